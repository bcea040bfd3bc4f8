"""The report of a diagnosis: one HTML page that holds its figures, to be sent as it is."""

import base64
import html
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.model_file import save_model
from rrr_oc.calibration.prediction_error import SIGNALS
from rrr_oc.diagnosis.diagnosis_file import to_json
from rrr_oc.diagnosis.held_out import intervals
from rrr_oc.diagnosis.procedure import Diagnosis
from rrr_oc.numerics.savitzky_golay import smooth
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.report.figures import save_figure
from rrr_oc.storage import write_json, write_text

FEW_TIMES, FEW_LEAST = 3.0, 0.2  # of the error within the fit, and NRMSE: beyond both, recordings left out are not foreseen
WIDE = 30.0  # ends of an axis over each other, from which its labels stand further apart
POINTS = 4000  # of a map, at most
COLOURS = {"before": "#c55a11", "after": "#1f6fb4"}
SIGNAL_NAMES = dict(zip(SIGNALS, ("position", "speed", "acceleration", "motor torque", "load torque"), strict=True))

STYLE = """body { font: 16px/1.55 system-ui, sans-serif; color: #222; max-width: 60em; margin: 2em auto; padding: 0 1.2em; }
h1 { font-size: 1.5em; margin-bottom: .2em; } h2 { font-size: 1.15em; margin-top: 2.2em; border-top: 1px solid #ddd; padding-top: .8em; }
.verdict { font-size: 1.1em; background: #eef4fa; border-left: 4px solid #1f6fb4; padding: .8em 1em; }
.wide { overflow-x: auto; } table { border-collapse: collapse; margin: .8em 0; font-size: .9em; }
td, th { border-bottom: 1px solid #ddd; padding: .35em .8em .35em 0; text-align: left; vertical-align: top; }
th { font-weight: 600; color: #555; } code { font-size: .95em; } img { max-width: 100%; } .small { color: #666; font-size: .88em; }"""


def write_diagnosis(diagnosis: Diagnosis, folder: Path, simulated: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Write model.json, the figures, report.html and, when all else is there, diagnosis.json.

    Args:
        simulated: What `in_closed_loop` returns; None leaves that part out.

    Returns:
        The content of diagnosis.json: the contract's, with "bootstrap" (`before_after.intervals`), "alone" and "simulated".
    """
    found = {**to_json(diagnosis), "bootstrap": intervals(diagnosis), "alone": _alone(diagnosis)}
    if simulated is not None:
        found["simulated"] = dict(simulated)
    save_model(diagnosis.model, folder / "model.json")
    figures = {"before_after": save_figure(_bars(found), folder / "before_after.png")}
    figures["prediction"] = save_figure(_prediction(diagnosis), folder / "prediction.png")
    for j, joint in enumerate(diagnosis.model.joints):
        name = re.sub(r"[^\w.-]", "_", joint)  # a joint may be called what a file may not
        figures[f"residual_{joint}"] = save_figure(_maps(diagnosis, j), folder / f"residual_{name}.png")
    for suggestion, entry in zip(diagnosis.suggestions, found["suggested_recordings"], strict=True):
        header = ",".join(["t", *(f"q_{joint}" for joint in diagnosis.model.joints)])
        table = np.vstack([suggestion.t, suggestion.q]).T
        lines = [",".join(f"{value:.6f}" for value in row) for row in table]
        write_text(folder / entry["trajectory"], "\n".join([header, *lines]) + "\n")
    write_text(folder / "report.html", page(found, about(diagnosis.recordings), figures))
    write_json(folder / "diagnosis.json", found)
    return found


def _alone(diagnosis: Diagnosis) -> list[str]:
    """Recordings held out whose set-up no recording shared that was fitted to, where something is present in some set-ups only."""
    every, result = diagnosis.recordings.recordings, []
    if diagnosis.way == "recordings" and any(term.groups for term in diagnosis.model.terms):
        for fold in diagnosis.folds:
            known = {r.group for k, r in enumerate(every) if k not in fold.held}
            result += [every[k].file for k in fold.held if every[k].group not in known]
    return sorted(result)


def about(recordings: RecordingSet) -> str:
    """What was diagnosed, in a sentence, and what is to be known of how it was read."""
    every, robot = recordings.recordings, recordings.robot
    seconds = sum(float(np.ptp(r.t)) for r in every)
    carrying, sprung = sum(bool(r.payload.any()) for r in every), sum(bool(r.springs) for r in every)
    return (
        f"Robot {robot.name}, {robot.n} joint{'s' * (robot.n > 1)} ({', '.join(robot.joints)}); {len(every)} "
        f"recording{'s' * (len(every) > 1)} of {seconds:.0f} s together, {carrying} with a payload, {sprung} with springs; "
        f"{recordings.torque} {'torque ' * (recordings.torque != 'current')}recorded."
        + "".join(f" {note[0].upper()}{note[1:]}." for note in recordings.notes)
    )


def page(found: Mapping[str, Any], subject: str, figures: Mapping[str, Path]) -> str:
    """The report as HTML, its figures inside."""
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'><title>Diagnosis</title>",
        f"<style>{STYLE}</style></head><body><h1>What the calibrated model lacks</h1><p class='small'>{html.escape(subject)}</p>",
        f"<p class='verdict'>{html.escape(sentence(found))}</p>",
        *_before_after(found, figures),
        *_added(found),
        *_where(found, figures),
        *_undecided(found),
        _reading(found),
    ]
    return "\n".join(parts) + "</body></html>\n"


def sentence(found: Mapping[str, Any]) -> str:
    """The verdict."""
    if found["verdict"] == "nothing_missing":
        poor = _unforeseen(found)
        few = f" But it predicts recordings left out of the fit badly ({poor}): these are too few or too short to show more."
        return "Nothing is missing: the calibrated model explains these recordings to their noise." + few * bool(poor)
    if not (found["effects"] or found["unexplained"]):
        names = " and ".join(m["joint"] for m in found["mismatch"] if m["significant"])
        return (
            f"Something is missing on {names}, where the error is far beyond the noise, and these recordings do not decide what: "
            "nothing that would explain it holds on recordings left out of the search."
        )
    names = _lacking(found)
    lacking = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
    ratios = {j: b["ratio"]["value"] for j, b in found["bootstrap"].items() if b["ratio"]["value"] is not None}
    gain = ""
    if ratios:
        joint = min(ratios, key=lambda j: ratios[j])
        before, after = (found["bootstrap"][joint][k]["value"] for k in ("before", "after"))
        left_out = "recordings" if found.get("held_out") != "blocks" else "blocks of the recording"
        gain = f" On {left_out} left out of the fit the error of {joint}'s torque goes from {before:.1%} to {after:.1%} of its spread."
    if found["verdict"] == "cannot_tell":
        return f"Something is missing, and these recordings do not decide what: {lacking}, or others that do as well.{gain}"
    rest = [f"{x:.0f} times the noise on {joint}" for joint, x in found.get("left_over", {}).items()]
    left = f" What is left is still {' and '.join(rest)}: more is missing, or of another shape." if rest else ""
    return f"The calibrated model lacks {lacking}.{gain}{left}"


def _unforeseen(found: Mapping[str, Any]) -> str:
    """The joints whose error on recordings left out of the fit is another than in it, with both."""
    inside, outside = (found["nrmse"][key]["before"] for key in ("calibration", "held_out"))
    poor = [j for j in inside if inside[j] and outside[j] and outside[j] > max(FEW_TIMES * inside[j], FEW_LEAST)]
    return ", ".join(f"{j}: NRMSE {outside[j]:.2g} against {inside[j]:.2g}" for j in poor)


def _lacking(found: Mapping[str, Any]) -> list[str]:
    """What was found and where, in a few words; what is another in each of several recordings, once."""
    named = [(_placed(e), e) for e in found["effects"]]
    named += [(f"a torque on {u['joint']} that depends on {' and '.join(u['depends_on'])}", u) for u in found["unexplained"]]
    files: dict[tuple[str, bool], set[str]] = {}
    for name, entry in named:
        files.setdefault((name, bool(_some(entry))), set()).update(_some(entry))
    return [name + f" in {len(there)} of the recordings" * some for (name, some), there in files.items()]


def _placed(e: Mapping[str, Any]) -> str:
    """An effect and where it is."""
    joint = e["joint"]
    where = "" if joint is None else f" of {joint if isinstance(joint, str) else ' and '.join(joint)}"
    return f"{e['effect'].replace('_', ' ')}{where}"


def _some(entry: Mapping[str, Any]) -> list[str]:
    """The recordings that have it, none if all do."""
    return [] if entry["recordings"] == "all" else entry["recordings"]


def _before_after(found: Mapping[str, Any], figures: Mapping[str, Path]) -> list[str]:
    whole = found["held_out"] == "recordings"
    what, unseen = (
        ("whole recordings", "that recording") if whole else ("blocks of the only recording", "the part that is shaded")
    )
    rows = [
        [joint, *(_with_interval(b[key]) for key in ("before", "after", "ratio"))] for joint, b in found["bootstrap"].items()
    ]
    parts = [
        "<h2>Before and after</h2>",
        f"<p>NRMSE of the torque predicted from the measured motion, held out: {what} that took part in no fit and no choice.</p>",
        _table(["joint", "before", "after", "after / before"], rows),
        *_foretold(found.get("alone", [])),
        _image(figures["before_after"], "error before and after"),
        *_simulated(found.get("simulated")),
        f"<p>Recorded and predicted torque where the plain model is worst, by models that did not see {unseen}:</p>",
        _image(figures["prediction"], "recorded and predicted torque"),
    ]
    return parts


def _foretold(alone: Sequence[str]) -> list[str]:
    if not alone:
        return []
    return [
        "<p>What only some set-ups have cannot be foretold for a recording whose set-up no other shares: they were predicted without "
        f"it, and may be predicted worse than by the plain model. So it is for {html.escape(', '.join(alone))}. A second "
        "recording of each would tell, with the same “group” in recordings.json.</p>"
    ]


def _simulated(simulated: Mapping[str, Any] | None) -> list[str]:
    if simulated is None:
        return []
    which = "held out as above" if simulated["held_out"] else "the only recording, not held out"
    parts = [f"<p>In closed loop: NRMSE while the MuJoCo twin tracks the recorded motion with its controllers ({which}), "
             "before → after.</p>"]  # fmt: skip
    before, after = simulated["before"], simulated["after"]
    for name, one in (("plain", before), ("extended", after)):
        if "why_not" in one:
            parts.append(f"<p>The {name} model was not simulated: {html.escape(one['why_not'])}.</p>")
    joints = next((list(one) for one in (before, after) if "why_not" not in one), [])
    rows = [[j, *(f"{_shown(_of(before, j, s))} → {_shown(_of(after, j, s))}" for s in SIGNALS)] for j in joints]
    return [*parts, _table(["joint", *SIGNAL_NAMES.values()], rows)] if rows else parts


def _of(errors: Mapping[str, Any], joint: str, signal: str) -> float | None:
    return errors.get(joint, {}).get(signal)


def _added(found: Mapping[str, Any]) -> list[str]:
    parts = []
    if found["effects"]:
        parts += ["<h2>What was added to the model</h2>", _table(
            ["effect", "joint", "recordings", "equation", "parameters", "share of error", "p", "as good on these data"],
            [_effect_row(e) for e in found["effects"]],
        )]  # fmt: skip
    if found["unexplained"]:
        rows = [
            [
                u["joint"],
                ", ".join(_some(u)) or "all",
                ", ".join(u["depends_on"]),
                f"{u['share_of_error']:.3f}",
                u["description"],
            ]
            for u in found["unexplained"]
        ]
        header = ["joint", "recordings", "depends on", "share of error", "what the model carries"]
        parts += ["<h2>Unexplained</h2>", _table(header, rows)]
    return parts


def _where(found: Mapping[str, Any], figures: Mapping[str, Path]) -> list[str]:
    header = ["joint", "more than noise", "p", "NRMSE", "held out", "where", "recordings"]
    return [
        "<h2>Where the plain model fails</h2>",
        _table(header, [_mismatch_row(m) for m in found["mismatch"]]),
        "<p>What is left of the torque, plain model above, extended model below; where there are no points nothing was recorded:</p>",
        *(_image(path, name) for name, path in figures.items() if name.startswith("residual_")),
    ]


def _undecided(found: Mapping[str, Any]) -> list[str]:
    open_between = [
        f"{_placed(e)} or {', '.join(e['indistinguishable_from'])}" for e in found["effects"] if e["indistinguishable_from"]
    ]
    if not open_between and not found["suggested_recordings"]:
        return []
    rows = [[", ".join(s["separates"]), s["why"], s["trajectory"]] for s in found["suggested_recordings"]]
    return [
        "<h2>What these recordings do not decide</h2>",
        *(f"<p>{html.escape(line.replace('_', ' '))}</p>" for line in open_between),
        *(
            ["<p>To record next:</p>", _table(["to tell apart", "why", "trajectory (CSV beside this page)"], rows)]
            if rows
            else []
        ),
    ]


def _reading(found: Mapping[str, Any]) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in found["versions"].items())
    return (
        "<h2>How to read this</h2><p class='small'>NRMSE: root mean square error over the recorded signal's standard deviation, both "
        "smoothed over 0.15 s. Brackets: 95 % bootstrap intervals over recordings, or over blocks of an "
        "only one; of fewer than three there are none. “Plain”: dry friction, "
        "viscous friction and armature of every joint, calibrated; “extended”: with what was added, everything calibrated "
        "anew. Share of error: fall of the held-out squared residual with the effect. As good: explains these recordings as well, "
        f"within the noise. {html.escape(versions)}.</p>"
    )


def _image(path: Path, alt: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return f"<p><img src='data:image/png;base64,{data}' alt='{html.escape(alt)}'></p>"


def _with_interval(entry: Mapping[str, Any]) -> str:
    value, interval = entry["value"], entry["interval"]
    if value is None or interval is None or None in interval:
        return _shown(value)
    return f"{value:.4f} [{interval[0]:.4f}, {interval[1]:.4f}]"


def _bars(found: Mapping[str, Any]) -> Any:
    """Held-out error of each joint with its interval, before and after, and of the simulated torques where there are any."""
    joints, simulated = list(found["bootstrap"]), found.get("simulated")
    panels = [("predicted from the motion", None)]
    panels += [(f"in closed loop: {SIGNAL_NAMES[s]}", s) for s in ("tau_motor", "tau_load") if simulated is not None]
    figure, axes = plt.subplots(
        1,
        len(panels),
        figsize=(3.9 * len(panels), 0.42 * len(joints) + 1.5),
        layout="constrained",
        squeeze=False,
        sharey=True,
        sharex=True,
    )
    rows = np.arange(len(joints))[::-1]
    for axis, (title, signal) in zip(axes[0], panels, strict=True):
        for key, shift in (("before", 0.12), ("after", -0.12)):
            for row, joint in zip(rows + shift, joints, strict=True):
                entry = found["bootstrap"][joint][key]
                if signal is not None:
                    entry = {"value": _of((simulated or {})[key], joint, signal), "interval": None}
                if entry["value"] is None:
                    continue
                if entry["interval"] is not None and None not in entry["interval"]:
                    axis.plot(entry["interval"], [row, row], color=COLOURS[key], lw=2)
                axis.plot(entry["value"], row, "o", ms=7, color=COLOURS[key], label=key if row > rows[0] - 0.5 else None)
        axis.set_xscale("log")
        low, high = axis.get_xlim()
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < WIDE * low else (1,)))
        axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.set_yticks(rows, joints)
        axis.set_ylim(-0.6, len(joints) - 0.4)
        axis.grid(alpha=0.3, axis="x")
        axis.set_title(title, fontsize=10, loc="left")
        axis.set_xlabel("NRMSE")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=8, loc="outside upper right", ncols=2)
    return figure


def _prediction(diagnosis: Diagnosis) -> Any:
    """Torque of each joint in the recording that the plain model predicts worst, and what both models make of it, held out."""
    fold, k = max(
        ((f, k) for f in diagnosis.folds for k in range(len(f.held))), key=lambda one: np.nanmax([-1.0, *one[0].before[one[1]]])
    )
    r = diagnosis.recordings.recordings[fold.held[k] if diagnosis.way == "recordings" else 0]
    recorded, joints = diagnosis.recordings.output_torque(r), diagnosis.model.joints
    figure, axes = plt.subplots(
        len(joints), 1, figsize=(11, 1.7 * len(joints) + 0.6), layout="constrained", squeeze=False, sharex=True
    )
    curves = [
        ("recorded", recorded, "0.8", 4.5),
        ("plain model", fold.plain.predicted_torque(r), COLOURS["before"], 1.2),
        ("extended model", fold.model.predicted_torque(r), COLOURS["after"], 1.2),
    ]
    for j, axis in enumerate(axes[:, 0]):
        for name, values, colour, width in curves:
            axis.plot(r.t - r.t[0], smooth(r.t, values[j : j + 1], r.segments)[0], color=colour, lw=width, label=name)
        if diagnosis.way == "blocks":
            part = np.array_split(r.t - r.t[0], len(fold.before) * len(diagnosis.folds))[fold.held[k]]
            axis.axvspan(part[0], part[-1], color="0.93")
        axis.set_ylabel(f"{joints[j]} [Nm]")
        axis.grid(alpha=0.3)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=8, ncols=3, loc="outside upper right")
    axes[0, 0].set_title(r.file, fontsize=10, loc="left")
    axes[-1, 0].set_xlabel("time [s]")
    return figure


def _effect_row(e: dict[str, Any]) -> list[str]:
    values = "; ".join(
        f"{k} = {_value(v)} {v['unit'] if v['unit'] != '1' else ''}".rstrip() for k, v in e["parameters"].items()
    )
    joint = e["joint"] or "arm"
    return [
        e["effect"],
        joint if isinstance(joint, str) else ", ".join(joint),
        ", ".join(_some(e)) or "all",
        e["equation"],
        values,
        f"{e['share_of_error']:.3f}",
        _chance(e["p_value"]),
        ", ".join(e["indistinguishable_from"]) or "nothing",
    ]


def _value(entry: dict[str, Any]) -> str:
    value, std = entry["value"], entry["std"]
    if isinstance(value, float):
        return f"{value:.4g}" + (f" ± {std:.2g}" if isinstance(std, float) else "")
    return str(np.round(value, 5).tolist()) if isinstance(value, list) and not isinstance(value[0], str) else str(value)


def _mismatch_row(m: dict[str, Any]) -> list[str]:
    where = "; ".join(
        f"{w['variable']} in {w['range'][0]:.3g} … {w['range'][1]:.3g} {w['unit']}: {w['share_of_error']:.0%} of the error in "
        f"{w['share_of_time']:.0%} of the time"
        for w in m["where"]
    )
    return [
        m["joint"], "yes" if m["significant"] else "no", _chance(m["p_value"]),
        _shown(m["nrmse"]["calibration"]), _shown(m["nrmse"]["held_out"]), where, ", ".join(m["recordings"]),
    ]  # fmt: skip


def _chance(p: float) -> str:
    return f"{p:.1g}" if p > 1e-16 else "< 1e-16"


def _table(header: list[str], rows: list[list[str]]) -> str:
    head = "".join(f"<th>{html.escape(h)}</th>" for h in header)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(str(c))}</td>" for c in row) + "</tr>" for row in rows)
    return f"<div class='wide'><table><tr>{head}</tr>{body}</table></div>"


def _shown(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"


def _maps(diagnosis: Diagnosis, j: int) -> Any:
    """Residual of one joint over position and speed, load and speed, and time: before in the first row, after in the second."""
    joint, recordings = diagnosis.model.joints[j], diagnosis.recordings
    figure, axes = plt.subplots(2, 3, figsize=(13, 6.5), layout="constrained")
    data = [_points(model, recordings, j) for model in (diagnosis.plain, diagnosis.model)]
    limit = max(float(np.quantile(np.abs(data[0]["residual"]), 0.98)), 1e-9)
    for row, points, name in zip(axes, data, ("plain model", "extended model"), strict=True):
        colours = {"c": points["residual"], "s": 3, "cmap": "coolwarm", "vmin": -limit, "vmax": limit, "rasterized": True}
        row[0].scatter(points["q"], points["dq"], **colours)
        row[0].set(xlabel="position [rad]", ylabel="speed [rad/s]")
        shown = row[1].scatter(points["load"], points["dq"], **colours)
        row[1].set(xlabel="load torque [Nm]", ylabel="speed [rad/s]")
        row[2].scatter(points["time"], points["residual"], s=3, color="0.35", rasterized=True)
        row[2].set(xlabel="time since start [s]", ylabel="residual [Nm]", ylim=(-2 * limit, 2 * limit))
        row[0].set_title(f"{joint}, {name}", loc="left", fontsize=10)
        figure.colorbar(shown, ax=row[1], label="residual [Nm]")
    return figure


def _points(model: CalibratedModel, recordings: RecordingSet, j: int) -> dict[str, np.ndarray]:
    parts: dict[str, list[np.ndarray]] = {}
    for r in recordings.recordings:
        residual = recordings.output_torque(r) - model.predicted_torque(r)
        values = {
            "q": r.q[j],
            "dq": r.dq[j],
            "load": model.torques(r)[1][j],
            "time": r.t - r.t[0],
            "residual": smooth(r.t, residual[j : j + 1], r.segments)[0],
        }
        for key, value in values.items():
            parts.setdefault(key, []).append(value)
    whole = {key: np.concatenate(value) for key, value in parts.items()}
    step = max(1, len(whole["q"]) // POINTS)
    return {key: value[::step] for key, value in whole.items()}

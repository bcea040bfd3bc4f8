"""The page of a diagnosis, made from its saved files alone: diagnosis.json, model.json, and the data of its figures."""

import json
import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.calibration.prediction_error import SIGNALS
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile
from rrr_oc.effects.words import joint_words, rounded
from rrr_oc.report import diagnosis_words as say
from rrr_oc.report.pages.diagnosis_claims import claims, covered, record_next, remaining, small
from rrr_oc.report.pages.diagnosis_curves import LEFT, PREDICTED, Curves
from rrr_oc.report.pages.diagnosis_model import model_numbers
from rrr_oc.report.pages.page import ALL, Curve, Figure, columns, joined, key, render
from rrr_oc.report.tables import NONE
from rrr_oc.schema import with_nan
from rrr_oc.storage import write_text

SIGNAL_NAMES: dict[str, str] = dict(
    zip(SIGNALS, ("position", "speed", "acceleration", "motor torque", "load torque"), strict=True)
)
FIGURES = "figures.npz"  # what `diagnosis_curves.curves` returns, with "subject" and "command"
WIDE = 30.0  # ratio of errors from which only powers of ten are on the axis
MODELS = {"before": "plain model", "after": "extended model"}
ERROR = "error [% of the standard deviation]"  # of a figure's axis
BY = ("recording", "joint")
PATCHES = "Patches of one colour are torque that the model does not explain; an even mixture of pale colours is noise."
DRIFT = "A drift or a step is torque that depends on time or on the recording, not on the motion alone."


def write_diagnosis_page(folder: Path, found: Mapping[str, Any] | None = None) -> Path:
    """Write report.html from figures.npz, diagnosis.json and model.json in a folder; nothing is fitted.

    Args:
        found: The content of diagnosis.json, where that is not written yet.

    Raises:
        UserError: The page cannot be written.
    """
    content = with_nan(_json(folder / "diagnosis.json") if found is None else found, DiagnosisFile)
    with np.load(folder / FIGURES) as file:
        curves = {name: file[name] for name in file.files}
    write_text(folder / "report.html", diagnosis_page(content, curves, _json(folder / "model.json")))
    return folder / "report.html"


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def diagnosis_page(found: Mapping[str, Any], curves: Curves, model: Mapping[str, Any]) -> str:
    """The page as HTML, from the content of diagnosis.json, figures.npz and model.json."""
    joints = curves["joints"].tolist()
    figures, data = _figures(found, curves)
    return render(
        "diagnosis.html",
        figures,
        data,
        found={"alone": [], "simulated": None, "priors_file": None, **found},
        subject=str(curves["subject"]),
        command=str(curves["command"]),
        verdict=say.sentence(found),
        recordings=[(str(k), file) for k, file in enumerate(curves["files"].tolist())],
        joints=[(str(j), joint_words(joint)) for j, joint in enumerate(joints)],
        first=_first_shown(found, curves, joints),
        everything=ALL,
        same=_same(found),
        errors=_error_rows(found),
        numbers=model_numbers(model),
        extrapolated=say.extrapolated(found),
        signals=list(SIGNAL_NAMES.values()),
        simulated=_simulated_rows(found.get("simulated")),
        claims=claims(found, curves["files"].tolist()),
        remaining=say.unsaid(remaining(found), say.sentence(found)) or ["Nothing beyond what is said above."],
        anatomy=say.anatomy(found),
        small=small(found),
        small_said=say.SMALL,
        mismatch=[_mismatch_row(m) for m in found["mismatch"]],
        not_claimed=say.unsaid(
            [*say.undecided(found), *say.off_links(found), *say.measured(found), *say.not_claimed(found), *say.not_made(found)],
            say.sentence(found),
        ),
        next=record_next(found),
        covered=covered(joints, _motions(curves)),
        suggestions=[[say.told_apart(found, s["separates"]), s["why"], s["trajectory"]] for s in found["suggested_recordings"]],
    )


def _first_shown(found: Mapping[str, Any], curves: Curves, joints: Sequence[str]) -> tuple[str, str]:
    """Numbers of the recording and of the joint that are shown at first: the joint of the first claim, where its error falls most; without
    a claim what the plain model predicts worst."""
    claimed = [*say.missing(found), *found["unexplained"]]
    if not claimed:
        worst = max(range(len(joints)), key=lambda j: found["bootstrap"][joints[j]]["before"]["value"] or 0.0)
        return str(curves["worst"]), str(worst)
    j = joints.index(claimed[0]["lowers_error"]["joint"])
    falls = curves["missed"][:, j, 0] - curves["missed"][:, j, 1]
    return str(int(np.argmax(np.nan_to_num(falls, nan=-np.inf)))), str(j)


def _motions(curves: Curves) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Angles and speeds of all recordings by joint."""
    result = {}
    for j, joint in enumerate(curves["joints"].tolist()):
        every = np.concatenate([curves[f"left {k} {j}"] for k in range(len(curves["files"]))], axis=1)
        result[joint] = every[LEFT.index("q")], every[LEFT.index("dq")]
    return result


def _figures(found: Mapping[str, Any], curves: Curves) -> tuple[list[Figure], dict[str, dict[str, Any]]]:
    """The figures of the page, and their data."""
    count, joints = len(curves["files"]), curves["joints"].tolist()
    errors, figures = _errors(found)
    pairs = [(k, j) for k in range(count) for j in range(len(joints))]
    predicted = {
        (k, j): dict(zip(PREDICTED, curves[f"predicted {k} {j}"], strict=True))
        for k, j in pairs
        if f"predicted {k} {j}" in curves
    }
    left = {(k, j): dict(zip(LEFT, curves[f"left {k} {j}"], strict=True)) for k, j in pairs}
    for j in range(len(joints)):
        ends = np.concatenate([left[k, j]["residual_before"] for k in range(count)])
        end = max(float(np.nanquantile(np.abs(ends), 0.98)), 1e-9)
        for k in range(count):
            left[k, j]["limit"] = np.array([end])
    data = {
        "predicted": {key(*pair): columns(c) for pair, c in predicted.items()},
        "left": {key(*pair): columns(c) for pair, c in left.items()}
        | {key(ALL, j): joined([key(k, j) for k in range(count)]) for j in range(len(joints))},
        **errors,
    }
    return [*figures, _prediction(predicted, curves["missed"]), *_maps(curves["remains"], curves["samples"])], data


def _errors(found: Mapping[str, Any]) -> tuple[dict[str, dict[str, Any]], list[Figure]]:
    """Held-out errors before and after: of the prediction, and of the simulated torques where there are any."""
    joints, simulated, data, figures = list(found["bootstrap"]), found.get("simulated"), {}, []
    models = {"before": MODELS["before"]} if _same(found) else MODELS
    panels: list[tuple[str, str, str | None]] = [("errors", "Predicted from the motion", None)]
    if simulated is not None and any("why_not" not in simulated[k] for k in MODELS):
        panels += [(s, f"In closed loop: {SIGNAL_NAMES[s]}", s) for s in ("tau_motor", "tau_load")]
    for name, title, signal in panels:
        table: dict[str, list[Any]] = {
            "joint": [escape(joint_words(joint), quote=False) for joint in joints]
        }  # plotly reads tags
        for k in models:
            entries = [found["bootstrap"][joint][k] for joint in joints]
            if signal is not None:
                entries = [{"value": (simulated or {})[k].get(joint, {}).get(signal), "interval": None} for joint in joints]
            bars = [
                _percents(e["interval"] if e["interval"] and None not in e["interval"] else [e["value"]] * 2) for e in entries
            ]
            table[k] = _percents([e["value"] for e in entries])
            for side, sign, i in (("below", -1, 0), ("above", 1, 1)):
                table[f"{k}_{side}"] = [
                    0.0 if v is None else max(sign * (bar[i] - v), 0.0) for v, bar in zip(table[k], bars, strict=True)
                ]
        dots = tuple(
            Curve(k, "joint", k, words, "markers", 10, bars=(f"{k}_below", f"{k}_above")) for k, words in models.items()
        )
        layout = {
            "xaxis": {"type": "log", "tickvals": _ticks(table), "ticktext": [f"{x:g}" for x in _ticks(table)]},
            "yaxis": {"type": "category", "autorange": "reversed"},
            "height": 130 + 34 * len(joints),
        }
        data[name] = {"": table}
        what = (
            "A dot further left is a smaller error; a line is its 95 % interval." if signal is None else _in_closed_loop(signal)
        )
        figures.append(Figure(name, title, name, (), (ERROR, ""), dots, {"": what}, layout))
    return data, figures


def _ticks(table: Mapping[str, Sequence[Any]]) -> list[float]:
    """Where an axis of these errors has numbers: at powers of ten if the errors are far apart, else closer, so that two are between them."""
    ends = [
        end
        for k in MODELS
        if k in table
        for v, below, above in zip(table[k], table[f"{k}_below"], table[f"{k}_above"], strict=True)
        for end in ((v - below, v + above) if v else ())
    ]
    positive = [end for end in ends if end > 0] or [1.0]
    low, high = min(positive), max(positive)
    decades = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 2)
    for steps in ((1,), (1, 2, 5), range(1, 10)):
        ticks = [float(f"{m}e{d}") for d in decades for m in steps]
        if high > WIDE * low or (len(steps) > 1 and sum(low <= tick <= high for tick in ticks) > 1):
            return ticks
    return sorted({float(f"{value:.2g}") for value in (low, high)})


def _in_closed_loop(signal: str) -> str:
    return f"The error of the {SIGNAL_NAMES[signal]} while the MuJoCo model tracks the recorded motion with its controllers."


def _prediction(predicted: Mapping[tuple[int, int], Curves], missed: np.ndarray) -> Figure:
    """Torques over time; `missed` is the rms of what each model misses [Nm], (recordings, n, 2)."""
    shown = (
        Curve("t", "recorded", "recorded", "recorded", width=5),
        Curve("t", "before", "before", MODELS["before"], width=1.5),
        Curve("t", "after", "after", MODELS["after"], width=1.5),
    )
    captions = {
        key(k, j): f"The closer a curve lies to the grey one, the better. {_missed(*missed[k, j])}" for k, j in predicted
    }
    return Figure("prediction", "Recorded and predicted torque", "predicted", BY, ("time [s]", "torque [Nm]"), shown, captions)


def _missed(before: float, after: float) -> str:
    if before == after:
        return f"Both models are the same here; they miss the torque by {before:.3g} Nm rms."
    return f"The plain model misses the torque by {before:.3g} Nm rms, the extended model by {after:.3g} Nm rms."


def _maps(remains: np.ndarray, samples: np.ndarray) -> list[Figure]:
    """What is left of a joint's torque over position, load and time, with the plain and, if that is another, with the extended model.

    Args:
        remains: Its rms [Nm], (recordings, n, 2).
        samples: Of each recording.
    """
    figures, (count, n, _) = [], remains.shape
    whole = np.sqrt(np.average(remains**2, axis=0, weights=samples))
    different = not np.array_equal(remains[..., 0], remains[..., 1])
    for i, (model, words) in enumerate(list(MODELS.items())[: 1 + different]):
        residual = f"residual_{model}"
        sizes = {key(k, j): remains[k, j, i] for k in range(count) for j in range(n)}
        sizes |= {key(ALL, j): whole[j, i] for j in range(n)}
        for name, over, axes, curve, see in (
            ("position", "over position and speed", ("position [rad]", "speed [rad/s]"), _cloud("q", residual), PATCHES),
            ("load", "over load and speed", ("load torque [Nm]", "speed [rad/s]"), _cloud(f"load_{model}", residual), PATCHES),
            ("time", "over time", ("time since start [s]", "residual [Nm]"), Curve("t", residual, model, "", "markers", 3), DRIFT),
        ):  # fmt: skip
            captions = {k: f"{size:.3g} Nm rms are left. {see}" for k, size in sizes.items()}
            title, limit = f"{words.capitalize()}, {over}", "limit" if curve.colour else ""
            figures.append(Figure(f"{name}_{model}", title, "left", ("shown", "joint"), axes, (curve,), captions, limit=limit))
    return figures


def _cloud(x: str, residual: str) -> Curve:
    return Curve(x, "dq", mode="markers", width=4, colour=residual)


def _simulated_rows(simulated: Mapping[str, Any] | None) -> list[list[str]]:
    """By joint, its errors in closed loop before → after, or both where they are equal; no rows where neither model was simulated."""
    if simulated is None:
        return []
    before, after = simulated["before"], simulated["after"]
    joints = next((list(one) for one in (before, after) if "why_not" not in one), [])

    def cell(joint: str, signal: str) -> str:
        shown = [_shown(errors.get(joint, {}).get(signal)) for errors in (before, after)]
        return " → ".join(dict.fromkeys(shown))

    return [[joint_words(joint), *(cell(joint, signal) for signal in SIGNALS)] for joint in joints]


def _same(found: Mapping[str, Any]) -> bool:
    """Whether the extended model predicts as the plain one, so that it is not shown beside it."""
    return all(b["before"] == b["after"] for b in found["bootstrap"].values())


def _error_rows(found: Mapping[str, Any]) -> list[list[str]]:
    """By joint, its held-out error; where the models differ also that of the extended one, and their ratio."""
    shown = ("before",) if _same(found) else tuple(MODELS)
    rows = [
        [joint_words(joint), *(say.error(b[k]) if b[k]["value"] is not None else NONE for k in shown)]
        for joint, b in found["bootstrap"].items()
    ]
    if len(shown) > 1:
        for row, b in zip(rows, found["bootstrap"].values(), strict=True):
            row.append(_ratio(b["ratio"]))
    return rows


def _ratio(entry: Mapping[str, Any]) -> str:
    value, interval = entry["value"], entry["interval"]
    if value is None or interval is None or None in interval:
        return NONE if value is None else f"{value:.3f}"
    return f"{value:.3f} (95 %: {interval[0]:.3f} to {interval[1]:.3f})"


def _percents(values: Sequence[float | None]) -> list[Any]:
    return [None if v is None else 100 * v for v in values]


def _mismatch_row(m: dict[str, Any]) -> list[str]:
    where = "; ".join(say.place(w) for w in m["where"])
    return [
        joint_words(m["joint"]), "yes" if m["significant"] else "no", _shown(m["nrmse"]["calibration"]),
        _shown(m["nrmse"]["held_out"]), where, ", ".join(m["recordings"]),
    ]  # fmt: skip


def _shown(value: float | None) -> str:
    """An error as a share of the signal's standard deviation."""
    return NONE if value is None else f"{rounded(100 * value)} %"

"""The report of a diagnosis: one HTML page with tables, and maps of the residual before and after."""

import html
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from rrr_oc.calibrated import CalibratedModel, save_model
from rrr_oc.diagnosis import Diagnosis, to_json
from rrr_oc.figures import save_figure
from rrr_oc.files import write_json, write_text
from rrr_oc.recordings import RecordingSet
from rrr_oc.savitzky_golay import smooth

POINTS = 4000  # of a map, at most

STYLE = """body { font: 15px/1.5 sans-serif; max-width: 62em; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; margin: 1em 0; } td, th { border-bottom: 1px solid #ccc; padding: .3em .8em; text-align: left; }
img { max-width: 100%; }"""


def write_diagnosis(diagnosis: Diagnosis, folder: Path) -> None:
    """Write model.json, the figures, report.html and, when all else is there, diagnosis.json."""
    found = to_json(diagnosis)
    save_model(diagnosis.model, folder / "model.json")
    figures = [
        save_figure(_maps(diagnosis, j), folder / f"residual_{joint}.png") for j, joint in enumerate(diagnosis.model.joints)
    ]
    for suggestion, entry in zip(diagnosis.suggestions, found["suggested_recordings"], strict=True):
        header = ",".join(["t", *(f"q_{joint}" for joint in diagnosis.model.joints)])
        table = np.vstack([suggestion.t, suggestion.q]).T
        lines = [",".join(f"{value:.6f}" for value in row) for row in table]
        write_text(folder / entry["trajectory"], "\n".join([header, *lines]) + "\n")
    write_text(folder / "report.html", page(found, [f.name for f in figures]))
    write_json(folder / "diagnosis.json", found)


def page(found: dict[str, Any], figures: list[str]) -> str:
    """The report as HTML."""
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'><title>Diagnosis</title>",
        f"<style>{STYLE}</style></head><body><h1>Diagnosis</h1>",
        f"<p>Verdict: <b>{found['verdict'].replace('_', ' ')}</b>. Held out: {found['held_out']}.</p>",
    ]
    if found["effects"]:
        parts += ["<h2>Effects added to the model</h2>", _table(
            ["effect", "joint", "recordings", "equation", "parameters", "share of error", "p", "as good on these data"],
            [_effect_row(e) for e in found["effects"]],
        )]  # fmt: skip
    if found["unexplained"]:
        rows = [
            [u["joint"], ", ".join(u["depends_on"]), f"{u['share_of_error']:.3f}", u["description"]]
            for u in found["unexplained"]
        ]
        parts += ["<h2>Unexplained</h2>", _table(["joint", "depends on", "share of error", "what the model carries"], rows)]
    parts += ["<h2>Where the plain model fails</h2>", _table(
        ["joint", "significant", "p", "NRMSE", "NRMSE held out", "where", "recordings"], [_mismatch_row(m) for m in found["mismatch"]]
    )]  # fmt: skip
    rows = [
        [
            joint,
            *(_shown(found["nrmse"][way][when][joint]) for way in ("calibration", "held_out") for when in ("before", "after")),
        ]
        for joint in found["nrmse"]["held_out"]["before"]
    ]
    parts += ["<h2>NRMSE of the torque</h2>", _table(["joint", "before", "after", "held out, before", "held out, after"], rows)]
    if found["suggested_recordings"]:
        rows = [[", ".join(s["separates"]), s["why"], s["trajectory"]] for s in found["suggested_recordings"]]
        parts += ["<h2>Recordings that would decide</h2>", _table(["between", "why", "trajectory"], rows)]
    parts += ["<h2>Residual of the torque, plain model above, extended model below</h2>"]
    parts += [f"<p><img src='{html.escape(name)}' alt='residual'></p>" for name in figures]
    return "\n".join(parts) + "</body></html>\n"


def _effect_row(e: dict[str, Any]) -> list[str]:
    values = "; ".join(f"{k} = {_value(v)} {v['unit']}" for k, v in e["parameters"].items())
    joint = e["joint"] or "arm"
    return [
        e["effect"],
        joint if isinstance(joint, str) else ", ".join(joint),
        e["recordings"] if isinstance(e["recordings"], str) else ", ".join(e["recordings"]),
        e["equation"],
        values,
        f"{e['share_of_error']:.3f}",
        f"{e['p_value']:.1g}",
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
        m["joint"], "yes" if m["significant"] else "no", f"{m['p_value']:.1g}",
        _shown(m["nrmse"]["calibration"]), _shown(m["nrmse"]["held_out"]), where, ", ".join(m["recordings"]),
    ]  # fmt: skip


def _table(header: list[str], rows: list[list[str]]) -> str:
    head = "".join(f"<th>{html.escape(h)}</th>" for h in header)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(str(c))}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


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
        residual = recordings.output_torque(r) - model.output_torque(r)
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

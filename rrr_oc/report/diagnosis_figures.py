"""The figures of a diagnosis: errors before and after, predicted torque, maps of the residual."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.prediction_error import SIGNALS
from rrr_oc.diagnosis.procedure import Diagnosis
from rrr_oc.effects.words import joint_words
from rrr_oc.numerics.savitzky_golay import smooth
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.report.figures import plt

WIDE = 30.0  # ratio of an axis' ends from which only powers of ten are labelled
POINTS = 4000  # of a map, at most
COLOURS = {"before": "#c55a11", "after": "#1f6fb4"}
SIGNAL_NAMES = dict(zip(SIGNALS, ("position", "speed", "acceleration", "motor torque", "load torque"), strict=True))


def draw_errors(found: Mapping[str, Any]) -> Any:
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
                    entry = {"value": (simulated or {})[key].get(joint, {}).get(signal), "interval": None}
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
        axis.set_yticks(rows, [joint_words(joint) for joint in joints])
        axis.set_ylim(-0.6, len(joints) - 0.4)
        axis.grid(alpha=0.3, axis="x")
        axis.set_title(title, fontsize=10, loc="left")
        axis.set_xlabel("NRMSE")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=8, loc="outside upper right", ncols=2)
    return figure


def draw_prediction(diagnosis: Diagnosis) -> Any:
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
        axis.set_ylabel(f"{joint_words(joints[j])} [Nm]")
        axis.grid(alpha=0.3)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=8, ncols=3, loc="outside upper right")
    axes[0, 0].set_title(r.file, fontsize=10, loc="left")
    axes[-1, 0].set_xlabel("time [s]")
    return figure


def draw_residuals(diagnosis: Diagnosis, j: int) -> Any:
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
        row[0].set_title(f"{joint_words(joint)}, {name}", loc="left", fontsize=10)
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

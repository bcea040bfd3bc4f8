"""The figures of a diagnosis as files: errors before and after, and predicted torque."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from rrr_oc.effects.words import joint_words
from rrr_oc.report.figures import plt
from rrr_oc.report.pages.diagnosis_curves import PREDICTED, Curves
from rrr_oc.report.pages.diagnosis_page import MODELS, SIGNAL_NAMES, WIDE

COLOURS = {"before": "#c55a11", "after": "#1f6fb4"}


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


def draw_prediction(curves: Curves) -> Any:
    """Torque of each joint in the recording that the plain model predicts worst, and what both models make of it, held out."""
    joints, k = curves["joints"].tolist(), int(curves["worst"])
    figure, axes = plt.subplots(
        len(joints), 1, figsize=(11, 1.7 * len(joints) + 0.6), layout="constrained", squeeze=False, sharex=True
    )
    styles = {"recorded": ("recorded", "0.8", 4.5)} | {name: (words, COLOURS[name], 1.2) for name, words in MODELS.items()}
    for j, axis in enumerate(axes[:, 0]):
        shown = dict(zip(PREDICTED, curves.get(f"predicted {k} {j}", ()), strict=False))
        for name, (words, colour, width) in styles.items():
            axis.plot(shown.get("t", []), shown.get(name, []), color=colour, lw=width, label=words)
        axis.set_ylabel(f"{joint_words(joints[j])} [Nm]")
        axis.grid(alpha=0.3)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=8, ncols=3, loc="outside upper right")
    axes[0, 0].set_title(str(curves["files"][k]), fontsize=10, loc="left")
    axes[-1, 0].set_xlabel("time [s]")
    return figure

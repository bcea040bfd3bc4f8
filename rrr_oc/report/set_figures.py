"""The figures of a study of a set of tasks, made from its saved files alone."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import LogFormatter

from rrr_oc.report.figures import COLOURS, FOOTER, plt, save_figure

MARKS = {
    "with_first": ("s", "springs of the first task"),
    "cost": ("o", "springs of the set"),
    "alone": ("D", "springs of its own"),
}


def draw_set(folder: Path) -> list[Path]:
    """Every figure of a run's folder; returns their paths."""
    summary = json.loads((folder / "summary.json").read_text())
    drawn = [save_figure(draw_tasks(summary), folder / "tasks.png")]
    if any(c["front"] for c in summary["configurations"].values()):
        drawn.append(save_figure(draw_front(summary), folder / "front.png"))
    if any(c["choice"] for c in summary["configurations"].values()):
        drawn.append(save_figure(draw_choice(summary), folder / "choice.png"))
    return drawn


def draw_tasks(summary: dict[str, Any]) -> Any:
    """The cost of each task with springs of its own, of the set, and of the first task; one panel a configuration with springs."""
    found = {name: c for name, c in summary["configurations"].items() if c["springs"]} or summary["configurations"]
    tasks = [t["name"] for t in summary["tasks"]]
    figure, axes = plt.subplots(
        1, len(found), figsize=(2.2 + 4.2 * len(found), 1.6 + 0.32 * len(tasks)), squeeze=False, sharey=True
    )
    y = np.arange(len(tasks))
    for axis, (name, c) in zip(axes[0], found.items(), strict=True):
        rows = {key: [c["tasks"][task][key] for task in tasks] for key in MARKS}
        every = np.array(list(rows.values()))
        axis.hlines(y, every.min(axis=0), every.max(axis=0), color="0.8", lw=2, zorder=1)
        for colour, (key, (mark, label)) in zip((COLOURS[1], COLOURS[0], COLOURS[2]), MARKS.items(), strict=True):
            axis.plot(rows[key], y, mark, color=colour, ms=6, mfc="none" if key == "alone" else colour, label=label)
        axis.set_xscale("log")
        for part in (axis.xaxis.set_major_formatter, axis.xaxis.set_minor_formatter):
            part(LogFormatter(labelOnlyBase=False, minor_thresholds=(1.5, 0.5)))
        axis.set_title(name, fontsize=10)
        axis.set_xlabel("{} [{}]".format(*summary["quantity"]))
        axis.grid(axis="x", which="both", color="0.92", lw=0.6)
    axes[0, 0].set_yticks(y, tasks)
    axes[0, 0].invert_yaxis()
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper center", ncols=3, fontsize=9, frameon=False, bbox_to_anchor=(0.5, 1.02))
    figure.tight_layout(rect=(0, 0, 1, 0.95))
    return figure


def draw_choice(summary: dict[str, Any]) -> Any:
    """The objective against the number of springs, without and with their price; one panel a configuration."""
    found = {name: c["choice"] for name, c in summary["configurations"].items() if c["choice"]}
    figure, axes = plt.subplots(1, len(found), figsize=(4.4 * len(found), 3.8), squeeze=False)
    what, unit = summary["quantity"]
    for axis, (name, choice) in zip(axes[0], found.items(), strict=True):
        points, best = choice["points"], choice["points"][choice["chosen"]]
        counts = [p["count"] for p in points]
        axis.plot(counts, [p["cost"] for p in points], "o-", color=COLOURS[0], lw=1.2, ms=5, label="without the price")
        label = f"with {choice['price']:g} a spring"
        axis.plot(counts, [p["priced"] for p in points], "s--", color=COLOURS[1], lw=1.2, ms=4, label=label)
        axis.plot(best["count"], best["priced"], "o", color=COLOURS[1], ms=12, mfc="none", label="chosen")
        axis.set_yscale("log")
        axis.set_xticks(range(choice["offered"] + 1))
        axis.set_title(name, fontsize=10)
        axis.set_xlabel("number of springs")
        axis.set_ylabel(f"{what} of the set [{unit}]")
        axis.grid(axis="y", which="both", color="0.92", lw=0.6)
        axis.legend(fontsize=8, frameon=False)
    figure.tight_layout()
    return figure


def draw_front(summary: dict[str, Any]) -> Any:
    """The cost of the first task against the objective of the set; one panel a configuration."""
    found = {name: c for name, c in summary["configurations"].items() if c["front"]}
    figure, axes = plt.subplots(1, len(found), figsize=(4.4 * len(found), 3.8), squeeze=False)
    what, unit = summary["quantity"]
    for axis, (name, c) in zip(axes[0], found.items(), strict=True):
        first, total, shares = ([p[key] for p in c["front"]] for key in ("first", "total", "share"))
        axis.plot(first, total, "o-", color=COLOURS[0], lw=1.2, ms=5)
        for x, y, share in zip(first, total, shares, strict=True):
            axis.annotate(f"{share:.2g}", (x, y), textcoords="offset points", xytext=(6, 4), **FOOTER)
        axis.set_title(name, fontsize=10)
        axis.set_xlabel(f"{what} of “{summary['tasks'][0]['name']}” [{unit}]")
        axis.set_ylabel(f"{what} of the set [{unit}]")
        axis.margins(0.12)
    figure.text(0.5, -0.02, "number: share of the objective that is the first task's alone", ha="center", **FOOTER)
    figure.tight_layout()
    return figure

"""The figures of a comparison of optimisers, made from its saved files alone."""

from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.codesign.task import PHASES
from rrr_oc.report.figures import COLOURS, FOOTER, plt, save_figure


def draw_comparison(folder: Path, summary: dict) -> list[Path]:
    """Figures of a comparison of ways: anytime curves, the trials, and Figure 5 from the motions in the folder."""
    drawn = [
        save_figure(draw_anytime(summary), folder / "anytime.png"),
        save_figure(draw_trials(summary), folder / "trials.png"),
    ]
    motions = {path.stem: dict(np.load(path)) for path in sorted((folder / "motions").glob("*.npz"))}
    if motions:
        drawn.append(save_figure(draw_figure_5(summary, motions), folder / "figure_5.png"))
    return drawn


def draw_figure_5(summary: dict, motions: dict[str, dict]) -> Any:
    """Load and spring torques over time, summed over the moving joints, of the best evolutionary trial and of the gradient optimum."""
    names = [n for n in summary["rest"] if any(m.startswith(f"{n} ") for m in motions)]
    columns = ("evolution", "gradient")
    figure, axes = plt.subplots(len(names), 2, figsize=(12, 2.3 * len(names)), squeeze=False, sharex=True)
    for row, name in zip(axes, names, strict=True):
        shown = [motions[f"{name} {c}"] for c in columns if f"{name} {c}" in motions]
        top = max(float((m["load"] + m["pea"] + m["bpea"]).max()) for m in shown)
        low = min(float(m["load"].min()) for m in shown)
        for axis, column in zip(row, columns, strict=True):
            axis.set_title(f"{name}: {column}", fontsize=10)
            axis.axhline(0, color="0.85", lw=0.8)
            axis.set_ylim(low - 0.05 * (top - low), top * 1.08)
            if f"{name} {column}" not in motions:
                continue
            m = motions[f"{name} {column}"]
            curves = (
                ("needed to move", m["load"] + m["pea"] + m["bpea"], "0.6", 1.0),
                ("PEA", m["pea"], COLOURS[2], 1.4),
                ("BPEA", m["bpea"], COLOURS[1], 1.4),
                ("load torque", m["load"], COLOURS[0], 1.8),
            )
            for label, values, colour, width in curves:
                if not np.any(values):
                    continue
                for i in range(len(PHASES)):
                    k = m["phase"] == i
                    axis.plot(m["t"][k], values[k], color=colour, lw=width, label=label if i == 0 else None)
            axis.axvline(m["t"][m["phase"] == 0][-1], color="0.7", lw=0.8, ls=":")
    for axis in axes[:, 0]:
        axis.set_ylabel("[Nm]")
    for axis in axes[-1]:
        axis.set_xlabel("time [s] (dotted: the payload is released)")
    for axis in axes.ravel()[::-1]:  # where all kinds of springs are
        if len(axis.get_legend_handles_labels()[1]) == max(len(a.get_legend_handles_labels()[1]) for a in axes.ravel()):
            axis.legend(fontsize=8, loc="upper right")
            break
    figure.tight_layout()
    return figure


def draw_trials(summary: dict) -> Any:
    """E1 of every run, way by way, relative to the best known of the experiment."""
    rest = summary["rest"]
    ways = {
        "evolution-engine": ("evolution in MuJoCo", COLOURS[1]),
        "evolution-analytic": ("evolution in the model", COLOURS[4]),
        "restricted": ("gradient, Akima: all local optima", COLOURS[2]),
        "multistart": ("gradient, Sobol: best", COLOURS[0]),
    }
    figure, axis = plt.subplots(figsize=(11, 4.5))
    for i, entry in enumerate(rest.values()):
        for j, (way, (label, colour)) in enumerate(ways.items()):
            if way not in entry:
                continue
            values = np.array(entry[way]["optima"] if way == "restricted" else entry[way]["E1"]) / entry["best_known"]
            x = i + 0.2 * (j - 1.5) + 0.05 * np.linspace(-1, 1, len(values))
            axis.plot(x, values, "o", ms=4, color=colour, alpha=0.75, label=label if i == 0 else None)
    axis.set_xticks(range(len(rest)), [f"{n}\n{e['best_known']:.4g}" for n, e in rest.items()])
    axis.set_yscale("log")
    axis.axhline(1.0, color="0.6", lw=0.8, ls=":")
    axis.set_ylabel("E1 / best known")
    axis.legend(fontsize=8)
    figure.text(0.5, -0.02, "below each experiment: the best known E1 [N²m²s]", ha="center", **FOOTER)
    figure.tight_layout()
    return figure


def draw_anytime(summary: dict) -> Any:
    """Best so far against processor time, each way's median and range, relative to the best known of the experiment."""
    rest = summary["rest"]
    rows = (len(rest) + 1) // 2
    figure, axes = plt.subplots(rows, min(2, len(rest)), figsize=(12, 3.0 * rows), squeeze=False)
    ways = {
        "evolution-engine": ("evolution in MuJoCo", COLOURS[1]),
        "evolution-analytic": ("evolution in the model", COLOURS[4]),
        "restricted": ("gradient, Akima", COLOURS[2]),
        "multistart": ("gradient, Sobol", COLOURS[0]),
        "cma-ipopt": ("gradient, CMA-ES", COLOURS[3]),
    }
    for axis, (name, entry) in zip(axes.ravel(), rest.items(), strict=False):
        for way, (label, colour) in ways.items():
            if way not in entry:
                continue
            curve = {k: np.array(v) for k, v in entry[way]["curve"].items()}
            shown = {k: curve[k] / entry["best_known"] for k in ("least", "median", "largest")}
            axis.plot(curve["core_s"], shown["median"], color=colour, lw=1.6, label=label)
            axis.fill_between(curve["core_s"], shown["least"], shown["largest"], color=colour, alpha=0.15, lw=0)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_ylim(0.9, 60)
        axis.axhline(1.0, color="0.6", lw=0.8, ls=":")
        axis.set_title(f"{name}: best known E1 = {entry['best_known']:.4g} N²m²s", fontsize=10)
        axis.set_xlabel("processor time [s]")
    for axis in axes[:, 0]:
        axis.set_ylabel("E1 / best known")
    for axis in axes.ravel()[len(rest) :]:
        axis.axis("off")
    axes[0, 0].legend(fontsize=8)
    note = "line: median over trials, band: from best to worst; the gradient's curves are on the coarse mesh until their last point"
    figure.text(0.5, -0.01, note, ha="center", **FOOTER)
    figure.tight_layout()
    return figure

"""Pictures of effects: the change of the motor torque along the example's motion, and over the variable that it follows."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from docs.from_code.examples import Example, followed
from rrr_oc.report.figures import plt

TEXT = "#0a0b0c"  # stands for the colour of the page's text, light or dark
COLOURS = ("#3b86c8", "#e07b28", "#56a35a", "#a06fc9")  # legible on white and on black
AXES = {
    "q": ("position of joint {}", "°", 180 / np.pi),
    "dq": ("speed of joint {}", "°/s", 180 / np.pi),
    "ddq": ("acceleration of joint {}", "°/s²", 180 / np.pi),
    "load": ("load torque of joint {}", "Nm", 1.0),
}


def svg(of: Example) -> str:
    """The picture of an example as an element of a page, in the page's own colour of text."""
    look: Any = {
        "svg.fonttype": "none",  # text stays text
        "svg.hashsalt": of.effect.name,  # the same picture has the same text, and pictures of one page differ in their ids
        "font.family": "sans-serif",
        "font.size": 9.5,
        **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), TEXT),
    }
    with plt.rc_context(look):
        figure, text = draw(of), io.StringIO()
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
        plt.close(figure)
    drawn = text.getvalue()
    return drawn[drawn.index("<svg") :].replace(TEXT, "currentColor").replace("\n", " ").strip()


def draw(of: Example) -> Any:
    """The change of the motor torque over time and, where it follows a variable, over that."""
    variable = followed(of)
    wide = [3, 2] if variable else [1]
    figure, axes = plt.subplots(
        1, 1 + bool(variable), figsize=(9.2, 2.9), layout="constrained", squeeze=False, sharey=True, width_ratios=wide
    )
    over_time, r = axes[0, 0], of.recording
    labels = _labels(of)
    for curve, colour, label in zip(of.curves, COLOURS, labels, strict=False):
        over_time.plot(r.t, curve.change[of.joint], color=colour, lw=1.5, label=label)
    if len(of.curves) == 1:
        for j, colour in zip(_others(of), COLOURS[1:], strict=False):
            over_time.plot(r.t, of.curves[0].change[j], color=colour, lw=1.1, label=f"joint {j + 1}")
    if variable:
        kind, j = variable
        name, unit, factor = AXES[kind]
        x = factor * (of.load if kind == "load" else getattr(r, kind))[j]
        for curve, colour in zip(of.curves, COLOURS, strict=False):
            axes[0, 1].plot(x, curve.change[of.joint], color=colour, lw=0.9)
        axes[0, 1].set_xlabel(f"{name.format(j + 1)} [{unit}]")
    over_time.set_xlabel("time [s]")
    over_time.set_ylabel(
        "change of torque [Nm]" if _others(of) and len(of.curves) == 1 else f"change of torque,\njoint {of.joint + 1} [Nm]"
    )
    for axis in axes[0]:
        axis.grid(alpha=0.25)
        axis.axhline(0, color=TEXT, lw=0.6, alpha=0.5)
        axis.spines[["top", "right"]].set_visible(False)
    if labels[0] or len(over_time.lines) > 2:
        figure.legend(*over_time.get_legend_handles_labels(), loc="outside upper left", ncols=4, frameon=False)
    return figure


def _others(of: Example) -> list[int]:
    """Further joints whose torque changes by a tenth of the largest change, or more."""
    sizes = np.sqrt(np.mean(of.curves[0].change ** 2, axis=1))
    return [j for j in np.argsort(sizes)[::-1].tolist() if j != of.joint and sizes[j] > 0.1 * sizes[of.joint]]


def _labels(of: Example) -> Sequence[str]:
    """What differs between the curves; of a single one its joint, where others stand beside it."""
    if len(of.curves) == 1:
        return [f"joint {of.joint + 1}" if _others(of) else ""]
    units = {p.name: p.unit for p in of.effect.parameters}
    differ = [name for name in units if len({round(c.theta[name], 9) for c in of.curves}) > 1]
    every = []
    for curve in of.curves:
        parts = [
            f"{name.replace('_', ' ')} {curve.theta[name]:.3g} {units[name]}".removesuffix(" 1")
            for name in differ
            if curve.theta[name] or len(differ) == 1
        ]
        every.append(", ".join(parts))
    return every

"""Figures as small data, which both matplotlib, for files, and the script of the pages draw.

A `Figure` names columns of numbers, and how they are shown; neither knows of a library. `draw` puts figures side by side in a picture.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from rrr_oc.storage import new_file

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.ticker import FixedLocator, FuncFormatter, LogFormatter, MaxNLocator, NullLocator

COLOURS = ("#1f4e79", "#c55a11", "#548235", "#7030a0", "#7f6000", "#833c0b", "#385723")
FOOTER = {"fontsize": 8, "color": "0.35"}  # text properties of notes
# Colours by role, those of the pages on white: the first of each in the style sheet
ROLES = dict(reversed(re.findall(r"--(\w+): (#\w+)", (files("rrr_oc.report") / "templates" / "style.css").read_text())))
DASHES = {"solid": "-", "dash": "--", "dot": ":"}
SYMBOLS = {"circle": "o", "square": "s", "diamond": "D", "star": "*"}
PICTURES = 9  # of what moves, in a file
SEPARATOR = "|"  # between the choices in a key of the data; they are numbers or names of configurations, which do not have it
Columns = Mapping[str, Any]  # numbers or texts by name


@dataclass(frozen=True)
class Curve:
    """One curve or cloud of a figure.

    Attributes:
        x, y: Names of columns of the data; where one is missing, the curve is not drawn.
        role: Name of the style sheet's colour.
        name: In the legend, which has curves of one name once.
        mode: "lines", "markers" or both, "lines+markers".
        width: Of lines, or size of markers [px].
        dash: Of lines: "solid", "dash" or "dot".
        symbol: Of markers: "circle", "square", "diamond" or "star".
        hollow: Whether markers are rings.
        text: A column with words beside the markers.
        colour: A column that colours each marker, around 0, in place of `role`.
        bars: A column with half-widths below and one above each marker, along x.
        band: A column with the lower and one with the upper edge of an area around the curve.
        moves: Whether its points are those of several pictures in turn, as many as the data's column "seconds" says they take.
    """

    x: str
    y: str
    role: str = "ink"
    name: str = ""
    mode: str = "lines"
    width: float = 2.0
    dash: str = "solid"
    symbol: str = "circle"
    hollow: bool = False
    text: str = ""
    colour: str = ""
    bars: tuple[str, str] | None = None
    band: tuple[str, str] | None = None
    moves: bool = False


@dataclass(frozen=True)
class Figure:
    """A figure; on a page its data depend on the reader's choices.

    Attributes:
        name: Its identifier in the page.
        title: Above it.
        axes: Titles of the horizontal and the vertical axis.
        curves: What is drawn.
        data: Columns by key, which joins the choices of `by`; figures may share them.
        table: Name of these data in the page.
        captions: By key, the sentence below it.
        by: Names of the choices.
        log: The axis that is logarithmic: "x", "y" or "".
        ticks: Where a logarithmic axis has numbers; none for the usual ones.
        names: Whether the vertical axis has names, from above.
        counts: Whether the horizontal axis has whole numbers.
        equal: Whether a length is the same on both axes.
        height: In a page [px].
        limit: A column whose only value is the end of the colour scale.
    """

    name: str
    title: str
    axes: tuple[str, str]
    curves: tuple[Curve, ...]
    data: Mapping[str, Columns] = field(default_factory=dict)
    table: str = ""
    captions: Mapping[str, str] = field(default_factory=dict)
    by: tuple[str, ...] = ()
    log: str = ""
    ticks: tuple[float, ...] = ()
    names: bool = False
    counts: bool = False
    equal: bool = False
    height: int = 320
    limit: str = ""

    def drawn(self, key: str) -> list[Curve]:
        """The curves whose columns there are."""
        columns = self.data.get(key, {})
        return [c for c in self.curves if c.x in columns and c.y in columns]


@dataclass(frozen=True)
class Panel:
    """A figure with the data of one key, under a title of its own."""

    figure: Figure
    key: str
    title: str = ""


def key(*choices: object) -> str:
    """The key of the data that belong to some choices."""
    return SEPARATOR.join(map(str, choices))


def thinned(rows: np.ndarray, points: int, keep: Sequence[int]) -> np.ndarray:
    """Indices of at most `points` samples of `rows` (m, K), in order: of equal stretches, where each row of `keep` is least and greatest."""
    count = rows.shape[1]
    if count <= points:
        return np.arange(count)
    chosen = {0, count - 1}
    for part in np.array_split(np.arange(count), max((points - 2) // (2 * len(keep)), 1)):
        for i in keep:
            values = rows[i, part]
            if np.isfinite(values).any():
                chosen |= {int(part[np.nanargmin(values)]), int(part[np.nanargmax(values)])}
    return np.array(sorted(chosen))


def draw(rows: Sequence[Sequence[Panel]], size: tuple[float, float] = (4.8, 2.6), share: bool = False) -> Any:
    """Panels in rows of one length as a matplotlib figure with one legend.

    Args:
        size: Width and height of a panel [inch].
        share: Whether the panels of a row have the same vertical axis.
    """
    width, height = size[0] * len(rows[0]), size[1] * len(rows) + 0.5
    sharing: Any = "row" if share else False
    picture, axes = plt.subplots(
        len(rows), len(rows[0]), figsize=(width, height), layout="constrained", squeeze=False, sharey=sharing
    )
    for i, row in enumerate(rows):
        for j, panel in enumerate(row):
            axis, below = axes[i, j], rows[i + 1][j] if i + 1 < len(rows) else None
            _draw_panel(axis, panel)
            if below is None or below.figure.axes[0] != panel.figure.axes[0]:
                axis.set_xlabel(panel.figure.axes[0])
            if j == 0 or row[j - 1].figure.axes[1] != panel.figure.axes[1]:
                axis.set_ylabel(panel.figure.axes[1])
    labels = {label: handle for axis in axes.flat for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    if len(labels) > 1:
        picture.legend(labels.values(), labels.keys(), fontsize=8, ncols=4, loc="outside upper center", frameon=False)
    return picture


def _draw_panel(axis: Any, panel: Panel) -> None:
    figure, columns = panel.figure, panel.figure.data.get(panel.key, {})
    for curve in figure.drawn(panel.key):
        _draw_curve(axis, curve, columns, figure)
    axis.set_title(panel.title or figure.title, fontsize=10, loc="left")
    axis.grid(color="0.92", lw=0.6)
    axis.set_axisbelow(True)
    if figure.log:
        getattr(axis, f"set_{figure.log}scale")("log")
        _number(getattr(axis, f"{figure.log}axis"), figure.ticks)
    if figure.counts:
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    if figure.names:
        axis.set_ylim(len(axis.get_yticks()) - 0.5, -0.5)
    if figure.equal:
        axis.set_aspect("equal")
    if any(curve.text for curve in figure.curves):
        axis.margins(0.15)  # so that words have room
        axis.ticklabel_format(axis="x" if figure.names else "both", useOffset=False)


def _number(axis: Any, ticks: Sequence[float]) -> None:
    """Numbers at an axis with a logarithmic scale."""
    if ticks:
        low, high = axis.get_view_interval()
        axis.set_major_locator(FixedLocator([x for x in ticks if low <= x <= high]))
        axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axis.set_minor_locator(NullLocator())
        return
    for part in (axis.set_major_formatter, axis.set_minor_formatter):
        part(LogFormatter(labelOnlyBase=False, minor_thresholds=(1.5, 0.5)))


def _draw_curve(axis: Any, curve: Curve, columns: Columns, figure: Figure) -> None:
    x, y, colour = columns[curve.x], columns[curve.y], ROLES[curve.role]
    if curve.colour:
        end = columns[figure.limit][0]
        axis.scatter(x, y, c=columns[curve.colour], s=curve.width, cmap="coolwarm", vmin=-end, vmax=end, label=curve.name)
        return
    if curve.moves:
        _draw_moving(axis, curve, columns)
        return
    if curve.band:
        axis.fill_between(x, *(columns[edge] for edge in curve.band), color=colour, alpha=0.2, lw=0)
    axis.plot(x, y, color=colour, label=curve.name or None, **_look(curve))
    if curve.bars:
        axis.errorbar(x, y, xerr=[columns[side] for side in curve.bars], fmt="none", color=colour, lw=2)
    for place, word in zip(zip(x, y, strict=True), columns[curve.text] if curve.text else (), strict=False):
        axis.annotate(word, place, textcoords="offset points", xytext=(6, 4), **FOOTER)


def _look(curve: Curve) -> dict[str, Any]:
    if curve.mode == "lines":
        return {"lw": 0.75 * curve.width, "ls": DASHES[curve.dash]}
    fill = "none" if curve.hollow else ROLES[curve.role]
    return {"ls": "", "marker": SYMBOLS[curve.symbol], "ms": 0.65 * curve.width, "mfc": fill}


def _draw_moving(axis: Any, curve: Curve, columns: Columns) -> None:
    """Pictures of what moves: of lines with markers several from dark to light, of all else the first and the last."""
    count = len(columns["path_x"])
    x, y = (np.reshape(columns[name], (count, -1)) for name in (curve.x, curve.y))
    several = curve.mode == "lines+markers"
    for share in np.linspace(0, 1, PICTURES if several else 2):
        i = round(share * (count - 1))
        if several:
            axis.plot(x[i], y[i], "o-", color=plt.cm.viridis(share), lw=1.6, ms=3.5)
            continue
        axis.plot(x[i], y[i], color=ROLES[curve.role], label=None if share else curve.name, **_look(curve))


def save_figure(figure: Any, path: Path, dpi: int = 130) -> Path:
    """Write a figure, whole or not at all, in the format of its name, and close it; raises `UserError` where the file cannot be written."""
    with new_file(path) as file:
        figure.savefig(file, format=path.suffix[1:], dpi=dpi, bbox_inches="tight")
    plt.close(figure)
    return path

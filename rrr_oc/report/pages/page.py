"""What all pages share: the template with its styles, plotly.js once, and figures whose data a reader chooses."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

DIGITS = 5  # significant ones of the numbers in figures; more cannot be seen
ALL = "all"  # the choice that joins the data of all others
SEPARATOR = "|"  # between the choices in a key of the data; they are numbers or names of configurations, which do not have it
Columns = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Curve:
    """One curve or cloud of a figure.

    Attributes:
        x, y: Names of columns of the data; where one is missing, the curve is not drawn.
        role: Name of the style sheet's colour.
        name: In the legend, which has curves of one name once.
        mode: "lines" or "markers".
        width: Of lines, or size of markers [px].
        dash: Of lines: "solid", "dash" or "dot".
        colour: A column that colours each marker, around 0, in place of `role`.
        bars: A column with half-widths below and one above each marker, along x.
    """

    x: str
    y: str
    role: str = "ink"
    name: str = ""
    mode: str = "lines"
    width: float = 2.0
    dash: str = "solid"
    colour: str = ""
    bars: tuple[str, str] | None = None


@dataclass(frozen=True)
class Figure:
    """A figure of a page; its data depend on the reader's choices.

    Attributes:
        name: Its identifier in the page.
        title: Above it.
        data: Name of a table of the page's data, which has columns by key; a key joins the choices of `by`.
        by: Names of the choices.
        axes: Titles of the horizontal and the vertical axis.
        curves: What is drawn.
        captions: By key, the sentence below it.
        layout: What else plotly's layout needs.
        limit: A column whose only value is the end of the colour scale.
    """

    name: str
    title: str
    data: str
    by: tuple[str, ...]
    axes: tuple[str, str]
    curves: tuple[Curve, ...]
    captions: Mapping[str, str]
    layout: Mapping[str, Any] = field(default_factory=dict)
    limit: str = ""


def render(template: str, figures: Sequence[Figure], data: Mapping[str, Mapping[str, Any]], **content: Any) -> str:
    """A page as HTML.

    Args:
        template: A file of `report/templates`, which extends `base.html`.
        figures: All figures; the template places each by its name.
        data: Tables of `columns` or `joined` data by key, by name.
        content: What else the template needs.
    """
    from plotly.offline import get_plotlyjs  # late: most commands write no page

    environment = Environment(loader=PackageLoader("rrr_oc.report"), autoescape=True, undefined=StrictUndefined)
    payload = {"figures": {f.name: asdict(f) for f in figures}, "data": data, "separator": SEPARATOR}
    shown = {f.name: f for f in figures}
    return environment.get_template(template).render(payload=payload, shown=shown, plotly=get_plotlyjs(), **content)


def key(*choices: object) -> str:
    """The key of the data that belong to some choices."""
    return SEPARATOR.join(map(str, choices))


def columns(arrays: Columns) -> dict[str, list[Any]]:
    """Columns for a page: numbers with few digits, None for NaN, and text as it is."""
    return {name: [_short(value) for value in np.asarray(array).tolist()] for name, array in arrays.items()}


def joined(keys: Sequence[str]) -> dict[str, list[str]]:
    """In the place of columns: those of several keys, one after the other."""
    return {"joined": list(keys)}


def _short(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None


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

"""What all pages share: the template with its styles, plotly.js once, and figures whose data a reader chooses."""

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import asdict
from importlib.resources import files
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from rrr_oc.report.figures import SEPARATOR, Figure

TEMPLATES = "templates"
PLOTLY = "plotly-basic.min.js"  # plotly.js with lines and markers alone, as its makers publish it
FEW = 64  # numbers of a column that stand in a page one by one
STEPS = 65534  # from the least to the greatest number of a column that does not; more cannot be seen, however far one zooms


def render(template: str, figures: Sequence[Figure], **content: Any) -> str:
    """A page as HTML.

    Args:
        template: A file of `report/templates`, which extends `base.html`.
        figures: All figures; the template places each by its name.
        content: What else the template needs.
    """
    environment = Environment(loader=PackageLoader("rrr_oc.report"), autoescape=True, undefined=StrictUndefined)
    shown = {f.name: {k: v for k, v in asdict(f).items() if k != "data"} for f in figures}
    tables = {f.table: {k: {n: packed(c) for n, c in columns.items()} for k, columns in f.data.items()} for f in figures}
    payload = {"figures": shown, "data": tables, "separator": SEPARATOR, "steps": STEPS}
    script = (files("rrr_oc.report") / TEMPLATES / PLOTLY).read_text(encoding="utf-8")
    return environment.get_template(template).render(payload=payload, shown=shown, plotly=script, **content)


def packed(column: Any) -> Any:
    """A column for a page: text and few numbers as they are, None for NaN; many numbers as their range and, in base64, where each lies
    in it, as integers of 16 bits up to `STEPS`, with one more for NaN."""
    array = np.asarray(column)
    if array.dtype.kind not in "fi":
        return array.tolist()
    if array.size < FEW:
        return [float(f"{x:.5g}") if np.isfinite(x) else None for x in array.tolist()]
    known = np.isfinite(array)
    low, high = (float(edge(array[known])) for edge in (np.min, np.max)) if known.any() else (0.0, 0.0)
    steps = np.where(known, np.rint((np.where(known, array, low) - low) / ((high - low) or 1.0) * STEPS), STEPS + 1)
    return {"low": low, "high": high, "steps": b64encode(steps.astype("<u2").tobytes()).decode()}

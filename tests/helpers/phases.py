"""Phases of made-up problems: their bounds by flat names, as in `x_upper`."""

from dataclasses import replace
from typing import Any

import numpy as np

from rrr_oc.optimal_control.problem import Bounded, Phase

PARTS = ("x", "u", "path")


def unbounded(names: tuple[str, ...]) -> Bounded:
    """Quantities without bounds, of scale 1."""
    far = np.full(len(names), np.inf)
    return Bounded(names, -far, far, np.ones(len(names)))


def changed(phase: Phase, **changes: Any) -> Phase:
    """A phase with changes: `x_lower`, `u_scale`, …, the names of its paths as `paths`, and its own fields."""
    path = unbounded(changes.pop("paths")) if "paths" in changes else phase.path
    parts = {"x": phase.x, "u": phase.u, "path": path}
    for kind in PARTS:
        own = {key.removeprefix(f"{kind}_"): changes.pop(key) for key in list(changes) if key.startswith(f"{kind}_")}
        parts[kind] = replace(parts[kind], **own)
    return replace(phase, **parts, **changes)

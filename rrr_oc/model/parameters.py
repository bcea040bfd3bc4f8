"""Where the parameters of effects stand in the one vector of all."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from rrr_oc.effects import Effect


def offsets(effects: Sequence[Effect]) -> list[int]:
    """Number of the first parameter of each effect, and last that of all parameters."""
    return [0, *np.cumsum([len(effect.parameters) for effect in effects]).tolist()]


def by_effect(effects: Sequence[Effect], theta: Any) -> list[tuple[Effect, dict[str, Any]]]:
    """Each effect with its parameters by name, of those of all (p, ...), numbers or casadi's."""
    firsts = zip(effects, offsets(effects)[:-1], strict=True)
    return [(effect, {p.name: theta[first + k] for k, p in enumerate(effect.parameters)}) for effect, first in firsts]


def for_each(values: Sequence[bool], effects: Sequence[Effect]) -> np.ndarray:
    """What holds for each effect, for each of its parameters, (p,)."""
    return np.repeat(np.array(values, bool), [len(effect.parameters) for effect in effects])

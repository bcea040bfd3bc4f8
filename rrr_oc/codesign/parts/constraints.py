"""Limits of springs in the optimal-control problem, in which motion and springs are found together."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from rrr_oc.codesign.parts.limits import SpringLimits
from rrr_oc.codesign.springs import SpringBounds
from rrr_oc.effects import Wound
from rrr_oc.effects.base import Signals


@dataclass(frozen=True)
class Limited:
    """What a limit bounds at an instant.

    Attributes:
        what: Its name.
        over: It, over the limit; at most 1.
        limit: The limit, in its unit.
        unit: The unit.
    """

    what: str
    over: Any
    limit: float
    unit: str


def limited(
    spring: SpringBounds, label: str, limits: SpringLimits, signals: Signals, theta: Mapping[str, Any]
) -> list[Limited]:
    """What the limits bound of a spring at positions and parameters, numbers or casadi's; nothing of one that no limit is for."""
    effect = spring.effect
    if spring.known or not isinstance(effect, Wound):
        return []
    stretch = effect.stretch(signals, theta)
    amplitude, cable = theta[effect.amplitudes[0]], spring.form.inverse_radii([*theta.values()], spring.hardware, spring.fixed)
    turn = None if limits.turn_deg is None else float(np.radians(limits.turn_deg))
    bounded = [("torque", amplitude * stretch, limits.torque_Nm, "Nm"), ("turn", stretch, turn, "rad")] * (not cable)
    bounded += [("cable force", amplitude * stretch * inverse, limits.force_N, "N") for inverse in cable]
    bounded += [("energy", amplitude * ca.fmax(stretch, 0) ** 2 / 2, limits.energy_J, "J")]
    return [
        Limited(f"{what} of the {label}", value / limit, limit, unit)
        for what, value, limit, unit in bounded
        if limit is not None
    ]

"""Cable spring across one joint over a pulley whose radius changes with the angle, for co-designs."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from rrr_oc.effects.base import Signals
from rrr_oc.effects.design_form import DesignForm, Quantity, angle
from rrr_oc.effects.elastic.parallel_spring import SIDES
from rrr_oc.effects.springs import DesignSpring, LinkSpring
from rrr_oc.numerics.smooth import cos, ramp, ramp_integral, sin
from rrr_oc.robot.parameters import Parameter

RADII = tuple(f"radius{i}" for i in range(1, 6))
PLACES = 2 * np.pi / len(RADII) * np.arange(len(RADII))  # [rad], of the bumps


@dataclass(frozen=True)
class PulleySpring(LinkSpring, DesignSpring):
    """Unilateral tension spring whose cable winds over a pulley of changing radius (Schmit and Okada 2012).

    With the length l(q) = ∫ r dq that is wound off, and the tension T = stiffness max(l(equilibrium) − l(q), 0), the torque is T r(q)
    (`active="below"`); `active="above"` is its mirror image. With equal radii r it is a parallel spring of stiffness × r² [Nm/rad].

    The radius is the lever of the cable about the joint, a sum of five bumps, one every 72°: r(q) = Σ_i radius_i b(q − q_i) with
    b(u) = 2/15 (1 + cos u)² and Σ_i b(q − q_i) = 1, the cyclic basis of Róth, Juhász, Schicho and Hoffmann (2009). So r lies between
    the least and the greatest of the five radii. So does the radius of curvature of the pulley's outline,
    r + r'' = Σ_i radius_i (1 − cos 2(q − q_i)) / 5: the outline is closed, smooth and convex, and the cable lies on all of it.
    |r'| is at most the difference between the greatest and the least radius, |r''| at most twice that.

    A stiffer spring on a smaller pulley of the same shape gives the same torque; which of the two a design has is open where the bounds
    leave both.
    """

    name = "pulley_spring"
    equation = "tau = stiffness (l(equilibrium) - l(q)) r(q) on the active side of the equilibrium, else 0; l = integral of r"
    plain = (
        "A spring of {stiffness} pulls {joints} by a cable over a pulley, {active} its equilibrium of {equilibrium:deg}; the pulley's "
        "radii are {radius1}, {radius2}, {radius3}, {radius4} and {radius5}."
    )
    parameters = (
        Parameter("stiffness", "N/m", 5000.0, lower=0.0),
        Parameter("equilibrium", "rad", 2.0),
        *(
            Parameter(name, "m", nominal, lower=0.0)
            for name, nominal in zip(RADII, (0.02, 0.03, 0.04, 0.03, 0.02), strict=True)
        ),
    )
    amplitudes = ("stiffness",)
    width = Parameter("width", "rad", 1e-3, lower=0.0)
    role = "design"
    options = {"active": SIDES}  # noqa: RUF012
    design = DesignForm(
        "VPEA",
        "cable springs over pulleys of changing radius",
        (
            Quantity("k_v", "stiffness_N_per_m", "N/m", lowest=0.0),
            angle("q_v", "equilibrium_deg"),
            *(Quantity(f"r{i}_v", "radius_mm", "m", 1e-3, lowest=1.0) for i in range(1, len(RADII) + 1)),
        ),
    )

    active: Literal["below", "above"] = "below"

    @property
    def _sign(self) -> int:
        return 1 if self.active == "below" else -1

    def radius(self, q: Any, theta) -> Any:
        """Lever of the cable about the joint at an angle [m]."""
        return sum(theta[name] * (1 + cos(q - at)) ** 2 for name, at in zip(RADII, PLACES, strict=True)) * (2 / 15)

    def length(self, q: Any, theta) -> Any:
        """Cable that is wound off from angle 0 [m], the integral of `radius`."""
        return sum(theta[name] * (_wound(q - at) - _wound(-at)) for name, at in zip(RADII, PLACES, strict=True)) * (2 / 15)

    def _stretch(self, signals, theta):
        return self._sign * (self.length(theta["equilibrium"], theta) - self.length(signals.q[self.joints[0]], theta))

    def _width(self, theta, width):
        """The smoothing width as a length of cable [m]: on the pulley's mean radius."""
        exact = isinstance(width, float) and width == 0.0
        return 0.0 if exact else width * sum(theta[name] for name in RADII) / len(RADII)

    def torque(self, signals, theta, width):
        tension = theta["stiffness"] * ramp(self._stretch(signals, theta), self._width(theta, width))
        return (self._sign * tension * self.radius(signals.q[self.joints[0]], theta),)

    def energy(self, signals, theta, width):
        return theta["stiffness"] * ramp_integral(self._stretch(signals, theta), self._width(theta, width))

    def profile(self, q, theta):
        """The cable's lever, its length from the equilibrium, the torque, and the outline in the frame of the pulley, whose axis is 0.

        The cable leaves along a fixed direction, so that in that frame it turns by −q, and the lever is the outline's support function.
        """
        at = self.joints[0]
        (torque,) = self.torque(Signals({at: q}), theta, 0.0)
        r, slope = self.radius(q, theta), self._slope(q, theta)
        columns = {"angle_deg": np.degrees(q), "radius_mm": 1e3 * r, "cable_mm": 1e3 * self._stretch(Signals({at: q}), theta)}
        outline = r * np.cos(q) - slope * np.sin(q), -r * np.sin(q) - slope * np.cos(q)
        return (
            columns
            | {"torque_Nm": torque}
            | dict(zip(("outline_x_mm", "outline_y_mm"), (1e3 * x for x in outline), strict=True))
        )

    def _slope(self, q, theta):
        """Derivative of `radius` [m/rad]."""
        bumps = (theta[name] * np.sin(q - at) * (1 + np.cos(q - at)) for name, at in zip(RADII, PLACES, strict=True))
        return -4 / 15 * sum(bumps)


def _wound(u: Any) -> Any:
    """Integral of (1 + cos u)²."""
    return 1.5 * u + 2 * sin(u) + sin(2 * u) / 4

"""Friction with a part in the square of speed."""

from dataclasses import dataclass

from rrr_oc.effects.base import Effect
from rrr_oc.numerics.smooth import fabs
from rrr_oc.robot.parameters import Parameter


@dataclass(frozen=True)
class QuadraticDrag(Effect):
    """tau = −coefficient dq |dq|: c_v2 of Eq. 9, of either sign.

    A negative one lowers friction until it drives the joint; no extrapolation beyond the speeds recorded is meant.
    """

    name = "quadratic_drag"
    equation = "tau = -coefficient dq |dq|"
    parameters = (Parameter("coefficient", "Nm s²/rad²", 0.0),)
    amplitudes = ("coefficient",)
    side = "drive"
    resembles = "friction_over_speed"

    def torque(self, signals, theta, width):
        dq = signals.dq[self.joints[0]]
        return (-theta["coefficient"] * dq * fabs(dq),)

"""Friction with a part in the square of speed."""

from rrr_oc.effects.base import Prior
from rrr_oc.effects.capabilities import ExportTwin
from rrr_oc.numerics.smooth import fabs
from rrr_oc.robot.parameters import Parameter


class QuadraticDrag(ExportTwin):
    """tau = −coefficient dq |dq|: c_v2 of Eq. 9, of either sign.

    With a negative coefficient friction falls with speed and would drive the joint beyond the speeds recorded: do not extrapolate.
    """

    name = "quadratic_drag"
    equation = "tau = -coefficient dq |dq|"
    plain = "Friction of {joints} {coefficient:grows|falls} with the square of its speed: {coefficient:abs}."
    parameters = (Parameter("coefficient", "Nm s²/rad²", 0.0),)
    amplitudes = ("coefficient",)
    side = "drive"
    resembles = "friction_over_speed"
    prior = Prior(
        0.03,
        {"coefficient": (0.3, "dry/speed²")},
        "Waiboer, Aarts & Jonker 2005, Stäubli RX90: not linear in speed",
    )

    def torque(self, signals, theta, width):
        dq = signals.dq[self.joints[0]]
        return (-theta["coefficient"] * dq * fabs(dq),)

    def native(self, spec, joints, theta):
        """The second of the coefficients of the joint's `damping`."""
        spec.joint(joints[self.joints[0]]).damping[1] += theta["coefficient"]

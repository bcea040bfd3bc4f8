"""Dry friction that differs between the directions of motion."""

from rrr_oc.effects.base import SIGN_WIDTH, Effect, Prior
from rrr_oc.numerics.smooth import sign
from rrr_oc.robot.parameters import Parameter


class CoulombAsymmetry(Effect):
    """tau = −(asymmetry/2) sgn²(dq): the level for dq > 0 minus that for dq < 0, half of it on either side of the plain level."""

    name = "coulomb_asymmetry"
    title = "direction-dependent dry friction"
    equation = "tau = -(asymmetry/2) sgn(dq)^2"
    plain = (
        "Dry friction of {joints} differs between directions: {asymmetry:abs} {asymmetry:more|less} in the positive "
        "direction than in the negative."
    )
    parameters = (Parameter("asymmetry", "Nm", 0.0),)
    amplitudes = ("asymmetry",)
    width = SIGN_WIDTH
    side = "drive"
    prior = Prior(
        0.03,
        {"asymmetry": (0.3, "dry")},
        "Corke & Armstrong-Hélouvry 1994, PUMA 560: levels of two directions differ by 10 to 90 %",
    )

    def torque(self, signals, theta, width):
        return (-theta["asymmetry"] / 2 * sign(signals.dq[self.joints[0]], width) ** 2,)

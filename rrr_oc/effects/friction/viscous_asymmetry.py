"""Viscous friction that differs between the directions of motion."""

from rrr_oc.effects.base import SIGN_WIDTH, Effect, Prior
from rrr_oc.numerics.smooth import sign
from rrr_oc.robot.parameters import Parameter


class ViscousAsymmetry(Effect):
    """tau = −(asymmetry/2) dq sgn(dq): the coefficient for dq > 0 minus that for dq < 0, half of it on either side of the plain one."""

    name = "viscous_asymmetry"
    title = "direction-dependent viscous friction"
    equation = "tau = -(asymmetry/2) dq sgn(dq)"
    plain = (
        "Viscous friction of {joints} differs between directions: {asymmetry:abs} {asymmetry:more|less} in the positive "
        "direction than in the negative."
    )
    parameters = (Parameter("asymmetry", "Nm s/rad", 0.0),)
    amplitudes = ("asymmetry",)
    width = SIGN_WIDTH
    side = "drive"
    prior = Prior(
        0.02,
        {"asymmetry": (0.3, "dry/speed")},
        "as dry friction, whose directions differ more often; Armstrong-Hélouvry 1991, PUMA 560",
    )

    def torque(self, signals, theta, width):
        dq = signals.dq[self.joints[0]]
        return (-theta["asymmetry"] / 2 * dq * sign(dq, width),)

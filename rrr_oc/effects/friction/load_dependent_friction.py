"""Friction that changes with the torque that the gear transmits."""

from rrr_oc.effects.base import SIGN_WIDTH, Effect, Prior
from rrr_oc.numerics.smooth import fabs, sign
from rrr_oc.robot.parameters import Parameter


class LoadDependentFriction(Effect):
    """tau = −mu |tau_l| sgn(dq): the dissipative form of c_12 in Eq. 9, which prints mu sgn(dq) tau_l; of either sign.

    A negative mu, as the paper has for joint 1, lowers the dry friction and might drive the joint beyond the loads recorded.
    """

    name = "load_dependent_friction"
    equation = "tau = -mu |tau_l| sgn(dq)"
    plain = "Dry friction of {joints} {mu:grows|falls} with its load: {mu:abs per load}."
    parameters = (Parameter("mu", "1", 0.0, lower=-1.0),)
    amplitudes = ("mu",)
    width = SIGN_WIDTH
    side = "drive"
    inputs = ("load",)
    scope = "set_up"
    prior = Prior(
        0.05,
        {"mu": (0.1, "")},
        "Bittencourt & Gunnarsson 2012; Hamon, Gautier & Garrec 2010: some per cent",
    )

    def torque(self, signals, theta, width):
        j = self.joints[0]
        return (-theta["mu"] * fabs(signals.load[j]) * sign(signals.dq[j], width),)

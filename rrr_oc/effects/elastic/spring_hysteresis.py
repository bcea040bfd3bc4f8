"""A listed spring, or its cable, that loses energy in a cycle."""

from rrr_oc.effects.base import SIGN_WIDTH, Effect, Prior
from rrr_oc.numerics.smooth import fabs, sign
from rrr_oc.robot.parameters import Parameter


class SpringHysteresis(Effect):
    """tau = −loss |torque of the listed spring| sgn(rate of its stretch), on each joint."""

    name = "spring_hysteresis"
    equation = "tau = -loss |tau_spring| sgn(stretch rate)"
    plain = "The listed spring of {joints} loses {loss:%} of its torque to friction."
    parameters = (Parameter("loss", "1", 0.0, lower=0.0),)
    amplitudes = ("loss",)
    width = SIGN_WIDTH
    inputs = ("springs",)
    scope = "set_up"
    placement = "spring"
    prior = Prior(0.03, {"loss": (0.1, "")}, "friction between coils and in cables: some per cent, rubber up to 30 %")

    def torque(self, signals, theta, width):
        spring, values, own = signals.springs[self.joints]
        torques, lever = spring.torque(signals, values, own), spring.lever(values)
        rate = sum(r * signals.dq[j] for r, j in zip(lever, self.joints, strict=True))
        size, direction = fabs(torques[0]), sign(rate, width)
        return tuple(-theta["loss"] * r * size * direction for r in lever)

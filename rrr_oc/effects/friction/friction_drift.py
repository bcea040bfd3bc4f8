"""Friction that changes with time since the start, as grease warms up."""

from rrr_oc.effects.base import Effect, Prior
from rrr_oc.numerics.smooth import exp
from rrr_oc.robot.parameters import Parameter


class FrictionDrift(Effect):
    """tau = ratio exp(−t/time_constant) × (plain dry and viscous friction of the joint)."""

    name = "friction_drift"
    equation = "friction = (1 + ratio exp(-t/time_constant)) steady friction"
    plain = (
        "Friction of {joints} is {ratio:abs %} {ratio:higher|lower} at the start than later, and settles within a time "
        "constant of {time_constant}."
    )
    parameters = (Parameter("ratio", "1", 0.0, lower=-1.0), Parameter("time_constant", "s", 10.0, lower=0.1))
    amplitudes = ("ratio",)
    side = "drive"
    inputs = ("friction",)
    prior = Prior(
        0.02, {"ratio": (0.5, "")}, "Bittencourt & Gunnarsson 2012: friction falls by tens of per cent while a joint warms up"
    )

    def torque(self, signals, theta, width):
        return (theta["ratio"] * exp(-signals.time / theta["time_constant"]) * signals.friction[self.joints[0]],)

    @classmethod
    def shapes(cls, view, joints):
        return [{"time_constant": share * view.duration} for share in (0.12, 0.25, 0.5, 1.5, 6.0)]

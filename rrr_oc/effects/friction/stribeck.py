"""Dry friction that falls from a static to a kinetic level as speed rises."""

from dataclasses import dataclass

from rrr_oc.effects.base import Effect
from rrr_oc.numerics.smooth import exp, sign
from rrr_oc.robot.parameters import Parameter


@dataclass(frozen=True)
class Stribeck(Effect):
    """tau = −excess exp(−(dq/velocity)²) sgn(dq), beside the plain (kinetic) level (Armstrong-Hélouvry 1991)."""

    name = "stribeck"
    equation = "tau = -excess exp(-(dq/velocity)^2) sgn(dq)"
    parameters = (Parameter("excess", "Nm", 0.0, lower=0.0), Parameter("velocity", "rad/s", 0.1, lower=1e-3))
    amplitudes = ("excess",)
    width = Parameter("width", "rad/s", 0.05, lower=0.0)
    side = "drive"
    resembles = "friction_over_speed"

    def torque(self, signals, theta, width):
        dq = signals.dq[self.joints[0]]
        turn = sign(dq, width)
        return (-theta["excess"] * exp(-((dq / theta["velocity"]) ** 2)) * turn,)

    @classmethod
    def trials(cls, view):
        for j in range(view.n):
            for share in (0.04, 0.08, 0.14, 0.22, 0.35):
                yield cls((j,)).trial(view, velocity=share * view.speed[j])

"""Dry friction that falls from a static to a kinetic level as speed rises."""

from rrr_oc.effects.base import SIGN_WIDTH, Prior
from rrr_oc.effects.capabilities import ExportTwin
from rrr_oc.numerics.smooth import exp, sign
from rrr_oc.robot.parameters import Parameter

BEND = (
    1e-3  # [rad] over which exported friction builds up; doubled, it holds half as stiffly; halved, it is as fast as the step
)


class Stribeck(ExportTwin):
    """tau = −excess exp(−(dq/velocity)²) sgn(dq), beside the plain (kinetic) level (Armstrong-Hélouvry 1991)."""

    name = "stribeck"
    equation = "tau = -excess exp(-(dq/velocity)^2) sgn(dq)"
    plain = (
        "Dry friction of {joints} is higher when it moves slowly: {excess} more near standstill, falling off over {velocity}."
    )
    parameters = (Parameter("excess", "Nm", 0.0, lower=0.0), Parameter("velocity", "rad/s", 0.1, lower=1e-3))
    amplitudes = ("excess",)
    width = SIGN_WIDTH
    side = "drive"
    resembles = "friction_over_speed"
    prior = Prior(
        0.05, {"excess": (0.5, "dry")}, "Armstrong-Hélouvry 1991, PUMA 560: static above kinetic friction by tens of per cent"
    )

    def torque(self, signals, theta, width):
        dq = signals.dq[self.joints[0]]
        return (-theta["excess"] * exp(-((dq / theta["velocity"]) ** 2)) * sign(dq, width),)

    @classmethod
    def shapes(cls, view, joints):
        return [{"velocity": share * view.speed[joints[0]]} for share in (0.04, 0.055, 0.08, 0.1, 0.14, 0.18, 0.24, 0.35)]

    def native(self, spec, joints, theta):
        """A passive motor's friction with a kinetic level of 0: bristles, in place of a smoothed sign, which hold the joint at rest."""
        excess = theta["excess"]
        if excess > 0:  # without, bristles have no stiffness
            law = (excess / BEND, 0.0, 0.0, excess, theta["velocity"])
            self.passive_motor(spec, joints[self.joints[0]], lugre=law)

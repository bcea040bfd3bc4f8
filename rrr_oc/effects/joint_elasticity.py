"""A transmission that twists under load."""

from dataclasses import dataclass

from rrr_oc.effects.effect import Effect
from rrr_oc.parameters import Parameter


@dataclass(frozen=True)
class JointElasticity(Effect):
    """q_link = theta − tau_l/stiffness; positions are the motor's (Spong 1987, without the link's own ringing)."""

    name = "joint_elasticity"
    equation = "q_link = theta - tau_l / stiffness"
    parameters = (Parameter("stiffness", "Nm/rad", 1e6, lower=1.0),)
    amplitudes = ("stiffness",)
    side = "motion"

    def torque(self, signals, theta, width):
        return (0 * signals.q[self.joints[0]],)

    def shift(self, signals, theta, width):
        return (-signals.load[self.joints[0]] / theta["stiffness"],)

    def combined(self, points, coefficients):
        """The shift is linear in the compliance."""
        return {"stiffness": 1 / max(float(coefficients[0]), 1e-12) if coefficients[0] > 0 else -1.0}

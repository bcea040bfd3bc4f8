"""Play between motor and link."""

from dataclasses import dataclass

import casadi as ca

from rrr_oc.effects.effect import Effect
from rrr_oc.parameters import Parameter


@dataclass(frozen=True)
class Backlash(Effect):
    """The link hangs behind the motor by half of the gap: q_link = theta − (gap/2) sgn(tau_l); positions are the motor's."""

    name = "backlash"
    equation = "q_link = theta - (gap/2) sgn(tau_l)"
    parameters = (Parameter("gap", "rad", 0.0, lower=0.0),)
    amplitudes = ("gap",)
    width = Parameter("width", "Nm", 0.05, lower=0.0)
    side = "motion"

    def torque(self, signals, theta, width):
        return (0 * signals.q[self.joints[0]],)

    def shift(self, signals, theta, width):
        return (-theta["gap"] / 2 * ca.tanh(signals.load[self.joints[0]] / ca.fmax(width, 1e-300)),)

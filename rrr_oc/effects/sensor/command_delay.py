"""Commands that act later than they are recorded: held between samples, sent over a bus, read by an inner loop."""

from rrr_oc.effects.base import Prior
from rrr_oc.effects.capabilities import LateCommand
from rrr_oc.robot.parameters import Parameter


class CommandDelay(LateCommand):
    """true torque(t) = kp (q_d(t − delay) − q(t)) − kd dq(t), of one joint.

    What is recorded is kp (q_d − q) − kd dq, the true torque and kp (q_d(t) − q_d(t − delay)): kp times the delay more viscous friction
    where the joint follows closely. A command that is held until the next one is, for motions that are slow beside that, late by half the
    time between two.
    """

    name = "command_delay"
    equation = "true torque(t) = kp (q_d(t - delay) - q(t)) - kd dq(t)"
    plain = "The commands of {joints} act {delay:ms} after they are recorded."
    parameters = (Parameter("delay", "s", 0.0, lower=-0.02, upper=0.1),)
    amplitudes = ("delay",)
    scope = "everywhere"
    placement = "joint"
    role = "plain"
    prior = Prior(1.0, {"delay": (0.01, "")}, "half of a servo's cycle of 20 ms, and the cycles of its bus")

    def wait(self, theta):
        return theta["delay"]

"""A torque channel that lags the position channel."""

from rrr_oc.effects.base import Prior
from rrr_oc.effects.capabilities import Delay
from rrr_oc.robot.parameters import Parameter


class TimeDelay(Delay):
    """recorded torque(t) = true torque(t − delay), for all joints."""

    name = "time_delay"
    equation = "recorded torque(t) = true torque(t - delay)"
    plain = "The recorded torque lags the recorded motion by {delay:ms}."
    parameters = (Parameter("delay", "s", 0.0, lower=0.0),)
    amplitudes = ("delay",)
    scope = "set_up"
    step = 1e-3
    prior = Prior(0.03, {"delay": (0.005, "")}, "cycles of field buses and filters of currents: 1 to 10 ms")

    def delay(self, theta):
        return theta["delay"]

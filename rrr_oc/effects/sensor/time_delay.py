"""A torque channel that lags the position channel."""

from rrr_oc.effects.base import Effect
from rrr_oc.robot.parameters import Parameter


class TimeDelay(Effect):
    """recorded torque(t) = true torque(t − delay), for all joints."""

    name = "time_delay"
    equation = "recorded torque(t) = true torque(t - delay)"
    parameters = (Parameter("delay", "s", 0.0, lower=0.0),)
    amplitudes = ("delay",)
    side = "sensor"
    scope = "set_up"
    placement = "arm"
    dynamics = "delay"
    step = 1e-3

    def delay(self, theta):
        return theta["delay"]

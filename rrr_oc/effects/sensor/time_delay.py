"""A torque channel that lags the position channel."""

from dataclasses import dataclass

from rrr_oc.effects.base import Effect, Trial
from rrr_oc.robot.parameters import Parameter

STEP = 1e-3  # [s], by which signals are shifted for a derivative


@dataclass(frozen=True)
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

    def torque(self, signals, theta, width):
        """None: whole signals are shifted instead."""
        return ()

    def delay(self, theta):
        return theta["delay"]

    @classmethod
    def trials(cls, view):
        yield Trial(cls(()), ({"delay": STEP},), STEP)

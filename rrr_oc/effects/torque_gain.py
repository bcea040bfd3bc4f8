"""A torque channel with a wrong scale."""

from dataclasses import dataclass

from rrr_oc.effects.effect import Effect
from rrr_oc.parameters import Parameter


@dataclass(frozen=True)
class TorqueGain(Effect):
    """recorded = (1 + gain) true."""

    name = "torque_gain"
    equation = "recorded torque = (1 + gain) true"
    parameters = (Parameter("gain", "1", 0.0, lower=-0.95),)
    amplitudes = ("gain",)
    side = "sensor"
    local = True

    def torque(self, signals, theta, width):
        return (theta["gain"] * signals.load[self.joints[0]],)

"""A torque channel with a wrong zero."""

from rrr_oc.effects.base import Prior
from rrr_oc.effects.capabilities import OfEach
from rrr_oc.robot.parameters import Parameter


class TorqueOffset(OfEach):
    """recorded = true + offset."""

    name = "torque_offset"
    equation = "recorded torque = true + offset"
    plain = "The recorded torque of {joints} is off by a constant {offset}."
    plain_each = "The zero of the recorded torque of {joints} is another in every recording: off by {offset:bare}."
    parameters = (Parameter("offset", "Nm", 0.0),)
    amplitudes = ("offset",)
    side = "sensor"
    scope = "set_up"
    resembles = "constant"
    prior = Prior(
        0.03, {"offset": (0.1, "torque")}, "data sheets of torque and current sensors: a zero within some per cent of the range"
    )

    def torque(self, signals, theta, width):
        return (self.value(signals, theta) + 0 * signals.load[self.joints[0]],)

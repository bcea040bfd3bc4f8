"""An encoder with a wrong zero."""

from rrr_oc.effects.base import Prior
from rrr_oc.effects.capabilities import MotionShift, OfEach
from rrr_oc.robot.parameters import Parameter


class EncoderOffset(OfEach, MotionShift):
    """recorded position = true + offset."""

    name = "encoder_offset"
    equation = "recorded position = true + offset"
    plain = "The encoder of {joints} reads {offset:abs deg} too {offset:much|little}."
    plain_each = "The zero of the encoder of {joints} is another in every recording: it reads {offset:bare deg} too much."
    parameters = (Parameter("offset", "rad", 0.0),)
    amplitudes = ("offset",)
    scope = "set_up"
    prior = Prior(
        0.01,
        {"offset": (0.02, "")},
        "Mooring, Roth & Driels 1991: zeros of joints are off by up to a degree before calibration",
    )

    def shift(self, signals, theta, width):
        return (-self.value(signals, theta) + 0 * signals.q[self.joints[0]],)

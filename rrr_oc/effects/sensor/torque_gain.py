"""A torque channel with a wrong scale."""

from rrr_oc.effects.base import Effect, Prior
from rrr_oc.robot.parameters import Parameter


class TorqueGain(Effect):
    """recorded = (1 + gain) true, of one joint, or of all joints alike: currents in another unit, one wrong torque constant."""

    name = "torque_gain"
    equation = "recorded torque = (1 + gain) true"
    plain = "The recorded torque of {joints} is {gain:abs %} too {gain:large|small}."
    parameters = (Parameter("gain", "1", 0.0, lower=-0.9, upper=9.0),)  # a tenth to ten times; beyond, all of the joint scales
    amplitudes = ("gain",)
    side = "sensor"
    scope = "set_up"
    placement = "joint or arm"
    recorded_as = ("motor", "load", "current")  # of a loop, `controller_gain` is the same and says more
    prior = Prior(0.02, {"gain": (0.1, "")}, "data sheets: torque constants within 10 %, torque sensors within some per cent")

    def possible(self, theta, payload):
        (gain,) = self.parameters
        return gain.lower < theta["gain"] < gain.upper

    def torque(self, signals, theta, width):
        return tuple(theta["gain"] * signals.load[j] for j in self.on(signals.load.shape[0]))

    @classmethod
    def sentence(cls, joints, values):
        return super().sentence(joints or ("all joints",), values)

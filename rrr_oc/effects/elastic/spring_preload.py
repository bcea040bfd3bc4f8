"""A listed spring whose equilibrium is not where it is listed."""

from rrr_oc.effects.base import Effect, Prior
from rrr_oc.robot.parameters import Parameter


class SpringPreload(Effect):
    """tau = torque of the listed spring with its equilibrium moved by the offset − its torque as listed."""

    name = "spring_preload"
    equation = "true equilibrium = listed + offset"
    plain = "The equilibrium of the listed spring of {joints} is {offset:abs deg} {offset:above|below} the listed one."
    parameters = (Parameter("offset", "rad", 0.0),)
    amplitudes = ("offset",)
    inputs = ("springs",)
    scope = "set_up"
    placement = "spring"
    step = 1e-3
    prior = Prior(0.03, {"offset": (0.2, "")}, "equilibria are set by hand at assembly, within some degrees")

    @property
    def linear(self):
        return False  # the spring goes slack elsewhere

    def torque(self, signals, theta, width):
        spring, values, own = signals.springs[self.joints]
        moved = spring.moved(values, theta["offset"])
        pairs = zip(spring.torque(signals, moved, own), spring.torque(signals, values, own), strict=True)
        return tuple(a - b for a, b in pairs)

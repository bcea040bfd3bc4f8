"""A listed spring whose equilibrium is not where it is listed."""

from rrr_oc.effects.base import Prior
from rrr_oc.effects.capabilities import SpringChange
from rrr_oc.robot.parameters import Parameter


class SpringPreload(SpringChange):
    """tau = torque of the listed spring with its equilibrium moved by the offset − its torque as listed."""

    name = "spring_preload"
    equation = "true equilibrium = listed + offset"
    plain = "The equilibrium of the listed spring of {joints} is {offset:abs deg} {offset:above|below} the listed one."
    parameters = (Parameter("offset", "rad", 0.0),)
    amplitudes = ("offset",)
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

    def added(self, spring, values, theta):
        return [spring.moved(values, theta["offset"]), {**values, **{name: -values[name] for name in spring.amplitudes}}]

"""A mounted spring whose equilibrium is not where it is listed."""

from dataclasses import dataclass

from rrr_oc.effects.base import Effect, Trial
from rrr_oc.robot.parameters import Parameter


@dataclass(frozen=True)
class SpringPreload(Effect):
    """Torque of the listed spring with its equilibrium moved by the offset, less its torque as listed."""

    name = "spring_preload"
    equation = "true equilibrium = listed + offset"
    parameters = (Parameter("offset", "rad", 0.0),)
    amplitudes = ("offset",)
    inputs = ("springs",)
    scope = "set_up"
    placement = "spring"

    @property
    def linear(self):
        return False  # the spring goes slack elsewhere

    def torque(self, signals, theta, width):
        spring, values, own = signals.springs[self.joints]
        moved = spring.moved(values, theta["offset"])
        pairs = zip(spring.torque(signals, moved, own), spring.torque(signals, values, own), strict=True)
        return tuple(a - b for a, b in pairs)

    @classmethod
    def trials(cls, view):
        for joints in view.springs:
            yield Trial(cls(joints), ({"offset": STEP},), STEP)


STEP = 1e-3  # [rad], for a derivative

"""A payload whose centre is off the tool point."""

from dataclasses import dataclass, replace

from rrr_oc.effects.base import Effect, Trial
from rrr_oc.robot.parameters import Parameter


@dataclass(frozen=True)
class PayloadCom(Effect):
    """centre of the payload = tool point + (x, y, z), in the frame of the link that carries it."""

    name = "payload_com"
    equation = "centre of the payload = tool point + (x, y, z)"
    parameters = (Parameter("x", "m", 0.0), Parameter("y", "m", 0.0), Parameter("z", "m", 0.0))
    amplitudes = ("x", "y", "z")
    side = "body"
    scope = "set_up"
    placement = "arm"
    alters = "position"

    def torque(self, signals, theta, width):
        return ()

    def change(self, body, theta):
        return replace(body, position=[p + theta[k] for p, k in zip(body.position, "xyz", strict=True)])

    @classmethod
    def trials(cls, view):
        if view.payload:
            zero = dict.fromkeys("xyz", 0.0)
            yield Trial(cls(()), tuple(zero | {k: STEP} for k in "xyz"), STEP)


STEP = 1e-4  # [m], for a derivative

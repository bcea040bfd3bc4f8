"""A payload that is heavier or lighter than listed."""

from dataclasses import dataclass, replace

from rrr_oc.effects.base import Effect
from rrr_oc.robot.parameters import Parameter

NOTHING = 0.05  # of a listed payload, below none: one that was not mounted is estimated to be a little less


@dataclass(frozen=True)
class PayloadMass(Effect):
    """mass at the tool = listed + mass."""

    name = "payload_mass"
    equation = "mass at the tool = listed + mass"
    parameters = (Parameter("mass", "kg", 0.0),)
    amplitudes = ("mass",)
    side = "body"
    scope = "mounted"
    placement = "arm"
    alters = "payload"

    def torque(self, signals, theta, width):
        return ()

    def change(self, body, theta):
        return replace(body, payload=body.payload + theta["mass"])

    def possible(self, theta, payload):
        return payload + theta["mass"] >= -NOTHING * payload

    @classmethod
    def trials(cls, view):
        yield cls(()).trial(view)

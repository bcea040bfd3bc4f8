"""A payload that is heavier or lighter than listed."""

from dataclasses import replace

from rrr_oc.effects.base import Prior
from rrr_oc.effects.capabilities import BodyChange
from rrr_oc.robot.parameters import Parameter

# Share of the listed payload by which the total may be negative, as an unmounted payload is estimated with errors
TOLERANCE = 0.05


class PayloadMass(BodyChange):
    """mass at the tool = listed + mass."""

    name = "payload_mass"
    equation = "mass at the tool = listed + mass"
    plain = "The model has {mass:abs} {mass:less|more} at the tool than the arm."
    parameters = (Parameter("mass", "kg", 0.0),)
    amplitudes = ("mass",)
    scope = "mounted"
    placement = "arm"
    alters = "payload"
    prior = Prior(0.03, {"mass": (0.2, "arm's mass")}, "data sheets of arms: rated payloads are 7 to 35 % of the arm's mass")

    def change(self, body, theta):
        return replace(body, payload=body.payload + theta["mass"])

    def possible(self, theta, payload):
        return payload + theta["mass"] >= -TOLERANCE * payload

"""A payload whose centre is off the tool point."""

from dataclasses import replace

from rrr_oc.effects.base import Prior
from rrr_oc.effects.capabilities import BodyChange
from rrr_oc.robot.parameters import Parameter


class PayloadCom(BodyChange):
    """centre of the payload = tool point + (x, y, z), in the frame of the link that carries it."""

    name = "payload_com"
    title = "payload's centre"
    equation = "centre of the payload = tool point + (x, y, z)"
    plain = (
        "The payload's centre is off the tool point by {x:mm}, {y:mm} and {z:mm} along x, y and z of the frame of the "
        "link that carries it."
    )
    parameters = (Parameter("x", "m", 0.0), Parameter("y", "m", 0.0), Parameter("z", "m", 0.0))
    amplitudes = ("x", "y", "z")
    scope = "set_up"
    placement = "arm"
    alters = "position"
    step = 1e-4
    prior = Prior(
        0.02,
        {"x": (0.05, ""), "y": (0.05, ""), "z": (0.05, "")},
        "grippers and tools: centres are some centimetres off the flange",
    )

    def change(self, body, theta):
        return replace(body, position=[p + theta[k] for p, k in zip(body.position, "xyz", strict=True)])

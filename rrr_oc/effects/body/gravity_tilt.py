"""A base that is not level."""

import math
from dataclasses import replace

from rrr_oc.effects.base import Prior
from rrr_oc.effects.capabilities import BodyChange
from rrr_oc.effects.words import NORMAL
from rrr_oc.numerics.smooth import sin, sqrt
from rrr_oc.robot.parameters import Parameter

TINY = 1e-9  # [rad], added to the angle in squares, so that its derivative exists where there is no turn


class GravityTilt(BodyChange):
    """gravity in the base frame = exp(w)ᵀ g, where the base is turned by |w| about the axis w/|w|, w = (about_x, about_y, 0).

    Rodrigues: exp(w)ᵀ g = g − s (w × g) + c w × (w × g), s = sin|w|/|w|, c = (1 − cos|w|)/|w|². A turn about the vertical changes no
    torque; these two reach every direction of gravity, of which straight up has no axis of its own.
    """

    name = "gravity_tilt"
    title = "tilted base"
    equation = "gravity in the base frame = exp((about_x, about_y, 0))^T g"
    plain = "The arm's base is not level: turned by {turn}{about_x:deg} about x and {about_y:deg} about y of the base frame."
    parameters = tuple(Parameter(name, "rad", 0.0, -math.pi, math.pi) for name in ("about_x", "about_y"))
    amplitudes = ("about_x", "about_y")
    scope = "set_up"
    placement = "arm"
    alters = "gravity"
    step = 1e-4
    prior = Prior(
        0.01, {"about_x": (0.02, ""), "about_y": (0.02, "")}, "bases set up by eye or with a spirit level: within a degree"
    )

    def change(self, body, theta):
        x, y = (theta[k] for k in self.amplitudes)
        angle = sqrt(x * x + y * y + TINY**2)
        s, c = sin(angle) / angle, 2 * (sin(angle / 2) / angle) ** 2
        g = [body.gravity[i] for i in range(3)]
        across = _cross(x, y, g)
        twice = _cross(x, y, across)
        return replace(
            body, gravity=[one - s * first + c * second for one, first, second in zip(g, across, twice, strict=True)]
        )

    def possible(self, theta, payload):
        return math.hypot(*(theta[k] for k in self.amplitudes)) <= math.pi

    def derived(self, found):
        """The turn as one angle with its interval, to first order and as if both components were independent, and its axis."""
        (x, of_x), (y, of_y) = (found[k] for k in self.amplitudes)
        angle = math.hypot(x, y)
        if angle == 0.0:
            return {}
        std = None if of_x is None or of_y is None else math.hypot(x * of_x, y * of_y) / angle
        interval = None if std is None else [max(angle - NORMAL * std, 0.0), min(angle + NORMAL * std, math.pi)]
        axis = {"value": [x / angle, y / angle, 0.0], "std": None, "unit": "1"}
        return {"angle": {"value": angle, "std": std, "unit": "rad", "interval": interval}, "axis": axis}

    @classmethod
    def sentence(cls, joints, values):
        about = ", ".join(f"{round(x, 2) + 0.0:.2f}" for x in values["axis"].values) if "axis" in values else ""
        turn = f"{values['angle']:deg} about the axis ({about}), which is " if about else ""
        return super().sentence(joints, {**values, "turn": turn})


def _cross(x, y, v):
    """(x, y, 0) × v, each component."""
    return [y * v[2], -x * v[2], x * v[1] - y * v[0]]

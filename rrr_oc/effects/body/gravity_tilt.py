"""A base that is not level."""

import math
from dataclasses import replace

from rrr_oc.effects.base import Prior
from rrr_oc.effects.capabilities import BodyChange
from rrr_oc.numerics.smooth import cos, sin
from rrr_oc.robot.parameters import Parameter


class GravityTilt(BodyChange):
    """gravity in the base frame = (R_y(about_y) R_x(about_x))ᵀ g."""

    name = "gravity_tilt"
    equation = "gravity in the base frame = (R_y(about_y) R_x(about_x))^T g"
    plain = "The arm's base is not level: turned by {about_x:deg} about x and {about_y:deg} about y of the base frame."
    parameters = tuple(Parameter(name, "rad", 0.0, -math.pi / 2, math.pi / 2) for name in ("about_x", "about_y"))
    amplitudes = ("about_x", "about_y")
    scope = "set_up"
    placement = "arm"
    alters = "gravity"
    step = 1e-4
    prior = Prior(
        0.01, {"about_x": (0.02, ""), "about_y": (0.02, "")}, "bases set up by eye or with a spirit level: within a degree"
    )

    def change(self, body, theta):
        (cx, sx), (cy, sy) = ((cos(theta[k]), sin(theta[k])) for k in self.amplitudes)
        x, y, z = body.gravity[0], body.gravity[1], body.gravity[2]
        x, z = cy * x - sy * z, sy * x + cy * z  # R_yᵀ
        return replace(body, gravity=[x, cx * y + sx * z, -sx * y + cx * z])  # R_xᵀ

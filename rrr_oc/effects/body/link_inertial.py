"""A link whose mass, centre or inertia is not the URDF's."""

from dataclasses import replace

import casadi as ca

from rrr_oc.effects.base import Prior
from rrr_oc.effects.capabilities import BodyChange
from rrr_oc.robot.parameters import Parameter


class LinkInertial(BodyChange):
    """The link's ten inertial parameters are the URDF's plus these, which stand as in `Robot.inertial`."""

    name = "link_inertial"
    title = "inertial parameters of the link"
    equation = "inertial parameters of the link = URDF's + these"
    plain = (
        "The link that {joints} moves {of_mass}; its first moment differs "
        "by {first_moment} and its moments of inertia xx, yy and zz by {inertia:diag}, in the frame of {joints}."
    )
    parameters = (
        Parameter("mass", "kg"),
        *(Parameter(f"first_moment_{k}", "kg m") for k in "xyz"),
        *(Parameter(f"inertia_{k}", "kg m²") for k in ("xx", "xy", "yy", "xz", "yz", "zz")),
    )
    amplitudes = tuple(p.name for p in parameters)
    alters = "inertial"
    prior = Prior(
        0.01,
        {
            "mass": (0.2, "mass"),
            **{f"first_moment_{k}": (0.1, "mass length") for k in "xyz"},
            **{f"inertia_{k}": (0.05, "mass length²") for k in ("xx", "xy", "yy", "xz", "yz", "zz")},
        },
        "numbers from drawings against identified ones, as in Swevers, Verdonck & De Schutter 2007",
        where_exact=0.01,
    )
    composed = {  # noqa: RUF012
        "mass": "mass",
        "first_moment": ("first_moment_x", "first_moment_y", "first_moment_z"),
        "inertia": tuple(tuple(f"inertia_{k}" for k in row.split()) for row in ("xx xy xz", "xy yy yz", "xz yz zz")),
    }

    @classmethod
    def sentence(cls, joints, values):
        """A mass that may as well be the URDF's is not told as more or less."""
        mass = values["mass"]
        known = mass.interval is None or mass.interval[0] * mass.interval[1] > 0
        said = f"has {mass:abs} {mass:more|less} mass than the URDF says"
        return super().sentence(
            joints,
            {**values, "of_mass": said if known else f"may have the mass that the URDF says, the difference being {mass}"},
        )

    def change(self, body, theta):
        more = ca.vertcat(*(theta[k] for k in self.amplitudes))
        columns = ca.horzsplit(ca.SX(body.inertial))
        return replace(body, inertial=ca.horzcat(*[c + more if i == self.joints[0] else c for i, c in enumerate(columns)]))

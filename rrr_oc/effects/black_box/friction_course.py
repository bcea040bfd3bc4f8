"""Plain friction that has another value in each recording, as while an arm warms up or wears over a session."""

from dataclasses import dataclass
from typing import Literal

from rrr_oc.effects.base import SIGN_WIDTH, Prior
from rrr_oc.effects.capabilities import BlackBox, OfEach
from rrr_oc.errors import UserError
from rrr_oc.numerics.smooth import sign
from rrr_oc.robot.parameters import Parameter

Part = Literal["friction", "dry", "viscous"]
CHANGES: dict[Part, Parameter] = {
    "friction": Parameter("ratio", "1", 0.0),
    "dry": Parameter("dry", "Nm", 0.0),
    "viscous": Parameter("viscous", "Nm s/rad", 0.0),
}


@dataclass(frozen=True)
class FrictionCourse(OfEach, BlackBox):
    """tau = ratio (plain friction), −dry sgn(dq) or −viscous dq, with another value in each recording.

    Attributes:
        part: What of the plain friction changes.
    """

    name = "friction_course"
    equation = "tau = ratio (plain friction), -dry sgn(dq) or -viscous dq, another in each recording"
    parameters = (CHANGES["friction"],)
    amplitudes = ("ratio",)
    width = SIGN_WIDTH
    side = "drive"
    inputs = ("friction",)
    prior = Prior(
        0.001,
        {"ratio": (0.3, ""), "dry": (0.3, "dry"), "viscous": (0.3, "dry/speed")},
        "Bittencourt & Gunnarsson 2012: by temperature and grease; the catalogue comes first",
    )

    part: Part = "friction"

    def __post_init__(self) -> None:
        if self.part not in CHANGES:
            raise UserError(f"found part {self.part!r}; {', '.join(CHANGES)} are allowed")
        object.__setattr__(self, "parameters", (self.of_all,))
        object.__setattr__(self, "amplitudes", (self.of_all.name,))
        super().__post_init__()

    @property
    def of_all(self):
        return CHANGES[self.part]

    @property
    def depends_on(self):
        (j,) = self.joints
        of_speed = {"friction": (("dq", j), ("sign", j)), "dry": (("sign", j),), "viscous": (("dq", j),)}
        return (("time", -1), *of_speed[self.part])

    def words(self, theta):
        what = {"friction": "plain friction by a ratio", "dry": "dry friction", "viscous": "viscous friction"}[self.part]
        return f"{what} that changes from recording to recording, {self.course(theta)}"

    def torque(self, signals, theta, width):
        (j,), value = self.joints, self.value(signals, theta)
        if self.part == "friction":
            return (value * signals.friction[j],)
        return (-value * (sign(signals.dq[j], width) if self.part == "dry" else signals.dq[j]),)

    @classmethod
    def trials(cls, view):
        yield from ()

    @classmethod
    def black_box_trials(cls, view, j, ranges, torque):
        if torque != "load" and len(view.groups) > 1:
            for part in CHANGES:
                yield cls((j,), view.groups, part=part).trial(view)

"""Friction that changes with the torque that the gear transmits, or with that of the motor."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from rrr_oc.effects.base import SIGN_WIDTH, Effect, Prior
from rrr_oc.errors import UserError
from rrr_oc.numerics.smooth import fabs, sign
from rrr_oc.robot.parameters import Parameter

Follows = Literal["load", "motor", "motor without friction"]
LAWS: dict[Follows, str] = {
    "load": "tau = -mu |tau_l| sgn(dq)",
    "motor": "tau = -mu |tau_m| sgn(dq), tau_m the motor's torque with rotor inertia, friction and tau itself",
    "motor without friction": "tau = -mu |tau_l + J ddq| sgn(dq), tau_l + J ddq the motor's torque without its friction",
}
FELT = {"load": "its load", "motor": "the torque of its motor"}


@dataclass(frozen=True)
class LoadDependentFriction(Effect):
    """tau = −mu |tau_l| sgn(dq): the dissipative form of c_12 in Eq. 9, which prints mu sgn(dq) tau_l; of either sign.

    A gear rubs by what passes through its teeth. Behind the rotor that is the load torque; where the motor's bearings or its first
    stage rub, the motor's torque, which also turns the rotor and overcomes the plain friction. With y what that needs and
    s = sgn(dq), the motor has tau_m = y + mu |tau_m| s, so that tau = −(mu s |y| + mu² s² y) / (1 − mu² s²).

    A negative mu, as the paper has for joint 1, lowers the dry friction and might drive the joint beyond the loads recorded.

    Attributes:
        follows: What it grows with, one of `LAWS`.
    """

    name = "load_dependent_friction"
    title = "load-dependent friction"
    equation = "tau = -mu |tau_l| sgn(dq), or with the motor's torque in the place of tau_l"
    plain = "Dry friction of {joints} {mu:grows|falls} with {felt}: {mu:abs per load}."
    parameters = (Parameter("mu", "1", 0.0, lower=-1.0, upper=0.95),)  # with 1, the motor could not turn the joint
    amplitudes = ("mu",)
    step = 1e-3
    width = SIGN_WIDTH
    side = "drive"
    inputs = ("load", "friction", "rotor")
    scope = "set_up"
    options = {"follows": tuple(LAWS)}  # noqa: RUF012
    prior = Prior(
        0.05,
        {"mu": (0.1, "")},
        "Bittencourt & Gunnarsson 2012; Hamon, Gautier & Garrec 2010: some per cent",
    )

    follows: Follows = "load"

    def __post_init__(self) -> None:
        if self.follows not in LAWS:
            raise UserError(f"load-dependent friction follows {', '.join(LAWS)}, got {self.follows!r}")

    @property
    def law(self):
        return LAWS[self.follows]

    @property
    def said(self) -> Mapping[str, Any]:
        return {"follows": self.follows.split()[0]}

    @property
    def linear(self):
        return self.follows != "motor"

    @classmethod
    def sentence(cls, joints, values):
        return super().sentence(joints, {**values, "felt": FELT[str(values.get("follows", "load")).split()[0]]})

    def starts(self, theta):
        for follows in LAWS:
            if follows != self.follows:
                yield replace(self, follows=follows), theta

    def torque(self, signals, theta, width):
        (j,), mu = self.joints, theta["mu"]
        turn, y = sign(signals.dq[j], width), signals.load[j]
        if self.follows != "load":
            y = y - signals.rotor[j]
        if self.follows != "motor":
            return (-mu * fabs(y) * turn,)
        y = y - signals.friction[j]
        return (-(mu * turn * fabs(y) + (mu * turn) ** 2 * y) / (1 - (mu * turn) ** 2),)

    @classmethod
    def trials(cls, view):
        for j in range(view.n):
            for follows in LAWS:
                yield cls((j,), follows).trial(view)

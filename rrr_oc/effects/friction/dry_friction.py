"""Dry friction of one joint's drive: bearings, seals and gears, independent of load and speed."""

from dataclasses import dataclass

from rrr_oc.effects.base import SIGN_WIDTH
from rrr_oc.effects.capabilities import NativeTwin
from rrr_oc.errors import UserError
from rrr_oc.numerics.smooth import TURNS, sign
from rrr_oc.robot.parameters import Parameter


@dataclass(frozen=True)
class DryFriction(NativeTwin):
    """tau = −level sgn(dq): Coulomb's law, c_0 of Eq. 9, whose authors take tanh(20 dq) for the sign.

    `turn` is the function by which the sign changes over its width, one of `smooth.TURNS`. At rest the friction may have any value
    between −level and level; the law gives 0 there, so calibration leaves out samples at rest.
    """

    name = "dry_friction"
    equation = "tau = -level sgn(dq)"
    plain = "{joints} has dry friction of {level}."
    parameters = (Parameter("level", "Nm", 0.0, lower=0.0),)
    width = SIGN_WIDTH
    side = "drive"
    provides = "friction"
    motor = "dry_Nm"
    role = "plain"

    turn: str = "tanh"

    def __post_init__(self) -> None:
        if self.turn not in TURNS:
            raise UserError(f"dry friction changes sign by {', '.join(TURNS)}, got {self.turn!r}")

    def torque(self, signals, theta, width):
        return (-theta["level"] * sign(signals.dq[self.joints[0]], width, self.turn),)

    @property
    def sign_forms(self):
        return tuple(DryFriction(self.joints, turn) for turn in TURNS)

    def native(self, spec, joints, theta):
        """The joint's `frictionloss`: the exact law, which holds a joint at rest."""
        spec.joint(joints[self.joints[0]]).frictionloss += theta["level"]

"""Friction that depends on another joint's motion, as in a coupled wrist."""

from dataclasses import dataclass
from typing import Literal

from rrr_oc.effects.base import SIGN_WIDTH, Effect
from rrr_oc.numerics.smooth import sign
from rrr_oc.robot.parameters import Parameter


@dataclass(frozen=True)
class CoupledFriction(Effect):
    """tau_a = −(coulomb sgn(r) + viscous r) with r = dq_a ± dq_b, on joint b the same torque times ±1; or r = dq_b, on joint a alone.

    A gear that turns with two joints has friction on both (`form` "sum" or "difference"); a seal or hose that another joint drags
    along has it on one ("other").
    """

    name = "coupled_friction"
    equation = "tau_a = -(coulomb sgn(r) + viscous r), r = dq_a + dq_b, dq_a - dq_b or dq_b"
    parameters = (Parameter("coulomb", "Nm", 0.0, lower=0.0), Parameter("viscous", "Nm s/rad", 0.0, lower=0.0))
    amplitudes = ("coulomb", "viscous")
    width = SIGN_WIDTH
    side = "drive"
    placement = "pair"
    options = {"form": ("sum", "difference", "other")}  # noqa: RUF012

    form: Literal["sum", "difference", "other"] = "sum"

    def torque(self, signals, theta, width):
        a, b = self.joints
        own, other = {"sum": (1, 1), "difference": (1, -1), "other": (0, 1)}[self.form]
        rate = own * signals.dq[a] + other * signals.dq[b]
        torque = -theta["coulomb"] * sign(rate, width) - theta["viscous"] * rate
        return torque, own * other * torque

    @classmethod
    def trials(cls, view):
        for a in range(view.n):
            for b in range(view.n):
                for form in ("sum", "difference", "other"):
                    if a < b or (a > b and form == "other"):
                        yield cls((a, b), form).trial(view)

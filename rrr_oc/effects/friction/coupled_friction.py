"""Friction that depends on another joint's motion, as in a coupled wrist."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rrr_oc.effects.base import SIGN_WIDTH, Effect, Prior
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
    plain = "Friction of {own} {with_what}: dry friction of {coulomb} and viscous friction of {viscous}."
    parameters = (Parameter("coulomb", "Nm", 0.0, lower=0.0), Parameter("viscous", "Nm s/rad", 0.0, lower=0.0))
    amplitudes = ("coulomb", "viscous")
    width = SIGN_WIDTH
    side = "drive"
    placement = "pair"
    options = {"form": ("sum", "difference", "other")}  # noqa: RUF012
    prior = Prior(
        0.001,
        {"coulomb": (0.3, "dry"), "viscous": (0.3, "dry/speed")},
        "coupled wrists: Gautier, Janot & Vandanjon 2013, Stäubli TX40",
    )

    form: Literal["sum", "difference", "other"] = "sum"

    @property
    def law(self):
        rate = {
            "sum": ", tau_b = tau_a, r = dq_a + dq_b",
            "difference": ", tau_b = -tau_a, r = dq_a - dq_b",
            "other": ", r = dq_b",
        }
        return "tau_a = -(coulomb sgn(r) + viscous r)" + rate[self.form]

    @classmethod
    def sentence(cls, joints, values):
        other = joints[-1]
        moved = f"and {other} follows the {values.get('form')} of their speeds"
        with_what = f"follows the speed of {other}" if values.get("form") == "other" else moved
        return super().sentence(joints, {**values, "with_what": with_what})

    def torque(self, signals, theta, width):
        a, b = self.joints
        own, other = {"sum": (1, 1), "difference": (1, -1), "other": (0, 1)}[self.form]
        rate = own * signals.dq[a] + other * signals.dq[b]
        torque = -theta["coulomb"] * sign(rate, width) - theta["viscous"] * rate
        return torque, own * other * torque

    def scales(self, view, trial, prior=None):
        """Of the joint that feels it; if both do, of the one with less friction."""
        felt = self.joints[:1] if self.form == "other" else self.joints
        typical = (prior or self.prior).typical
        return np.array([number * view.unit(unit, felt) for number, unit in (typical[a] for a in self.amplitudes)])

    @classmethod
    def trials(cls, view):
        for a in range(view.n):
            for b in range(view.n):
                for form in ("sum", "difference", "other"):
                    if a < b or (a > b and form == "other"):
                        yield cls((a, b), form).trial(view)

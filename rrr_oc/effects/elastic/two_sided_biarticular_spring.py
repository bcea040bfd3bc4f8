"""Spring, rod or cable across two joints that pulls both ways."""

import math
from dataclasses import dataclass

import numpy as np

from rrr_oc.effects.base import Prior, Signals, Trial
from rrr_oc.effects.elastic.biarticular_spring import BiarticularSpring
from rrr_oc.effects.springs import Elastic, LinkSpring
from rrr_oc.robot.parameters import Parameter

LEVERS = (
    0.35,
    0.6,
    1.0,
    1.7,
    2.9,
)  # |rho| of trials, a factor of 1.7 apart; half as many, and fits start too far from the lever
FURTHEST = 2  # joints between which a spring is sought are as many apart at most; all pairs of seven joints double the trials


@dataclass(frozen=True)
class TwoSidedBiarticularSpring(Elastic, LinkSpring):
    """tau_a = −kappa s, tau_b = −rho kappa s, with the stretch s = q_a + rho q_b − phi; rho is negative where the cable is crossed.

    Eq. 5 of both windings back to back, which always pulls.
    """

    name = "two_sided_biarticular_spring"
    equation = "tau_a = -kappa (q_a + rho q_b - phi), tau_b = rho tau_a"
    plain = (
        "A spring that no recording lists acts across {joints} and pulls both ways: {kappa} at {own}, with a lever of {rho} "
        "times that at {other}; it rests where {own} {sign} {rho:bare abs} times {other} is {phi:deg}."
    )
    parameters = (Parameter("kappa", "Nm/rad", 5.0, lower=0.0), Parameter("rho", "1", 1.0), Parameter("phi", "rad"))
    amplitudes = ("kappa", "phi")
    goes_slack = False
    placement = "pair"
    prior = Prior(
        0.0005, {"kappa": (0.5, "torque")}, "as springs across two joints, of hoses as well as of steel", where_springs=10.0
    )

    @classmethod
    def sentence(cls, joints, values):
        return super().sentence(joints, {**values, "sign": f"{values['rho']:plus|minus}"})

    def stretch(self, signals, theta):
        a, b = self.joints
        return -(signals.q[a] + theta["rho"] * signals.q[b] - theta["phi"])

    def lever(self, theta):
        return 1.0, theta["rho"]

    def moved(self, theta, offset):
        return {**theta, "phi": theta["phi"] + offset}

    @property
    def linear(self):
        return False  # in the product of kappa and phi, and in the lever

    def equivalents(self, theta):
        """A spring that pulls one way, of either winding, where the motion never lets it go slack."""
        other = 1 if theta["rho"] >= 0 else -1
        for way in (1, -1):
            numbers = {"kappa": theta["kappa"], "rho": abs(theta["rho"]), "phi": -way * theta["phi"]}
            yield BiarticularSpring(self.joints, (way, way * other)), numbers

    def scales(self, view, trial, prior=None):
        """The typical torque, on both joints as the geometric mean, is that at the recorded position that stretches the spring most."""
        number, unit = (prior or self.prior).typical["kappa"]
        result, (a, b) = [], self.joints
        for theta in trial.points:
            typical = math.sqrt(view.unit(unit, (a,)) * view.unit(unit, (b,)) / abs(theta["rho"]))
            stretch = float(np.abs(self.stretch(Signals(view.positions), theta)).max())
            result.append(number * typical / max(stretch, 1e-3))
        return np.array(result)

    @classmethod
    def trials(cls, view):
        """For each lever the spring as the sum of two, which rest at the ends of the stretch."""
        for a in range(view.n):
            for b in range(a + 1, min(a + FURTHEST + 1, view.n)):
                for rho in (way * lever for way in (1, -1) for lever in LEVERS):
                    length = view.positions[a] + rho * view.positions[b]
                    ends = (float(length.min()), float(length.max()))
                    yield Trial(cls((a, b)), tuple({"kappa": 1.0, "rho": rho, "phi": phi} for phi in ends))

    def combined(self, points, coefficients):
        kappa = float(np.sum(coefficients))
        phi = sum(c * p["phi"] for c, p in zip(coefficients, points, strict=True)) / (kappa or 1e-12)
        return {"kappa": kappa, "rho": points[0]["rho"], "phi": float(phi)}

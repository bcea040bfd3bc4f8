"""An elastic torque of a dress pack, cable or hose that is led along a joint."""

from dataclasses import dataclass

import numpy as np

from rrr_oc.effects.base import Prior, Trial
from rrr_oc.effects.elastic.parallel_spring import SIDES, ParallelSpring
from rrr_oc.effects.springs import Elastic
from rrr_oc.robot.parameters import Parameter

RESTS = (0.1, 0.3, 0.5, 0.7, 0.9)  # of trials that harden, as shares of the range; fits move them


@dataclass(frozen=True)
class CableHarness(Elastic):
    """tau = −stiffness x − hardening x³, x = q − rest: the two terms of an odd law, the second only where it `hardens`.

    Attributes:
        hardens: Whether it has the second term, of either sign; else it has no parameter `hardening`.
    """

    name = "cable_harness"
    equation = "tau = -stiffness (q - rest) - hardening (q - rest)^3"
    plain = (
        "Something elastic, such as a cable, a hose or a spring that acts both ways, pulls {joints} back towards "
        "{rest:deg}: {stiffness}{more}."
    )
    parameters = (
        Parameter("stiffness", "Nm/rad", 0.0, lower=0.0),
        Parameter("rest", "rad", 0.0),
        Parameter("hardening", "Nm/rad³", 0.0),
    )
    amplitudes = ("stiffness", "rest")
    scope = "set_up"
    prior = Prior(
        0.01,
        {"stiffness": (0.25, "torque/travel"), "hardening": (1.0, "torque/travel³")},
        "dress packs are led so that they pull less than the load does",
    )

    goes_slack = False

    hardens: bool = False

    def __post_init__(self) -> None:
        if self.hardens:  # linear in both at a given rest; without, in the stiffness and its product with the rest
            object.__setattr__(self, "amplitudes", ("stiffness", "hardening"))
        else:
            object.__setattr__(self, "parameters", self.parameters[:2])

    def stretch(self, signals, theta):
        return theta["rest"] - signals.q[self.joints[0]]

    def torque(self, signals, theta, width):
        (linear,) = super().torque(signals, theta, width)
        return (linear + theta["hardening"] * self.stretch(signals, theta) ** 3 if self.hardens else linear,)

    def energy(self, signals, theta, width):
        linear = super().energy(signals, theta, width)
        return linear + theta["hardening"] * self.stretch(signals, theta) ** 4 / 4 if self.hardens else linear

    @property
    def law(self):
        return self.equation if self.hardens else "tau = -stiffness (q - rest)"

    @property
    def linear(self):
        return False  # in the rest

    def equivalents(self, theta):
        """A spring that always pulls, unless it hardens; what some recordings have and others have not is more probably a spring."""
        for active in SIDES:
            yield ParallelSpring(self.joints, active), {"stiffness": theta["stiffness"], "equilibrium": theta["rest"]}

    @classmethod
    def sentence(cls, joints, values):
        more = f", and {values['hardening']} times the third power of the angle" if "hardening" in values else ""
        return super().sentence(joints, {**values, "more": more})

    @classmethod
    def trials(cls, view):
        for j in range(view.n):
            yield Trial(cls((j,)), ({"stiffness": 1.0, "rest": view.low[j]}, {"stiffness": 1.0, "rest": view.high[j]}))
            for share in RESTS:
                rest = float(view.low[j] + share * (view.high[j] - view.low[j]))
                yield cls((j,), True).trial(view, rest=rest)

    def combined(self, points, coefficients):
        if self.hardens:
            return super().combined(points, coefficients)
        stiffness = float(np.sum(coefficients))
        rest = sum(c * p["rest"] for c, p in zip(coefficients, points, strict=True)) / (stiffness or 1e-12)
        return {"stiffness": stiffness, "rest": float(rest)}

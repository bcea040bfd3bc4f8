"""An elastic torque of a dress pack, cable or hose that is led along a joint."""

import numpy as np

from rrr_oc.effects.base import Effect, Prior, Trial
from rrr_oc.effects.elastic.parallel_spring import SIDES, ParallelSpring
from rrr_oc.robot.parameters import Parameter


class CableHarness(Effect):
    """tau = −stiffness (q − rest)."""

    name = "cable_harness"
    equation = "tau = -stiffness (q - rest)"
    plain = "Something elastic, such as a cable or a hose, pulls {joints} back towards {rest:deg}: {stiffness}."
    parameters = (Parameter("stiffness", "Nm/rad", 0.0, lower=0.0), Parameter("rest", "rad", 0.0))
    amplitudes = ("stiffness", "rest")
    scope = "set_up"
    prior = Prior(0.01, {"stiffness": (0.25, "torque/travel")}, "dress packs are led so that they pull less than the load does")

    def torque(self, signals, theta, width):
        return (-theta["stiffness"] * (signals.q[self.joints[0]] - theta["rest"]),)

    def energy(self, signals, theta, width):
        return theta["stiffness"] * (signals.q[self.joints[0]] - theta["rest"]) ** 2 / 2

    @property
    def linear(self):
        return False  # in the product of both

    def equivalents(self, theta):
        """A spring that always pulls; what some recordings have and others have not is more probably a spring."""
        for active in SIDES:
            yield ParallelSpring(self.joints, active), {"stiffness": theta["stiffness"], "equilibrium": theta["rest"]}

    @classmethod
    def trials(cls, view):
        for j in range(view.n):
            yield Trial(cls((j,)), ({"stiffness": 1.0, "rest": view.low[j]}, {"stiffness": 1.0, "rest": view.high[j]}))

    def combined(self, points, coefficients):
        stiffness = float(np.sum(coefficients))
        rest = sum(c * p["rest"] for c, p in zip(coefficients, points, strict=True)) / (stiffness or 1e-12)
        return {"stiffness": stiffness, "rest": float(rest)}

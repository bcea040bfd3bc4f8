"""Spring in parallel with one joint's drive (PEA)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rrr_oc.effects.base import Prior
from rrr_oc.effects.design_form import DesignForm, about_a_joint
from rrr_oc.effects.springs import ListedSpring, Listing, Wound
from rrr_oc.robot.parameters import Parameter

FURTHEST = 4 * np.pi  # [rad], largest equilibrium; a spring beyond acts as a constant torque, which is another effect
SIDES = ("below", "above")


@dataclass(frozen=True)
class ParallelSpring(Wound, ListedSpring):
    """Unilateral spiral torsion spring across one joint (Eq. 3).

    tau_p = −k (q − q_eq) where q ≥ q_eq (`active="above"`, as Eq. 3 is printed), or where q ≤ q_eq (`active="below"`, the
    inverted orientation, which holds the arm up with the joint signs used here).
    """

    name = "parallel_spring"
    equation = "tau = stiffness (equilibrium - q) on the active side of the equilibrium, else 0"
    plain = "A spring that no recording lists acts across {joints}: {stiffness}, {active} its equilibrium of {equilibrium:deg}."
    parameters = (Parameter("stiffness", "Nm/rad", 5.0, lower=0.0), Parameter("equilibrium", "rad"))
    amplitudes = ("stiffness",)
    width = Parameter("width", "rad", 1e-3, lower=0.0)
    options = {"active": SIDES}  # noqa: RUF012
    prior = Prior(
        0.002,
        {"stiffness": (1.0, "torque")},
        "springs that carry gravity pull with the order of the joint's torque",
        where_springs=10.0,
    )
    listing = Listing("pea", ("stiffness_Nm_per_rad", "equilibrium_rad"))
    design = DesignForm(
        "PEA",
        "springs in parallel with joints",
        about_a_joint("k_p", "q_eq"),
        shop="parallel_springs_Nm_per_rad",
    )

    active: Literal["below", "above"] = "below"

    @property
    def law(self):
        below = "tau = stiffness max(equilibrium - q, 0)"
        return below if self.active == "below" else "tau = -stiffness max(q - equilibrium, 0)"

    @property
    def _sign(self) -> int:
        return 1 if self.active == "below" else -1

    def stretch(self, signals, theta):
        return self._sign * (theta["equilibrium"] - signals.q[self.joints[0]])

    def lever(self, theta):
        return (self._sign,)

    def possible(self, theta, payload):
        return super().possible(theta, payload) and abs(theta["equilibrium"]) < FURTHEST

    def scales(self, view, trial, prior=None):
        """The typical torque is that at the recorded position that stretches the spring most."""
        (j,), (number, unit) = self.joints, (prior or self.prior).typical["stiffness"]
        rest = trial.points[0]["equilibrium"]
        stretch = rest - view.low[j] if self.active == "below" else view.high[j] - rest
        return np.array([number * view.unit(unit, self.joints) / stretch])

    @classmethod
    def trials(cls, view):
        for j in range(view.n):
            for active in SIDES:
                for share in (0.12, 0.25, 0.37, 0.5, 0.62, 0.75, 0.88, 1.0):
                    way = view.high[j] - view.low[j]
                    start = view.low[j] + share * way if active == "below" else view.high[j] - share * way
                    yield cls((j,), active).trial(view, equilibrium=float(start))

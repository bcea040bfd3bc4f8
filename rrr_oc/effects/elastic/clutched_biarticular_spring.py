"""Spring across two joints that a clutch connects in one phase of a task only, for co-designs."""

from dataclasses import dataclass

import numpy as np

from rrr_oc.effects.elastic.biarticular_spring import WIDER, Biarticular, BiarticularForm, wound
from rrr_oc.effects.springs import Clutched
from rrr_oc.errors import UserError


@dataclass(frozen=True)
class ClutchedBiarticularSpring(Clutched, Biarticular):
    """Biarticular spring with a clutch and a lock: the law of `BiarticularSpring` in one phase of a task, no torque in the other.

    The clutch opens and closes where the arm stands still, between the phases. While it is open, the lock holds the cable, so that the
    spring keeps its energy. The cable comes back to its phase as it left it, so its stretch must be the same at both ends of the
    phase. That decides the ratio of the two levers: rho = −w_a Δq_a / (w_b Δq_b), with the joints' ways Δq from start to release. A
    plain clutch and lock do; nothing has to be wound up, and no energy is lost. The mass and the power of the clutch are not modelled.
    """

    name = "clutched_biarticular_spring"
    equation = "as biarticular_spring in one phase of a task, else 0"
    plain = (
        "In one phase ({phase}) a spring acts across {joints}: {kappa} at {own}, with a lever of {rho} times that at {other}; its "
        "phase is {phi:deg}."
    )
    role = "design"
    options = {**Biarticular.options, **Clutched.options}  # noqa: RUF012
    design = BiarticularForm("CBPEA", "a spring across two joints that a clutch connects in one phase", wound("c"))

    def kept_energy(self, lower, upper, ends):
        """The ratio of the levers is that with which the cable is as long at one end as at the other."""
        (a, b), (wa, wb) = self.joints, self.winding
        way = ends[1] - ends[0]
        rho = -wa * way[a] / (wb * way[b]) if way[b] else np.inf
        low, high = lower[1] * WIDER, upper[1] / WIDER
        if not low <= rho <= high:
            raise UserError(
                f"the cable is as long at the start as at the release only with r_3/r_2 = {rho:.4g}, and the windings and radii "
                f"allow {low:.4g} … {high:.4g}"
            )
        fixed = np.array([False, True, False])
        return np.where(fixed, rho, lower), np.where(fixed, rho, upper)

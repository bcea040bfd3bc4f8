"""Spring across one joint that a clutch connects in one phase of a task only, for co-designs."""

import numpy as np

from rrr_oc.effects.design_form import DesignForm, about_a_joint
from rrr_oc.effects.elastic.two_sided_spring import TwoSidedSpring
from rrr_oc.effects.springs import Clutched
from rrr_oc.errors import UserError


class ClutchedSpring(Clutched, TwoSidedSpring):
    """Two-sided spring with a clutch to the link and a lock: tau = −stiffness (q − equilibrium) in one phase, 0 in the other.

    The clutch opens and closes where the arm stands still, between the phases. While it is open, the lock holds the spring as it is, so
    that it keeps its energy. The spring comes back to its phase as it left it, so a repeated task is possible without loss only if the
    energy is the same at both ends of the phase, stiffness (start − equilibrium)² = stiffness (end − equilibrium)²: the equilibrium
    is in the middle between start and release. The spring is stretched to one side at the start and to the other at the end. It
    comes back as its mirror image, which needs a clutch that connects it either way round, such as the differential of the
    bi-directional clutched actuator by Plooij, van Nunspeet, Wisse and Vallery (2015).

    A spring that the clutch lets go under load would lose its energy, and one that a phase leaves with less energy would have to be
    wound up again; neither is offered. Nor does the clutch weigh or use anything here.
    """

    name = "clutched_spring"
    equation = "tau = -stiffness (q - equilibrium) in one phase of a task, else 0"
    plain = "In one phase ({phase}) a spring pulls {joints} towards {equilibrium:deg} from both sides: {stiffness}."
    design = DesignForm("CPEA", "springs across one joint that a clutch connects in one phase", about_a_joint("k_c", "q_c"))

    def kept_energy(self, lower, upper, ends):
        """The equilibrium is the middle between the ends."""
        middle = float(np.mean([q[self.joints[0]] for q in ends]))
        if not lower[1] <= middle <= upper[1]:
            low, high = np.degrees([lower[1], upper[1]])
            raise UserError(
                f"equilibrium_deg: found {low:g} … {high:g}; it must allow {np.degrees(middle):.2f}, the middle between start and "
                "release, where the spring keeps its energy while the clutch is open"
            )
        return np.array([lower[0], middle]), np.array([upper[0], middle])

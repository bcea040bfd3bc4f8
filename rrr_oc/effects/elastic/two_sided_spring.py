"""Spring across one joint that pulls both ways, for co-designs."""

import numpy as np

from rrr_oc.effects.capabilities import NativeTwin
from rrr_oc.effects.design_form import DesignForm, Quantity
from rrr_oc.effects.springs import DesignSpring, LinkSpring, two_sided_tendon
from rrr_oc.robot.parameters import Parameter


class TwoSidedSpring(LinkSpring, DesignSpring, NativeTwin):
    """Torsion spring with both ends fixed: tau = −stiffness (q − equilibrium), on both sides of the equilibrium."""

    name = "two_sided_spring"
    equation = "tau = -stiffness (q - equilibrium)"
    plain = "A spring pulls {joints} towards {equilibrium:deg} from both sides: {stiffness}."
    parameters = (Parameter("stiffness", "Nm/rad", 5.0, lower=0.0), Parameter("equilibrium", "rad"))
    amplitudes = ("stiffness",)
    role = "design"
    design = DesignForm(
        "TPEA",
        "springs in parallel with joints that pull both ways",
        (
            Quantity("k_t", "stiffness_Nm_per_rad", "Nm/rad", lowest=0.0),
            Quantity("q_t", "equilibrium_deg", "rad", np.pi / 180, free=True),
        ),
    )

    def _deflection(self, signals, theta):
        return signals.q[self.joints[0]] - theta["equilibrium"]

    def torque(self, signals, theta, width):
        return (-theta["stiffness"] * self._deflection(signals, theta),)

    def energy(self, signals, theta, width):
        return theta["stiffness"] * self._deflection(signals, theta) ** 2 / 2

    def native(self, spec, joints, theta):
        """A fixed tendon over one joint, so that several springs of a joint add up; its spring is slack nowhere."""
        two_sided_tendon(spec, self.name, joints[self.joints[0]], theta["stiffness"], theta["equilibrium"])

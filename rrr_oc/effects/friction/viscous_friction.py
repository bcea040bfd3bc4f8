"""Viscous friction of one joint's drive: grease, and what a motor loses in proportion to speed."""

from dataclasses import dataclass

from rrr_oc.effects.base import Effect
from rrr_oc.robot.parameters import Parameter


@dataclass(frozen=True)
class ViscousFriction(Effect):
    """tau = −coefficient dq: nu of Eq. 9."""

    name = "viscous_friction"
    parameters = (Parameter("coefficient", "Nm s/rad", 0.0, lower=0.0),)
    side = "drive"
    provides = "friction"
    role = "plain"

    def torque(self, signals, theta, width):
        return (-theta["coefficient"] * signals.dq[self.joints[0]],)

    def native(self, spec, joints, theta):
        """The joint's `damping`."""
        spec.joint(joints[self.joints[0]]).damping[0] += theta["coefficient"]
        return True

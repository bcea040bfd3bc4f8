"""Viscous friction of one joint's drive: grease, and losses of the motor in proportion to speed."""

from rrr_oc.effects.capabilities import NativeTwin
from rrr_oc.robot.parameters import Parameter


class ViscousFriction(NativeTwin):
    """tau = −coefficient dq: nu of Eq. 9."""

    name = "viscous_friction"
    equation = "tau = -coefficient dq"
    plain = "{joints} has viscous friction of {coefficient}."
    parameters = (Parameter("coefficient", "Nm s/rad", 0.0, lower=0.0),)
    side = "drive"
    provides = "friction"
    motor = "viscous_Nm_s_per_rad"
    role = "plain"

    def torque(self, signals, theta, width):
        return (-theta["coefficient"] * signals.dq[self.joints[0]],)

    def native(self, spec, joints, theta):
        """The joint's `damping`."""
        spec.joint(joints[self.joints[0]]).damping[0] += theta["coefficient"]

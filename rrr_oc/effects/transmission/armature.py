"""Inertia of one joint's motor and gear, reflected to the joint."""

from rrr_oc.effects.capabilities import NativeTwin
from rrr_oc.robot.parameters import Parameter


class Armature(NativeTwin):
    """tau = −inertia ddq: J_m of Eq. 7, the rotor's inertia times the gear ratio squared.

    The rotor's spin about its own axis is all that counts; its mass is part of the link that carries it.
    """

    name = "armature"
    equation = "tau = -inertia ddq"
    plain = "The rotor of {joints} adds an inertia of {inertia}."
    parameters = (Parameter("inertia", "kg m²", 0.0, lower=0.0),)
    side = "drive"
    provides = "rotor"
    motor = "inertia_kg_m2"
    role = "plain"

    def torque(self, signals, theta, width):
        return (-theta["inertia"] * signals.ddq[self.joints[0]],)

    def native(self, spec, joints, theta):
        """The joint's `armature`."""
        spec.joint(joints[self.joints[0]]).armature += theta["inertia"]

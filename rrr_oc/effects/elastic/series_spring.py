"""Spring between a drive and its link, for co-designs: series elastic actuation."""

from rrr_oc.effects.capabilities import MovesLink
from rrr_oc.effects.design_form import DesignForm, Quantity
from rrr_oc.effects.springs import DesignSpring
from rrr_oc.effects.transmission.joint_elasticity import JointElasticity
from rrr_oc.robot.parameters import Parameter


class SeriesSpring(DesignSpring, MovesLink):
    """The whole load torque passes through the spring: q_motor − q = compliance · tau_load (Spong 1987).

    It adds no torque to the links. What it changes is how the drive moves: q_motor' = q' + compliance tau_load', and the drive's
    inertia takes torque by q_motor''. There is no damping.
    """

    name = "series_spring"
    equation = "q_motor - q = compliance tau_load"
    plain = "A spring between drive and link of {joints} twists by {compliance} of its load."
    parameters = (Parameter("compliance", "rad/Nm", 0.001, lower=1e-9),)
    amplitudes = ("compliance",)
    role = "design"
    design = DesignForm(
        "SEA",
        "springs between drives and links",
        (Quantity("c_s", "compliance_mrad_per_Nm", "rad/Nm", 1e-3, lowest=0.01),),
    )

    @classmethod
    def trials(cls, view):
        """None: what gives in a recorded arm is a gear, `JointElasticity`."""
        yield from ()

    def motion(self, t, load, stiffness, inertia, theta):
        """Of an undamped gear."""
        own = {"stiffness": 1 / theta["compliance"], "damping_time": 0.0}
        return JointElasticity(self.joints).motion(t, load, stiffness, inertia, own)

    def gear(self, twist, theta, stiffest):
        twist.stiffness[0] = min(1 / theta["compliance"], stiffest)

"""Spring across one joint that pulls both ways, for co-designs."""

from rrr_oc.effects.design_form import DesignForm, about_a_joint
from rrr_oc.effects.springs import DesignSpring, Elastic, LinkSpring
from rrr_oc.robot.parameters import Parameter


class TwoSidedSpring(Elastic, LinkSpring, DesignSpring):
    """Torsion spring with both ends fixed: tau = −stiffness (q − equilibrium), on both sides of the equilibrium."""

    name = "two_sided_spring"
    equation = "tau = -stiffness (q - equilibrium)"
    plain = "A spring pulls {joints} towards {equilibrium:deg} from both sides: {stiffness}."
    parameters = (Parameter("stiffness", "Nm/rad", 5.0, lower=0.0), Parameter("equilibrium", "rad"))
    amplitudes = ("stiffness",)
    role = "design"
    design = DesignForm("TPEA", "springs in parallel with joints that pull both ways", about_a_joint("k_t", "q_t"))
    goes_slack = False

    def stretch(self, signals, theta):
        return theta["equilibrium"] - signals.q[self.joints[0]]

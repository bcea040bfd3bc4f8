"""Plain friction that differs in some recordings from the rest, as after a cold start or new grease."""

from rrr_oc.effects.base import SIGN_WIDTH, Prior
from rrr_oc.effects.capabilities import BlackBox
from rrr_oc.numerics.smooth import sign
from rrr_oc.robot.parameters import Parameter


class FrictionChange(BlackBox):
    """tau = −dry sgn(dq) − viscous dq, in some recordings only; in all of them it would be the plain friction itself.

    The recordings show that friction changed; no law of the catalogue says why.
    """

    name = "friction_change"
    equation = "tau = -dry sgn(dq) - viscous dq"
    parameters = (Parameter("dry", "Nm", 0.0), Parameter("viscous", "Nm s/rad", 0.0))
    amplitudes = ("dry", "viscous")
    width = SIGN_WIDTH
    side = "drive"
    scope = "some"
    prior = Prior(
        0.002,
        {"dry": (0.5, "dry"), "viscous": (0.5, "dry/speed")},
        "Bittencourt & Gunnarsson 2012: by temperature and grease; the catalogue comes first",
    )

    @property
    def depends_on(self):
        return (("dq", self.joints[0]), ("sign", self.joints[0]))

    def words(self, theta):
        return f"dry friction that is {theta['dry']:+.3g} Nm and viscous friction that is {theta['viscous']:+.3g} Nm s/rad off there"

    def torque(self, signals, theta, width):
        speed = signals.dq[self.joints[0]]
        return (-theta["dry"] * sign(speed, width) - theta["viscous"] * speed,)

    @classmethod
    def black_box_trials(cls, view, j, ranges, torque):
        if torque != "load":  # links have no drive's friction
            yield cls((j,)).trial(view)

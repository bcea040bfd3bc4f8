"""Dry friction that depends on the joint's own angle, as of a bent shaft or a worn seal."""

import numpy as np

from rrr_oc.effects.base import SIGN_WIDTH, Effect, Prior, Trial, canonical_wave
from rrr_oc.effects.words import periodic
from rrr_oc.numerics.smooth import cos, sign
from rrr_oc.robot.parameters import Parameter


class PositionDependentFriction(Effect):
    """tau = −amplitude cos(order q − phase) sgn(dq), beside the plain level."""

    name = "position_dependent_friction"
    title = "position-dependent friction"
    equation = "tau = -amplitude cos(order q - phase) sgn(dq)"
    plain = (
        "Dry friction of {joints} changes with its angle: by {amplitude} either way, {order:rev}; it is largest at "
        "{most:deg} and every {period:bare deg} from there."
    )
    parameters = (Parameter("amplitude", "Nm"), Parameter("order", "1", 1.0, lower=0.0), Parameter("phase", "rad"))
    amplitudes = ("amplitude",)
    width = SIGN_WIDTH
    side = "drive"
    prior = Prior(
        0.01, {"amplitude": (0.3, "dry")}, "Armstrong-Hélouvry 1991, PUMA 560: friction over the angle of gears and bearings"
    )

    @classmethod
    def sentence(cls, joints, values):
        return super().sentence(joints, {**values, **periodic(values, values["phase"])})

    def torque(self, signals, theta, width):
        j = self.joints[0]
        profile = cos(theta["order"] * signals.q[j] - theta["phase"])
        return (-theta["amplitude"] * profile * sign(signals.dq[j], width),)

    @classmethod
    def trials(cls, view):
        for j in range(view.n):
            turn = 2 * np.pi / (view.high[j] - view.low[j])
            for cycles in (0.5, 0.75, 1.0, 1.35, 1.8, 2.3, 2.8, 3.5, 4.2):
                points = tuple({"amplitude": 1.0, "order": cycles * turn, "phase": phase} for phase in (0.0, np.pi / 2))
                effect = cls((j,))
                yield Trial(effect, points, width=effect.sign_width(view))

    def canonical(self, theta):
        return canonical_wave(theta)

    def combined(self, points, coefficients):
        """c_0 cos x + c_1 sin x as one cosine."""
        c, s = map(float, coefficients)
        return {"amplitude": float(np.hypot(c, s)), "order": points[0]["order"], "phase": float(np.arctan2(s, c))}

"""Friction that builds up over a small travel, as of bristles that bend before they slip."""

from dataclasses import replace

from rrr_oc.effects.base import Prior
from rrr_oc.effects.capabilities import ExportTwin, WithStates
from rrr_oc.numerics.smooth import fabs, fmax, sign
from rrr_oc.robot.parameters import Parameter


class PreslidingHysteresis(WithStates, ExportTwin):
    """tau = −level z with dz/dt = |dq| (sgn(dq) − z) stiffness/level (Dahl 1968), beside the plain level.

    With a width the sign is tanh(dq / width). For a large stiffness the law tends to the plain one.
    """

    name = "presliding_hysteresis"
    equation = "tau = -level z, dz/dt = |dq| (sgn(dq) - z) stiffness / level"
    plain = "Dry friction of {joints} builds up after each reversal: {level}, with a stiffness of {stiffness} before it slips."
    parameters = (Parameter("stiffness", "Nm/rad", 100.0, lower=1e-3), Parameter("level", "Nm", 0.0, lower=0.0))
    amplitudes = ("level",)
    states = (Parameter("z", "1", 0.0),)
    width = Parameter("width", "rad/s", 0.0, lower=0.0)
    side = "drive"
    resembles = "friction_over_speed"
    prior = Prior(
        0.03, {"level": (1.0, "dry")}, "Swevers et al. 2000: all dry friction builds up over a travel; slow reversals show it"
    )

    def torque(self, signals, theta, width):
        return (-theta["level"] * (0 * signals.q[self.joints[0]] if signals.states is None else signals.states[0]),)

    def rate(self, signals, theta, width):
        dq = signals.dq[self.joints[0]]
        return (fabs(dq) * (sign(dq, width) - signals.states[0]) * theta["stiffness"] / fmax(theta["level"], 1e-9),)

    def native(self, spec, joints, theta):
        """A passive motor's friction with equal static and kinetic levels, and bristles without damping."""
        if theta["level"] > 0:
            law = (theta["stiffness"], 0.0, theta["level"], theta["level"], 1.0)  # at equal levels no speed matters
            self.passive_motor(spec, joints[self.joints[0]], lugre=law)

    @classmethod
    def trials(cls, view):
        for j in range(view.n):
            for share in (0.00001, 0.0002, 0.0006, 0.0015, 0.004, 0.01, 0.025, 0.06):
                trial = cls((j,)).trial(view, stiffness=1 / (share * (view.high[j] - view.low[j])))
                yield from (trial, replace(trial, width=0.0))

    def combined(self, points, coefficients):
        """The points have the travel level/stiffness in common."""
        level = float(coefficients[0])
        return {"stiffness": points[0]["stiffness"] * level, "level": level}

"""Torque that is periodic in the joint's angle: cogging, gear mesh, a harmonic drive's wave."""

import numpy as np

from rrr_oc.effects.base import Prior, Trial, View, canonical_wave
from rrr_oc.effects.capabilities import ExportTwin
from rrr_oc.effects.words import periodic
from rrr_oc.numerics.smooth import sin
from rrr_oc.robot.parameters import Parameter

LEAST_CYCLES = 2  # that recordings must see of a trial; with fewer, it may be any smooth torque, and a series is tried first
FASTEST = 5.0  # [Hz] of a trial at the joint's usual speed: what the filter of the recordings lets through


class TorqueRipple(ExportTwin):
    """tau = amplitude sin(order q + phase); one effect an order."""

    name = "torque_ripple"
    equation = "tau = amplitude sin(order q + phase)"
    plain = (
        "The torque of {joints} ripples with its angle: by {amplitude} either way, {order:rev}; it pushes forward most at "
        "{most:deg} and every {period:bare deg} from there."
    )
    parameters = (Parameter("amplitude", "Nm"), Parameter("order", "1", 1.0, lower=0.0), Parameter("phase", "rad"))
    amplitudes = ("amplitude",)
    side = "drive"
    placement = "many"
    resembles = "position_harmonic"
    prior = Prior(
        0.02,
        {"amplitude": (0.07, "torque")},
        "Tuttle & Seering 1996, Taghirad & Bélanger 1998; data sheets: cogging of 1 to 5 % of rated torque",
    )

    @classmethod
    def sentence(cls, joints, values):
        """The sine is 1 where its argument is a quarter turn."""
        return super().sentence(joints, {**values, **periodic(values, -(values["phase"] + -np.pi / 2))})

    def torque(self, signals, theta, width):
        return (theta["amplitude"] * sin(theta["order"] * signals.q[self.joints[0]] + theta["phase"]),)

    def native(self, spec, joints, theta):
        """A passive motor's cogging."""
        law = (theta["amplitude"], theta["order"], theta["phase"])
        self.passive_motor(spec, joints[self.joints[0]], cogging=law)

    @classmethod
    def trials(cls, view):
        """Whole orders of which the recordings see at least two cycles, slow enough to pass the filter."""
        for j in range(view.n):
            yield from cls._whole(j, _order(view, j, LEAST_CYCLES), _fastest(view, j))

    @classmethod
    def _whole(cls, j, least, most):
        for order in range(max(least, 1), most, max(1, least // (4 * LEAST_CYCLES))):  # a quarter cycle apart over the travel
            yield Trial(cls((j,)), tuple({"amplitude": 1.0, "order": order, "phase": p} for p in (0.0, np.pi / 2)))

    def canonical(self, theta):
        return canonical_wave(theta)

    def combined(self, points, coefficients):
        """c_0 sin x + c_1 cos x as one sine."""
        s, c = map(float, coefficients)
        return {"amplitude": float(np.hypot(c, s)), "order": points[0]["order"], "phase": float(np.arctan2(c, s))}


def _order(view: View, j: int, cycles: float) -> int:
    """The least whole order of which the recordings see that many cycles."""
    return int(np.ceil(2 * np.pi * cycles / (view.high[j] - view.low[j])))


def _fastest(view: View, j: int) -> int:
    """The least whole order that is too fast for the filter at the joint's usual speed in its slowest recording."""
    return int(np.ceil(2 * np.pi * FASTEST / view.usual_speed[j]))

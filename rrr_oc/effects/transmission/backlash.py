"""Play between motor and link."""

from dataclasses import dataclass

import numpy as np

from rrr_oc.effects.base import Prior, Trial
from rrr_oc.effects.capabilities import MovesLink
from rrr_oc.numerics.gap import across_gap
from rrr_oc.robot.parameters import Parameter

SLOWED = (3.0, 10.0, 30.0)  # [1/s], damping over inertia of the trials' links in the gap
WIDE = 0.01  # [rad], gap above which the moments of impacts may be beyond prediction
OTHERS = (0.3, 1.0, 3.0)  # of a damping, from which fits start: the moment of an impact is not smooth in it


@dataclass(frozen=True)
class Backlash(MovesLink):
    """The link is free within ±gap/2 of the motor; positions are the motor's.

    Pressed to an end of the gap, q_link = theta − (gap/2) sgn(tau_l). Between the ends the drive transmits viscous friction only, and
    the link moves by itself, M x'' + damping x' = −(tau_rigid + K x) with x = q_link − theta, until it meets the other end, where it
    stays without a rebound.

    Attributes:
        impacts: Whether the link's speed and acceleration within the gap count; the moment of an impact in a wide gap cannot be
            predicted, and a fit may be better without.
    """

    name = "backlash"
    equation = "tau_l = 0 while |q_link - theta| < gap/2, else q_link = theta - (gap/2) sgn(tau_l)"
    plain = "The gear of {joints} has a play of {gap:mrad} in all; within it the link is damped by {damping}."
    parameters = (Parameter("gap", "rad", 0.0, lower=0.0), Parameter("damping", "Nm s/rad", 0.0, lower=0.0, factor=3.0))
    amplitudes = ("gap",)
    prior = Prior(0.01, {"gap": (0.01, "")}, "data sheets of gears: 1 to 30 arc minutes, 0.3 to 9 mrad; more when worn")

    impacts: bool = True

    def motion(self, t, load, stiffness, inertia, theta):
        half = float(theta["gap"]) / 2
        if half <= 0.0 or len(t) < 2:
            return np.zeros((3, len(t)))
        found = across_gap(t, load, stiffness, np.maximum(inertia, 1e-9), half, theta["damping"])
        return found * np.array([[1.0], [self.impacts], [self.impacts]])

    def gear(self, twist, theta, stiffest):
        """The joint's range, with ends as hard as MuJoCo's constraints allow, and its `damping`."""
        twist.damping[0] = theta["damping"]
        twist.limited, twist.range = True, [-theta["gap"] / 2, theta["gap"] / 2]
        twist.solref_limit, twist.solimp_limit = [0.004, 1.0], [0.99, 0.999, 0.001, 0.5, 2.0]

    def starts(self, theta):
        for times in OTHERS:
            yield Backlash(self.joints, True), {**theta, "damping": times * theta["damping"]}

    @classmethod
    def trials(cls, view):
        for j in range(view.n):
            for gap in (0.002, 0.006, 0.011, 0.02, 0.033, 0.05, 0.11, 0.2):
                dampings = [slowed * float(view.inertia[j]) for slowed in SLOWED]
                for damping in dampings:
                    yield Trial(cls((j,), True), ({"gap": gap, "damping": damping},), gap)
                if gap > WIDE:
                    yield Trial(cls((j,), False), ({"gap": gap, "damping": dampings[len(dampings) // 2]},), gap)

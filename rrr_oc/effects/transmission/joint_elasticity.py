"""A transmission that twists under load."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.effects.base import Prior, Trial
from rrr_oc.effects.capabilities import MovesLink
from rrr_oc.numerics.oscillator import Oscillator
from rrr_oc.robot.parameters import Parameter

TIME = 0.002  # [s], damping time of a gear so stiff that its damping does not show
RINGING = (
    1e5,
    60.0,
    46.0,
    36.0,
    28.0,
    22.0,
    17.0,
    13.0,
    10.0,
    8.0,
)  # [rad/s], resonances of the trials; the first only twists with the load
DAMPED = 0.3  # damping ratio from which a fit starts; with less it converges to the right resonance only from near by
LIGHT = 0.01  # least inertia of a link over its largest along a motion: below, the estimate is wrong and would make the link diverge
FURTHEST = 1.0  # [rad], largest twist; beyond, something else in the model is wrong, and the motion is scaled down
SHARPEST = 0.06  # [s], shortest window over which the load is smoothed; doubled, stiff gears are hidden; halved, noise passes
SHARPER = 0.7  # ratio of each window to the one before
STABLE = 0.05  # least total stiffness of a link over its gear's, so that gravity does not make it fall


@dataclass(frozen=True)
class JointElasticity(MovesLink):
    """tau_l = stiffness (twist + damping_time · rate of twist), twist = theta − q_link; positions are the motor's (Spong 1987).

    The link moves by itself behind its spring: with x = q_link − theta, and M, K by how much the torque that the rigid motion needs
    grows with acceleration and position, M x'' + stiffness damping_time x' + (stiffness + K) x = −tau_rigid.

    Attributes:
        smoothed: Window by which the load is smoothed [s], so that the link does not ring with the noise of the accelerations.
    """

    name = "joint_elasticity"
    equation = "tau_l = stiffness (theta - q_link + damping_time (dtheta - dq_link))"
    plain = "The gear of {joints} twists under load: it has a stiffness of {stiffness}, damped over {damping_time:ms}."
    parameters = (
        Parameter("stiffness", "Nm/rad", 1e6, lower=1e-3, factor=3.0),
        Parameter("damping_time", "s", TIME, lower=0.0, upper=0.05),
    )
    amplitudes = ("stiffness",)
    prior = Prior(
        0.02, {"twist": (0.01, "")}, "Spong 1987; data sheets of harmonic drives: a twist of some mrad at the rated torque"
    )

    smoothed: float = 0.2

    @property
    def window(self):
        return self.smoothed

    def starts(self, theta):
        shorter = SHARPER * self.smoothed
        while shorter > SHARPEST:
            yield replace(self, smoothed=shorter), theta
            shorter *= SHARPER

    def motion(self, t, load, stiffness, inertia, theta):
        if len(t) < 3:
            return np.zeros((3, len(t)))
        found = _link(t, stiffness, inertia, theta).driven(-load)
        return found / max(1.0, np.abs(found[0]).max() / FURTHEST)

    def free(self, t, stiffness, inertia, theta):
        return _link(t, stiffness, inertia, theta).free() if len(t) > 2 else np.zeros((2, 3, len(t)))

    def gear(self, twist, theta, stiffest):
        """The joint's own `stiffness` and `damping`."""
        twist.stiffness[0] = stiffness = min(theta["stiffness"], stiffest)
        twist.damping[0] = stiffness * theta["damping_time"]

    def combined(self, points, coefficients):
        """The twist is nearly linear in the compliance, which the coefficient is."""
        stiffness = 1 / max(float(coefficients[0]), 1e-12) if coefficients[0] > 0 else -1.0
        return {**points[0], "stiffness": stiffness}

    def scales(self, view, trial, prior=None):
        """The coefficient is the compliance [rad/Nm]: the typical twist over the joint's torque."""
        return np.array([(prior or self.prior).typical["twist"][0] / view.unit("torque", self.joints)])

    @classmethod
    def trials(cls, view):
        for j in range(view.n):
            for ringing in RINGING:
                stiffness = ringing**2 * float(view.inertia[j])
                point = {"stiffness": stiffness, "damping_time": min(max(2 * DAMPED / ringing, TIME), cls.parameters[1].upper)}
                yield Trial(cls((j,)), (point,), 1 / stiffness)


def _link(t: np.ndarray, stiffness: np.ndarray, inertia: np.ndarray, theta: Mapping[str, float]) -> Oscillator:
    """A link behind its gear's spring, with gravity and the link's own springs."""
    own = theta["stiffness"]
    least = max(LIGHT * float(np.abs(inertia).max()), 1e-9), (STABLE - 1) * own
    mass, rest = (np.maximum((x[1:] + x[:-1]) / 2, low) for x, low in zip((inertia, stiffness), least, strict=True))
    return Oscillator(t, mass, own + rest, own * theta["damping_time"])

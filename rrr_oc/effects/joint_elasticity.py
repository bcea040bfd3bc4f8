"""A transmission that twists under load."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import solve_banded

from rrr_oc.effects.effect import Effect, Trial
from rrr_oc.parameters import Parameter

TIME = 0.002  # of damping, where a gear is so stiff that none is felt [s]
RINGING = (1e5, 60.0, 36.0, 22.0, 13.0, 8.0)  # of links that are looked for [rad/s]; the first has no inertia to speak of
DAMPED = 0.3  # of critical damping, from which a fit starts: with less it finds the right resonance only from near by
LIGHT = 0.01  # of the largest inertia, that a link has at the least: one near 0 is an estimate gone astray
FURTHEST = 1.0  # [rad]; in a model whose gears twist further, other things are wrong
STABLE = 0.05  # of the stiffness, that gravity and springs leave at the least


@dataclass(frozen=True)
class JointElasticity(Effect):
    """tau_l = stiffness (twist + damping_time · rate of twist), twist = theta − q_link; positions are the motor's (Spong 1987).

    The link moves by itself behind its spring: with x = q_link − theta, and M, K by how much the torque that the rigid motion needs
    grows with acceleration and position, M x'' + stiffness damping_time x' + (stiffness + K) x = −tau_rigid.
    """

    name = "joint_elasticity"
    equation = "tau_l = stiffness (theta - q_link + damping_time (dtheta - dq_link))"
    parameters = (
        Parameter("stiffness", "Nm/rad", 1e6, lower=1e-3, factor=3.0),
        Parameter("damping_time", "s", TIME, lower=0.0, upper=0.05),
    )
    amplitudes = ("stiffness",)
    side = "motion"
    simulated = True
    window = 0.2  # [s]: a link rings on the noise of accelerations, too

    def torque(self, signals, theta, width):
        return (0 * signals.q[self.joints[0]],)

    def motion(self, t, load, stiffness, inertia, theta):
        """Exact for a load that is a cubic spline of samples, with M and K constant in each step; steady at the start."""
        if len(t) < 3:
            return np.zeros((3, len(t)))
        link = _Link.of(t, stiffness, inertia, theta)
        p = -CubicSpline(t, load).c[::-1] / link.total  # of ascending powers: where the link is when it neither rings nor lags
        p[2] -= 3 * link.damping / link.total * p[3]
        p[1] -= 2 * link.damping / link.total * p[2] + 6 * link.mass / link.total * p[3]
        p[0] -= link.damping / link.total * p[1] + 2 * link.mass / link.total * p[2]
        swing = int(np.searchsorted(t - t[0], np.pi * np.sqrt(link.mass[0] / link.total[0])))  # samples in half a period
        speed = p[1, 0] if swing < 3 else -np.polyfit(t[:swing] - t[0], load[:swing], 1)[0] / link.total[0]
        (found,) = link.along(p, np.array([[p[0, 0], speed]]))
        return found / max(1.0, np.abs(found[0]).max() / FURTHEST)

    def free(self, t, stiffness, inertia, theta):
        if len(t) < 3:
            return np.zeros((2, 3, len(t)))
        link = _Link.of(t, stiffness, inertia, theta)
        return link.along(np.zeros((4, len(t) - 1)), np.eye(2))

    def gear(self, twist, theta, stiffest):
        """The joint's own `stiffness` and `damping`."""
        twist.stiffness[0] = stiffness = min(theta["stiffness"], stiffest)
        twist.damping[0] = stiffness * theta["damping_time"]

    def combined(self, points, coefficients):
        """The twist is nearly linear in the compliance."""
        stiffness = 1 / max(float(coefficients[0]), 1e-12) if coefficients[0] > 0 else -1.0
        return {**points[0], "stiffness": stiffness}

    @classmethod
    def trials(cls, view):
        for j in range(view.n):
            for ringing in RINGING:
                stiffness = ringing**2 * float(view.inertia[j])
                point = {"stiffness": stiffness, "damping_time": min(max(2 * DAMPED / ringing, TIME), cls.parameters[1].upper)}
                yield Trial(cls((j,)), (point,), 1 / stiffness)


@dataclass(frozen=True)
class _Link:
    """A link behind its spring, M x'' + damping x' + total x = a polynomial, over each of K − 1 steps.

    Attributes:
        step: [s].
        mass, total: Inertia [kg m²] and stiffness, gravity and springs included [Nm/rad].
        damping: The same for all [Nm s/rad].
    """

    step: np.ndarray
    mass: np.ndarray
    total: np.ndarray
    damping: float

    @classmethod
    def of(cls, t: np.ndarray, stiffness: np.ndarray, inertia: np.ndarray, theta: Mapping[str, float]) -> "_Link":
        own = theta["stiffness"]
        least = max(LIGHT * float(np.abs(inertia).max()), 1e-9), (STABLE - 1) * own
        mass, rest = (np.maximum((x[1:] + x[:-1]) / 2, low) for x, low in zip((inertia, stiffness), least, strict=True))
        return cls(np.diff(t), mass, own + rest, own * theta["damping_time"])

    def along(self, p: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Position, speed and acceleration (m, 3, K) from starts (m, 2), where the powers `p` (4, K − 1) are one solution in each step."""
        h, decay, square = self.step, self.damping / self.mass / 2, self.total / self.mass
        end = np.array([((p[3] * h + p[2]) * h + p[1]) * h + p[0], (3 * p[3] * h + 2 * p[2]) * h + p[1]])
        root = np.sqrt((decay**2 - square).astype(complex))
        root = np.where(np.abs(root) < 1e-6 * np.sqrt(square), 1e-6 * np.sqrt(square), root)  # critically damped
        slow, fast = np.exp((root - decay) * h), np.exp((-root - decay) * h)
        even, odd = ((slow + fast) / 2).real, ((slow - fast) / (2 * root)).real
        keep = np.array([[even + decay * odd, odd], [-square * odd, even - decay * odd]])
        gain = end - np.einsum("ijk,jk->ik", keep, p[:2])
        bands = np.zeros((4, 2 * len(h) + 2))  # position and speed at a sample from those at the one before
        bands[0] = 1.0
        bands[2, 0:-2:2], bands[1, 1:-2:2], bands[3, 0:-2:2], bands[2, 1:-2:2] = -keep.reshape(4, -1)
        right = np.concatenate([starts, np.broadcast_to(gain.T.reshape(-1), (len(starts), gain.size))], axis=1)
        found = solve_banded((3, 0), bands, right.T, check_finite=False)
        x, v = found[::2].T, found[1::2].T
        a = np.empty_like(x)
        a[:, :-1] = 2 * p[2] - 2 * decay * (v[:, :-1] - p[1]) - square * (x[:, :-1] - p[0])
        a[:, -1] = 2 * p[2, -1] + 6 * p[3, -1] * h[-1]
        a[:, -1] -= 2 * decay[-1] * (v[:, -1] - end[1, -1]) + square[-1] * (x[:, -1] - end[0, -1])
        return np.stack([x, v, a], axis=1)

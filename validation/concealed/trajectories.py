"""References that the controllers track: the paper's sweeps, multisines, splines, pick-and-place moves."""

import numpy as np
from scipy.interpolate import CubicSpline

from validation.concealed.arms import Arm
from validation.concealed.work import WORK

STANDARD = ("sweep_up", "sweep_down", "multisine", "spline", "sweep_slow", "multisine", "pick_and_place", "spline")
SHORT = ("sweep_up", "multisine", "spline", "sweep_down")
UNSEEN = ("multisine", "spline", "pick_and_place")


def reference(kind: str, arm: Arm, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Joint angles q_ref [rad], (n, T), inside the joint ranges and below the arm's fastest reference."""
    margin = 0.08 * (arm.upper - arm.lower)
    low, high = arm.lower + margin, arm.upper - margin
    warped = from_rest(t)
    q = squeezed(KINDS[kind](arm, warped, low, high, rng), low, high)
    return slowed(q, t, arm.speed)


def squeezed(q: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The path shrunk about the middle of each joint's range until it fits; cut off, it would jerk."""
    centre, half = 0.5 * (low + high)[:, None], 0.5 * (high - low)[:, None]
    reach = np.max(np.abs(q - centre) / half, axis=1, keepdims=True)
    return centre + (q - centre) / np.maximum(reach, 1.0)


def from_rest(t: np.ndarray, ramp: float = 1.5) -> np.ndarray:
    """Time whose rate rises smoothly from 0 to 1 over the first `ramp` seconds, so that every reference starts at rest."""
    u = np.minimum(t / ramp, 1.0)
    return np.where(t < ramp, ramp * (u**3 - u**4 / 2), t - ramp / 2)


def sweep(low, high, t, rng, first: float, last: float) -> np.ndarray:
    """Eq. 14 about a random centre: q = c + a t/T sin 2π (f0 t + (f1 − f0) t² / 2T)."""
    total, n = t[-1], len(low)
    centre = low + rng.uniform(0.35, 0.65, n) * (high - low)
    amplitude = rng.uniform(0.75, 1.0, n) * np.minimum(centre - low, high - centre)
    scatter = rng.uniform(0.7, 1.35, n)
    f0, f1 = first * scatter, last * scatter  # [Hz]
    phase = f0[:, None] * t + (f1 - f0)[:, None] / (2 * total) * t**2
    return centre[:, None] + amplitude[:, None] * (t / total) * np.sin(2 * np.pi * phase)


def multisine(arm, t, low, high, rng) -> np.ndarray:
    n = len(low)
    q = np.zeros((n, len(t)))
    for f in rng.uniform(0.04, 0.45, (5, n)):  # [Hz]
        q += rng.uniform(0.3, 1.0, (n, 1)) * np.sin(2 * np.pi * f[:, None] * t + rng.uniform(0, 2 * np.pi, (n, 1)))
    q *= (rng.uniform(0.3, 0.48, n) * (high - low) / np.abs(q).max(axis=1))[:, None]
    return (low + rng.uniform(0.45, 0.55, n) * (high - low))[:, None] + q


def spline(arm, t, low, high, rng) -> np.ndarray:
    n = len(low)
    knots = np.arange(0.0, t[-1] + 3.0, rng.uniform(1.1, 1.7))
    points = low + rng.uniform(0.0, 1.0, (len(knots), n)) * (high - low)
    return CubicSpline(knots, points, bc_type="clamped")(t).T


def pick_and_place(arm, t, low, high, rng) -> np.ndarray:
    """Fast moves between four postures, with rests of a second or less (quintic, at rest at both ends)."""
    n = len(low)
    stations = low + rng.uniform(0.0, 1.0, (4, n)) * (high - low)
    q, clock, at = np.empty((n, len(t))), 0.0, 0
    q[:] = stations[0][:, None]
    while clock < t[-1]:
        goal = (at + 1 + rng.integers(0, 3)) % 4
        move, rest = rng.uniform(1.0, 2.0), rng.uniform(0.2, 1.0)  # [s]
        u = np.clip((t - clock) / move, 0.0, 1.0)
        blend = u**3 * (10 - 15 * u + 6 * u**2)
        later = t >= clock
        q[:, later] = (stations[at][:, None] + (stations[goal] - stations[at])[:, None] * blend)[:, later]
        clock, at = clock + move + rest, goal
    return q


def slowed(q: np.ndarray, t: np.ndarray, speed: np.ndarray, acceleration: float = 6.0) -> np.ndarray:
    """The same path at a lower pace, where it would exceed `speed` [rad/s] or `acceleration` [rad/s²]; the end is cut."""
    dq = np.gradient(q, t, axis=1)
    pace = np.max(np.abs(dq).max(axis=1) / speed)
    pace = max(pace, np.sqrt(np.abs(np.gradient(dq, t, axis=1)[:, 2:-2]).max() / acceleration))
    if pace <= 1.0:
        return q
    return CubicSpline(t, q, axis=1)(t / pace)


KINDS = {
    "sweep_up": lambda arm, t, low, high, rng: sweep(low, high, t, rng, 0.05, 0.3),
    "sweep_down": lambda arm, t, low, high, rng: sweep(low, high, t, rng, 0.35, 0.06),
    "sweep_slow": lambda arm, t, low, high, rng: sweep(low, high, t, rng, 0.03, 0.12),
    "multisine": multisine,
    "spline": spline,
    "pick_and_place": pick_and_place,
} | WORK

"""Planned motions at the fine rate, with exact derivatives: time (F,), q [rad], v, a (n, F)."""

from dataclasses import dataclass

import numpy as np

from validation.chains.chain import FINE


@dataclass(frozen=True)
class Pace:
    """How an arm moves: time [s], greatest speed [rad/s], greatest angle from the middle [rad], lowest frequency [Hz]."""

    seconds: float = 12.0
    fastest: float = 1.8
    reach: float = 1.2
    slowest: float = 0.12


def sines(n: int, pace: Pace, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Five sines a joint."""
    t, waves = np.arange(0, pace.seconds, 1 / FINE), np.arange(1, 6)
    w = 2 * np.pi * pace.slowest * waves * (1 + 0.07 * np.arange(n))[:, None]
    a, b = rng.standard_normal((2, n, 5)) / waves
    phase = w[:, :, None] * t
    s, c = np.sin(phase), np.cos(phase)
    q, v, acc = (np.einsum("nk,nkt->nt", x, y) + np.einsum("nk,nkt->nt", z, u) for x, y, z, u in (
        (a, s, b, c), (a * w, c, -b * w, s), (-a * w**2, s, -b * w**2, c)
    ))  # fmt: skip
    size = np.minimum(pace.reach / np.abs(q).max(1), pace.fastest / np.abs(v).max(1))[:, None]
    return t, size * q, size * v, size * acc


def points(n: int, pace: Pace, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """From point to point with short stops, by polynomials of the seventh degree, the jerk of which is 0 at both ends."""
    t = np.arange(0, pace.seconds, 1 / FINE)
    q, v, a = np.zeros((3, n, t.size))
    at, clock = rng.uniform(-0.8, 0.8, n) * pace.reach, 0.0
    while clock < pace.seconds:
        goal = rng.uniform(-0.8, 0.8, n) * pace.reach
        move = max(2.1875 * np.abs(goal - at).max() / (0.9 * pace.fastest), 0.3)
        u, later = np.clip((t - clock) / move, 0, 1), t >= clock
        way = (goal - at)[:, None]
        q[:, later] = (at[:, None] + way * u**4 * (35 - 84 * u + 70 * u**2 - 20 * u**3))[:, later]
        v[:, later] = (way * 140 * (u * (1 - u)) ** 3 / move)[:, later]
        a[:, later] = (way * 420 * (u * (1 - u)) ** 2 * (1 - 2 * u) / move**2)[:, later]
        at, clock = goal, clock + move + rng.uniform(0.1, 0.5)
    return t, q, v, a

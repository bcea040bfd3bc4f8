"""Periodic motions as Fourier series that begin and end at rest.

Swevers et al., "Optimal robot excitation and identification", IEEE Trans. Robotics and Automation 13 (1997) 730–740 (cited
from memory).
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from rrr_oc.excitation.limits import MotionLimits


@dataclass(frozen=True, eq=False)
class Series:
    """Periodic motions of one joint whose speed and acceleration are zero at t = 0 and t = T: q(t) = B(t) x.

    B spans 1, sin(k w t)/k and cos(k w t)/k for k = 1…N, w = 2π/T, under Σ a_k = 0 (speed) and Σ k b_k = 0 (acceleration).

    A trigonometric polynomial of degree N is nowhere larger than its largest value at M > 2 N equidistant times over
    cos(π N/M) (Ehlich & Zeller, Math. Z. 86 (1964) 41–44). Limits lowered by that factor on the grid hold between its points.
    """

    duration: float
    harmonics: int

    @property
    def grid(self) -> np.ndarray:
        """16 N equidistant times of one period [s]."""
        count = 16 * self.harmonics
        return np.arange(count) * self.duration / count

    @property
    def margin(self) -> float:
        """cos(π N/M) on the grid, less what the solver's tolerance needs."""
        return math.cos(math.pi / 16) * (1 - 1e-6)

    @cached_property
    def _rest(self) -> np.ndarray:
        """Orthonormal basis of the coefficients (1, a, b) that are at rest at t = 0, shape (2 N + 1, 2 N − 1)."""
        k, zeros = np.arange(1, self.harmonics + 1), np.zeros(self.harmonics)
        return scipy.linalg.null_space(np.array([[0, *(k**0), *zeros], [0, *zeros, *k]]))

    def basis(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """B, dB/dt, d²B/dt² at times t (K,) [s], each (K, 2 N − 1)."""
        k, w, one = np.arange(1, self.harmonics + 1), 2 * np.pi / self.duration, np.ones((len(t), 1))
        s, c = np.sin(w * np.outer(t, k)), np.cos(w * np.outer(t, k))
        rows = np.hstack([one, s / k, c / k]), np.hstack([0 * one, w * c, -w * s]), w**2 * np.hstack([0 * one, -k * s, -k * c])
        return rows[0] @ self._rest, rows[1] @ self._rest, rows[2] @ self._rest

    @property
    def still(self) -> np.ndarray:
        """The coefficients of q = 1, shape (2 N − 1,)."""
        return self._rest[0]

    def random(self, limits: MotionLimits, rng: np.random.Generator) -> np.ndarray:
        """Coefficients (2 N − 1, moving joints) of a random motion within ranges, speed and acceleration limits."""
        bases, moving = self.basis(self.grid), limits.moving
        x = rng.normal(size=(bases[0].shape[1], moving.size))
        x -= np.outer(self.still, self.still @ x)
        middle, half = (limits.upper + limits.lower)[moving] / 2, (limits.upper - limits.lower)[moving] / 2
        allowed = half, limits.speed[moving], limits.acceleration[moving]
        room = [self.margin * limit / np.max(np.abs(basis @ x), axis=0) for basis, limit in zip(bases, allowed, strict=True)]
        size = np.min(room, axis=0) * rng.uniform(0.5, 1, moving.size)
        shift = np.maximum(half - np.max(np.abs(bases[0] @ x), axis=0) * size / self.margin, 0)
        return x * size + np.outer(self.still, middle + shift * rng.uniform(-1, 1, moving.size))

    def motion(self, x: np.ndarray, limits: MotionLimits, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, dq, ddq (n, K) of all joints at times t (K,)."""
        result = []
        for basis in self.basis(t):
            rows = np.zeros((limits.lower.size, len(t)))
            rows[limits.moving] = (basis @ x).T
            result.append(rows)
        result[0] += np.where(limits.lower == limits.upper, limits.lower, 0.0)[:, None]
        return result[0], result[1], result[2]

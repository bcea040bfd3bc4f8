"""A damped oscillator driven by a sampled signal, such as a link behind an elastic gear."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import get_blas_funcs

(_substitute,) = get_blas_funcs(("tbsv",), dtype=np.dtype(float))


def substituted(bands: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solution x (K,) of L x = right, L lower triangular and banded: `bands` (number, K) are its diagonals, the main one first."""
    return _substitute(len(bands) - 1, np.asfortranarray(bands), right, lower=1)


@dataclass(frozen=True)
class Oscillator:
    """mass x'' + damping x' + total x = signal, with mass and stiffness constant over each of K − 1 steps.

    Attributes:
        t: Times [s], strictly increasing, (K,), at least 3.
        mass, total: Inertia and stiffness in each step, (K − 1,), above 0.
        damping: Damping, the same in all steps.
    """

    t: np.ndarray
    mass: np.ndarray
    total: np.ndarray
    damping: float

    def driven(self, signal: np.ndarray, rested: bool = False) -> np.ndarray:
        """Position, speed and acceleration (3, K), exact for the cubic spline through a signal (K,).

        Args:
            rested: Whether it starts at rest in equilibrium with the first sample. Default: it starts on the slowly varying
                solution, estimated over half a period, without oscillation.
        """
        t = self.t
        p = CubicSpline(t, signal).c[::-1] / self.total  # of the particular solution, by ascending powers; corrected below
        p[2] -= 3 * self.damping / self.total * p[3]
        p[1] -= 2 * self.damping / self.total * p[2] + 6 * self.mass / self.total * p[3]
        p[0] -= self.damping / self.total * p[1] + 2 * self.mass / self.total * p[2]
        if rested:
            return self._along(p, np.array([[signal[0] / self.total[0], 0.0]]))[0]
        swing = int(np.searchsorted(t - t[0], np.pi * np.sqrt(self.mass[0] / self.total[0])))  # samples in half a period
        speed = p[1, 0] if swing < 3 else np.polyfit(t[:swing] - t[0], signal[:swing], 1)[0] / self.total[0]
        return self._along(p, np.array([[p[0, 0], speed]]))[0]

    def free(self) -> np.ndarray:
        """Free motions from an initial position of 1 at rest, and from an initial speed of 1 at zero, (2, 3, K)."""
        return self._along(np.zeros((4, len(self.t) - 1)), np.eye(2))

    def _along(self, p: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Motions (m, 3, K) from initial states (m, 2); `p` (4, K − 1) is the particular solution in each step, by powers of time."""
        h, decay, square = np.diff(self.t), self.damping / self.mass / 2, self.total / self.mass
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
        found = np.array([substituted(bands, one) for one in right]).T
        x, v = found[::2].T, found[1::2].T
        a = np.empty_like(x)
        a[:, :-1] = 2 * p[2] - 2 * decay * (v[:, :-1] - p[1]) - square * (x[:, :-1] - p[0])
        a[:, -1] = 2 * p[2, -1] + 6 * p[3, -1] * h[-1]
        a[:, -1] -= 2 * decay[-1] * (v[:, -1] - end[1, -1]) + square[-1] * (x[:, -1] - end[0, -1])
        return np.stack([x, v, a], axis=1)

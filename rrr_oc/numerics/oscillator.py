"""A damped oscillator driven by a sampled signal, such as a link behind an elastic gear."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

import rrr_oc.numerics._stepping as extension


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
        arrays = [np.ascontiguousarray(x, float) for x in (self.t, self.mass, self.total)]
        result = np.empty((len(starts), 3, len(self.t)))
        extension.oscillate(len(self.t), len(starts), *arrays, float(self.damping), np.ascontiguousarray(p), starts, result)
        return result

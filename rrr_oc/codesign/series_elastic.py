"""Series elastic actuation in the co-design problem: the states that springs between drives and links add, and how the drives move.

With the torque τ of the series springs as states, the links of their joints e obey

    M_ee q̈_e = τ − (load torque at q̈_e = 0),    τ̈ = control,

and the drives are at q_e + c τ with the compliance c, which so stands in the cost alone (Spong 1987; the gyroscopic part of the rotors
is left out). Other joints keep their accelerations as controls.
"""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.interpolate import CubicSpline

from rrr_oc.optimal_control.problem import PhaseGuess

POINTS = 65  # at which a guess's load torque is interpolated; doubled, its kinks are sharper


@dataclass(frozen=True, eq=False)
class SeriesElastic:
    """The joints with series springs, and where their compliances stand.

    The states are q, dq (m each), then torque and rate of torque of the series springs (e each).

    Attributes:
        count: Number of moving joints m.
        rows: Rows among the moving joints of those with series springs (e).
        compliances: Indices of their compliances among the problem's parameters.
    """

    count: int
    rows: tuple[int, ...]
    compliances: tuple[int, ...]

    @property
    def states(self) -> tuple[int, ...]:
        """Indices of the series springs' states."""
        return tuple(range(2 * self.count, 2 * self.count + 2 * len(self.rows)))

    def accelerations(self, load: Callable[[ca.SX], ca.SX], x: ca.SX, u: ca.SX) -> ca.SX:
        """Accelerations of the links (m,): the controls, and of joints with series springs what their torque causes.

        Args:
            load: Load torque (m,) of accelerations (m,), at the positions and speeds of x.
        """
        at, own = list(self.rows), ca.SX.sym("own", len(self.rows))
        if not at:
            return u
        ddq = ca.SX(u)
        ddq[at] = own
        needed = load(ddq)[at]
        mass, bias = ca.jacobian(needed, own), ca.substitute(needed, own, ca.SX.zeros(len(at)))
        ddq[at] = ca.solve(mass, x[2 * self.count : 2 * self.count + len(at)] - bias)
        return ddq

    def twist(self, x, u, parameters) -> tuple:
        """q, dq, ddq of the links less those of their drives, each (m, ...) [rad]; states, controls and parameters are casadi's or
        numbers, over time as the last axis."""
        zeros = ca.SX.zeros if isinstance(x, ca.SX) else lambda m: np.zeros((m, *x.shape[1:]))
        found, e, m = tuple(zeros(self.count) for _ in range(3)), len(self.rows), self.count
        for i, (row, at) in enumerate(zip(self.rows, self.compliances, strict=True)):
            for twist, torque in zip(found, (x[2 * m + i], x[2 * m + e + i], u[row]), strict=True):
                twist[row] = -parameters[at] * torque
        return found

    def lifted(self, guess: PhaseGuess, load: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]) -> PhaseGuess:
        """A guess (q, dq; ddq) of the arm without series springs with their torque: the load torque (m, K) at (q, dq, ddq)."""
        if not self.rows:
            return guess
        at, s = list(self.rows), np.linspace(0, 1, POINTS)
        x, T = guess.states(s), guess.duration
        torque = CubicSpline(s, load(x[: self.count], x[self.count :], guess.controls(s))[at], axis=1)

        def controls(s: np.ndarray) -> np.ndarray:
            u = guess.controls(s).copy()
            u[at] = torque(s, 2) / T**2
            return u

        return PhaseGuess(T, lambda s: np.vstack([guess.states(s), torque(s), torque(s, 1) / T]), controls)

"""Series elastic actuation in the co-design problem: the states that springs between drives and links add, and how the drives move.

With the torque τ of the springs and the speed ω of the drives as states, and the drives' acceleration as control, the links of their
joints e obey

    M_ee q̈_e = τ − (load torque at q̈_e = 0),    c τ̇ = ω − q̇_e,    ω̇ = control

(Spong 1987; the gyroscopic part of the rotors is left out). So limits of speed and acceleration bound a state and a control. Other
joints keep their accelerations as controls.
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

    The states begin with q, dq (m each), then torques of the series springs and speeds of their drives (e each). The controls are taken
    to be the accelerations of the drives, which are states themselves where their jerk has a limit.

    Attributes:
        count: Number of moving joints m.
        rows: Rows among the moving joints of those with series springs (e).
        compliances: Indices of their compliances among the problem's parameters.
    """

    count: int
    rows: tuple[int, ...]
    compliances: tuple[int, ...]

    def torques(self, x):
        """Torques of the series springs (e, ...) [Nm] among the states."""
        return x[2 * self.count : 2 * self.count + len(self.rows)]

    def speeds(self, x):
        """Speeds of their drives (e, ...) [rad/s] among the states."""
        return x[2 * self.count + len(self.rows) : 2 * self.count + 2 * len(self.rows)]

    def speed_state(self, row: int) -> int:
        """Index of the state that the speed of a moving joint's drive is."""
        own = row in self.rows
        return 2 * self.count + len(self.rows) + self.rows.index(row) if own else self.count + row

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
        ddq[at] = ca.solve(mass, self.torques(x) - bias)
        return ddq

    def rates(self, x: ca.SX, u: ca.SX, parameters: ca.SX) -> ca.SX:
        """Rates of the torques and of the drives' speeds (2 e,)."""
        at = list(self.rows)
        if not at:
            return ca.SX(0, 1)
        return ca.vertcat((self.speeds(x) - x[self.count : 2 * self.count][at]) / parameters[list(self.compliances)], u[at])

    def twist(self, x: np.ndarray, ddq: np.ndarray, u: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """q, dq, ddq of the links less those of their drives, (3, m, ...); 0 of joints without series springs.

        Args:
            x, u: States and controls, over time as the last axis.
            ddq: Accelerations of the links (m, ...) [rad/s²].
        """
        found, at = np.zeros((3, *ddq.shape)), list(self.rows)
        compliance = parameters[list(self.compliances)].reshape(-1, *[1] * (x.ndim - 1))
        found[0, at] = -compliance * self.torques(x)
        found[1, at] = x[self.count : 2 * self.count][at] - self.speeds(x)
        found[2, at] = (ddq - u)[at]
        return found

    def lifted(
        self, guess: PhaseGuess, load: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray], compliance: np.ndarray
    ) -> PhaseGuess:
        """A guess (q, dq; ddq) of the arm without series springs with those of compliances (e,).

        Args:
            load: Load torque (m, K) of q, dq, ddq, each (m, K).
        """
        at, s, c, T = list(self.rows), np.linspace(0, 1, POINTS), compliance[:, None], guess.duration
        x = guess.states(s)
        torque = CubicSpline(s, load(x[: self.count], x[self.count :], guess.controls(s))[at], axis=1)

        def states(s: np.ndarray) -> np.ndarray:
            x = guess.states(s)
            return np.vstack([x, torque(s), x[self.count :][at] + c * torque(s, 1) / T])

        def controls(s: np.ndarray) -> np.ndarray:
            u = guess.controls(s).copy()
            u[at] += c * torque(s, 2) / T**2
            return u

        return PhaseGuess(T, states, controls)

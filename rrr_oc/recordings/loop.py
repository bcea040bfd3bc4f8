"""The loop that drives joints without torque sensors to commanded angles: its torque follows from commands and motion."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Loop:
    """A PD loop at each joint: torque = kp (q_d − q) − kd dq, with commanded angles q_d.

    Attributes:
        kp: [Nm/rad], above 0, (n,).
        kd: [Nm s/rad], 0 or above, (n,).
    """

    kp: np.ndarray
    kd: np.ndarray

    def torque(self, command: np.ndarray, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """What the loop gives [Nm], (n, K), for commanded and measured positions [rad] and speeds [rad/s], each (n, K)."""
        return self.kp[:, None] * (command - q) - self.braking(dq)

    def braking(self, dq: np.ndarray) -> np.ndarray:
        """Its torque against the motion, kd dq [Nm], (n, K), for speeds (n, K) [rad/s]."""
        return self.kd[:, None] * dq

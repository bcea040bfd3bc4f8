"""The loop of an arm whose commanded angles are recorded in place of torques: torque = kp (q_d − q) − kd dq."""

import numpy as np

from validation.concealed.arms import Arm

ERROR = 5e-3  # of position under a torque as large as the dry friction [rad]
BRAKE = 2.0  # kd over the viscous friction


def gains(arm: Arm) -> tuple[np.ndarray, np.ndarray]:
    """kp [Nm/rad] and kd [Nm s/rad] of each joint as they are listed, (n,)."""
    return arm.coulomb / ERROR, BRAKE * arm.viscous


def commands(arm: Arm, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Angles (n, N) [rad] that the loop as listed would have needed for these torques (n, N) [Nm]."""
    kp, kd = gains(arm)
    return q + (tau + kd[:, None] * dq) / kp[:, None]

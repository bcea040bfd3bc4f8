"""Cost figures of a task's load torques: E1, RMS, peak. Time is the last axis; a task is a sequence of phases.

A phase is a pair (t, tau): times [s], shape (K,), and load torques [Nm], shape (n, K). Nothing is integrated from one phase to the
next, where the torque jumps as a payload is gripped or released.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rrr_oc.errors import UserError

WORTHLESS = 1.0  # NRMSE above which a constant would explain the signal as well


@dataclass(frozen=True)
class Metrics:
    """Figures of one task, joint by joint.

    Attributes:
        E1: Sum over the phases of ∫ tau² dt [N²m²s], the terms of Eq. 12 and 13, by the trapezoid rule, shape (n,).
        rms: sqrt(E1 / duration) [Nm], shape (n,).
        peak: Largest |tau| at the given times [Nm], shape (n,).
        duration: Of all phases together [s].
    """

    E1: np.ndarray
    rms: np.ndarray
    peak: np.ndarray
    duration: float

    @property
    def E1_total(self) -> float:
        """E1 of Eq. 12: the sum over the joints [N²m²s]; of Eq. 13 where joint 1 is left out of the torques."""
        return float(np.sum(self.E1))


def measure(phases: Sequence[tuple[np.ndarray, np.ndarray]]) -> Metrics:
    """All figures of a task; raises `UserError` for phases of unequal or unusable shapes."""
    if not phases:
        raise UserError("metrics need at least one phase, got none")
    rows = np.shape(phases[0][1])[:-1]
    for i, (t, tau) in enumerate(phases):
        if np.ndim(t) != 1 or np.size(t) < 2 or np.shape(tau) != (*rows, np.size(t)):
            raise UserError(
                f"phase {i}: shapes of times and torques are {np.shape(t)} and {np.shape(tau)}, not (K,) and (n, K) with K ≥ 2"
            )
        if not (np.all(np.diff(t) > 0) and np.all(np.isfinite(tau))):
            raise UserError(f"phase {i}: times must increase and torques be finite")
    duration = float(sum(t[-1] - t[0] for t, _ in phases))
    E1 = np.sum([np.trapezoid(np.square(tau), t, axis=-1) for t, tau in phases], axis=0)
    peak = np.max([np.max(np.abs(tau), axis=-1) for _, tau in phases], axis=0)
    return Metrics(E1, np.sqrt(E1 / duration), peak, duration)


def decrease(value, reference):
    """Relative decrease 1 − value/reference [1], against stiff actuation in the paper; scalars or (n,)."""
    return 1 - np.asarray(value) / np.asarray(reference)

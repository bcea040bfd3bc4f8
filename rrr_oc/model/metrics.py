"""What the load torques of a task cost: E1, RMS, peak. Time is the last axis; a task is a sequence of phases.

A phase is a pair (t, tau): times [s], shape (K,), and load torques [Nm], shape (n, K). Phases have clocks of their own, and
nothing is integrated across the jump of torque where a payload is gripped or let go.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rrr_oc.errors import UserError

Phases = Sequence[tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Metrics:
    """Figures of one task, joint by joint.

    Attributes:
        E1: Sum over the phases of ∫ tau² dt [N²m²s], shape (n,).
        rms: Root of E1 over the task's duration [Nm], shape (n,).
        peak: Largest |tau| [Nm], shape (n,).
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


def measure(phases: Phases) -> Metrics:
    """All figures of a task; raises `UserError` for phases of unequal or unusable shapes."""
    _check(phases)
    return Metrics(E1(phases), rms(phases), peak(phases), duration(phases))


def E1(phases: Phases) -> np.ndarray:
    """Σ_phases ∫ tau² dt [N²m²s], the terms of Eq. 12 and 13, by the trapezoid rule; shape (n,)."""
    return np.sum([np.trapezoid(np.square(tau), t, axis=-1) for t, tau in phases], axis=0)


def rms(phases: Phases) -> np.ndarray:
    """sqrt(Σ_phases ∫ tau² dt / Σ_phases T) [Nm], shape (n,)."""
    return np.sqrt(E1(phases) / duration(phases))


def peak(phases: Phases) -> np.ndarray:
    """Largest |tau| at the given times [Nm], shape (n,)."""
    return np.max([np.max(np.abs(tau), axis=-1) for _, tau in phases], axis=0)


def duration(phases: Phases) -> float:
    """Duration of all phases together [s]."""
    return float(sum(t[-1] - t[0] for t, _ in phases))


def decrease(value, reference):
    """Relative decrease 1 − value/reference [1], against stiff actuation in the paper; scalars or (n,)."""
    return 1 - np.asarray(value) / np.asarray(reference)


def _check(phases: Phases) -> None:
    if not phases:
        raise UserError("metrics need at least one phase, got none")
    rows = np.shape(phases[0][1])[:-1]
    for i, (t, tau) in enumerate(phases):
        t, tau = np.asarray(t, float), np.asarray(tau, float)
        if t.ndim != 1 or t.size < 2 or tau.shape != (*rows, t.size):
            raise UserError(
                f"phase {i}: shapes of times and torques are {t.shape} and {tau.shape}, not (K,) and (n, K) with K ≥ 2"
            )
        if not (np.all(np.diff(t) > 0) and np.all(np.isfinite(tau))):
            raise UserError(f"phase {i}: times must increase and torques be finite")

"""Motions to record: the paper's sweeps (Eq. 14) and its protocol of eight recordings."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from rrr_oc.effects import listed_springs
from rrr_oc.errors import UserError
from rrr_oc.excitation.design import STEP, times
from rrr_oc.model.motion import Motion
from rrr_oc.recordings.header import Spring
from rrr_oc.recordings.importers.prototype import PAYLOAD, SPRINGS
from rrr_oc.recordings.recording import Recording

Direction = Literal["rising", "falling"]


@dataclass(frozen=True, eq=False)
class Sweep:
    """Eq. 14: q = centre + amplitude t/T sin(2π (f0 t + (f1 − f0) t² / (2 T))), from f0 to f1 in the time T.

    Attributes:
        centre, amplitude: [rad], shape (n,).
        slow, fast: Lowest and highest frequency [Hz], shape (n,).
        duration: T [s].
    """

    centre: np.ndarray
    amplitude: np.ndarray
    slow: np.ndarray
    fast: np.ndarray
    duration: float = 60.0

    def __post_init__(self) -> None:
        shapes = {name: np.shape(getattr(self, name)) for name in ("centre", "amplitude", "slow", "fast")}
        if len(set(shapes.values())) != 1 or len(shapes["centre"]) != 1:
            raise UserError(f"a sweep needs centre, amplitude, slow and fast of one shape (n,), got {shapes}")
        if not (np.all(self.slow > 0) and np.all(self.slow <= self.fast) and np.all(np.isfinite(self.fast))):
            raise UserError(f"a sweep needs 0 < slow ≤ fast [Hz], got slow {self.slow} and fast {self.fast}")
        if not 0 < self.duration < math.inf:
            raise UserError(f"a sweep's duration must be above 0 and finite, got {self.duration:g} s")

    def motion(self, t: np.ndarray, direction: Direction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, dq, ddq (n, K) at times t (K,) [s]."""
        f0, f1 = (self.slow, self.fast) if direction == "rising" else (self.fast, self.slow)
        f0, rate = f0[:, None], (f1 - f0)[:, None] / self.duration
        phase, omega, alpha = 2 * np.pi * (f0 * t + rate * t**2 / 2), 2 * np.pi * (f0 + rate * t), 2 * np.pi * rate
        sine, cosine = np.sin(phase), np.cos(phase)
        slope = self.amplitude[:, None] / self.duration
        return (
            self.centre[:, None] + slope * t * sine,
            slope * (sine + t * omega * cosine),
            slope * (2 * omega * cosine + t * (alpha * cosine - omega**2 * sine)),
        )


# What the authors' arm was moved by; its files' elbow turns the other way. Joints 1, 2, 3.
PROTOTYPE_SWEEP = Sweep(
    centre=np.radians([0.0, 45.0, 0.0]),
    amplitude=np.radians([45.0, 45.0, -135.0]),
    slow=np.array([0.05, 0.01, 0.01]),
    fast=np.array([0.2, 0.2, 0.1]),
)
PROTOTYPE_JOINTS = ("joint1", "joint2", "joint3")
PROTOTYPE_SPRINGS: tuple[Spring, ...] = tuple(
    listed_springs()[key].from_entry((PROTOTYPE_JOINTS.index(joint),), spring)
    for key, springs in SPRINGS.items()
    for joint, spring in springs.items()
)


def sweep(
    motion: Sweep,
    direction: Direction,
    step: float = STEP,
    name: str | None = None,
    payload: float = 0.0,
    springs: Sequence[Spring] = (),
) -> Recording:
    """A sweep as a planned recording with a payload [kg] and springs, named after its direction unless given.

    Raises `UserError` for an unknown direction or an unusable sampling step [s].
    """
    if direction not in get_args(Direction):
        raise UserError(f"a sweep is {' or '.join(get_args(Direction))}, got {direction!r}")
    t = times(motion.duration, step)
    planned = Motion(t, *motion.motion(t, direction), np.full(len(t), payload))
    return Recording.planned(name or direction, planned, tuple(springs))


def protocol(
    motion: Sweep = PROTOTYPE_SWEEP,
    payload: float = PAYLOAD,
    springs: Sequence[Spring] = PROTOTYPE_SPRINGS,
    step: float = STEP,
) -> tuple[Recording, ...]:
    """The paper's eight recordings: rising and falling, with and without payload, with and without springs."""
    return tuple(
        sweep(
            motion,
            direction,
            step,
            "_".join([direction, *(["payload"] if mass else []), *(["springs"] if mounted else [])]),
            mass,
            mounted,
        )
        for direction in get_args(Direction)
        for mass in (payload, 0.0)
        for mounted in (springs, ())
    )

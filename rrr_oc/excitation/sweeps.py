"""Motions to record: the paper's sweeps (Eq. 14) and its protocol of eight recordings."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from rrr_oc.effects import listed_springs
from rrr_oc.errors import UserError
from rrr_oc.recordings.header import Spring
from rrr_oc.recordings.importers.prototype import PAYLOAD, SPRINGS
from rrr_oc.storage import write_csv

Direction = Literal["rising", "falling"]

STEP = 0.01  # default sampling of a planned recording [s]


@dataclass(frozen=True, eq=False)
class PlannedRecording:
    """A motion to be recorded; joints (n,), time last.

    Attributes:
        name: Name in reports and files.
        joints: Names of the joints (n).
        t: Times [s], shape (K,).
        q, dq, ddq: Motion [rad, rad/s, rad/s²], shape (n, K).
        payload: Mass at the tool [kg].
        springs: Springs to be mounted, each an effect with its parameters.
    """

    name: str
    joints: tuple[str, ...]
    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    payload: float = 0.0
    springs: tuple[Spring, ...] = ()


def write_trajectory(path: str | Path, plan: PlannedRecording) -> None:
    """Write a planned motion as CSV with the columns t [s] and q_<joint> [rad]; numbers read back exactly."""
    write_csv(path, {"t": plan.t, **{f"q_{joint}": q for joint, q in zip(plan.joints, plan.q, strict=True)}})


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
    motion: Sweep, direction: Direction, joints: Sequence[str] = PROTOTYPE_JOINTS, step: float = STEP, **load: Any
) -> PlannedRecording:
    """A sweep as a planned recording, named after its direction; `load` is its name, payload and springs.

    Raises:
        UserError: The direction is unknown, the step unusable, or the sweep has another number of joints.
    """
    if direction not in get_args(Direction):
        raise UserError(f"a sweep is {' or '.join(get_args(Direction))}, got {direction!r}")
    if len(joints) != len(motion.centre):
        raise UserError(f"the sweep moves {len(motion.centre)} joints, but {len(joints)} are named: {', '.join(joints)}")
    t = times(motion.duration, step)
    return PlannedRecording(load.pop("name", direction), tuple(joints), t, *motion.motion(t, direction), **load)


def protocol(
    motion: Sweep = PROTOTYPE_SWEEP,
    joints: Sequence[str] = PROTOTYPE_JOINTS,
    payload: float = PAYLOAD,
    springs: Sequence[Spring] = PROTOTYPE_SPRINGS,
    step: float = STEP,
) -> tuple[PlannedRecording, ...]:
    """The paper's eight recordings: rising and falling, with and without payload, with and without springs."""
    return tuple(
        sweep(
            motion,
            direction,
            joints,
            step,
            name="_".join([direction, *(["payload"] if mass else []), *(["springs"] if mounted else [])]),
            payload=mass,
            springs=tuple(mounted),
        )
        for direction in get_args(Direction)
        for mass in (payload, 0.0)
        for mounted in (springs, ())
    )


def times(duration: float, step: float) -> np.ndarray:
    """Sampling times from 0 to the duration [s]; raises `UserError` for a step that is not within it."""
    if not 0 < step <= duration:
        raise UserError(f"the sampling step must be above 0 and at most the duration, {duration:g} s, got {step:g} s")
    return np.linspace(0, duration, round(duration / step) + 1)

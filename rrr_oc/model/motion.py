"""A motion of an arm: what the model's torques are computed along, and what the engine follows."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix

from rrr_oc.numerics.savitzky_golay import as_matrix


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion of n joints at K instants; time is the last axis.

    Attributes:
        t: Time [s], increasing within each segment, shape (K,).
        q, dq, ddq: Positions [rad], speeds [rad/s], accelerations [rad/s²], shape (n, K).
        payload: Mass at the tool [kg], shape (K,).
        segments: Slices of the samples that no filter, derivative or integral may cross. Default: one slice of all samples.
        start: When the motion, or the session that it is part of, began [s]; None: with the first sample.
    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    payload: np.ndarray
    segments: tuple[slice, ...] = ()
    start: float | None = None

    def __post_init__(self) -> None:
        if not self.segments:
            object.__setattr__(self, "segments", (slice(0, len(self.t)),))

    @property
    def clock(self) -> np.ndarray:
        """Time since the start [s], shape (K,)."""
        return self.t - (self.t[0] if self.start is None else self.start)

    def of_drives(self, twist: np.ndarray) -> "Motion":
        """The motion of the drives, where this is of the links: q, dq, ddq of the links less those of their drives are twist, (3, n, K)."""
        q, dq, ddq = (x - by for x, by in zip((self.q, self.dq, self.ddq), twist, strict=True))
        return Motion(self.t, q, dq, ddq, self.payload, self.segments, self.start)

    def smoothing(self, window: float) -> csr_matrix:
        """Savitzky–Golay filter over a window [s], within each segment, as a matrix (K, K); computed once for each window."""
        if window not in self._filters:
            self._filters[window] = as_matrix(self.t, self.segments, window)
        return self._filters[window]

    @cached_property
    def _filters(self) -> dict[float, csr_matrix]:
        return {}

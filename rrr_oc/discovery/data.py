"""Recordings as the data of a discovery: which rows count, where joints turn, and what no law is exact enough for."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.regression import Rows, rows, with_residuals
from rrr_oc.calibration.samples import Prepared, _turning, kept_rows
from rrr_oc.diagnosis.signatures import SignatureCache
from rrr_oc.discovery.knobs import CENTRE_ERROR, INERTIA_ERROR, MASS_ERROR
from rrr_oc.numerics.smooth import sign

EVERY = 2  # rows of which one is used: beyond 6 Hz derivatives of recorded positions are not exact
TURNS = 0.3  # share of a row's filter on samples at a reversal from which the row counts as one
ORDERS = {"q": 8, "dq": 4, "load": 4}  # of the cosines of a discrepancy over each variable


@dataclass(frozen=True, eq=False)
class Data:
    """Recordings ready for a discovery.

    Attributes:
        prepared: The recordings.
        start: The plain model, calibrated.
        links: Errors of the links' inertial parameters that one standard deviation of their prior stands for, (10 n, k).
        free: Whether these errors are of unknown size, as of a URDF that is not exact; else of size 1.
        whole: All recordings, if these are a part of them.
    """

    prepared: tuple[Prepared, ...]
    start: CalibratedModel
    links: np.ndarray
    free: bool
    signatures: SignatureCache
    whole: tuple[Prepared, ...] = ()

    def part(self, keep: Sequence[int]) -> "Data":
        """The data of some of the recordings."""
        return Data(
            tuple(self.prepared[i] for i in keep), self.start, self.links, self.free, self.signatures, self.whole or self.prepared
        )

    @property
    def every(self) -> tuple[Prepared, ...]:
        return self.whole or self.prepared

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.prepared[0].measured)

    @cached_property
    def torque(self) -> np.ndarray:
        """Standard deviation of each joint's recorded torque, (n,) [Nm]."""
        return np.maximum(np.concatenate([p.measured for p in self.every], axis=1).std(axis=1), 1e-9)

    @cached_property
    def edges(self) -> np.ndarray:
        """First row of each recording, and the number of rows, (R + 1,)."""
        return np.cumsum([0, *(len(k) for k in self.kept)]).astype(int)

    @cached_property
    def kept(self) -> tuple[np.ndarray, ...]:
        """Of each recording the rows of `regression.rows` that are used: every `EVERY`-th of a stretch."""
        return tuple(
            np.concatenate([np.arange(s.start, s.stop, EVERY) for s in kept_rows(p.recording)[1]] or [np.zeros(0, int)])
            for p in self.prepared
        )

    @cached_property
    def at(self) -> np.ndarray:
        """The rows of `regression.rows` that are used, (M,)."""
        first = np.cumsum([0, *(p.counted.shape[1] for p in self.prepared)])
        return np.concatenate([a + k for a, k in zip(first, self.kept, strict=False)])

    def rows(self, model: CalibratedModel) -> Rows:
        """Residuals and derivatives of a model at the rows that are used."""
        found = rows(self.prepared, model, inertial=True)
        return replace(found, residual=found.residual[:, self.at], jacobian=found.jacobian[:, self.at], moving=self.counted)

    def residual(self, found: Rows, model: CalibratedModel) -> np.ndarray:
        """The residual of another model, (n, M)."""
        return with_residuals(found, self.prepared, model).residual[:, self.at]

    @property
    def groups(self) -> tuple[str, ...]:
        """Physical set-up of each recording."""
        return tuple(p.recording.group for p in self.prepared)

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """The distinct groups."""
        return tuple(dict.fromkeys(self.groups))

    @cached_property
    def label(self) -> np.ndarray:
        """Number of the group of each row, (M,)."""
        numbers = [self.labels.index(g) for g in self.groups]
        return np.repeat(numbers, np.diff(self.edges))

    @cached_property
    def counted(self) -> np.ndarray:
        """Rows that count, (n, M)."""
        return np.concatenate([p.counted for p in self.prepared], axis=1)[:, self.at]

    @cached_property
    def turning(self) -> np.ndarray:
        """Rows at which a joint turns, (n, M)."""
        parts = [(p.matrix @ _turning(p.recording).T.astype(float)).T for p in self.prepared]
        return np.concatenate(parts, axis=1)[:, self.at] > TURNS

    @cached_property
    def place(self) -> np.ndarray:
        """Number of rows without a gap before each row; −1 where a row does not count, (n, M)."""
        begins = np.zeros(self.edges[-1], bool)
        for p, k, first in zip(self.prepared, self.kept, self.edges, strict=False):
            for s in kept_rows(p.recording)[1]:
                begins[first + np.searchsorted(k, s.start)] = True
        result = np.full(self.counted.shape, -1)
        for j, counted in enumerate(self.counted):
            broken = begins | ~np.concatenate([[False], counted[:-1]])
            last = np.maximum.accumulate(np.where(broken, np.arange(len(counted)), 0))
            result[j] = np.where(counted, np.arange(len(counted)) - last, -1)
        return result

    @cached_property
    def features(self) -> tuple[np.ndarray, ...]:
        """For each joint the functions of which a discrepancy is made, for a standard deviation of all its torque, (M, F) [Nm]."""
        parts = [self._features(p, r) for r, p in enumerate(self.prepared)]
        return tuple(np.concatenate([part[j] for part in parts])[self.at] for j in range(self.n))

    def _features(self, p: Prepared, number: int) -> list[np.ndarray]:
        r, start, result = p.recording, self.start, []
        load = start.torques(r)[1]
        q_all = np.concatenate([x.recording.q for x in self.every], axis=1)
        dq_all = np.concatenate([np.abs(x.recording.dq) for x in self.every], axis=1)
        low, high = np.quantile(q_all, [0.002, 0.998], axis=1)
        speed = np.maximum(np.quantile(dq_all, 0.99, axis=1), 1e-3)
        for j in range(self.n):
            reach = max(3.0 * float(np.std(load[j])), 1e-6)
            span = max(high[j] - low[j], 1e-3)
            x = {
                "q": np.clip((r.q[j] - low[j]) / span, 0, 1),
                "dq": np.clip(np.abs(r.dq[j]) / speed[j], 0, 1),
                "load": np.clip(0.5 + load[j] / reach / 2, 0, 1),
            }
            series = {k: [np.cos(np.pi * o * v) / (1 + o) for o in range(1, ORDERS[k] + 1)] for k, v in x.items()}
            both = [a * b for a in series["q"][:3] for b in (*series["load"][:2], *series["dq"][:2])]
            shapes = [*series["q"], *series["dq"], *series["load"], *both]
            turned = sign(r.dq[j], 0.03)
            own = [np.zeros_like(load[j])] * (4 * len(self.prepared))
            steady = [np.ones_like(load[j]), turned, r.dq[j] / speed[j], load[j] / reach * 2]
            own[4 * number : 4 * number + 4] = steady
            every = np.array([*shapes, *(turned * f for f in shapes), *own])
            result.append(p.passed(every * self.torque[j], np.full(len(every), j)).T)
        return result


def link_errors(inertial: np.ndarray) -> np.ndarray:
    """Errors that a URDF's inertial parameters (10, n) may have: mass, centre and inertia of each link, (10 n, 7 n)."""
    n = inertial.shape[1]
    result = np.zeros((10 * n, 7 * n))
    for i in range(n):
        m, h, body = inertial[0, i], inertial[1:4, i], inertial[4:, i]
        c = h / max(m, 1e-9)
        own = np.zeros((10, 7))
        own[:, 0] = MASS_ERROR * inertial[:, i]
        for k in range(3):
            d = np.zeros(3)
            d[k] = CENTRE_ERROR
            own[1:4, 1 + k] = m * d
            own[4:, 1 + k] = m * _packed(2 * (c @ d) * np.eye(3) - np.outer(c, d) - np.outer(d, c))
        about = body - m * _packed((c @ c) * np.eye(3) - np.outer(c, c))
        for k, at in enumerate((0, 2, 5)):
            own[4 + at, 4 + k] = INERTIA_ERROR * max(about[at], 1e-9)
        result[10 * i : 10 * i + 10, 7 * i : 7 * i + 7] = own
    return result


def _packed(matrix: np.ndarray) -> np.ndarray:
    """xx, xy, yy, xz, yz, zz."""
    return matrix[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]

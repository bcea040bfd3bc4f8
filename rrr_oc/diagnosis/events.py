"""Stretches of time in which a joint's torque is explained by nothing: pushes, contacts, catches.

A friction that sticks or a play that closes leaves large errors for some tenths of a second, too. But these come again where angle,
speed, acceleration and load do; an event does not.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from msgspec import Struct
from scipy.ndimage import median_filter
from scipy.spatial import KDTree

from rrr_oc.calibration.estimator.data import EVERY, Data
from rrr_oc.calibration.estimator.fitting import Fitted
from rrr_oc.calibration.samples import STRIDE, Prepared, kept_rows
from rrr_oc.diagnosis.mismatch import signals_at_rows
from rrr_oc.diagnosis.structures.search import Search

# deviations of a joint's error, of an event's peak and up to its ends; doubled, weak pushes stay in the fit
FAR, NEAR = 10.0, 2.5
SHARE = 0.15  # of a joint's torque, that a peak has at least; doubled, weak pushes stay in the fit
SLOW = 2.0  # [s] of the running median, which passes what lasts half as long; doubled, longer contacts are events
MOST = 0.2  # share of the time that events may take; more is missing physics
ALIKE, AGAIN = 5, 0.3  # rows of a like state, and share of a peak that they may have in the median
EXPLAINED = 0.7  # of the error at a joint's events, that a law may leave which explains them; doubled, no law does
STATE = ("q", "dq", "ddq", "load_torque")
LEAST = 60  # rows from which deviations are known


class Event(Struct, frozen=True, rename={"begin": "from", "end": "to"}):
    """A stretch of time in which a joint's torque is not explained by anything.

    Attributes:
        joint: The joint.
        recording: File of the recording.
        begin: Time in the file at which it begins [s].
        end: Time in the file at which it ends [s].
        peak: Largest error of the plain model, smoothed as its rows are [Nm].
    """

    joint: str
    recording: str
    begin: float
    end: float
    peak: float


def events(fitted: Fitted) -> list[Event]:
    """Events in the error of a plain fit."""
    data, model = fitted.posterior.data, fitted.model
    signals = signals_at_rows(data, model)
    state = np.array([signals[name][0] for name in STATE])
    t, result = _times(data), list[Event]()
    for j, joint in enumerate(model.joints):
        counted = data.counted[j]
        if counted.sum() < LEAST:
            continue
        sudden = np.where(counted, fitted.residual[j] - _slow(data, fitted.residual[j]), 0.0)
        deviation = 1.4826 * np.median(np.abs(sudden[counted]))
        stretches = _stretches(data, sudden, deviation, SHARE * data.torque[j]) if deviation > 0 else []
        if sum(map(len, stretches)) > MOST * counted.sum():
            continue
        own = state[:, j] / np.maximum(state[:, j, counted].std(axis=1, keepdims=True), 1e-12)
        for rows in stretches:
            if not _comes_again(data, own, sudden, t, rows, counted):
                k = int(np.searchsorted(data.edges, rows[0], side="right")) - 1
                half = STRIDE * EVERY / 2
                peak = float(sudden[rows[np.argmax(np.abs(sudden[rows]))]])
                result.append(
                    Event(joint, data.prepared[k].recording.file, float(t[rows[0]] - half), float(t[rows[-1]] + half), peak)
                )
    return result


def unlike_laws(search: Search, begin: Fitted, some: Sequence[Event]) -> list[Event]:
    """Events of those joints of which no law of the catalogue explains much there, in the linear problem about the plain fit."""
    if not some:
        return []
    near, data, result = search.neighbours(begin), begin.posterior.data, list[Event]()
    here = near.at((), begin.posterior.hyper, True)
    rows = np.arange(data.edges[-1])
    left = [near.linear.left((), here.solution.step, rows)]
    for a in near.candidates(here):
        there = near.at((a,), begin.posterior.hyper, True)
        left.append(near.linear.left((a,), there.solution.step, rows))
    for j, joint in enumerate(begin.model.joints):
        own = [e for e in some if e.joint == joint]
        at = np.concatenate([np.zeros(0, int), *(rows_of(data, e) for e in own)])
        sizes = [float(np.linalg.norm(x[j, at])) for x in left]
        result += own if min(sizes) > EXPLAINED * sizes[0] else []
    return result


def rows_of(data: Data, event: Event) -> np.ndarray:
    """The rows in an event."""
    times = _times(data)
    number = np.repeat([p.recording.file for p in data.prepared], np.diff(data.edges))
    return np.flatnonzero((number == event.recording) & (times >= event.begin) & (times <= event.end))


def _times(data: Data) -> np.ndarray:
    """Times of the rows in their files, (M,) [s]."""
    each = [p.recording.t[kept_rows(p.recording)[0][k]] for p, k in zip(data.prepared, data.kept, strict=True)]
    return np.concatenate(each)


def without(prepared: Sequence[Prepared], joints: Sequence[str], some: Sequence[Event]) -> tuple[Prepared, ...]:
    """The recordings, in which events count as little as rests do."""
    result = []
    for p in prepared:
        moving = p.moving.copy()
        for e in some:
            if e.recording == p.recording.file:
                moving[joints.index(e.joint), (p.recording.t >= e.begin) & (p.recording.t <= e.end)] = False
        result.append(replace(p, moving=moving))
    return tuple(result)


def _slow(data: Data, error: np.ndarray) -> np.ndarray:
    """The running median of an error (M,), recording by recording."""
    size = round(SLOW / (STRIDE * EVERY)) | 1
    return np.concatenate([median_filter(x, size, mode="nearest") for x in np.split(error, data.edges[1:-1])])


def _stretches(data: Data, error: np.ndarray, deviation: float, least: float) -> list[np.ndarray]:
    """Rows of each stretch in which an error (M,) stays large and peaks far above the rest."""
    result = []
    for first, one in zip(data.edges, np.split(error, data.edges[1:-1]), strict=False):
        numbers = np.cumsum(np.diff(np.abs(one) > NEAR * deviation, prepend=False))
        result += [first + np.flatnonzero(numbers == i) for i in range(1, int(numbers.max(initial=0)) + 1, 2)]
    return [rows for rows in result if np.abs(error[rows]).max() > max(FAR * deviation, least)]


def _comes_again(
    data: Data, state: np.ndarray, error: np.ndarray, t: np.ndarray, rows: np.ndarray, counted: np.ndarray
) -> bool:
    """Whether the error at a stretch's peak is there at other times in a like state (4, M), or at the angle, its first row."""
    peak = rows[np.argmax(np.abs(error[rows]))]
    some = np.flatnonzero(counted)
    number = np.repeat(np.arange(len(data.edges) - 1), np.diff(data.edges))
    other = some[(number[some] != number[peak]) | (np.abs(t[some] - t[peak]) > SLOW)]
    if len(other) < ALIKE:
        return False
    near = [KDTree(x[:, other].T).query(x[:, peak], k=ALIKE)[1] for x in (state, state[:1])]
    return any(np.median(error[other[k]]) / error[peak] > AGAIN for k in near)

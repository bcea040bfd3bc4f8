"""Stretches of time in which a joint's torque is explained by nothing: pushes, contacts, catches.

A friction that sticks or a play that closes leaves large errors for some tenths of a second, too. But these come again where angle,
speed, acceleration and load do; an event does not. And where a joint turns or begins to move, an event is more than what friction may be there.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial import KDTree

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.estimator.data import EVERY, Data
from rrr_oc.calibration.estimator.fitting import Fitted
from rrr_oc.calibration.samples import STRIDE, Prepared, kept_rows
from rrr_oc.diagnosis.mismatch import signals_at_rows
from rrr_oc.diagnosis.result import Event
from rrr_oc.diagnosis.structures.search import StructureSearch

# deviations of a joint's error, of an event's peak and up to its ends; doubled, weak pushes stay in the fit
FAR, NEAR = 7.0, 2.5
SHARE = 0.15  # of a joint's torque, that a peak has at least; doubled, weak pushes stay in the fit
SLOW = 2.0  # [s] of the running median, which passes what lasts half as long; doubled, longer contacts are events
MOST = 0.2  # share of the time that events may take; more is missing physics
ALIKE = 5  # rows of a like state of which the median is taken; doubled, what only one other recording has is no like state
AGAIN = 0.3  # share of a peak that the rows of the most alike states may have in the median; doubled, friction that sticks is events
NEIGHBOURS = 40  # rows of the most alike states, some of which are of the same time; doubled, no change
CLOSE = 0.6  # deviations of a state up to which another is like it; doubled, motions that only one recording has are events
AGREE = 0.7  # share of the difference to errors in like states that these may be apart; doubled, what differs between set-ups is events
FAR_FROM_LIKE = 5.0  # deviations of the difference to errors in like states; doubled, weak pushes stay in the fit
FUNCTIONS = 4  # of a joint that are tried, those of the largest gain
EXPLAINED = 0.7  # of the error at a joint's events, that a law may leave which explains them; doubled, no law does
WHOLLY = 0.3  # of the error at an event, that a law may leave which was fitted to it, too; doubled, some laws explain pushes
STATE = ("q", "dq", "ddq", "load_torque")
LEAST = 60  # rows from which deviations are known


def events(fitted: Fitted) -> list[Event]:
    """Events in the error of a plain fit."""
    data, model = fitted.posterior.data, fitted.model
    signals = signals_at_rows(data, model)
    state = np.array([signals[name][0] for name in STATE])
    t, result = times(data), list[Event]()
    number = np.repeat(np.arange(len(data.edges) - 1), np.diff(data.edges))
    for j, joint in enumerate(model.joints):
        counted = data.counted[j]
        if counted.sum() < LEAST:
            continue
        sudden = np.where(counted, fitted.residual[j] - _slow(data, fitted.residual[j]), 0.0)
        least = np.maximum(SHARE * data.torque[j], _of_sticking(data, model, j))
        own = state[:, j] / np.maximum(state[:, j, counted].std(axis=1, keepdims=True), 1e-12)
        at = np.array([t, number * 2 * (t.max() + SLOW) + t])
        stretches = _stretches_of(data, sudden, own, at, counted)
        stretches = [rows for rows in stretches if np.any(np.abs(sudden[rows]) > least[rows])]
        if sum(map(len, stretches)) > MOST * counted.sum():
            continue
        half = STRIDE * EVERY / 2
        for rows in sorted(stretches, key=lambda rows: rows[0]):
            file = data.prepared[number[rows[0]]].recording.file
            peak = float(sudden[rows[np.argmax(np.abs(sudden[rows]))]])
            result.append(Event(joint, file, float(t[rows[0]] - half), float(t[rows[-1]] + half), peak))
    return result


def unlike_laws(search: StructureSearch, begin: Fitted, some: Sequence[Event]) -> list[Event]:
    """Events of those joints of which no law of the catalogue and no function explains much there, in the linear problem about the plain
    fit."""
    if not some:
        return []
    near, data, result = search.neighbours(begin), begin.posterior.data, list[Event]()
    here = near.at((), begin.posterior.hyper, True)
    rows = np.arange(data.edges[-1])
    left = [near.linear.left((), here.solution.step, rows)]
    joints = sorted({begin.model.joints.index(e.joint) for e in some})
    functions = (a for j in joints for a in itertools.islice(near.black_boxes(here, j), FUNCTIONS))
    for a in (*near.candidates(here), *functions):
        there = near.at((a,), begin.posterior.hyper, True)
        left.append(near.linear.left((a,), there.solution.step, rows))
    for j, joint in enumerate(begin.model.joints):
        own = [e for e in some if e.joint == joint]
        at = np.concatenate([np.zeros(0, int), *(rows_of(data, e) for e in own)])
        sizes = [float(np.linalg.norm(x[j, at])) for x in left]
        result += own if min(sizes) > EXPLAINED * sizes[0] else []
    return result


def unexplained_events(
    data: Data, plain: CalibratedModel, model: CalibratedModel, some: Sequence[Event], most: float = EXPLAINED
) -> list[Event]:
    """Those events of whose error a model leaves more than a share `most`; `data` are all, and the plain model was fitted without them."""
    before, after = data.residual(plain), data.residual(model)

    def left(e: Event) -> bool:
        j, rows = plain.joints.index(e.joint), rows_of(data, e)
        return bool(np.linalg.norm(after[j, rows]) > most * np.linalg.norm(before[j, rows]))

    return [e for e in some if left(e)]


def rows_of(data: Data, event: Event) -> np.ndarray:
    """The rows in an event."""
    t = times(data)
    number = np.repeat([p.recording.file for p in data.prepared], np.diff(data.edges))
    return np.flatnonzero((number == event.recording) & (t >= event.begin) & (t <= event.end))


def times(data: Data) -> np.ndarray:
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


def _of_sticking(data: Data, model: CalibratedModel, j: int) -> np.ndarray:
    """By how much dry friction may be other than predicted where a joint turns or begins to move, (M,) [Nm]: it has any value there that
    is not above its level."""
    result = np.zeros(len(data.may_stick[j]))
    for term in model.terms:
        if term.effect.sign_forms and term.effect.joints == (j,) and term.width:
            result += abs(term.values[0]) * (1 + np.abs(data.friction(term.effect, term.width)))
    return result * data.may_stick[j]


def _slow(data: Data, error: np.ndarray) -> np.ndarray:
    """The running median of an error (M,), recording by recording."""
    size = round(SLOW / (STRIDE * EVERY)) | 1
    return np.concatenate([median_filter(x, size, mode="nearest") for x in np.split(error, data.edges[1:-1])])


def _stretches_of(data: Data, error: np.ndarray, state: np.ndarray, at: np.ndarray, counted: np.ndarray) -> list[np.ndarray]:
    """Rows of each stretch in which a joint's error (M,) is far above the rest and does not come again, or is far from what it is at
    other times in a like state.

    Args:
        state: Angle, speed, acceleration and load over their deviations, (4, M).
        at: Times in the files, and such that those of different recordings are far from each other, (2, M).
    """
    some = np.flatnonzero(counted)
    like, near, apart = (np.full(error.shape, x) for x in (np.nan, np.inf, np.inf))
    like[some], near[some], apart[some] = _at_other_times(error[some], state[:, some], at[1, some])
    other = np.where((near < CLOSE) & (apart < AGREE * np.abs(error - like)), error - like, np.nan)
    known = (error, np.where(near < CLOSE, error - like, np.nan))
    sizes = [1.4826 * np.nanmedian(np.abs(x[some])) if np.isfinite(x[some]).any() else 0.0 for x in known]
    if not sizes[0] > 0:
        return []
    alone = np.abs(error) / sizes[0]
    stretches = _stretches(data, alone, FAR)
    if sizes[1] > 0:
        unlike = np.where(np.isfinite(other), np.abs(other) / sizes[1], np.minimum(alone, FAR_FROM_LIKE))
        taken = set(np.concatenate([np.zeros(0, int), *stretches]).tolist())
        stretches += [rows for rows in _stretches(data, unlike, FAR_FROM_LIKE) if not taken & set(rows.tolist())]
    return [rows for rows in stretches if not _comes_again(error, state, at, rows, some)]


def _at_other_times(error: np.ndarray, state: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The median error (M,) at other times in the most alike states (4, M), how far the last of these is, and the range of the errors."""
    far, rows = KDTree(state.T).query(state.T, k=min(NEIGHBOURS, len(t)))
    others = np.abs(t[rows] - t[:, None]) > SLOW
    order = np.argsort(~others, axis=1, kind="stable")[:, :ALIKE]
    taken = np.take_along_axis(others, order, 1).all(axis=1) & (order.shape[1] == ALIKE)
    alike = error[np.take_along_axis(rows, order, 1)]
    last = np.take_along_axis(far, order, 1)[:, -1]
    return np.where(taken, np.median(alike, axis=1), np.nan), np.where(taken, last, np.inf), np.ptp(alike, axis=1)


def _stretches(data: Data, size: np.ndarray, far: float) -> list[np.ndarray]:
    """Rows of each stretch in which an error over its deviation (M,) stays large and peaks far above the rest."""
    result = []
    for first, one in zip(data.edges, np.split(size, data.edges[1:-1]), strict=False):
        numbers = np.cumsum(np.diff(one > NEAR, prepend=False))
        result += [first + np.flatnonzero(numbers == i) for i in range(1, int(numbers.max(initial=0)) + 1, 2)]
    return [rows for rows in result if size[rows].max() > far]


def _comes_again(error: np.ndarray, state: np.ndarray, at: np.ndarray, rows: np.ndarray, some: np.ndarray) -> bool:
    """Whether the error at a stretch's peak is there at other times in a like state, at the angle, its first row, or at the same time of
    another recording."""
    peak = rows[np.argmax(np.abs(error[rows]))]
    other = some[np.abs(at[1, some] - at[1, peak]) > SLOW]
    alike = (state, state[:1], at[:1])
    near = [KDTree(x[:, other].T).query(x[:, peak], k=k)[1] for x in alike for k in (3, ALIKE) if k <= len(other)]
    return any(np.median(error[other[k]]) * np.sign(error[peak]) > AGAIN * np.abs(error[peak]) for k in near)

"""Recordings whose torques have a clock of their own: later than the positions by another time in each recording, or from row to row.

Two devices, or two programs, stamp what they record by their own clocks; these are set by hand, and drift apart.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import t as student

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.samples import STRIDE, Prepared, kept_rows, residuals, thinned
from rrr_oc.recordings.recording import Recording, RecordingSet

# Chance of a delay that is none to be taken for one, in all and without any one joint: one clock takes the torques of all joints
CHANCE, ALONE = 1e-4, 0.01
SHORTEST, LONGEST = 0.002, 0.05  # [s] of a delay that is undone: shorter ones matter little, longer ones are no clock's
PASSES = 4  # in which a long delay is found, whose slope is that of the torque at the wrong times
BLOCK = 1.0  # [s] of the blocks whose differences give standard errors; doubled, these are less exact
OWN = "clock of "  # kind of what is told of a recording's clock in `Recording.mended`, with its file
TURN = 0.02  # [rad/s] of the change of sign in friction that may differ in each recording


def on_one_clock(recordings: RecordingSet, lags: np.ndarray) -> RecordingSet:
    """The recordings with torques at the times of the positions; the same object if none has a clock of its own.

    Args:
        lags: By how much torques are late in the middle of each recording and how much more at its end than at its begin, (R, 2) [s].
    """
    if not lags.any():
        return recordings
    new = [_undone(r, *lag) if any(lag) else r for r, lag in zip(recordings.recordings, lags.tolist(), strict=True)]
    return replace(recordings, recordings=tuple(new))


def clock_lags(whole: Sequence[Prepared], model: CalibratedModel) -> np.ndarray:
    """By how much torques are later than those of all recordings, and how that grows, as `on_one_clock` takes it, (R, 2) [s].

    Clocks drift apart at one rate. 0 where that is not sure, or not seen at every joint, as of one joint or of commands.

    Args:
        model: Calibrated, with one delay for all recordings.
    """
    some = thinned(whole)
    lags = np.zeros((len(some), 2))
    if len(model.joints) == 1 or some[0].recording.command is not None:
        return lags
    predicted = [p.measured - residuals(p, model) for p in some]
    freedom, time = np.array([len(_edges(p)) - 2 for p in some]), np.array([np.ptp(p.recording.t) for p in some])
    sure = np.zeros(lags.shape, bool)
    for _ in range(PASSES):
        steps, std = np.moveaxis(np.array([_lag(p, x, lag) for p, x, lag in zip(some, predicted, lags, strict=True)]), 1, 0)
        found = lags[:, None] + steps  # (R, 1 + n, 2), of all joints and of all but one
        found[:, :, 0] -= np.average(found[:, :, 0], axis=0, weights=std[:, :, 0] ** -2.0)  # which the model's delay has
        weight = np.sum((time[:, None] / std[:, :, 1]) ** 2, axis=0)
        rate = np.sum(found[:, :, 1] * time[:, None] / std[:, :, 1] ** 2, axis=0) / weight
        sure[:, 0] = _is_sure(np.abs(found[:, :, 0]) / std[:, :, 0], freedom)
        sure[:, 1] = _is_sure(np.abs(rate) * np.sqrt(weight), freedom.sum())
        lags = np.array([found[:, 0, 0], rate[0] * time]).T
    return lags * (sure & (np.abs(lags) > SHORTEST) & (np.abs(lags) < LONGEST))


def _is_sure(size: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Whether estimates over their standard errors (..., 1 + n), of all joints and of all but one, are no chance."""
    of_all, alone = student.isf(CHANCE / 2, freedom), student.isf(ALONE / 2, freedom)
    return (size[..., 0] > of_all) & (size[..., 1:].min(axis=-1) > alone)


def errors_of(prepared: Sequence[Prepared], model: CalibratedModel) -> np.ndarray:
    """Of each recording the mean square of a model's filtered residual over that of the torque, summed over the joints, (R,)."""
    left = [p.passed(residuals(p, model), np.arange(len(p.measured))) for p in prepared]
    sizes = [np.maximum(np.var(p.measured, axis=1), 1e-300) for p in prepared]
    return np.array([np.sum(np.mean(x**2, axis=1) / size) for x, size in zip(left, sizes, strict=True)])


def _lag(p: Prepared, predicted: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """By how much the torques of a recording are later than is known, in the middle and from its begin to its end [s], by all joints and by
    all but each, (1 + n, 2), and standard errors.

    A delay changes torques by their slope. So do, nearly, friction and inertia that are others in this recording, or change in it: only
    what these do not explain counts. Standard errors follow from how blocks of some seconds differ.
    """
    r, n = p.recording, len(predicted)
    course, left = _course(r.t), _shifted(r, p.measured, known) - predicted
    edges = _edges(p)
    slope, gram = np.zeros((n, len(edges) - 1, 2)), np.zeros((n, len(edges) - 1, 2, 2))
    for j in range(n):
        own = np.array([np.ones_like(r.t), np.tanh(r.dq[j] / TURN), r.dq[j], r.ddq[j]])
        columns = np.concatenate(
            [-np.gradient(predicted[j], r.t) * [np.ones_like(r.t), course], own, own * course, left[j : j + 1]]
        )
        x = (p.passed(columns, np.full(len(columns), j)) * ~p.turning[j]).T  # where a joint turns, friction sticks
        x = x[:, [0, 1, -1]] - x[:, 2:-1] @ np.linalg.lstsq(x[:, 2:-1], x[:, [0, 1, -1]], rcond=None)[0]
        scale = max(float(np.mean(x[:, 2] ** 2)), 1e-300)
        slope[j] = np.add.reduceat(x[:, :2] * x[:, 2:], edges[:-1]) / scale
        gram[j] = np.add.reduceat(x[:, :2, None] * x[:, None, :2], edges[:-1]) / scale
    every = [slope.sum(axis=0), *(np.delete(slope, j, 0).sum(axis=0) for j in range(n))]
    grams = [gram.sum(axis=0), *(np.delete(gram, j, 0).sum(axis=0) for j in range(n))]
    values, stds = zip(*map(_estimate, every, grams), strict=True)
    return np.array(values), np.array(stds)


def _edges(p: Prepared) -> np.ndarray:
    """First row of each block, and the number of rows, of those that are kept."""
    rows = len(kept_rows(p.recording)[0])
    return np.linspace(0, rows, max(round(rows * STRIDE / BLOCK), 3) + 1).astype(int)


def _estimate(slope: np.ndarray, gram: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least squares from sums of each block, (B, 2) and (B, 2, 2), and standard errors from how the blocks differ (White 1980)."""
    total = gram.sum(axis=0)
    inverse = np.linalg.pinv(total)
    value = inverse @ slope.sum(axis=0)
    apart = (slope - gram @ value) @ inverse
    std = np.sqrt(len(slope) / (len(slope) - 1) * np.sum(apart**2, axis=0))
    return value, np.where(np.diag(total) > 0, np.maximum(std, 1e-12), 1.0)  # a second, where nothing tells: longer than any


def said_of_clocks(recordings: RecordingSet) -> list[str]:
    """What was undone, a sentence each, without a full stop."""
    return [f"{r.file}: {said}" for r in recordings.recordings for kind, said in r.mended.items() if kind.startswith(OWN)]


def _course(t: np.ndarray) -> np.ndarray:
    """From -1/2 at the first sample to 1/2 at the last, (K,)."""
    return (t - t[0]) / max(float(np.ptp(t)), 1e-12) - 0.5


def _shifted(r: Recording, x: np.ndarray, lag: np.ndarray) -> np.ndarray:
    """Signals (m, K) as they are by a time later that grows over the recording; linear between samples, within each segment."""
    at, result = r.t + lag[0] + lag[1] * _course(r.t), x.copy()
    for s in r.segments:
        result[:, s] = [np.interp(at[s], r.t[s], one[s]) for one in x]
    return result


def _undone(r: Recording, middle: float, over_all: float) -> Recording:
    """A recording with its torques at the times of its positions, which says so."""
    said = []
    if middle:
        said.append(f"are {abs(middle) * 1e3:.2g} ms {'later' if middle > 0 else 'earlier'} than those of other recordings")
    if over_all:
        said.append(f"fall {'behind' if over_all > 0 else 'ahead of'} the positions by {abs(over_all) * 1e3:.2g} ms over it")
    known = {OWN + r.file: f"torques {' and '.join(said)}, as by a clock of their own; this is undone"}
    return replace(r, tau=_shifted(r, r.tau, np.array([middle, over_all])), mended={**r.mended, **known})

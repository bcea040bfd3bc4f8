"""Times of samples that a driver hands over several at once, stamps sooner or later than they were taken, or repeats until the next."""

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from rrr_oc.numerics.savitzky_golay import GAP, local_polynomial

TOGETHER = 0.1  # of the mean step, below which two samples were handed over at once; doubled, jitter counts as that
BATCHED = 0.3  # share of such steps from which samples came in batches; doubled, batches of two are no batches
LEAST = 8  # samples, and batches, from which these are told
# Residual of positions at even times over that at the stamps, below which stamps jitter; at .9, jitter of 1 ms stays
SMOOTHER = 0.95
CUBIC = 9  # samples of a window of that residual; doubled, fast motion hides the jitter
JUMP = 3.0  # resolutions by which a position jumps that is fast: such steps follow each other row by row; doubled, fewer count
REPEATED = 0.15  # share of fast changes that follow a row without one, from which positions are repeated; doubled, a third of rows may be
OWN_RATE = 0.9  # share of even distances between samples from which a signal has a rate of its own; at .8, marks of wrong rows are filled
ROUNDED = 1e-3  # of the usual step: smaller deviations from even times come from rounding; doubled, jitter of a few µs stays
PAUSE = 1.6  # times the usual time of a sample, above which samples are missing before a batch; doubled, gaps are filled


def spread(t: np.ndarray) -> tuple[np.ndarray, float]:
    """Stamps t (K,) [s], not decreasing, as the samples were taken, and how many samples a batch has; 1 where they came one by one.

    A batch is stamped when it is handed over, with its last sample. Where samples at even distances fit all stamps within a sample or
    two, they have these; of a batch from which samples were lost only the last one's time is known, and the others' are NaN. Else the
    samples of a batch are spread evenly over the time since the batch before; after a pause they have the usual distance.
    """
    with np.errstate(all="ignore"):  # absurd times are refused elsewhere
        steps = np.diff(t)
        mean = float(np.mean(steps)) if len(t) >= LEAST else np.nan
    if not (np.isfinite(mean) and np.all(steps >= 0)):
        return t, 1.0
    together = steps < TOGETHER * mean
    if np.mean(together) < BATCHED:
        return t, 1.0
    ends = np.append(np.flatnonzero(~together), len(t) - 1)  # the last sample of each batch
    if len(ends) < LEAST:
        return t, 1.0
    counts, arrivals = np.diff(ends, prepend=-1), t[ends]
    each, size = np.diff(arrivals) / counts[1:], float(np.median(counts))
    usual, whole = float(np.median(each)), slice(1, -1)  # the first and the last batch may not be whole
    to_end = np.repeat(ends, counts) - np.arange(len(t))
    places = np.append(counts[0], np.maximum(counts[1:], np.round(np.diff(arrivals) / usual)))
    number = np.cumsum(places)  # of a batch's last sample, with those that were lost
    line = np.polynomial.Polynomial.fit(number[whole], arrivals[whole], 1)
    if np.max(np.abs(arrivals - line(number))[whole]) < PAUSE * usual:
        unknown = (to_end > 0) & np.repeat(places > counts, counts)
        return np.where(unknown, np.nan, line(np.repeat(number, counts) - to_end)), size
    each = np.append(usual, np.where(each > PAUSE * usual, usual, each))
    return np.repeat(arrivals, counts) - to_end * np.repeat(each, counts), size


def even(t: np.ndarray, q: np.ndarray, segments: Sequence[slice]) -> tuple[np.ndarray, float]:
    """Times t (K,) [s] without the jitter of the stamps, and its standard deviation [s]; 0 where the stamps stay.

    A clock takes samples at even times; a busy computer stamps them when it gets to them. Samples may be lost. Where the positions
    q (n, K) [rad] are smoother at even times than at the stamps, the former are used; where sampling itself is uneven, and the stamps are
    right, they are not.
    """
    times, long = np.array(t), [s for s in segments if s.stop - s.start >= 2 * CUBIC]
    for s in long:
        times[s] = _grid(t[s], float(np.median(np.diff(t[s]))))
    jitter = float(np.std(t - times))
    if jitter < ROUNDED * np.median(np.diff(t)) or any(np.any(np.diff(times[s]) <= 0) for s in long):
        return t, 0.0
    with np.errstate(all="ignore"):
        left = [
            np.concatenate([q[:, s] - local_polynomial(x[s], q[:, s], 0, 3, CUBIC) for s in long], axis=1) for x in (times, t)
        ]
        at_even, at_stamps = (np.sqrt(np.mean(np.square(x), axis=1)) for x in left)
    moves = at_stamps > 0
    if not moves.any() or not float(np.exp(np.mean(np.log(at_even[moves] / at_stamps[moves])))) < SMOOTHER:
        return t, 0.0
    return times, jitter


def _grid(t: np.ndarray, step: float) -> np.ndarray:
    """Even times, about `step` [s] apart, nearest to stamps t (K,) [s], of which some may be lost; the stamps where there are none."""
    number = np.cumsum(np.append(0, np.maximum(1, np.round(np.diff(t) / step))))
    line = np.polynomial.Polynomial.fit(number, t, 1)
    for _ in range(5):
        nearest = np.round((t - line(0)) / (line(1) - line(0)))
        if np.array_equal(nearest, number) or np.any(np.diff(nearest) < 1):
            break
        number, line = nearest, np.polynomial.Polynomial.fit(nearest, t, 1)
    return line(number) if np.max(np.abs(t - line(number))) < step else t


def between_updates(t: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, float]:
    """A position q (K,) [rad] at times t (K,) [s] between its updates, and the time between these [s]; 0 where every row is one.

    A logger that is faster than the encoder repeats a position until the next one comes, so the position jumps. A fast one then does not
    change from each row to the next. Its updates come at even times, and a spline through them has no jumps; that it is late by a
    constant time stays.
    """
    steps = np.abs(np.diff(q))
    changes = np.flatnonzero(steps > 0) + 1
    if len(changes) < 2 * CUBIC:
        return q, 0.0
    fast = steps[changes[1:] - 1] > JUMP * np.min(steps[steps > 0])
    between = np.diff(t[changes])
    fast &= between < GAP * np.median(between)  # a stop is none
    if np.sum(fast) < 2 * CUBIC or np.mean(np.diff(changes)[fast] > 1) < REPEATED:
        return q, 0.0
    usual = float(np.mean(between[fast]))
    times = _grid(t[changes], usual)
    usual = float(np.median(np.diff(times)[fast]))
    at, values = [t[0] - usual], [q[0]]
    for begin, end, value in zip(times, np.append(times[1:], t[-1] + usual), q[changes], strict=True):
        some = np.arange(begin, end - usual / 2, usual)  # a position that stands is updated by the same value
        at += some.tolist()
        values += [value] * len(some)
    at, kept = np.unique(at, return_index=True)
    return CubicSpline(at, np.array(values)[kept])(t), usual


def at_every_row(t: np.ndarray, x: np.ndarray, position: bool) -> np.ndarray:
    """A signal x (K,) that has a rate of its own, NaN at other rows, at all rows at times t (K,) [s] between its samples.

    A position follows a spline, anything else a line from sample to sample. NaN stay where the samples are not at even distances, as
    where rows were marked as wrong, and in gaps.
    """
    own = np.flatnonzero(np.isfinite(x) & np.isfinite(t))
    if len(own) < LEAST or len(own) == len(t) or np.any(np.diff(t[own]) <= 0):
        return x
    steps = np.diff(t[own])
    if np.mean(steps > PAUSE * np.median(steps)) > 1 - OWN_RATE:
        return x
    after = np.clip(np.searchsorted(t[own], t), 1, len(own) - 1)
    inside = (t >= t[own[0]]) & (t <= t[own[-1]]) & (steps[after - 1] < GAP * np.median(steps))
    filled = CubicSpline(t[own], x[own])(t) if position else np.interp(t, t[own], x[own])
    return np.where(np.isnan(x) & inside, filled, x)

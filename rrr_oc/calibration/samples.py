"""Recordings made ready for regression: motion from short windows, the samples that count, and the common filter.

Torque and regressors pass the same filter (Savitzky–Golay, twice), so that the filter biases no estimate. Speeds and
accelerations come from windows as short as the sampling allows: attenuated motion would bias the estimates, whereas the filter
removes the noise of short windows. `validation/calibration_coverage.py` measures the bias that is left.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from weakref import WeakKeyDictionary

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter, minimum_filter1d
from scipy.signal import savgol_coeffs
from scipy.sparse import csr_matrix, diags

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.errors import UserError
from rrr_oc.model.recorded_physics import Physics, samples_before
from rrr_oc.numerics.savitzky_golay import as_matrix, local_polynomial, smooth, window_samples
from rrr_oc.recordings.recording import Recording, RecordingSet

FILTER = 0.2  # [s], window of the common filter, applied twice; doubled, less noise, and less of fast motion is left
SPEED_WINDOW, ACCELERATION_WINDOW = 0.07, 0.09  # [s], of the regressors; doubled, fast motion biases the estimates
# Times the window of the speed that are tried; with one more, coarser encoders are smoothed enough
LONGER = (1.0, 1.4, 2.0, 2.8, 4.0)
STRIDE = 0.04  # [s] between the rows that are kept; doubled, half as many rows, which lose what the filter lets through
ENDS = 0.25  # [s] left out at both ends of a stretch, where filter and derivatives are one-sided; a fifth of it at most
SHORTEST = 0.6  # [s], least length of a segment: three times the common filter; doubled, short segments are lost
REST_SPEED, REST_TIME = 0.01, 0.25  # below this speed [rad/s] for this long [s] a joint rests; doubled, slow motion is lost
THIN = 0.012  # [s] between samples where many models are compared; doubled, half the time, and 8 samples in the filter
LONGEST = 1200.0  # [s]: the most data on which many models are compared; doubled, twice the time
PIECE = 10.0  # [s] of the pieces of which parts of recordings are made; doubled, fewer motions are in them
SOME = 60.0  # [s] of recordings on which a first model is fitted; doubled, long recordings take twice the time
TURNS = 0.02  # share of a row's filter on samples at a reversal from which the row counts as one
SHORTEST_PIECE = 2.0  # [s] of a piece; doubled, pieces of many recordings take twice the time
GOLDEN = 0.618034  # by which pieces of one recording after the other lie later: evenly over all times
SPIKE = 6.0  # standard deviations off the running median that make a spike; doubled, small spikes stay in the torque
RARE = (0.99, 2.576)  # quantile of the residual, and that of normal noise: its ratio bounds the deviation from below
SPIKE_SAMPLES = 7  # of the running median: spikes of up to 3 samples; doubled, fast signals look like spikes
BLOCKS = 4  # contiguous pieces of a single recording, each held out once in a diagnosis
SHORT = 10  # samples; shorter segments are left out of the blocks


# Common filters by recording and window [s], for all that is prepared of a recording; they last as long as the recording.
_COMMON_FILTERS: WeakKeyDictionary[Recording, dict[float, csr_matrix]] = WeakKeyDictionary()
_KEPT_ROWS: WeakKeyDictionary[Recording, tuple[np.ndarray, tuple[slice, ...]]] = WeakKeyDictionary()


def common_filter(recording: Recording, window: float) -> csr_matrix:
    """The smoothing filter over a window [s], applied twice, at the samples of a recording that are kept, (kept, K)."""
    filters = _COMMON_FILTERS.setdefault(recording, {})
    if window not in filters:
        once = as_matrix(recording.t, recording.segments, window)
        filters[window] = (once[kept_rows(recording)[0]] @ once).tocsr()
    return filters[window]


@dataclass(frozen=True, eq=False)
class Prepared:
    """A recording made ready for regression. Two are equal only if they are the same object, which may key a cache.

    Attributes:
        recording: The recording with speeds and accelerations from short windows.
        measured: Recorded torque at the joints' output (n, K) [Nm].
        moving: Where each joint moves and no window of its motion reaches into a rest, (n, K). At rest, dry friction takes any
            value below its level, so samples at rest do not count; nor do those at which the recorded torque is cut off, or 0 in a dead
            band, or a motor gives less than its loop asks for.
        window: Window of the common filter [s].
        spikes: Number of samples of `measured` that were replaced, (n,).
    """

    recording: Recording
    measured: np.ndarray
    moving: np.ndarray
    window: float
    spikes: np.ndarray

    @property
    def matrix(self) -> csr_matrix:
        """The common filter at the samples that are kept, (kept, K)."""
        return common_filter(self.recording, self.window)

    @cached_property
    def counted(self) -> np.ndarray:
        """Rows that count: of those kept, the ones to which samples in motion contribute at least half, (n, kept)."""
        return (self.matrix @ self.moving.T.astype(float)).T > 0.5

    @cached_property
    def turning(self) -> np.ndarray:
        """Rows at which a joint turns, (n, kept)."""
        return (self.matrix @ _turning(self.recording).T.astype(float)).T > TURNS

    def filter_of(self, joint: int, delay: float = 0.0) -> csr_matrix:
        """The common filter of a joint's torques that are recorded late [s] and count while it moves, (kept, K)."""
        if self._late.get(joint, (None,))[0] != delay:
            matrix = self.matrix @ diags(self.moving[joint].astype(float))
            if delay:
                before, after, share = samples_before(self.recording, delay)
                rows, size = np.arange(len(before)), len(before)
                pairs = np.concatenate([rows, rows]), np.concatenate([before, after])
                matrix = matrix @ csr_matrix((np.concatenate([1 - share, share]), pairs), shape=(size, size))
            self._late[joint] = delay, csr_matrix(matrix)
        return self._late[joint][1]

    @cached_property
    def _late(self) -> dict[int, tuple[float | None, csr_matrix]]:
        return {}

    def passed(self, torques: np.ndarray, joints: Sequence[int] | np.ndarray) -> np.ndarray:
        """Torques (m, K) of joints (m,), filtered, at the rows that are kept, (m, kept); 0 at rest."""
        return self.filtered(torques * self.moving[joints]) * self.counted[joints]

    def filtered(self, x: np.ndarray) -> np.ndarray:
        """Signals (m, K) after the common filter, at the rows that are kept, (m, kept)."""
        return (self.matrix @ x.T).T


def prepare(recordings: RecordingSet, window: float = FILTER) -> tuple[Prepared, ...]:
    """All recordings of a set made ready for `regression.rows`.

    Raises `UserError` for one of which the filters leave nothing, and a torque that moves a joint and never changes.
    """
    for r in recordings.recordings:
        if not len(kept_rows(r)[0]):
            raise UserError(
                f"{recordings.path / r.file}: {len(r.t)} rows of {np.ptp(r.t):.3g} s are too short for the filters, which take {window:g} s; "
                "longer recordings are required, and this one must be left out"
            )
    sharp = [_with_sharp_motion(r, recordings.joints) for r in recordings.recordings]
    spikes = np.zeros(recordings.robot.n, int)
    found = tuple(Prepared(r, recordings.output_torque(r), _moving(r) & ~recordings.clipped(r), window, spikes) for r in sharp)
    low, high = (f([f(p.measured, axis=1) for p in found], axis=0) for f in (np.min, np.max))
    for j in np.flatnonzero((low == high) & np.any([p.moving.any(axis=1) for p in found], axis=0))[:1]:
        said = f"the torque of {recordings.joints[j]} is {low[j] + 0.0:g} Nm in every sample while the joint moves"
        raise UserError(f"{recordings.path}: {said}, which tells nothing of the arm; was it recorded?")
    return found


def thinned(prepared: Sequence[Prepared], step: float = THIN) -> tuple[Prepared, ...]:
    """The recordings with at most one sample in `step` [s], which keeps all that the common filter lets through.

    Torque is averaged over the samples left out; motion, which is smooth already, is not. If the recordings last longer than
    `LONGEST` in all, pieces are kept, evenly over the recordings.
    """
    share = min(1.0, LONGEST / max(lasting(prepared), 1e-9))
    strides = [max(1, int(step / np.median(np.diff(p.recording.t)) + 0.01)) for p in prepared]
    return tuple(_thinned(p, stride, share, 0.5) for p, stride in zip(prepared, strides, strict=True))


def lasting(prepared: Sequence[Prepared]) -> float:
    """How long recordings last in all [s]."""
    return sum(float(np.ptp(p.recording.t)) for p in prepared)


def shortened(prepared: Sequence[Prepared]) -> tuple[Prepared, ...]:
    """Pieces of all recordings that last `SOME` in all, of each recording at other times in it; the recordings if they are not twice that."""
    share = min(1.0, SOME / max(lasting(prepared), 1e-9))
    return tuple(_thinned(p, 1, share, GOLDEN * (k + 1) % 1) if share < 0.5 else p for k, p in enumerate(prepared))


def pieces_of(only: Prepared) -> tuple[Prepared, ...]:
    """Contiguous pieces of an only recording, as recordings."""
    r, pieces = only.recording, []
    began = r.t[0] if r.start is None else r.start
    for part in blocks_of(r):
        a, b = int(part[0]), int(part[-1]) + 1
        arrays = r.samples(slice(a, b))
        inside = [(max(s.start, a) - a, min(s.stop, b) - a) for s in r.segments]
        segments = tuple(slice(first, end) for first, end in inside if end - first > SHORT)
        piece = replace(r, **arrays, segments=segments, start=float(began))
        pieces.append(replace(only, recording=piece, measured=only.measured[:, a:b], moving=only.moving[:, a:b]))
    return tuple(pieces)


def blocks_of(r: Recording) -> list[np.ndarray]:
    """Indices of the samples of each contiguous piece of an only recording."""
    usable = [np.arange(s.start, s.stop) for s in r.segments if s.stop - s.start > SHORT]
    return np.array_split(np.concatenate(usable or [np.arange(len(r.t))]), BLOCKS)


def residuals(prepared: Prepared, model: CalibratedModel, physics: Physics | None = None) -> np.ndarray:
    """Measured less predicted torque at every sample, unfiltered, (n, K) [Nm]; `physics` of the recording, if it is at hand."""
    return prepared.measured - model.output_torque(prepared.recording, physics)


def without_spikes(prepared: Sequence[Prepared], model: CalibratedModel) -> tuple[Prepared, ...]:
    """The recordings with spikes replaced: samples whose residual is `SPIKE` deviations off the residual's running median.

    The residual of a model is judged, not the torque itself, so that the torque's steps at reversals stay.
    """
    result = []
    for p in prepared:
        off = residuals(p, model)
        for s in p.recording.segments:
            off[:, s] -= median_filter(off[:, s], (1, SPIKE_SAMPLES), mode="nearest")
        middling, rare = np.quantile(np.abs(off), [0.5, RARE[0]], axis=1, keepdims=True)
        spread = np.maximum(1.4826 * middling, rare / RARE[1])
        spike = (np.abs(off) > SPIKE * spread) & (spread > 0)
        result.append(replace(p, measured=np.where(spike, p.measured - off, p.measured), spikes=spike.sum(axis=1)))
    return tuple(result)


def noise(prepared: Sequence[Prepared], model: CalibratedModel) -> np.ndarray:
    """Standard deviation of the recorded noise (n,) [Nm]: of the part of the residual that a window of 0.15 s removes.

    From the median of its size, so that spikes do not count.
    """
    sizes = []
    for p in prepared:
        t, r = p.recording.t, residuals(p, model)
        centre = 2.25 / max(window_samples(t, 0.15), 5)  # weight of the middle sample: the share of white noise that passes
        sizes.append(np.abs(r - smooth(t, r, p.recording.segments)) / np.sqrt(1 - min(centre, 0.5)))
    return 1.4826 * np.median(np.concatenate(sizes, axis=1), axis=1)


def kept_rows(recording: Recording) -> tuple[np.ndarray, tuple[slice, ...]]:
    """Samples that are kept, and the stretches of rows that they become.

    Segments shorter than `SHORTEST` are left out, unless there are no others.
    """
    if recording not in _KEPT_ROWS:
        _KEPT_ROWS[recording] = _kept_rows(recording)
    return _KEPT_ROWS[recording]


def _kept_rows(recording: Recording) -> tuple[np.ndarray, tuple[slice, ...]]:
    kept = []
    long = [s for s in recording.segments if np.ptp(recording.t[s]) > SHORTEST]
    for s in long or recording.segments:
        t = recording.t[s]
        stride = max(1, round(STRIDE / np.median(np.diff(t)))) if len(t) > 1 else 1
        ends = min(ENDS, float(np.ptp(t)) / 5)
        inside = np.flatnonzero((t >= t[0] + ends) & (t <= t[-1] - ends))[::stride]
        if len(inside) > 1:
            kept.append(inside + s.start)
    ends = np.cumsum([0, *map(len, kept)]).tolist()
    stretches = tuple(slice(a, b) for a, b in pairwise(ends))
    return np.concatenate([*kept, np.zeros(0, int)]).astype(int), stretches


def _with_sharp_motion(recording: Recording, joints: Sequence[str]) -> Recording:
    """The recording with speeds and accelerations from short windows, wherever the file does not give the signal itself."""
    r, dq, ddq = recording, recording.dq.copy(), recording.ddq.copy()
    given = np.array([f"dq_{joint}" not in r.computed for joint in joints])
    derived = np.array([f"ddq_{joint}" in r.computed for joint in joints])
    speed, acceleration = window_samples(r.t, SPEED_WINDOW, 7), window_samples(r.t, ACCELERATION_WINDOW, 9)
    for s in r.segments:
        if s.stop - s.start < acceleration:
            continue  # the derivatives of the reader stay
        t, from_q, from_dq = r.t[s], derived & ~given, derived & given
        ddq[from_q, s] = local_polynomial(t, r.q[from_q, s], 2, 4, acceleration)
        ddq[from_dq, s] = local_polynomial(t, r.dq[from_dq, s], 1, 3, acceleration)
        for j in np.flatnonzero(~given):
            dq[j, s] = _speed(t, r.q[j, s], speed)
        dq[given, s] = local_polynomial(t, r.dq[given, s], 0, 3, speed)
    return replace(r, dq=dq, ddq=ddq)


def _speed(t: np.ndarray, q: np.ndarray, least: int) -> np.ndarray:
    """Speed (K,) [rad/s] of a position q (K,) [rad] from windows of `least` samples, or longer ones where positions are coarse.

    The longer the window, the less noise and the more bias a speed has. The sum of their squares has an unbiased estimate: the squared
    difference from the shortest window's speed less the noise in that difference, plus the noise of the longer one (Mallows 1973). Noise
    matters since friction turns with the sign of the speed: coarse encoders would make dry friction larger and viscous smaller.
    """
    step = float(np.median(np.diff(t)))
    counts = [c + 1 - c % 2 for c in (int(least * times) for times in LONGER) if 2 * c < len(t)] or [least]
    speeds = [local_polynomial(t, q[None], 1, 3, count)[0] for count in counts]
    weights = [np.pad(savgol_coeffs(count, 3, 1, step), (counts[-1] - count) // 2) for count in counts]
    middle = savgol_coeffs(least, 3)[least // 2]
    noise = np.mean(np.square(q - local_polynomial(t, q[None], 0, 3, least)[0])) / (1 - middle)
    errors = [
        np.mean(np.square(v - speeds[0])) - noise * (np.sum(np.square(w - weights[0])) - np.sum(np.square(w)))
        for v, w in zip(speeds, weights, strict=True)
    ]
    return speeds[int(np.argmin(errors))]


def _moving(recording: Recording) -> np.ndarray:
    """False where the speed stays below `REST_SPEED` for `REST_TIME`, and where windows of the motion reach into that, (n, K)."""
    moving = np.empty(recording.dq.shape, bool)
    for s in recording.segments:
        stay, reach = (window_samples(recording.t[s], x) for x in (REST_TIME, REST_TIME + ACCELERATION_WINDOW))
        resting = maximum_filter1d(np.abs(recording.dq[:, s]), stay, axis=1) < REST_SPEED
        moving[:, s] = np.logical_not(maximum_filter1d(resting, reach, axis=1))
    return moving


def _turning(recording: Recording) -> np.ndarray:
    """Where the window of the speed holds speeds of both signs, or below `REST_SPEED`, (n, K)."""
    turning = np.empty(recording.dq.shape, bool)
    for s in recording.segments:
        dq, width = recording.dq[:, s], window_samples(recording.t[s], SPEED_WINDOW, 7)
        turning[:, s] = minimum_filter1d(dq, width, axis=1) < REST_SPEED
        turning[:, s] &= maximum_filter1d(dq, width, axis=1) > -REST_SPEED
    return turning


def _thinned(prepared: Prepared, stride: int, share: float, phase: float) -> Prepared:
    if stride == 1 and share == 1.0:
        return prepared
    r, measured = prepared.recording, prepared.measured.copy()
    kept = []
    for s in r.segments if share == 1.0 else _pieces(r.t, r.segments, share, phase):
        count = stride + 1 - stride % 2
        if s.stop - s.start > count > 1:
            measured[:, s] = local_polynomial(r.t[s], measured[:, s], 0, 1, count)
        kept.append(np.arange(s.start, s.stop, stride))
    ends = np.cumsum([0, *map(len, kept)]).tolist()
    segments = [slice(a, b) for a, b in pairwise(ends)]
    rows = np.concatenate(kept)
    arrays = r.samples(rows)
    coarse = replace(r, **arrays, segments=tuple(segments))
    return replace(prepared, recording=coarse, measured=measured[:, rows], moving=prepared.moving[:, rows])


def _pieces(t: np.ndarray, segments: Sequence[slice], share: float, phase: float) -> list[slice]:
    """Pieces of about `PIECE` that make up a share of the segments, each at a share `phase` of what is left out around it."""
    step, pieces = np.median(np.diff(t)), []
    for s in segments:
        size = s.stop - s.start
        number = max(1, round(share * size * step / PIECE))
        length = min(size, max(int(share * size / number), int(SHORTEST_PIECE / step), 1))
        free = size / number - length
        begins = [s.start + int(k * size / number + phase * max(free, 0.0)) for k in range(number)]
        pieces += [slice(a, min(a + length, s.stop)) for a in begins]
    return pieces

"""Recordings as rows of a least-squares problem: filtered residuals of the inverse dynamics and their exact derivatives.

Torque and regressors pass the same filter (twice Savitzky–Golay), so that it biases nothing and only noise is lost. Speeds and
accelerations, which the filter meets again, come from windows as short as the sampling allows: what they attenuate of the
motion would bias the estimates, whereas the noise that they let through is taken away by the filter. What bias is left is
measured by `validation/calibration_coverage.py`.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter, minimum_filter1d
from scipy.sparse import csr_matrix

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.model.recorded_physics import Physics
from rrr_oc.model.symbolic_model import CHAIN, Model
from rrr_oc.numerics.along import along
from rrr_oc.numerics.savitzky_golay import as_matrix, local_polynomial, smooth, window_samples
from rrr_oc.recordings.recording import Recording, RecordingSet

FILTER = 0.2  # window of the common filter [s], applied twice
CORRELATION = 0.2  # time over which filtered noise is correlated [s]
SPEED_WINDOW, ACCELERATION_WINDOW = 0.07, 0.09  # of the motion that enters the regressors [s]
STRIDE = 0.04  # [s] between the rows kept; the filter has removed what is faster
ENDS = 0.25  # [s] left out at both ends of a stretch, where filter and derivatives are one-sided; a fifth of it at most
SHORTEST = 0.6  # [s], three times the common filter: the least length of a segment
REST_SPEED, REST_TIME = 0.01, 0.25  # a joint rests where it stays below this speed [rad/s] for this long [s]
SPIKE = 6.0  # standard deviations off the running median
RARE = (0.99, 2.576)  # the deviation is at least that of normal noise with this quantile: spikes are one in a hundred at most
FELT = 1e-3  # of a recording's torque: what the start of a stretch adds, and is less, is not felt
ROUNDING = 1e-10  # Nm: derivatives by a parameter (of 1 or its value, if more) that are all below it are rounding
THIN = 0.012  # [s] between samples of recordings that were sampled faster, where many models are to be compared
LONGEST, PIECE = 1200.0, 20.0  # [s]: what many models are compared on at most, and the pieces it is then made of
SPIKE_SAMPLES = 7  # of the running median: spikes of up to 3 samples


@dataclass(frozen=True)
class Prepared:
    """A recording made ready.

    Attributes:
        recording: The recording with speeds and accelerations from short windows.
        measured: Recorded torque at the joints' output (n, K) [Nm].
        moving: Where each joint moves and its motion is not smoothed over a stop, (n, K): at rest its dry friction may be
            anything below its level. Samples elsewhere count for nothing.
        window: Of the common filter [s].
        spikes: Samples of `measured` that were replaced, one count per joint (n,).
        signatures: Of trials, by the parts of a model that they depend on, as `signatures.table` fills them in.
    """

    recording: Recording
    measured: np.ndarray
    moving: np.ndarray
    window: float
    spikes: np.ndarray
    signatures: dict[Hashable, dict[Hashable, tuple[np.ndarray, np.ndarray]]] = field(
        default_factory=dict, init=False, compare=False, repr=False
    )

    @property
    def matrix(self) -> csr_matrix:
        """The common filter at the samples that are kept, (kept, K)."""
        return common_filter(self.recording, self.window)

    @cached_property
    def counted(self) -> np.ndarray:
        """Rows, of those kept, of which at least half is what a moving joint showed, (n, kept)."""
        return (self.matrix @ self.moving.T.astype(float)).T > 0.5

    def passed(self, torques: np.ndarray, joints: Sequence[int] | np.ndarray) -> np.ndarray:
        """Torques (m, K) at these joints (m,), filtered, at the rows that are kept, (m, kept); those at rest count for nothing."""
        return through_filter(torques * self.moving[joints], self) * self.counted[joints]


# Common filters by recording and window [s], for all that is prepared of a recording; they last as long as the recording.
_COMMON_FILTERS: WeakKeyDictionary[Recording, dict[float, csr_matrix]] = WeakKeyDictionary()


def common_filter(recording: Recording, window: float) -> csr_matrix:
    """The smoothing filter over a window [s], applied twice, at the samples of a recording that are kept, (kept, K)."""
    filters = _COMMON_FILTERS.setdefault(recording, {})
    if window not in filters:
        once = as_matrix(recording.t, recording.segments, window)
        filters[window] = (once[kept_rows(recording)[0]] @ once).tocsr()
    return filters[window]


@dataclass(frozen=True)
class Rows:
    """Residuals r = filtered (measured − predicted) and J = filtered d predicted / d parameters, over all recordings.

    Attributes:
        residual: (n, M) [Nm]; 0 where a joint rests.
        jacobian: (n, M, p); 0 where a joint rests.
        moving: Rows that count, (n, M).
        stretches: Slices of the rows without a gap; the filter crosses none of their ends.
        durations: Of the stretches [s].
    """

    residual: np.ndarray
    jacobian: np.ndarray
    moving: np.ndarray
    stretches: tuple[slice, ...]
    durations: tuple[float, ...]

    def deviation(self) -> np.ndarray:
        """Root mean square residual of each joint over the rows in which it moves, (n,) [Nm]; never 0."""
        count = np.maximum(self.moving.sum(axis=1), 1)
        size = np.sqrt(np.sum(self.residual**2, axis=1) / count)
        return np.maximum(size, 1e-9)  # data without noise


def prepare(recordings: RecordingSet, window: float = FILTER) -> tuple[Prepared, ...]:
    """All recordings of a set made ready for `rows`."""
    return tuple(_prepare(recordings, r, window) for r in recordings.recordings)


def thinned(prepared: Sequence[Prepared], step: float = THIN) -> tuple[Prepared, ...]:
    """The recordings with no more samples than one in `step` [s], of which the common filter keeps all it lets through.

    Torque is averaged over what is left out; motion, which was smoothed before, is not. Of more than `LONGEST` seconds, pieces
    are kept, evenly over the recordings.
    """
    total = sum(float(np.ptp(p.recording.t)) for p in prepared)
    share = min(1.0, LONGEST / max(total, 1e-9))
    return tuple(_thinned(p, max(1, int(step / np.median(np.diff(p.recording.t)) + 0.01)), share) for p in prepared)


def without_reversals(prepared: Sequence[Prepared], joints: np.ndarray | bool = True) -> tuple[Prepared, ...]:
    """The recordings of which nothing counts near a joint's reversal, within the window that its speed comes from.

    Which way abrupt friction points there is beyond what smoothed speeds can tell, and friction that turns a little too early or
    too late looks like any law of low speeds.

    Args:
        joints: Whether this is so for each of them, (n,).
    """
    chosen = np.reshape(joints, (-1, 1))
    return tuple(replace(p, moving=p.moving & ~(_turning(p.recording) & chosen)) for p in prepared)


def _pieces(t: np.ndarray, segments: Sequence[slice], share: float) -> list[slice]:
    """Pieces of `PIECE` seconds, evenly over the segments, that make up a share of them."""
    step, pieces = np.median(np.diff(t)), []
    for s in segments:
        size = s.stop - s.start
        length = min(size, max(int(PIECE / step), 1))
        number = max(1, round(share * size / length))
        pieces += [slice(a, a + length) for a in np.linspace(s.start, s.stop - length, number).astype(int)]
    return pieces


def _thinned(prepared: Prepared, stride: int, share: float) -> Prepared:
    if stride == 1 and share == 1.0:
        return prepared
    r, measured = prepared.recording, prepared.measured.copy()
    segments, kept, start = [], [], 0
    for s in r.segments if share == 1.0 else _pieces(r.t, r.segments, share):
        count = stride + 1 - stride % 2
        if s.stop - s.start > count > 1:
            measured[:, s] = local_polynomial(r.t[s], measured[:, s], 0, 1, count)
        kept.append(np.arange(s.start, s.stop, stride))
        segments.append(slice(start, start + len(kept[-1])))
        start += len(kept[-1])
    rows = np.concatenate(kept)
    arrays = {name: getattr(r, name)[..., rows] for name in ("t", "q", "dq", "ddq", "tau", "payload")}
    coarse = replace(r, **arrays, segments=tuple(segments))
    return replace(prepared, recording=coarse, measured=measured[:, rows], moving=prepared.moving[:, rows])


def rows(
    prepared: Sequence[Prepared], model: CalibratedModel, inertial: bool = False, without_last: Rows | None = None
) -> Rows:
    """The rows of a model: derivatives by the parameters of its terms in their order and, if wanted, by (10, n) inertial ones.

    Derivatives by the inertial parameters follow, link by link in the order of `Robot.inertial`.

    Args:
        without_last: Rows of the model without its last term, from which all other derivatives are taken as they are.
    """
    parts = [_rows(p, model, inertial, without_last is not None) for p in prepared]
    stretches, start = [], 0
    for part in parts:
        stretches += [slice(start + s.start, start + s.stop) for s in part.stretches]
        start += part.residual.shape[1]
    jacobian = np.concatenate([p.jacobian for p in parts], axis=1)
    if without_last is not None:
        at = sum(len(t.estimates) for t in model.terms[:-1])
        jacobian = np.concatenate([without_last.jacobian[:, :, :at], jacobian, without_last.jacobian[:, :, at:]], axis=2)
    values = model.values
    sizes = np.maximum(np.abs(np.append(values, np.zeros(jacobian.shape[2] - len(values)))), 1.0)
    rounding = np.max(np.abs(jacobian), axis=(0, 1), initial=0.0) * sizes < ROUNDING  # as by a mass that nothing moves
    jacobian[:, :, rounding] = 0.0
    return Rows(
        residual=np.concatenate([p.residual for p in parts], axis=1),
        jacobian=jacobian,
        moving=np.concatenate([p.moving for p in parts], axis=1),
        stretches=tuple(stretches),
        durations=tuple(d for p in parts for d in p.durations),
    )


def with_residuals(found: Rows, prepared: Sequence[Prepared], model: CalibratedModel) -> Rows:
    """The rows with the residuals of another model or of cleaned torques, and the derivatives that they had.

    Those of parameters that enter linearly (`is_linear`) change neither with the parameters nor with the torque.
    """
    return replace(found, residual=np.concatenate([_left(p, model) for p in prepared], axis=1))


def _left(prepared: Prepared, model: CalibratedModel) -> np.ndarray:
    """Filtered residuals at the rows that are kept, (n, kept), whatever the start of each stretch was."""
    physics = model.physics(prepared.recording)
    residual = residuals(prepared, model, physics)
    return _Starts.of(prepared, model, physics).cleared(prepared.passed(residual, range(len(residual))))


@dataclass(frozen=True)
class _Starts:
    """What unknown starts of the stretches may add to filtered torques: for each joint an orthonormal basis (kept, number)."""

    bases: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, prepared: Prepared, model: CalibratedModel, physics: Physics) -> "_Starts":
        r, n = prepared.recording, len(prepared.measured)
        found = physics.starts(r, model.torque == "load")
        if not len(found):
            return cls(())
        passed = prepared.passed(found.reshape(-1, len(r.t)), np.tile(np.arange(n), len(found))).reshape(len(found), n, -1)
        columns = [_only(x, s) for x in passed for s in kept_rows(r)[1]]
        whole = np.linalg.norm(prepared.passed(prepared.measured, range(n)), axis=1)
        return cls(tuple(_basis(np.array([x[j] for x in columns]).T, FELT * whole[j]) for j in range(n)))

    def cleared(self, rows: np.ndarray) -> np.ndarray:
        """Rows (n, kept) or (n, kept, p) less what a start may explain."""
        if not self.bases:
            return rows
        return np.array([x - basis @ (basis.T @ x) for basis, x in zip(self.bases, rows, strict=True)])


def _only(rows: np.ndarray, stretch: slice) -> np.ndarray:
    result = np.zeros_like(rows)
    result[:, stretch] = rows[:, stretch]
    return result


def _basis(columns: np.ndarray, least: float) -> np.ndarray:
    """Orthonormal columns that span these, but for what is less or has died away."""
    u, size, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, size > least]


def is_linear(prepared: Sequence[Prepared], model: CalibratedModel) -> bool:
    """Whether the predicted torques are linear in the parameters of all terms."""
    if any(t.effect.states or t.effect.side not in ("link", "drive") for t in model.terms):
        return False  # they reach the torque by other ways than `Model.sensitivity`
    signal = "load" if model.torque == "load" else "motor"
    for p in prepared:
        function = model.physics(p.recording).model.sensitivity(signal, "theta")
        size = function.size2_out(0)
        listed = size - sum(len(t.estimates) for t in model.terms if t.holds_for(p.recording))
        second = np.array(function.jac_sparsity(0, CHAIN.index("theta")).find(), int)  # in the order of the columns
        entry, column = second % (model.robot.n * size), second // (model.robot.n * size)
        if np.any((entry // model.robot.n >= listed) & (column >= listed)):
            return False
    return True


def without_spikes(prepared: Sequence[Prepared], model: CalibratedModel) -> tuple[Prepared, ...]:
    """The recordings with lone samples, `SPIKE` deviations off the residual's running median, put onto it.

    The residual of a model, not the torque itself, so that steps of the torque at a reversal are left alone.
    """
    return tuple(_without_spikes(p, residuals(p, model)) for p in prepared)


def filtered(prepared: Sequence[Prepared], law: Callable[[Recording], np.ndarray], joints: Sequence[int]) -> np.ndarray:
    """Torques (m, K) at joints (m,) that a function makes of a recording, filtered, at the samples that `rows` keeps, (m, M)."""
    return np.concatenate([p.passed(law(p.recording), joints) for p in prepared], axis=1)


def residuals(prepared: Prepared, model: CalibratedModel, physics: Physics | None = None) -> np.ndarray:
    """Measured less predicted torque at every sample, unfiltered, (n, K) [Nm]; `physics` of the recording, where it is at hand."""
    return prepared.measured - model.output_torque(prepared.recording, physics)


def noise(prepared: Sequence[Prepared], model: CalibratedModel) -> np.ndarray:
    """Standard deviation of what no motion explains: of the residual's part that a 0.15 s window takes away, (n,) [Nm].

    From the median of its size, so that spikes do not count.
    """
    sizes = []
    for p in prepared:
        t, r = p.recording.t, residuals(p, model)
        centre = 2.25 / max(window_samples(t, 0.15), 5)  # weight of the middle sample: what of white noise is left in
        sizes.append(np.abs(r - smooth(t, r, p.recording.segments)) / np.sqrt(1 - min(centre, 0.5)))
    return 1.4826 * np.median(np.concatenate(sizes, axis=1), axis=1)


def variance(prepared: Sequence[Prepared], model: CalibratedModel) -> np.ndarray:
    """Of the filtered residuals, over what samples of white noise of variance 1 would leave in the rows that count, (n,)."""
    square = white = 0.0
    for p in prepared:
        square = square + np.sum(_left(p, model) ** 2, axis=1)
        white = white + np.sum((p.matrix.multiply(p.matrix) @ p.moving.T).T * p.counted, axis=1)
    return square / np.maximum(white, 1e-300)


def _prepare(recordings: RecordingSet, recording: Recording, window: float) -> Prepared:
    sharp = _with_sharp_motion(recording, recordings.joints)
    return Prepared(sharp, recordings.output_torque(recording), _moving(sharp), window, np.zeros(recordings.robot.n, int))


def _with_sharp_motion(recording: Recording, joints: Sequence[str]) -> Recording:
    r, dq, ddq = recording, recording.dq.copy(), recording.ddq.copy()
    given = np.array([f"dq_{joint}" not in r.computed for joint in joints])
    derived = np.array([f"ddq_{joint}" in r.computed for joint in joints])
    speed, acceleration = _speed_samples(r.t), window_samples(r.t, ACCELERATION_WINDOW, 9)
    for s in r.segments:
        if s.stop - s.start < acceleration:
            continue  # what the reader computed stays
        t, from_q, from_dq = r.t[s], derived & ~given, derived & given
        ddq[from_q, s] = local_polynomial(t, r.q[from_q, s], 2, 4, acceleration)
        ddq[from_dq, s] = local_polynomial(t, r.dq[from_dq, s], 1, 3, acceleration)
        dq[~given, s] = local_polynomial(t, r.q[~given, s], 1, 3, speed)
        dq[given, s] = local_polynomial(t, r.dq[given, s], 0, 3, speed)
    return replace(r, dq=dq, ddq=ddq)


def _speed_samples(t: np.ndarray) -> int:
    return window_samples(t, SPEED_WINDOW, 7)


def _moving(recording: Recording) -> np.ndarray:
    """False where the speed stays below `REST_SPEED` for `REST_TIME`, and where windows of the motion reach into that, (n, K)."""
    moving = np.empty(recording.dq.shape, bool)
    for s in recording.segments:
        stay, reach = (window_samples(recording.t[s], x) for x in (REST_TIME, REST_TIME + ACCELERATION_WINDOW))
        resting = maximum_filter1d(np.abs(recording.dq[:, s]), stay, axis=1) < REST_SPEED
        moving[:, s] = np.logical_not(maximum_filter1d(resting, reach, axis=1))
    return moving


def _turning(recording: Recording) -> np.ndarray:
    """Where speeds on both sides of 0, or below `REST_SPEED`, lie within the window of the speed, (n, K)."""
    turning = np.empty(recording.dq.shape, bool)
    for s in recording.segments:
        dq, width = recording.dq[:, s], _speed_samples(recording.t[s])
        turning[:, s] = minimum_filter1d(dq, width, axis=1) < REST_SPEED
        turning[:, s] &= maximum_filter1d(dq, width, axis=1) > -REST_SPEED
    return turning


def _rows(prepared: Prepared, model: CalibratedModel, inertial: bool, last: bool) -> Rows:
    r = prepared.recording
    physics = model.physics(r)
    residual = residuals(prepared, model, physics)
    jacobian = derivatives(model, r, inertial and not last, last, physics)
    kept, stretches, durations = kept_rows(r)
    n, p = len(residual), jacobian.shape[2]
    columns = np.moveaxis(jacobian, 2, 1).reshape(n * p, len(r.t))
    used = np.flatnonzero(np.any(columns != 0, axis=1))
    filtered = np.zeros((n * p, len(kept)))
    filtered[used] = prepared.passed(columns[used], used // p)
    starts = _Starts.of(prepared, model, physics)
    return Rows(
        residual=starts.cleared(prepared.passed(residual, range(n))),
        jacobian=starts.cleared(np.moveaxis(filtered.reshape(n, p, len(kept)), 1, 2)),
        moving=prepared.counted,
        stretches=stretches,
        durations=durations,
    )


def _without_spikes(prepared: Prepared, residual: np.ndarray) -> Prepared:
    r, middle = prepared.recording, np.empty_like(residual)
    for s in r.segments:
        middle[:, s] = median_filter(residual[:, s], (1, SPIKE_SAMPLES), mode="nearest")
    off = residual - middle
    middling, rare = np.quantile(np.abs(off), [0.5, RARE[0]], axis=1, keepdims=True)
    spread = np.maximum(1.4826 * middling, rare / RARE[1])
    spike = (np.abs(off) > SPIKE * spread) & (spread > 0)
    return replace(prepared, measured=np.where(spike, prepared.measured - off, prepared.measured), spikes=spike.sum(axis=1))


def through_filter(x: np.ndarray, prepared: Prepared) -> np.ndarray:
    """Signals (m, K) after the common filter at the samples that are kept, (m, kept)."""
    return (prepared.matrix @ x.T).T


def kept_rows(recording: Recording) -> tuple[np.ndarray, tuple[slice, ...], tuple[float, ...]]:
    """Samples kept, the stretches of the rows that they become, and their durations [s].

    None of segments so short that they are hardly filtered, unless there are no others.
    """
    kept, stretches, durations, count = [], [], [], 0
    long = [s for s in recording.segments if np.ptp(recording.t[s]) > SHORTEST]
    for s in long or recording.segments:
        t = recording.t[s]
        stride = max(1, round(STRIDE / np.median(np.diff(t)))) if len(t) > 1 else 1
        ends = min(ENDS, float(np.ptp(t)) / 5)
        inside = np.flatnonzero((t >= t[0] + ends) & (t <= t[-1] - ends))[::stride]
        if len(inside) > 1:
            kept.append(inside + s.start)
            stretches.append(slice(count, count + len(inside)))
            durations.append(float(t[inside[-1]] - t[inside[0]]) * len(inside) / (len(inside) - 1))
            count += len(inside)
    return np.concatenate([*kept, np.zeros(0, int)]).astype(int), tuple(stretches), tuple(durations)


def derivatives(
    model: CalibratedModel,
    recording: Recording,
    inertial: bool = False,
    last: bool = False,
    physics: Physics | None = None,
) -> np.ndarray:
    """d predicted / d (parameters of the terms, inertial parameters), (n, K, p).

    Args:
        last: Whether only those by the parameters of the last term are wanted.
        physics: `model.physics(recording)`, where it is at hand.
    """
    physics, n, count = physics or model.physics(recording), model.robot.n, len(recording.t)
    wanted = model.terms[-1:] if last else model.terms
    special = [t.effect.side in ("motion", "sensor") or bool(t.effect.states) for t in wanted]
    result = np.zeros((n, count, sum(len(t.estimates) for t in wanted)))
    if not all(special):
        by_theta = _sensitivity(physics, recording, model.torque, "theta")
        listed = by_theta.shape[2] - sum(len(t.estimates) for t in wanted if t.holds_for(recording))
        column = 0
        for term in wanted:
            size = len(term.estimates)
            if term.holds_for(recording):
                result[:, :, column : column + size] = by_theta[:, :, listed : listed + size]
                listed += size
            column += size
    if inertial:
        result = np.concatenate([result, _sensitivity(physics, recording, model.torque, "inertial")], axis=2)
    for k in range(result.shape[2]) if any(t.effect.side == "sensor" for t in model.terms) else ():
        result[:, :, k] = physics.passed_on(recording, result[:, :, k])
    if any(special):
        true = model.true_torque(recording, physics)
        _fill_in(result, physics, wanted, special, recording, true, model.torque == "load")
    return result


def _fill_in(
    jacobian: np.ndarray, physics: Physics, wanted, special, recording: Recording, true: np.ndarray, load: bool
) -> None:
    """The derivatives by the parameters of those terms that do not add a torque of the instant."""
    holding = [t.holds_for(recording) for t in wanted]
    last = len(physics.model.effects) - sum(holding)  # effects of a recording: springs listed, then the terms that hold
    numbers = np.cumsum(holding) - 1 + last
    columns = np.cumsum([0, *(len(t.estimates) for t in wanted)])
    which = [i for i, (other, holds) in enumerate(zip(special, holding, strict=True)) if other and holds]
    found = physics.by_differences(recording, [int(numbers[i]) for i in which], true, load)
    for i, part in zip(which, found, strict=True):
        jacobian[:, :, columns[i] : columns[i + 1]] = part


def _sensitivity(physics: Physics, recording: Recording, torque: str, by) -> np.ndarray:
    model: Model = physics.model
    function = model.sensitivity("load" if torque == "load" else "motor", by)
    columns = function.size2_out(0)
    if columns == 0:
        return np.zeros((model.robot.n, len(recording.t), 0))
    (found,) = along(function, *physics.inputs(recording), physics.theta, physics.widths, physics.inertial)
    return found.reshape(model.robot.n, len(recording.t), columns)

"""Signatures: by how much each effect that might be missing would change the torque that a model predicts for recordings.

They are linear in the effects' coefficients (`effects.Trial`) and pass the same filter as the residuals (`regression`), so that
what is missing is found by linear algebra on few numbers.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import block_diag, csr_matrix

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.estimator.data import dry_friction
from rrr_oc.calibration.jacobian import Prediction
from rrr_oc.calibration.regression import coarse
from rrr_oc.calibration.samples import REST_SPEED, Prepared
from rrr_oc.effects import CATALOGUE, BlackBox, Delay, OfEach, Signals, Trial, View
from rrr_oc.effects.base import SOUGHT
from rrr_oc.robot.rigid_body import rigid_body

FEW = 32  # columns that are filtered at once; more take more memory, and no less time
SAMPLE = 400  # positions that stand for all when trials are made; twice as many cost time
SAME = 0.01  # share of the load torque by which it may change before signatures that depend on it are made anew


def view(prepared: Sequence[Prepared], model: CalibratedModel) -> View:
    """What the recordings show of the arm."""
    q = np.concatenate([p.recording.q for p in prepared], axis=1)
    dq = np.concatenate([p.recording.dq for p in prepared], axis=1)
    low, high = np.quantile(q, [0.002, 0.998], axis=1)
    widths = np.full(len(q), 0.05)
    for term in model.terms:
        if term.effect.sign_forms and term.width is not None:
            widths[term.effect.joints[0]] = term.width
    springs = {spring.joints for p in prepared for spring, _ in p.recording.springs}
    positions = q[:, :: max(1, q.shape[1] // SAMPLE)]
    torque = np.maximum(np.concatenate([p.measured for p in prepared], axis=1).std(axis=1), 1e-9)
    body = rigid_body(model.robot)
    inertia = [np.diag(np.asarray(body.mass_matrix(x, model.robot.inertial))) for x in positions.T]
    return View(
        low=low,
        high=np.maximum(high, low + 1e-3),
        speed=np.maximum(np.quantile(np.abs(dq), 0.99, axis=1), 1e-3),
        usual_speed=np.min([_usual_speed(p.recording.dq) for p in prepared], axis=0),
        duration=max(float(p.recording.clock[-1]) for p in prepared),
        widths=widths,
        positions=positions,
        inertia=np.maximum(np.median(inertia, axis=0), 1e-9),
        springs=tuple(sorted(springs)),
        dry=dry_friction(model, torque, np.maximum(np.quantile(np.abs(dq), 0.99, axis=1), 1e-3)),
        torque=torque,
        mass=np.maximum(model.robot.inertial[0], 1e-3),
        groups=tuple(dict.fromkeys(p.recording.group for p in prepared)),
    )


def _usual_speed(dq: np.ndarray) -> np.ndarray:
    """Median speed of each joint while it moves, of speeds (n, K), (n,) [rad/s]; infinite where it rests."""
    return np.array([np.median(v[v > REST_SPEED]) if np.any(v > REST_SPEED) else np.inf for v in np.abs(dq)])


def trials(seen: View, torque: str) -> list[Trial]:
    """All ways in which effects of the catalogue might be missing; what is recorded as load torque holds no drive.

    A delay is none: it is a part of every model.
    """
    kinds = [k for k in CATALOGUE.values() if k.role in SOUGHT and torque in k.recorded_as and not issubclass(k, Delay)]
    kinds = [kind for kind in kinds if not (torque == "load" and kind.side == "drive")]
    return [trial for kind in kinds for trial in kind.trials(seen)]


def black_box_trials(prepared: Sequence[Prepared], seen: View, model: CalibratedModel, j: int) -> list[Trial]:
    """All black-box terms that joint j might lack, over the ranges that the recordings cover."""
    ranges = _ranges(prepared, seen, model)
    kinds = [kind for kind in CATALOGUE.values() if issubclass(kind, BlackBox)]
    return [trial for kind in kinds for trial in kind.black_box_trials(seen, j, ranges, model.torque)]


def _ranges(prepared: Sequence[Prepared], seen: View, model: CalibratedModel) -> dict[tuple[str, int], tuple[float, float]]:
    """Smallest and largest recorded value of each variable that a torque may depend on, by name and joint."""
    torques = [model.torques(p.recording) for p in prepared]
    motor, load = (np.concatenate(parts, axis=1) for parts in zip(*torques, strict=True))
    acceleration = np.quantile(np.concatenate([np.abs(p.recording.ddq) for p in prepared], axis=1), 0.99, axis=1)
    found = {("time", -1): (0.0, float(seen.duration))}
    for i in range(len(motor)):
        for name, size in (("dq", float(seen.speed[i])), ("ddq", max(float(acceleration[i]), 1e-3))):
            found[name, i] = (-size, size)
        for name, low, high in (
            ("q", seen.low[i], seen.high[i]),
            ("load", load[i].min(), load[i].max()),
            ("motor", motor[i].min(), motor[i].max()),
        ):
            found[name, i] = (float(low), max(float(high), float(low) + 1e-6))
    return found


@dataclass(frozen=True)
class Along:
    """What a model without sensors predicts along all recordings, one behind the other, to first order.

    Attributes:
        parts: The predictions for each.
    """

    parts: tuple[Prediction, ...]

    @cached_property
    def signals(self) -> Signals:
        """The signals on which effects of the instant may depend, (n, K) of all recordings."""
        names = ("q", "dq", "ddq", "load", "friction", "rotor", "time", "payload", "braking")
        return Signals(**{name: np.concatenate([getattr(at.signals, name) for at in self.parts], axis=-1) for name in names})

    @cached_property
    def true(self) -> np.ndarray:
        """The torque that a perfect sensor records, (n, K) [Nm]."""
        return np.concatenate([at.model.true_torque(at.recording, at.physics) for at in self.parts], axis=1)

    @cached_property
    def through(self) -> np.ndarray:
        """d (what is recorded) / d (load torque), (n, K)."""
        return np.concatenate([at.through for at in self.parts], axis=1)

    def by_trial(self, trial: Trial) -> dict[int, np.ndarray]:
        """As `Prediction.before_sensors` for all recordings: by joint (m, K) [Nm], where it is not 0."""
        effect = trial.effect
        alone = effect.states or isinstance(effect, Delay) or "springs" in effect.inputs
        alone = alone or (isinstance(effect, OfEach) and effect.each)
        if alone or effect.side not in ("link", "drive", "sensor"):
            dense = np.concatenate([at.before_sensors(trial) for at in self.parts], axis=2)
            return {j: dense[:, j] for j in np.flatnonzero(dense.any(axis=(0, 2))).tolist()}
        signals = replace(self.signals, load=self.true) if effect.side == "sensor" else self.signals
        result = {j: torque for j, torque in _torques(trial, signals).items() if torque.any()}
        sign = 1.0 if effect.side == "sensor" else -1.0
        scale = {j: sign * self.through[j] if effect.side == "link" else sign for j in result}
        return {j: torque * (scale[j] / trial.size) for j, torque in result.items()}


def _torques(trial: Trial, signals: Signals) -> dict[int, np.ndarray]:
    """Torque of an effect of the instant on each of its joints for each coefficient, (m, K) [Nm]."""
    effect = trial.effect
    basis = effect.basis(signals, trial.width) if isinstance(effect, BlackBox) else None
    if basis is not None:
        coefficients = np.array([[theta[a] for a in effect.amplitudes] for theta in trial.points])
        series = np.array(basis)
        return {effect.joints[0]: series if np.array_equal(coefficients, np.eye(len(series))) else coefficients @ series}
    every = [effect.torque(signals, theta, trial.width) for theta in trial.points]
    return {j: np.array([np.reshape(torques[i], -1) for torques in every]) for i, j in enumerate(effect.on(len(signals.q)))}


@dataclass(frozen=True, eq=False)
class Signatures:
    """Signatures of many trials at the rows of all recordings.

    Attributes:
        trials: The trials, in order.
        start: First column of each trial, and the number of columns at the end, (trials + 1,).
        values: For each joint (M, columns of the trials that are not 0 there) [Nm].
        used: For each joint the numbers of those columns; of a trial all or none.
    """

    trials: tuple[Trial, ...]
    start: np.ndarray
    values: tuple[np.ndarray, ...]
    used: tuple[np.ndarray, ...]

    def of(self, k: int) -> np.ndarray:
        """The signature of a trial by its number, (n, M, m)."""
        first, end = int(self.start[k]), int(self.start[k + 1])
        result = np.zeros((len(self.values), len(self.values[0]), end - first))
        for own, values, used in zip(result, self.values, self.used, strict=True):
            at = slice(*np.searchsorted(used, [first, end]))
            own[:, used[at] - first] = values[:, at]
        return result

    def recorded(self, gains: np.ndarray) -> "Signatures":
        """The table as sensors record it, which change torques by these factors, (n, M)."""
        of_sensors = np.repeat([t.effect.side == "sensor" for t in self.trials], np.diff(self.start))
        factors = [np.where(of_sensors[u], 1.0, g[:, None]) for u, g in zip(self.used, gains, strict=True)]
        return replace(self, values=tuple(v * f for v, f in zip(self.values, factors, strict=True)))

    def renewed(self, which: Sequence[int], other: "Signatures") -> "Signatures":
        """The table with the signatures of some trials, by their numbers, from another that has these alone."""
        columns = np.concatenate([np.arange(self.start[k], self.start[k + 1]) for k in which] or [np.zeros(0, int)])
        values, used = [], []
        for own, at, new, where in zip(self.values, self.used, other.values, other.used, strict=True):
            stay = ~np.isin(at, columns)
            every = np.concatenate([at[stay], columns[where]])
            order = np.argsort(every)
            values.append(np.hstack([own[:, stay], new])[:, order])
            used.append(every[order])
        return replace(self, values=tuple(values), used=tuple(used))


def table(
    prepared: Sequence[Prepared], model: CalibratedModel, every: Iterable[Trial], kept: Sequence[np.ndarray] | None = None
) -> Signatures:
    """The signatures of trials at a model without its sensors but for their delays, filtered, at the rows of `regression.rows`.

    Args:
        kept: Of each recording the rows that are wanted; all if None.
    """
    model = without_sensors(model)
    every = tuple(every)
    along = Along(tuple(Prediction(model, p.recording) for p in prepared))
    start = np.concatenate([[0], np.cumsum([len(t.points) for t in every])]).astype(int)
    rows = [np.arange(p.counted.shape[1]) for p in prepared] if kept is None else list(kept)
    counted = np.concatenate([p.counted[:, k] for p, k in zip(prepared, rows, strict=True)], axis=1)
    late = [coarse(model.delays(p.recording)) for p in prepared]
    filtered = []
    for j, at in enumerate(counted):
        own = [p.filter_of(j, d[j])[k] for p, d, k in zip(prepared, late, rows, strict=True)]
        filtered.append(Filtered(csr_matrix(block_diag(own, "csr")), at))
    numbers: list[list[int]] = [[] for _ in counted]
    for first, trial in zip(start, every, strict=False):
        for j, torques in along.by_trial(trial).items():
            filtered[j].add(torques)
            numbers[j] += range(first, first + len(torques))
    return Signatures(every, start, tuple(f.whole for f in filtered), tuple(np.array(n, int) for n in numbers))


class Filtered:
    """Columns that are filtered by a matrix (M, K) as they come, some at once, at the rows that count (M,)."""

    def __init__(self, matrix: csr_matrix, counted: np.ndarray) -> None:
        self.matrix, self.counted = matrix, counted
        self._waiting: list[np.ndarray] = []
        self._done = [np.zeros((len(counted), 0))]

    def add(self, columns: np.ndarray) -> None:
        """Add columns (m, K)."""
        self._waiting += list(columns)
        if len(self._waiting) >= FEW:
            self._filter()

    @property
    def whole(self) -> np.ndarray:
        """All columns, (M, number of them)."""
        self._filter()
        return np.hstack(self._done)

    def _filter(self) -> None:
        if self._waiting:
            self._done.append((self.matrix @ np.array(self._waiting).T) * self.counted[:, None])
            self._waiting = []


def without_sensors(model: CalibratedModel) -> CalibratedModel:
    """The model with perfect sensors, as late as they are."""
    return replace(model, terms=tuple(t for t in model.terms if t.effect.side != "sensor" or isinstance(t.effect, Delay)))


class Tables:
    """The signatures of the catalogue and of the black-box terms of each joint, at the models that are asked for.

    They are made anew where the load torque, or what of it the motors feel, has changed by more than `SAME`; the newest and the
    catalogue's first are kept. Sensors scale them, and they are as late as the torque was when they were made.
    """

    def __init__(self, prepared: Sequence[Prepared], kept: Sequence[np.ndarray], trials: Sequence[Trial], seen: View) -> None:
        self.prepared, self.kept, self.trials, self.seen = prepared, kept, tuple(trials), seen
        self._known: dict[int | None, list[tuple[np.ndarray, Signatures]]] = {}

    def at(self, model: CalibratedModel, joint: int | None) -> Signatures:
        """The table of the catalogue (None) or of a joint's black-box terms."""
        return self._recorded(self._at(without_sensors(model), joint), model)

    def of(self, model: CalibratedModel, some: Sequence[Trial]) -> Signatures:
        """A table of some trials, which is not kept."""
        return self._recorded(table(self.prepared, model, some, self.kept), model)

    def _recorded(self, found: Signatures, model: CalibratedModel) -> Signatures:
        gains = self._gains(model)
        return found if np.all(gains == 1.0) else found.recorded(gains)

    def _at(self, model: CalibratedModel, joint: int | None) -> Signatures:
        now, known = self._state(model), self._known.setdefault(joint, [])
        for before, there in known:
            if _alike(before, now):
                return there
        new = self._made(model, joint, known[0][1] if known else None)
        self._known[joint] = [*(known[:1] if joint is None else []), (now, new)]
        return new

    def _made(self, model: CalibratedModel, joint: int | None, before: Signatures | None) -> Signatures:
        if joint is not None:
            return table(self.prepared, model, black_box_trials(self.prepared, self.seen, model, joint), self.kept)
        if before is None:
            return table(self.prepared, model, self.trials, self.kept)
        at = [Prediction(model, p.recording) for p in self.prepared]
        which = [k for k, trial in enumerate(self.trials) if any(one.depends_on(trial.effect) != () for one in at)]
        return before.renewed(which, table(self.prepared, model, [self.trials[k] for k in which], self.kept))

    def _state(self, model: CalibratedModel) -> np.ndarray:
        """What signatures depend on, as torques by joint, (3, n, K): the load, what of it the motors feel, and as late as it is recorded."""
        at = Along(tuple(Prediction(model, p.recording) for p in self.prepared))
        load = [at.signals.load, at.through * at.signals.load]
        recorded = [one.physics.late(one.recording, x) for one, x in zip(at.parts, self._split(load[0]), strict=True)]
        return np.array([*load, np.concatenate(recorded, axis=1)])

    def _split(self, x: np.ndarray) -> list[np.ndarray]:
        """Signals (n, K) of all recordings, by recording."""
        return np.split(x, np.cumsum([len(p.recording.t) for p in self.prepared])[:-1], axis=1)

    def _gains(self, model: CalibratedModel) -> np.ndarray:
        """Recorded over true change of each joint's torque, (n, M)."""
        gains = [Prediction(model, p.recording).gain for p in self.prepared]
        return np.repeat(np.array(gains).T, [len(k) for k in self.kept], axis=1)


def _alike(before: np.ndarray, now: np.ndarray) -> bool:
    """Whether torques by joint (…, n, K) differ by less than `SAME` of their size."""
    size = np.sqrt(np.mean(before**2, axis=-1))
    return bool(np.all(np.sqrt(np.mean((now - before) ** 2, axis=-1)) <= SAME * size))

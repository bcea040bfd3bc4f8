"""Signatures: by how much each effect that might be missing would change the torque that a model predicts for recordings.

They are linear in the effects' coefficients (`effects.Trial`) and pass the same filter as the residuals (`regression`), so that
what is missing is found by linear algebra on few numbers.
"""

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.jacobian import Prediction
from rrr_oc.calibration.samples import REST_SPEED, Prepared
from rrr_oc.effects import CATALOGUE, BlackBox, Signals, Trial, View
from rrr_oc.effects.base import SOUGHT
from rrr_oc.robot.rigid_body import rigid_body

SAMPLE = 400  # positions that stand for all when trials are made; twice as many cost time
LEAST_DRY = 0.02  # of a joint's torque, the least dry friction that priors of friction refer to; doubled, weak friction is believed larger
Signature = tuple[np.ndarray, np.ndarray]  # where columns are not 0 (m, n), and these, filtered (number of them, M)


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
        usual_speed=np.array([np.median(v[v > REST_SPEED]) if np.any(v > REST_SPEED) else REST_SPEED for v in np.abs(dq)]),
        duration=max(float(np.ptp(p.recording.t)) for p in prepared),
        widths=widths,
        positions=positions,
        inertia=np.maximum(np.median(inertia, axis=0), 1e-9),
        springs=tuple(sorted(springs)),
        payload=any(np.any(p.recording.payload > 0) for p in prepared)
        or any(term.effect.alters == "payload" for term in model.terms),
        dry=dry_friction(model, torque, np.maximum(np.quantile(np.abs(dq), 0.99, axis=1), 1e-3)),
        torque=torque,
        mass=np.maximum(model.robot.inertial[0], 1e-3),
    )


def dry_friction(model: CalibratedModel, torque: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Plain dry friction of each joint [Nm], at least `LEAST_DRY` of its torque, and half of its friction at the largest speed, (n,).

    The latter, since a plain model that lacks friction may share out what there is between dry and viscous in any way.
    """
    dry, whole = LEAST_DRY * torque, np.zeros(len(torque))
    for term in model.terms:
        effect = term.effect
        if effect.role == "plain" and effect.provides == "friction":
            (at,) = effect.torque(Signals(0 * speed, speed), term.named, 0.0)
            whole[effect.joints[0]] += abs(float(at))
        if effect.sign_forms:
            dry[effect.joints[0]] = max(dry[effect.joints[0]], float(term.values[0]))
    return np.maximum(dry, 0.5 * whole)


def trials(seen: View, torque: str) -> list[Trial]:
    """All ways in which effects of the catalogue might be missing; what is recorded as load torque holds no drive."""
    kinds = [kind for kind in CATALOGUE.values() if kind.role in SOUGHT and not (torque == "load" and kind.side == "drive")]
    return [trial for kind in kinds for trial in kind.trials(seen)]


def black_box_trials(prepared: Sequence[Prepared], seen: View, model: CalibratedModel, j: int) -> list[Trial]:
    """All black-box terms that joint j might lack, over the ranges that the recordings cover."""
    ranges = _ranges(prepared, model)
    kinds = [kind for kind in CATALOGUE.values() if issubclass(kind, BlackBox)]
    return [trial for kind in kinds for trial in kind.black_box_trials(seen, j, ranges, model.torque)]


def _ranges(prepared: Sequence[Prepared], model: CalibratedModel) -> dict[tuple[str, int], tuple[float, float]]:
    """Smallest and largest recorded value of each variable that a torque may depend on, by name and joint."""
    seen, torques = view(prepared, model), [model.torques(p.recording) for p in prepared]
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
class SignatureCache:
    """Filtered signatures that were computed before, shared by all models that are compared on the same recordings.

    `Data` owns it, and data of some of its recordings share it; it lives as long as they do. The key is the recording, the
    trial, and what else of the model the signature depends on: of the last, the first value and the newest are kept.
    """

    _found: dict[Prepared, dict[Hashable, dict[Hashable, Signature]]] = field(default_factory=dict, compare=False, repr=False)

    def get(self, prepared: Prepared, trial: Hashable, depends_on: Hashable, find: Callable[[], Signature]) -> Signature:
        """The signature of a trial; `find` computes it if it is not in the cache."""
        known = self._found.setdefault(prepared, {}).setdefault(trial, {})
        if depends_on not in known:
            signature = find()
            if len(known) > 1:
                known.popitem()
            known[depends_on] = signature
        return known[depends_on]

    @property
    def sizes(self) -> dict[Prepared, list[int]]:
        """Number of signatures kept of each trial, by recording."""
        return {prepared: [len(known) for known in by_trial.values()] for prepared, by_trial in self._found.items()}

    @property
    def nbytes(self) -> int:
        """Bytes of all signatures."""
        by_trial = [known for one in self._found.values() for known in one.values()]
        return sum(x.nbytes for known in by_trial for signature in known.values() for x in signature)


@dataclass(frozen=True)
class Table:
    """Signatures of many trials at the rows of all recordings.

    Attributes:
        trials: The trials, in order.
        start: First column of each trial, and the number of columns at the end, (trials + 1,).
        values: For each joint (M, columns that are not 0 there) [Nm].
        used: For each joint the numbers of those columns.
    """

    trials: tuple[Trial, ...]
    start: np.ndarray
    values: tuple[np.ndarray, ...]
    used: tuple[np.ndarray, ...]


def table(
    prepared: Sequence[Prepared], model: CalibratedModel, every: Iterable[Trial], cache: SignatureCache | None = None
) -> Table:
    """The signatures of trials at a model, filtered, at the rows of `regression.rows`; those in a cache are not computed again."""
    every, cache = tuple(every), cache or SignatureCache()
    start = np.concatenate([[0], np.cumsum([len(t.points) for t in every])]).astype(int)
    found = [_signatures(p, model, every, cache) for p in prepared]
    live = np.array([np.concatenate([where for where, _ in part]) for part in found])  # (R, columns, n)
    edges = np.cumsum([0, *(p.counted.shape[1] for p in prepared)])
    values, used = [], []
    for j in range(live.shape[2]):
        own = np.flatnonzero(live[:, :, j].any(axis=0))
        whole = np.zeros((len(own), edges[-1]))
        for part, first, end in zip(found, edges, edges[1:], strict=False):
            for (where, passed), column in zip(part, start, strict=False):
                if where[:, j].any():
                    rows, here = np.cumsum(where).reshape(where.shape)[:, j] - 1, np.flatnonzero(where[:, j])
                    whole[np.searchsorted(own, column + here), first:end] = passed[rows[here]]
        values.append(whole.T)
        used.append(own)
    return Table(every, start, tuple(values), tuple(used))


def _signatures(prepared: Prepared, model: CalibratedModel, every: Sequence[Trial], cache: SignatureCache) -> list[Signature]:
    """The signatures of trials at a recording."""
    at = Prediction(model, prepared.recording)
    return [_signature(prepared, at, trial, cache) for trial in every]


def _signature(prepared: Prepared, at: Prediction, trial: Trial, cache: SignatureCache) -> Signature:
    """A trial's signature at a recording; from the cache, except that series are too many to keep."""
    effect, gain = trial.effect, at.gain

    def find() -> Signature:
        return prepared.nonzero_passed(at.by_trial(trial) if gain is None else at.before_sensors(trial), 1)

    parts = None if effect.validity or gain is None else at.depends_on(effect)
    if parts is None:
        where, passed = find()
    else:
        key = (effect, trial.size, *(tuple(point.items()) for point in trial.points))
        where, passed = cache.get(prepared, key, (trial.width, parts), find)
    if gain is None or effect.side == "sensor" or np.all(gain == 1.0):
        return where, passed
    return where, passed * gain[np.nonzero(where)[1], None]

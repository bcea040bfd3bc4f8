"""Signatures: by how much each effect that might be missing would change the torque that a model predicts for recordings.

They are linear in the effects' coefficients (`effects.Trial`) and pass the same filter as the residuals (`regression`), so that
what is missing is found by linear algebra on few numbers.
"""

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.samples import Prepared
from rrr_oc.effects import CATALOGUE, Body, Effect, Signals, Trial, View
from rrr_oc.effects.black_box.empirical import Empirical
from rrr_oc.effects.friction.dry_friction import DryFriction
from rrr_oc.model.recorded_physics import Physics, later, moved, states_along
from rrr_oc.numerics.along import along
from rrr_oc.recordings.recording import Recording
from rrr_oc.robot.rigid_body import rigid_body, with_payload

SAMPLE = 400  # positions that trials look at
Signature = tuple[np.ndarray, np.ndarray]  # where columns are not 0 (m, n), and these, filtered (number of them, M)


def view(prepared: Sequence[Prepared], model: CalibratedModel) -> View:
    """What the recordings show of the arm."""
    q = np.concatenate([p.recording.q for p in prepared], axis=1)
    dq = np.concatenate([p.recording.dq for p in prepared], axis=1)
    low, high = np.quantile(q, [0.002, 0.998], axis=1)
    widths = np.full(len(q), 0.05)
    for term in model.terms:
        if isinstance(term.effect, DryFriction) and term.width is not None:
            widths[term.effect.joints[0]] = term.width
    springs = {spring.joints for p in prepared for spring, _ in p.recording.springs}
    positions = q[:, :: max(1, q.shape[1] // SAMPLE)]
    body = rigid_body(model.robot)
    inertia = [np.diag(np.asarray(body.mass_matrix(x, model.robot.inertial))) for x in positions.T]
    return View(
        low=low,
        high=np.maximum(high, low + 1e-3),
        speed=np.maximum(np.quantile(np.abs(dq), 0.99, axis=1), 1e-3),
        duration=max(float(np.ptp(p.recording.t)) for p in prepared),
        widths=widths,
        positions=positions,
        inertia=np.maximum(np.median(inertia, axis=0), 1e-9),
        springs=tuple(sorted(springs)),
        payload=any(np.any(p.recording.payload > 0) for p in prepared)
        or any(term.effect.name == "payload_mass" for term in model.terms),
    )


def trials(seen: View, torque: str) -> list[Trial]:
    """All ways in which effects of the catalogue might be missing; what is recorded as load torque holds no drive."""
    kinds = [kind for kind in CATALOGUE.values() if not kind.plain and not (torque == "load" and kind.side == "drive")]
    return [trial for kind in kinds for trial in kind.trials(seen)]


@dataclass(frozen=True)
class Context:
    """A recording at a model: what signatures are made of.

    Attributes:
        prepared: The recording.
        physics: What is at work in it.
        load, motor: Load torque and motor torque (n, K) [Nm].
        through: d motor torque / d load torque of each joint (n, K).
        body: The rigid body with the model's effects, without payload in `Body.payload`.
        partials: Derivatives of the load torque by q, dq, ddq (n, n, K), the links' parameters (n, 10 n, K) and gravity (n, 3, K).
        friction: Torque of the plain friction (n, K) [Nm].
        torque: What is recorded, as in `CalibratedModel.torque`.
    """

    prepared: Prepared
    physics: Physics
    load: np.ndarray
    motor: np.ndarray
    through: np.ndarray
    body: Body
    partials: tuple[np.ndarray, ...]
    friction: np.ndarray
    torque: str

    @property
    def recording(self) -> Recording:
        """With speeds and accelerations from short windows."""
        return self.prepared.recording

    @cached_property
    def of_motion(self) -> Signals:
        """What effects may depend on, as arrays, without what the model has to say."""
        r = self.recording
        return Signals(r.q, r.dq, r.ddq, time=r.clock, payload=r.payload)

    @cached_property
    def signals(self) -> Signals:
        """What effects may depend on, as arrays."""
        listed = reversed(self.physics.named()[: len(self.recording.springs)])
        springs = {effect.joints: (effect, theta, width) for effect, theta, width in listed}
        return replace(self.of_motion, load=self.load, friction=self.friction, springs=springs)

    @cached_property
    def gain(self) -> np.ndarray | None:
        """Recorded over true change of each joint's torque (n,), as the model's sensors have it; None where they delay it."""
        if any(effect.side == "sensor" and effect.of_arm for effect in self.physics.model.effects):
            return None
        return self.physics.passed_on(self.recording, np.ones_like(self.load))[:, 0]

    @cached_property
    def _at_work(self) -> dict[str, tuple[Any, ...]]:
        """What is at work with its numbers: what load torques and the rigid body follow from, and what depends on load torques."""
        named = [(effect, tuple(theta.values()), width) for effect, theta, width in self.physics.named()]

        def of(*sides: str) -> tuple[Any, ...]:
            return (self.physics.inertial.tobytes(), *(one for one in named if one[0].side in sides))

        load = of("link", "body", "motion")
        return {
            "load": load,
            "body": load if any(effect.simulated for effect, *_ in named) else of("body", "motion"),
            "through": tuple(one for one in named if one[0].load_dependent and self.torque != "load"),
        }

    def behind(self, effect: Effect) -> Hashable | None:
        """What of the model the signature of an effect follows from, before sensors; None where from nearly all of it."""
        if effect.side == "sensor" or effect.of_friction:
            return None
        felt = range(len(self.load)) if effect.side != "link" else effect.joints
        through = [one for one in self._at_work["through"] if effect.side != "drive" and one[0].joints[0] in felt]
        if effect.load_dependent or effect.side == "motion" or through:
            return *through, self._at_work["load"]
        return self._at_work["body"] if effect.side == "body" else ()


def context(prepared: Prepared, model: CalibratedModel) -> Context:
    """A recording at a model."""
    r, physics = prepared.recording, model.physics(prepared.recording)
    n, chain = model.robot.n, physics.model
    motor, load = physics.torques(r)
    named = physics.named()
    body = Body(ca.DM(model.robot.inertial), ca.DM(model.robot.gravity), 0.0, list(model.tool.position))
    for effect, theta, _ in named:
        body = effect.change(body, theta)
    held = float(ca.DM(body.payload))
    gravity = np.array(ca.DM(ca.vertcat(*body.gravity)) if isinstance(body.gravity, list) else ca.DM(body.gravity)).reshape(3)
    body = replace(body, inertial=ca.evalf(ca.SX(body.inertial)), gravity=ca.DM(gravity))
    links = _by_payload(
        r, lambda m: np.array(ca.evalf(with_payload(ca.SX(body.inertial), model.tool.joint, held + m, body.position)))
    )
    links = links[0] if len(links) == 1 else np.concatenate(list(links), axis=1)
    motion = [x + s for x, s in zip((r.q, r.dq, r.ddq), np.split(physics.shift(r), 3), strict=True)]
    found = along(chain.load_partials, *motion, links, gravity, physics.theta, physics.widths)[1:]
    widths_of = (n, n, n, 10 * n, 3)
    partials = tuple(
        np.moveaxis(part.reshape(n, len(r.t), width), 1, 2).copy() for part, width in zip(found, widths_of, strict=True)
    )
    friction = np.zeros_like(load)
    through = np.ones_like(load)
    plain = Signals(r.q, r.dq, r.ddq, time=r.clock, payload=r.payload)
    for effect, theta, width in named:
        if effect.plain and effect.name != "armature":
            friction[effect.joints[0]] += np.array(effect.torque(plain, theta, width)[0]).reshape(-1)
    plain = replace(plain, friction=friction)
    for effect, theta, width in named:
        if effect.load_dependent and model.torque != "load":
            more, now = (
                np.array(effect.torque(replace(plain, load=x), theta, width)[0]).reshape(-1) for x in (load + 1e-6, load)
            )
            through[effect.joints[0]] -= (more - now) / 1e-6
    return Context(prepared, physics, load, motor, through, body, partials, friction, model.torque)


def columns(at: Context, trial: Trial) -> np.ndarray:
    """Change of the predicted recorded torque for each coefficient, unfiltered, (m, n, K) [Nm]."""
    true = _before_sensors(at, trial)
    if trial.effect.side == "sensor":
        return true
    return np.array([at.physics.passed_on(at.recording, change) for change in true])


def _before_sensors(at: Context, trial: Trial) -> np.ndarray:
    """Change of the predicted torque as no sensor distorts it, or of what one records, where the effect is one of sensors."""
    effect, r = trial.effect, at.recording
    result = np.zeros((len(trial.points), *r.q.shape))
    if effect.of_spring and effect.joints not in (at.signals.springs or {}):
        return result
    if effect.side in ("link", "drive"):
        signals = at.signals if effect.load_dependent or effect.of_spring or effect.of_friction else at.of_motion
        if isinstance(effect, Empirical):
            coefficients = np.array([[point[a] for a in effect.amplitudes] for point in trial.points])
            result[:, effect.joints[0]] = -coefficients @ np.array(effect.basis(signals, trial.width))
        else:
            for k, theta in enumerate(trial.points):
                _add(
                    result[k], effect, effect.torque(_with_states(signals, r, trial, theta, at.load), theta, trial.width), -1.0
                )
    else:
        for k, theta in enumerate(trial.points):
            if effect.side == "sensor":
                true = at.load if at.torque == "load" else at.motor
                if effect.of_arm:
                    result[k] = later(r, true, theta["delay"]) - true
                else:
                    _add(result[k], effect, effect.torque(replace(at.signals, load=true), theta, trial.width))
            else:
                result[k] = _of_body(at, effect, theta) if effect.side == "body" else _of_motion(at, trial, theta)
    if effect.side not in ("sensor", "drive"):
        result *= at.through
    return result / trial.size


def _add(change: np.ndarray, effect, torques, sign: float = 1.0) -> None:
    for j, torque in zip(effect.joints, torques, strict=True):
        change[j] += sign * np.array(torque).reshape(-1)


def _with_states(signals: Signals, recording: Recording, trial: Trial, theta, load: np.ndarray) -> Signals:
    if not trial.effect.states:
        return signals
    return replace(signals, states=list(states_along(recording, trial.effect, theta, trial.width, load)))


def _of_body(at: Context, effect, theta) -> np.ndarray:
    r, tool = at.recording, at.physics.model.tool.joint

    def more(mass: float) -> np.ndarray:
        base = replace(at.body, payload=at.body.payload + mass)
        there = effect.change(base, theta)
        links = [np.array(with_payload(ca.DM(b.inertial), tool, b.payload, b.position)) for b in (base, there)]
        gravity = ca.vertcat(*there.gravity) if isinstance(there.gravity, list) else there.gravity
        pull = np.array(ca.evalf(ca.SX(gravity) - ca.SX(base.gravity))).reshape(3)
        return np.concatenate([(links[1] - links[0]).T.reshape(-1), pull])

    change, total = _by_payload(r, more), np.zeros_like(at.load)
    for by, part in ((at.partials[3], change[:, :-3]), (at.partials[4], change[:, -3:])):
        used = np.flatnonzero(np.any(part, axis=0))
        if len(used):
            total += np.einsum("ick,kc->ik", by[:, used], np.broadcast_to(part[:, used], (len(r.t), len(used))))
    return total


def _by_payload(recording: Recording, affine: Callable[[float], np.ndarray]) -> np.ndarray:
    """What is affine in the listed payload [kg] at every sample, (K, …), or where that never changes (1, …)."""
    low, high = float(recording.payload.min()), float(recording.payload.max())
    first = affine(low)
    if low == high:
        return first[None]
    share = (recording.payload - low) / (high - low)
    return first + share.reshape(-1, *np.ones(first.ndim, int)) * (affine(high) - first)


def _of_motion(at: Context, trial: Trial, theta) -> np.ndarray:
    by_q, _, by_ddq = at.partials[:3]
    shift = moved(at.recording, trial.effect, theta, trial.width, at.load, lambda j: (by_q[j, j], by_ddq[j, j]))
    parts = np.split(shift, 3)
    return np.sum([np.einsum("ijk,jk->ik", by, x) for by, x in zip(at.partials[:3], parts, strict=True)], axis=0)


@dataclass(frozen=True)
class SignatureCache:
    """Filtered signatures that were computed before, shared by all models that are compared on the same recordings.

    A `Bench` owns it, and benches of some of its recordings share it; it lives as long as they do. The key is the recording, the
    trial, and whatever of a model and a trial the signature depends on: of the latter, the first and the latest are kept.
    """

    _found: dict[Prepared, dict[Hashable, dict[Hashable, Signature]]] = field(default_factory=dict, compare=False, repr=False)

    def once(self, prepared: Prepared, trial: Hashable, depends_on: Hashable, find: Callable[[], Signature]) -> Signature:
        """The signature of a trial, which `find` computes where there is none."""
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


def table(contexts: Sequence[Context], every: Iterable[Trial], cache: SignatureCache | None = None) -> Table:
    """The signatures of trials at a model, filtered, at the rows of `regression.rows`; those in a cache are not computed again."""
    every, cache = tuple(every), cache or SignatureCache()
    start = np.concatenate([[0], np.cumsum([len(t.points) for t in every])]).astype(int)
    found = [[_signature(at, trial, cache) for trial in every] for at in contexts]
    live = np.array([np.concatenate([where for where, _ in part]) for part in found])  # (R, columns, n)
    edges = np.cumsum([0, *(at.prepared.counted.shape[1] for at in contexts)])
    values, used = [], []
    for j in range(live.shape[2]):
        own = np.flatnonzero(live[:, :, j].any(axis=0))
        place = np.zeros(live.shape[1], int)
        place[own] = np.arange(len(own))
        whole = np.zeros((len(own), edges[-1]))
        for part, first, end in zip(found, edges, edges[1:], strict=False):
            for (where, passed), column in zip(part, start, strict=False):
                if where[:, j].any():
                    rows = np.cumsum(where).reshape(where.shape)[:, j] - 1
                    here = np.flatnonzero(where[:, j])
                    whole[place[column + here], first:end] = passed[rows[here]]
        values.append(whole.T)
        used.append(own)
    return Table(every, start, tuple(values), tuple(used))


def _signature(at: Context, trial: Trial, cache: SignatureCache) -> Signature:
    """A trial's signature at a recording; from the cache, except that series are too many to keep."""
    effect, gain = trial.effect, at.gain

    def find() -> Signature:
        raw = columns(at, trial) if gain is None else _before_sensors(at, trial)
        where = np.any(raw != 0, axis=2)
        return where, at.prepared.passed(raw[where], np.nonzero(where)[1])

    behind = None if isinstance(effect, Empirical) or gain is None else at.behind(effect)
    if behind is None:
        where, passed = find()
    else:
        key = (effect, trial.size, *(tuple(point.items()) for point in trial.points))
        where, passed = cache.once(at.prepared, key, (trial.width, behind), find)
    if gain is None or effect.side == "sensor" or np.all(gain == 1.0):
        return where, passed
    return where, passed * gain[np.nonzero(where)[1], None]

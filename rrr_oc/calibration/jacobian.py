"""Derivatives of the torque that a model predicts for a recording: by its parameters, and by effects that it lacks.

One class computes both, since both follow the same chain: an effect changes the motion of the links, a body, or a torque at the
links or in the drives; drives pass a change of load torque on to the motor torque; sensors pass that on to what is recorded.

Two things remain apart. By parameters, derivatives are those at the present values, exact or by differences of the whole model.
By an effect that the model lacks, they are those at size 0 in the direction of a finite shape, from the chain's own derivatives
and with no model built: there are hundreds of such effects, and a model of each would take a thousand times as long.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Literal

import casadi as ca
import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.effects import BlackBox, Body, BodyChange, Delay, Effect, LateCommand, MovesLink, Signals, Trial, WithStates
from rrr_oc.model.recorded_physics import Physics, braking_of, felt_load, later, moved, states_along
from rrr_oc.model.shared_model import KEPT
from rrr_oc.numerics.along import along
from rrr_oc.recordings.recording import Recording
from rrr_oc.robot.rigid_body import with_payload

UNIT_BODY = np.array([1.0, 0, 0, 0, 1, 0, 1, 0, 0, 1])  # inertial parameters of 1 kg in the origin with 1 kg m² about each axis
LOAD_STEP = 1e-6  # [Nm], for derivatives of friction by the load torque; doubled, no change


@dataclass(frozen=True)
class Columns:
    """Derivatives of torques (n, K, p), those that are not 0 at all samples.

    Attributes:
        joints, numbers: Joint and parameter of each, (m,).
        values: (K, m): sample by sample, as `along` finds them and the filter takes them.
        size: p.
    """

    joints: np.ndarray
    numbers: np.ndarray
    values: np.ndarray
    size: int

    @classmethod
    def of(cls, torques: np.ndarray) -> "Columns":
        """Of derivatives (n, K, p)."""
        joints, numbers = np.nonzero(np.any(torques != 0, axis=1))
        return cls(joints, numbers, torques[joints, :, numbers].T, torques.shape[2])

    @classmethod
    def none(cls, count: int) -> "Columns":
        """No derivatives at that number of samples."""
        return cls(np.zeros(0, int), np.zeros(0, int), np.zeros((count, 0)), 0)

    @classmethod
    def joined(cls, parts: Sequence["Columns"], size: int) -> "Columns":
        """Derivatives by parameters whose numbers differ, of `size` in all."""
        parts = [part for part in parts if len(part.joints)] or parts[:1]
        joints, numbers, values = ([getattr(part, name) for part in parts] for name in ("joints", "numbers", "values"))
        return cls(np.concatenate(joints), np.concatenate(numbers), values[0] if len(parts) == 1 else np.hstack(values), size)

    def moved(self, first: int) -> "Columns":
        """The same behind `first` other parameters."""
        return replace(self, numbers=self.numbers + first, size=self.size + first)

    def placed(self, holds: np.ndarray, wanted: np.ndarray) -> "Columns":
        """The same among parameters (p,), of which these are the last for which `holds` is true; only those `wanted`."""
        at = np.flatnonzero(holds)
        among = np.concatenate([np.full(self.size - len(at), -1), np.where(wanted[at], at, -1)])[self.numbers]
        keep = among >= 0
        values = self.values if keep.all() else self.values[:, keep]
        return Columns(self.joints[keep], among[keep], values, len(holds))

    def dense(self, n: int) -> np.ndarray:
        """The derivatives (n, K, p) of all n joints by all parameters."""
        result = np.zeros((len(self.values), self.size, n))
        result[:, self.numbers, self.joints] = self.values
        return np.moveaxis(result, 2, 0)


@dataclass(frozen=True)
class Prediction:
    """What a model predicts for a recording, to first order.

    Attributes:
        model: The model.
        recording: With speeds and accelerations from short windows.
    """

    model: CalibratedModel
    recording: Recording

    @cached_property
    def physics(self) -> Physics:
        """What is at work in the recording: the springs that it lists, then the model's terms that hold for it."""
        return self.model.physics(self.recording)

    def by_parameters(self, inertial: bool = False) -> np.ndarray:
        """d `CalibratedModel.output_torque` / d (parameters of the terms, inertial parameters), (n, K, p).

        Args:
            inertial: Whether the derivatives by the inertial parameters (10, n) are wanted too, link by link.
        """
        dense = self.nonzero_by_parameters(inertial).dense(self.model.robot.n)
        for column in np.moveaxis(dense, 2, 0) if any(self.physics.delays) else ():
            column[:] = self.physics.late(self.recording, column)
        return dense

    def nonzero_by_parameters(self, inertial: bool = False) -> Columns:
        """As `by_parameters`, without those that are 0, as recorded without delays."""
        terms, physics, r = self.model.terms, self.physics, self.recording
        sizes, holds = np.diff(self.model.offsets), [t.holds_for(r) for t in terms]
        late = [isinstance(t.effect, Delay) for t in terms]
        inexact = [t.effect.side in ("motion", "sensor") or bool(t.effect.states) for t in terms]  # no torque of the instant
        n, parts = self.model.robot.n, [Columns.none(len(r.t))]
        size = self.model.offsets[-1] + (10 * n if inertial else 0)
        if not all(inexact):
            prompt = np.repeat(np.array(holds) & ~np.array(late), sizes)
            parts.append(self._sensitivity("theta", self.physics.inertial).placed(prompt, ~np.repeat(inexact, sizes)))
        if inertial:
            parts.append(self._sensitivity("inertial", self.physics.inertial).moved(self.model.offsets[-1]))
        if any(effect.side == "sensor" for effect in physics.model.effects):
            dense = Columns.joined(parts, size).dense(n)
            for k in np.flatnonzero(np.any(dense, axis=(0, 1))):
                dense[:, :, k] = physics.passed_on(r, dense[:, :, k])
            parts = [Columns.of(dense)]
        at_work, ends = np.array(holds) & ~np.array(late), np.cumsum(sizes)
        if which := [i for i in range(len(terms)) if inexact[i] and at_work[i]]:
            numbers = len(physics.model.effects) - sum(at_work) + np.cumsum(at_work) - 1  # of the terms among the effects
            true = self.model.true_torque(r, physics)
            found = physics.by_differences(r, [int(numbers[i]) for i in which], true, self.model.torque == "load")
            parts += [Columns.of(part).moved(int(ends[i]) - sizes[i]) for i, part in zip(which, found, strict=True)]
        if which := [i for i in range(len(terms)) if late[i] and holds[i]]:
            values = -differentiated(r, physics.measured(r, self.model.true_torque(r, physics)))
            waits = physics.by_waits(r)
            for i in which:
                joints = np.array(terms[i].effect.joints or range(n))
                found = waits if isinstance(terms[i].effect, LateCommand) else values
                parts.append(Columns(joints, np.full(len(joints), ends[i] - 1), found[joints].T, int(ends[i])))
        return Columns.joined(parts, size)

    @property
    def regressor_depends_on(self) -> Hashable | None:
        """The parts of the model on which derivatives by the inertial parameters depend; None where on nearly all of it."""
        named = self.physics.named()
        if any(effect.side == "sensor" or ("load" in effect.inputs and self.model.torque != "load") for effect, *_ in named):
            return None
        robot, bodies = self.model.robot, [(e, tuple(theta.values())) for e, theta, _ in named if e.side == "body"]
        return (*bodies, *(x.tobytes() for x in (robot.placements, robot.axes, robot.gravity)))

    def by_inertial(self) -> Columns:
        """d `CalibratedModel.output_torque` / d inertial parameters (10, n), link by link, without the model's sensors."""
        if self.regressor_depends_on is None:
            return self._sensitivity("inertial", self.physics.inertial)
        # They do not depend on the inertial parameters: those of unit bodies give the same bits, whichever model asked first
        return self._sensitivity("inertial", np.tile(UNIT_BODY, (self.model.robot.n, 1)).T)

    def by_widths(self, joints: Sequence[tuple[int, ...]]) -> Columns:
        """d measured torque / d logarithm of the width over which all friction on each of these joints changes sign."""
        found, smooth = self._sensitivity("widths", self.physics.inertial), [e for e in self.physics.model.effects if e.width]
        if not len(found.joints):
            return replace(found, size=len(joints))
        own = [joints.index(e.joints) if e.joints in joints and changes_sign(e) else -1 for e in smooth]
        dense = np.zeros((self.model.robot.n, len(found.values), len(joints)))
        for j, number, column in zip(found.joints, found.numbers, found.values.T, strict=True):
            if own[number] >= 0:
                dense[j, :, own[number]] += column * self.physics.widths[number]
        if any(effect.side == "sensor" for effect in self.physics.model.effects):
            for k in range(len(joints)):
                dense[:, :, k] = self.physics.passed_on(self.recording, dense[:, :, k])
        return Columns.of(dense)

    def before_sensors(self, trial: Trial) -> np.ndarray:
        """Change of `CalibratedModel.output_torque` for each coefficient of a trial, (m, n, K) [Nm], as a perfect sensor records it, unless
        the trial's effect is one of sensors."""
        effect, shape = trial.effect, self.recording.q.shape
        if "springs" in effect.inputs and effect.joints not in (self.signals.springs or {}):
            return np.zeros((len(trial.points), *shape))
        result = self._of_series(trial) if effect.side in ("link", "drive") else None
        if result is None:
            changes = {"body": self._of_body, "motion": self._of_motion, "sensor": self._of_sensor}
            change = changes.get(effect.side, self._of_torque)
            result = np.array([change(effect, theta, trial.width) for theta in trial.points]).reshape(-1, *shape)
        if effect.side not in ("sensor", "drive") and self._at_work["through"]:
            result *= self.through
        return result if trial.size == 1.0 else result / trial.size

    def depends_on(self, effect: Effect) -> Hashable | None:
        """The parts of the model on which `before_sensors` depends for an effect; None where on nearly all of it."""
        if effect.side == "sensor" or "friction" in effect.inputs:
            return None
        felt = range(self.model.robot.n) if effect.side != "link" else effect.joints
        through = [one for one in self._at_work["through"] if effect.side != "drive" and one[0].joints[0] in felt]
        if "load" in effect.inputs or effect.side == "motion" or through:
            return *through, self._at_work["load"]
        return self._at_work["body"] if effect.side == "body" else ()

    @cached_property
    def gain(self) -> np.ndarray:
        """Measured over true change of each joint's torque (n,), by the model's sensors."""
        return self.physics.passed_on(self.recording, np.ones_like(self.recording.q))[:, 0]

    @cached_property
    def of_motion(self) -> Signals:
        """The signals on which effects may depend, as arrays, without those that the model predicts."""
        r = self.recording
        return Signals(r.q, r.dq, r.ddq, time=r.clock, payload=r.payload, group=r.group, braking=braking_of(r))

    @cached_property
    def signals(self) -> Signals:
        """The signals on which effects may depend, as arrays."""
        listed = reversed(self.physics.named()[: len(self.recording.springs)])
        springs = {effect.joints: (effect, theta, width) for effect, theta, width in listed}
        return replace(self.of_motion, load=self.load, friction=self.friction, rotor=self.rotor, springs=springs)

    @property
    def load(self) -> np.ndarray:
        """Load torque that the drives pass on (n, K) [Nm]."""
        return self.physics.arm.torques(self.recording)[1]

    @cached_property
    def friction(self) -> np.ndarray:
        """Torque of the plain friction (n, K) [Nm]."""
        return self._provided("friction")

    @cached_property
    def rotor(self) -> np.ndarray:
        """Torque of the rotors' inertia (n, K) [Nm]."""
        return self._provided("rotor")

    def _provided(self, signal: str) -> np.ndarray:
        """Torque of the effects that provide a signal (n, K) [Nm]."""
        result = np.zeros_like(self.load)
        for effect, theta, width in self.physics.named():
            if effect.provides == signal:
                result[effect.joints[0]] += np.array(effect.torque(self.of_motion, theta, width)[0]).reshape(-1)
        return result

    @cached_property
    def through(self) -> np.ndarray:
        """d (what is recorded) / d (load torque) of each joint, (n, K): 1 but for friction that grows with the load."""
        result, signals = np.ones_like(self.load), replace(self.of_motion, friction=self.friction, rotor=self.rotor)
        for effect, theta, width in self.physics.named():
            if "load" in effect.inputs and self.model.torque != "load":
                more, now = (
                    np.array(effect.torque(replace(signals, load=x), theta, width)[0]).reshape(-1)
                    for x in (self.load + LOAD_STEP, self.load)
                )
                result[effect.joints[0]] -= (more - now) / LOAD_STEP
        return result

    @cached_property
    def body(self) -> Body:
        """The rigid body with the model's effects, without the listed payload."""
        body = Body(ca.DM(self.model.robot.inertial), ca.DM(self.model.robot.gravity), 0.0, list(self.model.tool.position))
        for effect, theta, _ in self.physics.named():
            body = effect.change(body, theta) if isinstance(effect, BodyChange) else body
        return replace(body, inertial=ca.evalf(ca.SX(body.inertial)), gravity=ca.evalf(_gravity(body)))

    @cached_property
    def partials(self) -> tuple[np.ndarray, ...]:
        """Derivatives of the load torque by q, dq, ddq (n, n, K), the links' parameters (n, 10 n, K) and gravity (n, 3, K)."""
        r, n, body, tool = self.recording, self.model.robot.n, self.body, self.model.tool.joint
        held = float(ca.DM(body.payload))

        def carried(mass: float) -> np.ndarray:
            return np.array(ca.evalf(with_payload(ca.SX(body.inertial), tool, held + mass, body.position)))

        links = _by_payload(r, carried)
        links = links[0] if len(links) == 1 else np.concatenate(list(links), axis=1)
        motion = [x + s for x, s in zip((r.q, r.dq, r.ddq), np.split(self.physics.shift(r), 3), strict=True)]
        values = links, np.array(body.gravity).reshape(3), self.physics.theta, self.physics.widths
        found = along(self.physics.model.load_partials, *motion, *values)[1:]
        columns = (n, n, n, 10 * n, 3)
        return tuple(np.moveaxis(x.reshape(n, len(r.t), c), 1, 2).copy() for x, c in zip(found, columns, strict=True))

    @cached_property
    def _at_work(self) -> dict[str, tuple[Any, ...]]:
        """Effects with their numbers on which load torques, rigid body, and the way from load to motor torque depend."""
        named = [(effect, tuple(theta.values()), width) for effect, theta, width in self.physics.named()]

        def of(*sides: str) -> tuple[Any, ...]:
            return (self.physics.inertial.tobytes(), *(one for one in named if one[0].side in sides))

        load = of("link", "body", "motion")
        return {
            "load": load,
            "body": load if any(effect.moves_link for effect, *_ in named) else of("body", "motion"),
            "through": tuple(one for one in named if "load" in one[0].inputs and self.model.torque != "load"),
        }

    def _sensitivity(self, by: Literal["theta", "inertial", "widths"], inertial: np.ndarray) -> Columns:
        physics, r = self.physics, self.recording
        function, joints, numbers = _nonzero(physics.model.sensitivity("load" if self.model.torque == "load" else "motor", by))
        values = np.zeros((0, len(r.t)))
        if len(joints):
            (values,) = along(function, *physics.inputs(r), physics.theta, physics.widths, inertial)
        sizes = {"theta": physics.theta.size, "inertial": physics.inertial.size, "widths": physics.widths.size}
        return Columns(joints, numbers, values.T, sizes[by])

    def _of_series(self, trial: Trial) -> np.ndarray | None:
        """Of an effect that is a sum of given functions times coefficients; None of any other."""
        effect = trial.effect
        if not isinstance(effect, BlackBox):
            return None
        basis = effect.basis(self.signals if effect.inputs else self.of_motion, trial.width)
        if basis is None:
            return None
        result = np.zeros((len(trial.points), *self.recording.q.shape))
        coefficients = np.array([[point[a] for a in effect.amplitudes] for point in trial.points])
        result[:, effect.joints[0]] = -coefficients @ np.array(basis)
        return result

    def _of_torque(self, effect: Effect, theta: Mapping[str, float], width: Any) -> np.ndarray:
        signals = self.signals if effect.inputs else self.of_motion
        if isinstance(effect, WithStates):
            signals = replace(signals, states=list(states_along(self.recording, effect, theta, width, self.load)))
        return -self._on_joints(effect, effect.torque(signals, theta, width))

    def _of_sensor(self, effect: Effect, theta: Mapping[str, float], width: Any) -> np.ndarray:
        true = self.physics.torques(self.recording)[self.model.torque == "load"]
        if isinstance(effect, Delay):
            return later(self.recording, true, [effect.delay(theta)] * len(true)) - true
        return self._on_joints(effect, effect.torque(replace(self.signals, load=true), theta, width))

    def _on_joints(self, effect: Effect, torques: Sequence[Any]) -> np.ndarray:
        result = np.zeros(self.recording.q.shape)
        for j, torque in zip(effect.on(len(result)), torques, strict=True):
            result[j] += np.array(torque).reshape(-1)
        return result

    def _of_body(self, effect: Effect, theta: Mapping[str, float], _width: Any) -> np.ndarray:
        r, tool = self.recording, self.model.tool.joint

        def more(mass: float) -> np.ndarray:
            base = replace(self.body, payload=self.body.payload + mass)
            there = effect.change(base, theta) if isinstance(effect, BodyChange) else base
            links = [np.array(with_payload(ca.DM(b.inertial), tool, b.payload, b.position)) for b in (base, there)]
            pull = np.array(ca.evalf(_gravity(there) - _gravity(base))).reshape(3)
            return np.concatenate([(links[1] - links[0]).T.reshape(-1), pull])

        change, total = _by_payload(r, more), np.zeros(r.q.shape)
        for by, part in ((self.partials[3], change[:, :-3]), (self.partials[4], change[:, -3:])):
            used = np.flatnonzero(np.any(part, axis=0))
            if len(used):
                total += np.einsum("ick,kc->ik", by[:, used], np.broadcast_to(part[:, used], (len(r.t), len(used))))
        return total

    def _of_motion(self, effect: Effect, theta: Mapping[str, float], width: Any) -> np.ndarray:
        by_q, _, by_ddq = self.partials[:3]
        if isinstance(effect, MovesLink):
            (j,) = effect.joints
            own = felt_load(self.recording, effect, self.load[j]), (by_q[j, j], by_ddq[j, j])
            shift = moved(self.recording, effect, theta, width, *own)
        else:
            shift = moved(self.recording, effect, theta, width)
        n, result = len(by_q), np.zeros(self.recording.q.shape)
        for row in np.flatnonzero(np.any(shift, axis=1)).tolist():
            result += self.partials[row // n][:, row % n] * shift[row]
        return result


def differentiated(recording: Recording, x: np.ndarray) -> np.ndarray:
    """Derivative by time of signals (m, K), central and within each segment, (m, K)."""
    result = np.zeros(x.shape)
    for s in recording.segments:
        if s.stop - s.start > 1:
            result[:, s] = np.gradient(x[:, s], recording.t[s], axis=1)
    return result


def changes_sign(effect: Effect) -> bool:
    """Whether an effect changes sign with the speed over a width, which all friction of a joint has in common."""
    return effect.width is not None and effect.width.unit == "rad/s"


@lru_cache(maxsize=KEPT)
def _nonzero(jacobian: ca.Function) -> tuple[ca.Function, np.ndarray, np.ndarray]:
    """A Function with the elements of a Jacobian that are not 0 at all arguments, and their rows and columns."""
    arguments = jacobian.sx_in()
    found = ca.sparsify(jacobian.call(arguments)[0])
    rows, columns = (np.array(x, int) for x in found.sparsity().get_triplet())
    return ca.Function("nonzero", arguments, [ca.densify(ca.vec(found.nz[:]))]), rows, columns


def _gravity(body: Body) -> ca.SX:
    return ca.SX(ca.vertcat(*body.gravity) if isinstance(body.gravity, list) else body.gravity)


def _by_payload(recording: Recording, affine: Callable[[float], np.ndarray]) -> np.ndarray:
    """A function that is affine in the listed payload [kg], at every sample (K, …), or (1, …) if the payload is constant."""
    low, high = float(recording.payload.min()), float(recording.payload.max())
    first = affine(low)
    if low == high:
        return first[None]
    share = (recording.payload - low) / (high - low)
    return first + share.reshape(-1, *np.ones(first.ndim, int)) * (affine(high) - first)

"""The physics of one recording, with numbers: the torques that its motion needs, and what the sensors record of them."""

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial, wraps
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from rrr_oc.effects import Effect, FollowsLoad, LoopChange, MotionShift, MovesLink, OnlyRecorded, Signals, WithStates
from rrr_oc.model.motion import Motion
from rrr_oc.model.parameters import by_effect, for_each, offsets
from rrr_oc.model.shared_model import KEPT, shared_model
from rrr_oc.model.symbolic_model import Model
from rrr_oc.numerics.along import along
from rrr_oc.numerics.relaxation import relaxed

DIFFERENCE = 1e-4  # step of finite differences: this share of a parameter, or of 1 where the parameter is 0
# Substeps of a sampling interval, over which the rates of internal states are constant; doubled, it takes twice the time
PARTS = 4
WAIT = 5e-4  # [s], half the step of derivatives by a wait; doubled, no change
LATEST = 16  # delays of a motion that are kept; doubled, twice the memory
SWEEPS = 2  # iterations over coupled and nonlinear links behind elastic gears; doubled, it takes twice the time
# By joint: d (its load torque) / d (its own position) [Nm/rad] and d / d (its own acceleration) [kg m²], each (K,)
Reactions = dict[int, tuple[np.ndarray, np.ndarray]]
Result = TypeVar("Result")
# By the index of an effect: its displacement of the links as a function of its parameters, and at their present values (3 n, K)
Shifts = dict[int, tuple[Callable[[Mapping[str, float]], np.ndarray], np.ndarray]]

# By motion: load torques, and reactions of joints, of the last links that were asked for, and what they depend on
_OF_LINKS: WeakKeyDictionary[Motion, dict[Hashable, tuple[Hashable, Any]]] = WeakKeyDictionary()
# By motion and delay: the samples between which a signal was so long ago, with the share of the later one
_LATE: WeakKeyDictionary[Motion, dict[float, tuple[np.ndarray, np.ndarray, np.ndarray]]] = WeakKeyDictionary()


def _kept(find: Callable[..., Result]) -> Callable[..., Result]:
    """A method of `Physics` whose result is kept until it is called with another motion."""

    @wraps(find)
    def kept(self: "Physics", motion: Motion, *more: bool) -> Result:
        key = (find.__name__, *more)
        if key not in self._cache or self._cache[key][0] is not motion:
            self._cache[key] = motion, find(self, motion, *more)
        return self._cache[key][1]

    return kept


@dataclass(frozen=True)
class Physics:
    """A model with the numbers that go into it; `motion` below is the recorded one, as the encoders see it.

    Attributes:
        model: The robot with the springs that are mounted and the effects at work.
        theta: Parameters of the effects, as in `Model.theta`.
        widths: Smoothing widths, as in `Model.widths`.
        inertial: Inertial parameters of the links, (10, n).
        delays: By how much the recorded torque of each joint lags the motion [s], (n,); () for none.
        waits: By how much later than they are recorded the commands of each joint act [s], (n,); () for none.
    """

    model: Model
    theta: np.ndarray
    widths: np.ndarray
    inertial: np.ndarray
    delays: tuple[float, ...] = ()
    waits: tuple[float, ...] = ()
    _cache: dict[tuple[Any, ...], tuple[Motion, Any]] = field(default_factory=dict, init=False, compare=False, repr=False)

    @staticmethod
    def inputs(motion: Motion) -> tuple[np.ndarray, ...]:
        """q, dq, ddq, time and payload, the first arguments of `Model.motor_inverse`."""
        return motion.q, motion.dq, motion.ddq, motion.clock[None], motion.payload[None]

    @property
    def built(self) -> Model:
        """The model with `inertial` as its robot's own parameters, as the engine needs it."""
        return replace(self.model, robot=replace(self.model.robot, inertial=self.inertial))

    @cached_property
    def arm(self) -> "Physics":
        """The physics of the arm itself, without what is only in its records."""
        own = [not isinstance(effect, OnlyRecorded) for effect in self.model.effects]
        if all(own):
            return self
        kept = for_each(own, self.model.effects)
        effects = tuple(effect for effect, stays in zip(self.model.effects, own, strict=True) if stays)
        model = shared_model(self.model.robot, self.model.tool, effects)
        return Physics(model, self.theta[kept], self.widths, self.inertial, self.delays, self.waits)

    @_kept
    def torques(self, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
        """Motor torque and load torque that the motion needs, as perfect sensors record them, each (n, K) [Nm]."""
        states = self.states(motion)
        at_once = any(effect.side == "motion" or isinstance(effect, OnlyRecorded) for effect in self.model.effects)
        if self._load_depends_on is None or at_once:
            motor, load = self._evaluated(self.model.recorded_inverse, motion, self.shift(motion), states)
            return motor, load
        load = self._load(motion)
        (drive,) = along(self.model.drive_torque, *self.inputs(motion), self.theta, self.widths, load, states)
        return load - drive, load

    @cached_property
    def _load_depends_on(self) -> Hashable | None:
        """The parts of the physics on which the load torque of a rigid arm depends; None where on the drives as well."""
        links = [one for one in self.named() if one[0].side in ("link", "body")]
        if any(effect.states or {"load", "friction"} & set(effect.inputs) for effect, *_ in links):
            return None
        robot, tool = self.model.robot, self.model.tool
        arrays = robot.placements, robot.axes, robot.gravity, tool.position, self.inertial
        of_links = ((effect, tuple(theta.values()), width) for effect, theta, width in links)
        return (tool.joint, *of_links, *(np.asarray(x, float).tobytes() for x in arrays))

    def _shared(self, motion: Motion, name: Hashable, find: Callable[[], Result]) -> Result:
        """What follows from the load torque of a rigid arm along a motion, found once for all physics with the same links."""
        known, depends_on = _OF_LINKS.setdefault(motion, {}), self._load_depends_on
        if depends_on is None:
            return find()
        if name not in known or known[name][0] != depends_on:
            known[name] = depends_on, find()
        return known[name][1]

    def _evaluated(self, function: ca.Function, motion: Motion, shift: np.ndarray, states: np.ndarray) -> list[np.ndarray]:
        """Outputs of a function of the arguments of `Model.recorded_inverse`, with the links displaced by `shift` (3 n, K)."""
        return along(function, *self.inputs(motion), self.theta, self.widths, self.inertial, shift, states)

    def shift(self, motion: Motion) -> np.ndarray:
        """Motion of the links less the recorded one: q, dq, ddq, one below the other, (3 n, K)."""
        return _summed(self._moved(motion)[0], motion)

    def twist(self, motion: Motion) -> np.ndarray:
        """The part of `shift` that elastic gears cause: motion of the links less that of their drives, (3 n, K)."""
        effects, shifts = self.model.effects, self._moved(motion)[0]
        return _summed({i: shift for i, shift in shifts.items() if effects[i].moves_link}, motion)

    @_kept
    def _moved(self, motion: Motion) -> tuple[Shifts, Reactions]:
        """Displacements of the links by effect, and the reactions of the links behind elastic gears."""
        found: Shifts = {}
        reactions: Reactions = {}
        named = [(i, *one) for i, one in enumerate(self.named())]
        for i, effect, theta, width in named:
            if isinstance(effect, MotionShift):
                shift = partial(moved, motion, effect, width=width)
                found[i] = shift, shift(theta)
        elastic = [(i, effect, theta, width) for i, effect, theta, width in named if isinstance(effect, MovesLink)]
        for _ in range(SWEEPS if elastic else 0):  # a link's motion behind its gear follows from that of all other links
            joints = tuple(one[1].joints[0] for one in elastic)
            react = partial(self._reactions, motion, _summed(found, motion), joints)
            load, reactions = react() if found else self._shared(motion, joints, react)
            for i, effect, theta, width in elastic:
                (j,) = effect.joints
                needed = load[j].copy()  # load torque of a link that moves with its drive
                if i in found:
                    needed -= np.sum(np.array(reactions[j]) * found[i][1][[j, 2 * len(load) + j]], axis=0)
                felt = felt_load(motion, effect, needed)
                shift = partial(moved, motion, effect, width=width, felt=felt, reaction=reactions[j])
                found[i] = shift, shift(theta)
        return found, reactions

    @_kept
    def _load(self, motion: Motion) -> np.ndarray:
        """Load torque by which internal states follow, (n, K) [Nm]: without their own part in it."""

        def find() -> np.ndarray:
            states = np.zeros((len(self.model.states), len(motion.t)))
            return self._evaluated(self.model.recorded_load, motion, self.shift(motion), states)[0]

        return find() if any(effect.side == "motion" for effect in self.model.effects) else self._shared(motion, "load", find)

    def _reactions(self, motion: Motion, shift: np.ndarray, joints: tuple[int, ...]) -> tuple[np.ndarray, Reactions]:
        """Load torque (n, K) [Nm] with the links displaced by `shift` (3 n, K), and the reactions of some joints."""
        states = np.zeros((len(self.model.states), len(motion.t)))
        load, *found = self._evaluated(_with_reactions(self.model.recorded_load, joints), motion, shift, states)
        return load, {j: (by_q, by_ddq) for j, by_q, by_ddq in zip(joints, *found, strict=True)}

    @_kept
    def _partials(self, motion: Motion, load: bool) -> dict[tuple[str, int], np.ndarray]:
        """Derivatives of the motor torque, or of the load torque, by what effects change that are not of the instant, (n, K) each.

        Keys: "shift", "states" or "theta" and the number therein; of the parameters only those of effects with internal states.
        """
        n, effects, wanted, state = len(motion.q), self.model.effects, [], 0
        for effect, first in zip(effects, offsets(effects), strict=False):
            of_joint = [j + d * n for j in effect.joints for d in range(3 if effect.moves_link else 1)]
            wanted += [("shift", row) for row in of_joint if effect.side == "motion"]
            wanted += [("states", state + k) for k in range(len(effect.states))]
            wanted += [("theta", first + k) for k in range(len(effect.parameters)) if effect.states]
            state += len(effect.states)
        keys = tuple(dict.fromkeys(wanted))
        function = _with_partials(self.model.recorded_inverse, int(load), keys)
        (found,) = self._evaluated(function, motion, self.shift(motion), self.states(motion))
        return dict(zip(keys, np.moveaxis(found.reshape((n, len(keys), len(motion.t)), order="F"), 1, 0), strict=True))

    def by_differences(self, motion: Motion, numbers: Iterable[int], true: np.ndarray, load: bool) -> list[np.ndarray]:
        """Derivatives of the measured torque by the parameters of some effects, (n, K, p) for each effect.

        For effects whose torque is not a function of the instant alone: those of sensors, of motion, and with internal states. The
        change of what is recorded, of the links' motion or of the states is that of a small step of the parameter; the torque's
        derivatives by these are exact.

        Args:
            numbers: Indices of those effects in the model.
            true: The torque that a perfect sensor records, (n, K) [Nm].
            load: Whether that is the load torque, not the motor torque.
        """
        named, result = self.named(), []
        first = offsets(self.model.effects)
        for i in numbers:
            effect, theta, _ = named[i]
            columns = np.empty((*true.shape, len(effect.parameters)))
            for k, parameter in enumerate(effect.parameters):
                value = theta[parameter.name]
                step = DIFFERENCE * max(abs(value), 1.0 if value else DIFFERENCE)
                if effect.side == "sensor":
                    there = replace(self, theta=self.theta + step * (np.arange(len(self.theta)) == first[i] + k))
                    columns[:, :, k] = (there.measured(motion, true) - self.measured(motion, true)) / step
                    continue
                change = self._change(motion, i, theta | {parameter.name: value + step}, load) / step
                if effect.states:
                    change += self._partials(motion, load)["theta", int(first[i]) + k]
                columns[:, :, k] = self.passed_on(motion, change)
            result.append(columns)
        return result

    def _change(self, motion: Motion, i: int, theta: Mapping[str, float], load: bool) -> np.ndarray:
        """Change of the true torque (n, K) [Nm], to first order, as effect i moves the links or its states as with other parameters."""
        effect, _, width = self.named()[i]
        shifts, partials, result = self._moved(motion)[0], self._partials(motion, load), np.zeros(motion.q.shape)
        if i in shifts:
            change = shifts[i][0](theta) - shifts[i][1]
            for row in np.flatnonzero(np.any(change, axis=1)).tolist():
                result += partials["shift", row] * change[row]
        before = sum(len(one.states) for one in self.model.effects[:i])
        for k, course in enumerate(self._courses(motion, effect, theta, width)):
            result += partials["states", before + k] * (course - self.states(motion)[before + k])
        return result

    def _courses(self, motion: Motion, effect: Effect, theta: Mapping[str, float], width: Any) -> np.ndarray:
        """Internal states of an effect along the motion, (number, K)."""
        if not isinstance(effect, WithStates):
            return np.zeros((0, len(motion.t)))
        return states_along(motion, effect, theta, width, self._load(motion) if isinstance(effect, FollowsLoad) else None)

    def starts(self, motion: Motion, load: bool) -> np.ndarray:
        """Change of the measured torque with the unknown initial states of links behind elastic gears, (number, n, K) [Nm].

        To first order, for an initial deviation as large as the root mean square displacement of the link. `load`: whether the load
        torque is recorded, not the motor torque.
        """
        (shifts, reactions), n, named, found = self._moved(motion), len(motion.q), self.named(), []
        for i, (effect, theta, _) in enumerate(named):
            if not isinstance(effect, MovesLink):
                continue
            (j,) = effect.joints
            stiffness, inertia = reactions[j]
            parts = [effect.free(motion.t[s], stiffness[s], inertia[s], theta) for s in motion.segments]
            for k in range(len(parts[0])):
                usual, free = float(np.sqrt(np.mean(shifts[i][1][k * n + j] ** 2))), np.zeros((3, len(motion.t)))
                for s, part in zip(motion.segments, parts, strict=True):
                    free[:, s] = usual * part[k]
                by = [self._partials(motion, load)["shift", d * n + j] for d in range(3)]
                found.append(self.passed_on(motion, np.einsum("dnk,dk->nk", by, free)))
        return np.array(found).reshape(-1, n, len(motion.t))

    def recorded(self, motion: Motion, torque: np.ndarray) -> np.ndarray:
        """Torque that the sensors record of a true torque (n, K), by the effects of the side "sensor" and delays, (n, K) [Nm]."""
        return self.late(motion, self.measured(motion, torque)) + self._ahead(motion)

    def _ahead(self, motion: Motion) -> np.ndarray | float:
        """Torque that recorded commands ask for beyond those that act at the time, kp (q_d(t) − q_d(t − delay)), (n, K) [Nm]."""
        loop, command = getattr(motion, "loop", None), getattr(motion, "command", None)
        if loop is None or command is None or not any(self.waits):
            return 0.0
        return loop.kp[:, None] * (command - later(motion, command, self.waits))

    def by_waits(self, motion: Motion) -> np.ndarray:
        """Derivative of what is recorded by the time that the commands of its joint wait, (n, K) [Nm/s]; 0 without commands."""
        loop, command = getattr(motion, "loop", None), getattr(motion, "command", None)
        if loop is None or command is None:
            return np.zeros(motion.q.shape)
        waits = self.waits or (0.0,) * len(command)
        there, here = (later(motion, command, [wait + more for wait in waits]) for more in (WAIT, -WAIT))
        return loop.kp[:, None] * (here - there) / (2 * WAIT)

    def late(self, motion: Motion, x: np.ndarray) -> np.ndarray:
        """Torques (n, K) as late as they are recorded."""
        return later(motion, x, self.delays) if any(self.delays) else x

    def measured(self, motion: Motion, torque: np.ndarray) -> np.ndarray:
        """As `recorded`, without delays."""
        result = np.array(torque)
        for effect, theta, width in self.named():
            if effect.side == "sensor":
                signals = Signals(motion.q, load=torque, group=group_of(motion), braking=braking_of(motion))
                more = effect.torque(signals, theta, width)
                for j, one in zip(effect.on(len(torque)), more, strict=True):
                    result[j] += one
        return result

    def gains(self, motion: Motion) -> tuple[np.ndarray, np.ndarray] | None:
        """kp and kd (n,) of the loop at work where commands were recorded, [Nm/rad] and [Nm s/rad]; None where they were not."""
        loop = getattr(motion, "loop", None)
        if loop is None:
            return None
        kp, kd = np.array(loop.kp), np.array(loop.kd)
        for effect, theta, _ in self.named():
            if isinstance(effect, LoopChange):
                for j in effect.on(len(kp)):
                    kp[j], kd[j] = effect.gains(kp[j], kd[j], theta)
        return kp, kd

    def passed_on(self, motion: Motion, change: np.ndarray) -> np.ndarray:
        """Change of the measured torque with a change (n, K) of the true torque, (n, K) [Nm]."""
        if all(effect.side != "sensor" for effect in self.model.effects):
            return change
        return self.measured(motion, change) - self._of_nothing(motion)

    @_kept
    def _of_nothing(self, motion: Motion) -> np.ndarray:
        """What the sensors measure of no torque, (n, K) [Nm]."""
        return self.measured(motion, np.zeros(motion.q.shape))

    @_kept
    def states(self, motion: Motion) -> np.ndarray:
        """Internal states of the effects along the motion, (number of states, K)."""
        found = [self._courses(motion, *one) for one in self.named()]
        return np.concatenate([*found, np.zeros((0, len(motion.t)))])

    def named(self) -> list[tuple[Effect, dict[str, float], float | None]]:
        """Each effect with its parameters by name and its width."""
        widths = iter(self.widths.tolist())
        pairs = by_effect(self.model.effects, self.theta.tolist())
        return [(e, named, next(widths) if e.width is not None else None) for e, named in pairs]


@lru_cache(maxsize=KEPT)
def _with_reactions(load: ca.Function, joints: tuple[int, ...]) -> ca.Function:
    """Arguments of `Model.recorded_load` -> load torque, and the derivatives of joints' own by their positions and accelerations."""
    arguments = load.sx_in()
    shift, torque = arguments[load.index_in("shift")], load.call(arguments)[0]
    n = torque.numel()
    own = [ca.vertcat(*(ca.jacobian(torque[j], shift[d * n + j]) for j in joints)) for d in (0, 2)]
    return ca.Function("reactions", arguments, ca.cse([torque, *map(ca.densify, own)]))


@lru_cache(maxsize=KEPT)
def _with_partials(inverse: ca.Function, output: int, keys: tuple[tuple[str, int], ...]) -> ca.Function:
    """Arguments of `Model.recorded_inverse` -> derivatives of one of its outputs by elements of its arguments, (n, number of keys)."""
    arguments = inverse.sx_in()
    by = ca.vertcat(*(arguments[inverse.index_in(name)][k] for name, k in keys))
    partials = ca.densify(ca.jacobian(inverse.call(arguments)[output], by))
    return ca.Function("partials", arguments, ca.cse([partials]))


def _summed(shifts: Shifts, motion: Motion) -> np.ndarray:
    return sum((shift for _, shift in shifts.values()), np.zeros((3 * len(motion.q), len(motion.t))))


def group_of(motion: Motion) -> str | None:
    """Label of the set-up of a recorded motion."""
    return getattr(motion, "group", None)


def braking_of(motion: Motion) -> np.ndarray:
    """Torque kd dq (n, K) [Nm] of the loop whose commands were recorded along a motion; 0 where there is none."""
    loop = getattr(motion, "loop", None)
    return np.zeros(motion.q.shape) if loop is None else loop.braking(motion.dq)


def felt_load(motion: Motion, effect: MovesLink, load: np.ndarray) -> np.ndarray:
    """The load torque (K,) [Nm] that `MovesLink.motion` is given: smoothed where the effect says so."""
    return motion.smoothing(effect.window) @ load if effect.window else load


def moved(
    motion: Motion,
    effect: Effect,
    theta: Mapping[str, float],
    width: Any,
    felt: np.ndarray | None = None,
    reaction: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Motion of the links less the recorded one because of one effect: q, dq, ddq, one below the other, (3 n, K).

    Args:
        felt: As `felt_load` returns it for the load torque of a link that moves with its drive (K,) [Nm].
        reaction: Of the effect's joint, as in `Reactions`. Both are required where the link moves relative to its drive.
    """
    n = len(motion.q)
    result = np.zeros((3 * n, len(motion.t)))
    if isinstance(effect, MovesLink):
        assert felt is not None
        assert reaction is not None
        (j,), (stiffness, inertia) = effect.joints, reaction
        for s in motion.segments:
            result[[j, n + j, 2 * n + j], s] = effect.motion(motion.t[s], felt[s], stiffness[s], inertia[s], theta)
    if isinstance(effect, MotionShift):
        for j, shift in zip(effect.joints, effect.shift(Signals(motion.q, group=group_of(motion)), theta, width), strict=True):
            result[j] = np.array(shift).reshape(-1)
    return result


def later(motion: Motion, x: np.ndarray, delays: Sequence[float]) -> np.ndarray:
    """Signals (m, K) delayed by `delays` (m,) [s], within each segment; linear between samples."""
    result = np.array(x, float)
    for i in np.flatnonzero(delays).tolist():
        before, after, share = samples_before(motion, float(delays[i]))
        result[i] = x[i, before] * (1 - share) + x[i, after] * share
    return result


def samples_before(motion: Motion, delay: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The samples between which each sample was a delay [s] ago, within its segment, and the share of the later one, (K,) each."""
    known = _LATE.setdefault(motion, {})
    if delay not in known:
        before, share = np.arange(len(motion.t)), np.zeros(len(motion.t))
        for s in motion.segments:
            t = motion.t[s]
            if len(t) > 1:
                at = np.clip(np.searchsorted(t, t - delay, "right") - 1, 0, len(t) - 2)
                before[s], share[s] = s.start + at, np.clip((t - delay - t[at]) / (t[at + 1] - t[at]), 0.0, 1.0)
        while len(known) >= LATEST:
            known.pop(next(iter(known)))
        known[delay] = before, np.minimum(before + 1, len(motion.t) - 1), share
    return known[delay]


def states_along(
    motion: Motion, effect: WithStates, theta: Mapping[str, float], width: Any, load: np.ndarray | None = None
) -> np.ndarray:
    """Internal states (number, K) of an effect along a motion.

    By the load torque (n, K) [Nm] if it `FollowsLoad`; else from rates that are affine, each in its own state: the motion is linear
    between samples and the rates constant over each of `PARTS` substeps, so that reversals between samples count.
    """
    states = np.zeros((len(effect.states), len(motion.t)))
    for s in motion.segments:
        if isinstance(effect, FollowsLoad):
            assert load is not None
            states[:, s] = effect.course(motion.t[s], load[effect.joints[0], s], theta)
            continue
        signals = Signals(*(_Fine(x[:, s]) for x in (motion.q, motion.dq, motion.ddq)))
        count = (s.stop - s.start - 1) * PARTS + 1
        at = [effect.rate(replace(signals, states=np.full((len(states), count), z)), theta, width) for z in (0.0, 1.0)]
        constant, unit = ([np.broadcast_to(np.array(rate).reshape(-1), (count,)) for rate in rates] for rates in at)
        for i, state in enumerate(effect.states):
            states[i, s] = relaxed(motion.t[s], constant[i], unit[i] - constant[i], state.nominal)
    return states


@dataclass(frozen=True)
class _Fine:
    """Signals (n, K) interpolated linearly at the substeps, (K − 1) PARTS + 1, of those joints that are asked for."""

    coarse: np.ndarray

    def __getitem__(self, joint: Any) -> np.ndarray:
        x = self.coarse[joint]
        between = x[..., :-1, None] + np.diff(x)[..., None] * (np.arange(PARTS) / PARTS)
        return np.concatenate([between.reshape(*x.shape[:-1], -1), x[..., -1:]], axis=-1)

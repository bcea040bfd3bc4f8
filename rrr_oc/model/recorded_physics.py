"""The physics of one recording, with numbers: the torques that its motion needs, and what the sensors record of them."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial, wraps
from typing import Any, TypeVar

import numpy as np

from rrr_oc.effects import Effect, Signals
from rrr_oc.model.motion import Motion
from rrr_oc.model.symbolic_model import Model
from rrr_oc.numerics.along import along
from rrr_oc.numerics.oscillator import substituted

DIFFERENCE = 1e-4  # step of finite differences: this share of a parameter, or of 1 where the parameter is 0
# Substeps of a sampling interval, over which the rates of internal states are constant; doubled, it takes twice the time
PARTS = 4
SWEEPS = 2  # iterations over coupled and nonlinear links behind elastic gears; doubled, it takes twice the time
# Of joint j: d (its load torque) / d (its own position) [Nm/rad] and d / d (its own acceleration) [kg m²], each (K,)
Reaction = Callable[[int], tuple[np.ndarray, np.ndarray]]
Result = TypeVar("Result")
# By the index of an effect: its displacement of the links as a function of its parameters, and at their present values (3 n, K)
Shifts = dict[int, tuple[Callable[[Mapping[str, float]], np.ndarray], np.ndarray]]


def _kept(find: Callable[["Physics", Motion], Result]) -> Callable[["Physics", Motion], Result]:
    """A method of `Physics` whose result is kept until it is called with another motion."""

    @wraps(find)
    def kept(self: "Physics", motion: Motion) -> Result:
        name = find.__name__
        if name not in self._cache or self._cache[name][0] is not motion:
            self._cache[name] = motion, find(self, motion)
        return self._cache[name][1]

    return kept


@dataclass(frozen=True)
class Physics:
    """A model with the numbers that go into it; `motion` below is the recorded one, as the encoders see it.

    Attributes:
        model: The robot with the springs that are mounted and the effects at work.
        theta: Parameters of the effects, as in `Model.theta`.
        widths: Smoothing widths, as in `Model.widths`.
        inertial: Inertial parameters of the links, (10, n).
    """

    model: Model
    theta: np.ndarray
    widths: np.ndarray
    inertial: np.ndarray
    _cache: dict[str, tuple[Motion, Any]] = field(default_factory=dict, init=False, compare=False, repr=False)

    @staticmethod
    def inputs(motion: Motion) -> tuple[np.ndarray, ...]:
        """q, dq, ddq, time and payload, the first arguments of `Model.motor_inverse`."""
        return motion.q, motion.dq, motion.ddq, motion.clock[None], motion.payload[None]

    @property
    def built(self) -> Model:
        """The model with `inertial` as its robot's own parameters, as the engine needs it."""
        return replace(self.model, robot=replace(self.model.robot, inertial=self.inertial))

    @_kept
    def torques(self, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
        """Motor torque and load torque that the motion needs, each (n, K) [Nm]."""
        states = self.states(motion)
        if not len(states) and all(effect.side != "motion" for effect in self.model.effects):
            values = (self.theta, self.widths, self.inertial)
            motor, load = along(self.model.motor_inverse, *self.inputs(motion), *values)
            return motor, load
        return self._moving(motion, self.shift(motion), states)

    def _moving(self, motion: Motion, shift: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Motor and load torque with the links displaced by `shift` (3 n, K) and these internal states, each (n, K) [Nm]."""
        values = (self.theta, self.widths, self.inertial)
        motor, load = along(self.model.recorded_inverse, *self.inputs(motion), *values, shift, states)
        return motor, load

    def shift(self, motion: Motion) -> np.ndarray:
        """Motion of the links less the recorded one: q, dq, ddq, one below the other, (3 n, K)."""
        return _summed(self._moved(motion)[0], motion)

    def twist(self, motion: Motion) -> np.ndarray:
        """The part of `shift` that elastic gears cause: motion of the links less that of their drives, (3 n, K)."""
        effects, shifts = self.model.effects, self._moved(motion)[0]
        return _summed({i: shift for i, shift in shifts.items() if effects[i].moves_link}, motion)

    @_kept
    def _moved(self, motion: Motion) -> tuple[Shifts, Reaction | None]:
        """Displacements of the links by effect, and the reaction of the links behind elastic gears if there are any."""
        found: Shifts = {}
        reaction = None
        displacing = [(i, *one) for i, one in enumerate(self.named()) if one[0].side == "motion"]
        rigid, elastic = ([one for one in displacing if one[1].moves_link == by_itself] for by_itself in (False, True))
        for i, effect, theta, width in rigid:
            shift = partial(moved, motion, effect, width=width)
            found[i] = shift, shift(theta)
        for _ in range(SWEEPS if elastic else 0):  # a link's motion behind its gear follows from that of all other links
            total = _summed(found, motion)
            load = self._load(motion, total)
            reaction = cache(partial(self._reaction, motion, load, total))
            for i, effect, theta, width in elastic:
                (j,) = effect.joints
                needed = load.copy()  # load torque of a link that moves with its drive
                if i in found:
                    needed[j] -= np.sum(np.array(reaction(j)) * found[i][1][[j, 2 * len(load) + j]], axis=0)
                shift = partial(moved, motion, effect, width=width, load=needed, reaction=reaction)
                found[i] = shift, shift(theta)
        return found, reaction

    def _load(self, motion: Motion, shift: np.ndarray) -> np.ndarray:
        """Load torque with the links displaced by `shift` (3 n, K), (n, K) [Nm]."""
        states = np.zeros((len(self.model.states), len(motion.t)))
        values = (self.theta, self.widths, self.inertial)
        return along(self.model.recorded_load, *self.inputs(motion), *values, shift, states)[0]

    def _reaction(self, motion: Motion, load: np.ndarray, shift: np.ndarray, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of joint j's load torque by its own position [Nm/rad] and acceleration [kg m²], each (K,)."""
        found = []
        for row, step in ((j, 1e-4), (2 * self.model.robot.n + j, 1.0)):
            there = shift.copy()
            there[row] += step
            found.append((self._load(motion, there)[j] - load[j]) / step)
        return found[0], found[1]

    def by_differences(self, motion: Motion, numbers: Iterable[int], true: np.ndarray, load: bool) -> list[np.ndarray]:
        """Derivatives of the recorded torque by the parameters of some effects, by forward differences, (n, K, p) for each effect.

        For effects whose torque is not a function of the instant alone: those of sensors, of motion, and with internal states.

        Args:
            numbers: Indices of those effects in the model.
            true: The torque that a perfect sensor records, (n, K) [Nm].
            load: Whether that is the load torque, not the motor torque.
        """
        named, shifts, states = self.named(), self._moved(motion)[0], self.states(motion)
        base, total, result = self.recorded(motion, true), _summed(shifts, motion), []
        first = np.cumsum([0, *(len(effect.parameters) for effect, *_ in named)])
        for i in numbers:
            effect, theta, _ = named[i]
            columns = np.empty((*base.shape, len(effect.parameters)))
            for k, parameter in enumerate(effect.parameters):
                value = theta[parameter.name]
                step = DIFFERENCE * max(abs(value), 1.0 if value else DIFFERENCE)
                there = replace(self, theta=self.theta + step * (np.arange(len(self.theta)) == first[i] + k))
                torque = true
                if effect.side != "sensor":
                    shift = total
                    if i in shifts:
                        shift = total - shifts[i][1] + shifts[i][0](theta | {parameter.name: value + step})
                    torque = there._moving(motion, shift, there.states(motion) if effect.states else states)[load]
                columns[:, :, k] = (there.recorded(motion, torque) - base) / step
            result.append(columns)
        return result

    def starts(self, motion: Motion, load: bool) -> np.ndarray:
        """Change of the recorded torque with the unknown initial states of links behind elastic gears, (number, n, K) [Nm].

        To first order, for an initial deviation as large as the root mean square displacement of the link. `load`: whether the load
        torque is recorded, not the motor torque.
        """
        (shifts, reaction), states, n = self._moved(motion), self.states(motion), len(motion.q)
        total, base, named, found = _summed(shifts, motion), self.torques(motion)[load], self.named(), []
        for i, (effect, theta, _) in ((i, named[i]) for i in shifts if named[i][0].moves_link):
            (j,) = effect.joints
            assert reaction is not None
            stiffness, inertia = reaction(j)
            parts = [effect.free(motion.t[s], stiffness[s], inertia[s], theta) for s in motion.segments]
            for k in range(len(parts[0])):
                there = total.copy()
                usual = float(np.sqrt(np.mean(shifts[i][1][k * n + j] ** 2)))
                for s, part in zip(motion.segments, parts, strict=True):
                    there[[j, n + j, 2 * n + j], s] += DIFFERENCE * usual * part[k]
                found.append(self._moving(motion, there, states)[load] - base)
        return np.array([self.passed_on(motion, x) for x in found]).reshape(-1, n, len(motion.t)) / DIFFERENCE

    def recorded(self, motion: Motion, torque: np.ndarray) -> np.ndarray:
        """Torque that the sensors record of a true torque (n, K), by the effects of the side "sensor", (n, K) [Nm]."""
        result, delay = np.array(torque), 0.0
        for effect, theta, width in self.named():
            if effect.side == "sensor":
                delay += effect.delay(theta)
                for j, more in zip(effect.joints, effect.torque(Signals(motion.q, load=torque), theta, width), strict=True):
                    result[j] += more
        return later(motion, result, delay) if delay else result

    def passed_on(self, motion: Motion, change: np.ndarray) -> np.ndarray:
        """Change of the recorded torque with a change (n, K) of the true torque, (n, K) [Nm]."""
        if all(effect.side != "sensor" for effect in self.model.effects):
            return change
        return self.recorded(motion, change) - self.recorded(motion, np.zeros_like(change))

    @_kept
    def states(self, motion: Motion) -> np.ndarray:
        """Internal states of the effects along the motion, (number of states, K)."""
        named = [one for one in self.named() if one[0].states]
        load = self._load(motion, self.shift(motion)) if any(effect.dynamics == "load_states" for effect, *_ in named) else None
        found = [states_along(motion, *one, load) for one in named]
        return np.concatenate([*found, np.zeros((0, len(motion.t)))])

    def named(self) -> list[tuple[Effect, dict[str, float], float | None]]:
        """Each effect with its parameters by name and its width."""
        numbers, widths = iter(self.theta.tolist()), iter(self.widths.tolist())
        return [
            (e, {p.name: next(numbers) for p in e.parameters}, next(widths) if e.width is not None else None)
            for e in self.model.effects
        ]


def _summed(shifts: Shifts, motion: Motion) -> np.ndarray:
    return sum((shift for _, shift in shifts.values()), np.zeros((3 * len(motion.q), len(motion.t))))


def moved(
    motion: Motion,
    effect: Effect,
    theta: Mapping[str, float],
    width: Any,
    load: np.ndarray | None = None,
    reaction: Reaction | None = None,
) -> np.ndarray:
    """Motion of the links less the recorded one because of one effect: q, dq, ddq, one below the other, (3 n, K).

    Args:
        load: Load torque of links that move with their drives (n, K) [Nm].
        reaction: As `Reaction`. Both are required where the link moves relative to its drive.
    """
    n = len(motion.q)
    result = np.zeros((3 * n, len(motion.t)))
    if effect.moves_link:
        assert load is not None
        assert reaction is not None
        for j in effect.joints:
            stiffness, inertia = reaction(j)
            felt = motion.smoothing(effect.window) @ load[j] if effect.window else load[j]
            for s in motion.segments:
                result[[j, n + j, 2 * n + j], s] = effect.motion(motion.t[s], felt[s], stiffness[s], inertia[s], theta)
        return result
    for j, shift in zip(effect.joints, effect.shift(Signals(motion.q), theta, width), strict=True):
        result[j] = np.array(shift).reshape(-1)
    return result


def later(motion: Motion, x: np.ndarray, delay: float) -> np.ndarray:
    """Signals (m, K) delayed by `delay` [s], within each segment."""
    result = np.array(x)
    for s in motion.segments:
        t = motion.t[s]
        for row in result:
            row[s] = np.interp(t - delay, t, row[s])
    return result


def states_along(
    motion: Motion, effect: Effect, theta: Mapping[str, float], width: Any, load: np.ndarray | None = None
) -> np.ndarray:
    """Internal states (number, K) of an effect along a motion.

    By the load torque (n, K) [Nm] if `dynamics` is "load_states"; else from rates that are affine, each in its own state: the motion
    is linear between samples and the rates constant over each of `PARTS` substeps, so that reversals between samples count.
    """
    states = np.zeros((len(effect.states), len(motion.t)))
    for s in motion.segments:
        if effect.dynamics == "load_states":
            assert load is not None
            states[:, s] = effect.course(motion.t[s], load[effect.joints[0], s], theta)
            continue
        signals = Signals(*(_finely(x[:, s]) for x in (motion.q, motion.dq, motion.ddq)))
        count = signals.q.shape[1]
        h = np.repeat(np.diff(motion.t[s]) / PARTS, PARTS)
        at = [effect.rate(replace(signals, states=np.full((len(states), count), z)), theta, width) for z in (0.0, 1.0)]
        constant, unit = ([np.broadcast_to(np.array(rate).reshape(-1), (count,)) for rate in rates] for rates in at)
        for i, state in enumerate(effect.states):
            slope = unit[i] - constant[i]
            a, b = (((x[1:] + x[:-1]) / 2) * h for x in (constant[i], slope))
            bounded = np.clip(b, -700, 50)
            keep = np.exp(bounded)
            gain = np.where(np.abs(b) > 1e-8, np.expm1(bounded) / np.where(b == 0, 1, b), 1.0) * a
            steps = np.array([np.ones(count), np.append(-keep, 0.0)])  # z_k+1 − keep_k z_k = gain_k
            states[i, s] = substituted(steps, np.append(state.nominal, gain))[::PARTS]
    return states


def _finely(x: np.ndarray) -> np.ndarray:
    """Signals (n, K) interpolated linearly at the substeps, (n, (K − 1) PARTS + 1)."""
    share = np.arange(PARTS) / PARTS
    between = x[:, :-1, None] + np.diff(x, axis=1)[:, :, None] * share
    return np.concatenate([between.reshape(len(x), -1), x[:, -1:]], axis=1)

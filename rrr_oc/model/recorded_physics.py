"""What is at work in one recording, with numbers: the torques that its motion needs, and what sensors make of them."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any

import numpy as np

from rrr_oc.effects import Effect, Signals
from rrr_oc.model.symbolic_model import Model
from rrr_oc.numerics.along import along
from rrr_oc.numerics.oscillator import substituted
from rrr_oc.numerics.savitzky_golay import as_matrix
from rrr_oc.recordings.recording import Recording

DIFFERENCE = 1e-4  # of a parameter, or of 1 where it is less, by which derivatives are taken where no expression gives them
PARTS = 4  # of a sample's step, for internal states
SWEEPS = 2  # over the links that move by themselves, for what they do to one another and what is not linear
Reaction = Callable[[int], tuple[np.ndarray, np.ndarray]]
Shifts = dict[int, tuple[Callable[[Mapping[str, float]], np.ndarray], np.ndarray]]


class _Memory:
    """Results for one recording: owned by a `Physics`, by name, until another recording is asked for."""

    def __init__(self) -> None:
        self._recording: Recording | None = None
        self._found: dict[str, Any] = {}

    def once(self, name: str, find: Callable[[Recording], Any], recording: Recording) -> Any:
        """What `find` returns for a recording, computed at the first call."""
        if recording is not self._recording:
            self._recording, self._found = recording, {}
        if name not in self._found:
            self._found[name] = find(recording)
        return self._found[name]


@dataclass(frozen=True)
class Physics:
    """What is at work in one recording: the model with listed springs and terms, and the numbers that go into it."""

    model: Model
    theta: np.ndarray
    widths: np.ndarray
    inertial: np.ndarray
    _memory: _Memory = field(default_factory=_Memory, init=False, compare=False, repr=False)

    @staticmethod
    def inputs(recording: Recording) -> tuple[np.ndarray, ...]:
        """q, dq, ddq, time and payload, the first arguments of `Model.motor_inverse`."""
        r = recording
        return r.q, r.dq, r.ddq, r.clock[None], r.payload[None]

    @property
    def built(self) -> Model:
        """The model with these links, for what does not take them as numbers: an engine."""
        return replace(self.model, robot=replace(self.model.robot, inertial=self.inertial))

    def torques(self, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
        """Motor torque and load torque that the recorded motion needs, each (n, K) [Nm]."""
        return self._memory.once("torques", self._find_torques, recording)

    def _find_torques(self, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
        states = self.states(recording)
        if not len(states) and all(effect.side != "motion" for effect in self.model.effects):
            inputs = self.inputs(recording)
            motor, load = along(self.model.motor_inverse, *inputs, self.theta, self.widths, self.inertial)
            return motor, load
        return self._moving(recording, self.shift(recording), states)

    def _moving(self, recording: Recording, shift: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Motor torque and load torque with a shift of the links (3 n, K) and states of the effects."""
        values = (self.theta, self.widths, self.inertial)
        motor, load = along(self.model.recorded_inverse, *self.inputs(recording), *values, shift, states)
        return motor, load

    def shift(self, recording: Recording) -> np.ndarray:
        """What the links move otherwise than the recorded motion: q, dq, ddq, one below the other, (3 n, K)."""
        return _summed(self._moved(recording)[0], recording)

    def twist(self, recording: Recording) -> np.ndarray:
        """The part of `shift` by which links move by themselves behind their gears."""
        effects, shifts = self.model.effects, self._moved(recording)[0]
        return _summed({i: shift for i, shift in shifts.items() if effects[i].moves_link}, recording)

    def _moved(self, recording: Recording) -> tuple[Shifts, Reaction | None]:
        """For each effect that moves the links, by its number, its shift as a function of its parameters, and the shift.

        Beside them what the links that move by themselves meet, if there are any.
        """
        return self._memory.once("moved", self._find_moved, recording)

    def _find_moved(self, recording: Recording) -> tuple[Shifts, Reaction | None]:
        found: Shifts = {}
        total = _summed(found, recording)
        motion = [(i, *one) for i, one in enumerate(self.named()) if one[0].side == "motion"]
        reaction = None
        rigid, alone = ([one for one in motion if one[1].moves_link == by_itself] for by_itself in (False, True))
        for i, effect, theta, width in rigid:
            shift = partial(moved, recording, effect, width=width)
            found[i] = shift, shift(theta)
        for _ in range(SWEEPS if alone else 0):  # what a link does behind its gear follows from the motion that all else makes
            total = _summed(found, recording)
            load = self._load(recording, total)
            reaction = cache(partial(self._reaction, recording, load, total))
            for i, effect, theta, width in alone:
                (j,) = effect.joints
                needed = load.copy()  # by the link if it moved with its drive
                if i in found:
                    needed[j] -= np.sum(np.array(reaction(j)) * found[i][1][[j, 2 * len(load) + j]], axis=0)
                shift = partial(moved, recording, effect, width=width, load=needed, reaction=reaction)
                found[i] = shift, shift(theta)
        return found, reaction

    def _load(self, recording: Recording, shift: np.ndarray) -> np.ndarray:
        """Load torque (n, K) [Nm] of the motion that differs from the recorded one by `shift` (3 n, K)."""
        states = np.zeros((len(self.model.states), len(recording.t)))
        values = (self.theta, self.widths, self.inertial)
        return along(self.model.recorded_load, *self.inputs(recording), *values, shift, states)[0]

    def _reaction(self, recording: Recording, load: np.ndarray, shift: np.ndarray, j: int) -> tuple[np.ndarray, np.ndarray]:
        """By how much joint j's load torque grows with its own position and acceleration, K [Nm/rad] and M [kg m²], each (K,)."""
        found = []
        for row, step in ((j, 1e-4), (2 * self.model.robot.n + j, 1.0)):
            there = shift.copy()
            there[row] += step
            found.append((self._load(recording, there)[j] - load[j]) / step)
        return found[0], found[1]

    def by_differences(self, recording: Recording, numbers: Iterable[int], true: np.ndarray, load: bool) -> list[np.ndarray]:
        """Derivatives of what is recorded by the parameters of effects that do not add a torque of the instant, (n, K, p) each.

        Args:
            numbers: Of those effects.
            true: What a perfect sensor has, (n, K) [Nm].
            load: Whether that is the load torque, not the motor torque.
        """
        named, shifts, states = self.named(), self._moved(recording)[0], self.states(recording)
        base, total, result = self.recorded(recording, true), _summed(shifts, recording), []
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
                    torque = there._moving(recording, shift, there.states(recording) if effect.states else states)[load]
                columns[:, :, k] = (there.recorded(recording, torque) - base) / step
            result.append(columns)
        return result

    def starts(self, recording: Recording, load: bool) -> np.ndarray:
        """By how much what is recorded may differ because nobody knows how a stretch began, (number, n, K) [Nm], to first order.

        For starts that are as far off as the links move otherwise than recorded, on the average.

        Args:
            load: Whether the load torque is recorded, not the motor torque.
        """
        (shifts, reaction), states, n = self._moved(recording), self.states(recording), len(recording.q)
        total, base, named, found = _summed(shifts, recording), self.torques(recording)[load], self.named(), []
        for i in [i for i in shifts if named[i][0].moves_link]:
            effect, theta, _ = named[i]
            (j,) = effect.joints
            assert reaction is not None
            stiffness, inertia = reaction(j)
            parts = [effect.free(recording.t[s], stiffness[s], inertia[s], theta) for s in recording.segments]
            for k in range(len(parts[0])):
                there = total.copy()
                usual = float(np.sqrt(np.mean(shifts[i][1][k * n + j] ** 2)))
                for s, part in zip(recording.segments, parts, strict=True):
                    there[[j, n + j, 2 * n + j], s] += DIFFERENCE * usual * part[k]
                found.append(self._moving(recording, there, states)[load] - base)
        return np.array([self.passed_on(recording, x) for x in found]).reshape(-1, n, len(recording.t)) / DIFFERENCE

    def recorded(self, recording: Recording, torque: np.ndarray) -> np.ndarray:
        """What sensors make of a torque (n, K), as the effects of the side "sensor" say."""
        result, delay = np.array(torque), 0.0
        for effect, theta, width in self.named():
            if effect.side == "sensor":
                delay += effect.delay(theta)
                for j, more in zip(effect.joints, effect.torque(Signals(recording.q, load=torque), theta, width), strict=True):
                    result[j] += more
        return later(recording, result, delay) if delay else result

    def passed_on(self, recording: Recording, change: np.ndarray) -> np.ndarray:
        """What sensors make of a change (n, K) of the true torque."""
        if all(effect.side != "sensor" for effect in self.model.effects):
            return change
        return self.recorded(recording, change) - self.recorded(recording, np.zeros_like(change))

    def states(self, recording: Recording) -> np.ndarray:
        """Internal states of the effects along the recording, (number of states, K)."""
        return self._memory.once("states", self._find_states, recording)

    def _find_states(self, recording: Recording) -> np.ndarray:
        named = [one for one in self.named() if one[0].states]
        load = (
            self._load(recording, self.shift(recording))
            if any(effect.dynamics == "load_states" for effect, *_ in named)
            else None
        )
        found = [states_along(recording, *one, load) for one in named]
        return np.concatenate([*found, np.zeros((0, len(recording.t)))])

    def named(self) -> list[tuple[Effect, dict[str, float], float | None]]:
        """Each effect with its parameters by name and its width."""
        numbers, widths = iter(self.theta.tolist()), iter(self.widths.tolist())
        return [
            (e, {p.name: next(numbers) for p in e.parameters}, next(widths) if e.width is not None else None)
            for e in self.model.effects
        ]


def _summed(shifts: Shifts, recording: Recording) -> np.ndarray:
    return sum((shift for _, shift in shifts.values()), np.zeros((3 * len(recording.q), len(recording.t))))


def moved(
    recording: Recording,
    effect: Effect,
    theta: Mapping[str, float],
    width: Any,
    load: np.ndarray | None = None,
    reaction: Reaction | None = None,
) -> np.ndarray:
    """What the links move otherwise than the recorded motion because of one effect: q, dq, ddq, one below the other, (3 n, K).

    Args:
        load: Torque that the link would need if it moved with its drive (n, K) [Nm].
        reaction: From joint j to by how much its load torque grows with its position [Nm/rad] and acceleration [kg m²], (K,) each.
            Both are needed where the link moves by itself.
    """
    n = len(recording.q)
    result = np.zeros((3 * n, len(recording.t)))
    if effect.moves_link:
        assert load is not None
        assert reaction is not None
        for j in effect.joints:
            stiffness, inertia = reaction(j)
            felt = _smoothed(recording, load[j], effect.window)
            for s in recording.segments:
                result[[j, n + j, 2 * n + j], s] = effect.motion(recording.t[s], felt[s], stiffness[s], inertia[s], theta)
        return result
    for j, shift in zip(effect.joints, effect.shift(Signals(recording.q), theta, width), strict=True):
        result[j] = np.array(shift).reshape(-1)
    return result


def _smoothed(recording: Recording, x: np.ndarray, window: float) -> np.ndarray:
    """A signal (K,) smoothed over a window [s], within each segment; by a matrix that is made once a recording."""
    if not window:
        return x
    key = "once", window
    if key not in recording.filters:
        recording.filters[key] = as_matrix(recording.t, recording.segments, window)
    return recording.filters[key] @ x


def later(recording: Recording, x: np.ndarray, delay: float) -> np.ndarray:
    """Signals (m, K) as they were a delay [s] before, within each segment."""
    result = np.array(x)
    for s in recording.segments:
        t = recording.t[s]
        for row in result:
            row[s] = np.interp(t - delay, t, row[s])
    return result


def states_along(
    recording: Recording, effect: Effect, theta: Mapping[str, float], width: Any, load: np.ndarray | None = None
) -> np.ndarray:
    """Internal states (number, K) of an effect, which the load torque (n, K) [Nm] drives, or whose rates are affine in them, each in
    its own.

    Motion is taken as linear between samples, and the rates as constant over each of `PARTS` of a sample's step: where a joint turns
    around, its way within the step is what a bristle feels.
    """
    states = np.zeros((len(effect.states), len(recording.t)))
    for s in recording.segments:
        if effect.dynamics == "load_states":
            assert load is not None
            states[:, s] = effect.course(recording.t[s], load[effect.joints[0], s], theta)
            continue
        signals = Signals(*(_finely(x[:, s]) for x in (recording.q, recording.dq, recording.ddq)))
        count = signals.q.shape[1]
        h = np.repeat(np.diff(recording.t[s]) / PARTS, PARTS)
        constant, unit = (
            [
                np.broadcast_to(np.array(v).reshape(-1), (count,))
                for v in effect.rate(replace(signals, states=np.full((len(states), count), z)), theta, width)
            ]
            for z in (0.0, 1.0)
        )
        for i, state in enumerate(effect.states):
            slope = unit[i] - constant[i]
            a, b = (((x[1:] + x[:-1]) / 2) * h for x in (constant[i], slope))
            keep = np.exp(np.clip(b, -700, 50))
            gain = np.where(np.abs(b) > 1e-8, np.expm1(np.clip(b, -700, 50)) / np.where(b == 0, 1, b), 1.0) * a
            steps = np.array([np.ones(count), np.append(-keep, 0.0)])  # z_k+1 − keep_k z_k = gain_k
            states[i, s] = substituted(steps, np.append(state.nominal, gain))[::PARTS]
    return states


def _finely(x: np.ndarray) -> np.ndarray:
    """Signals (n, K) with `PARTS` − 1 values between each two, on the line between them."""
    share = np.arange(PARTS) / PARTS
    between = x[:, :-1, None] + np.diff(x, axis=1)[:, :, None] * share
    return np.concatenate([between.reshape(len(x), -1), x[:, -1:]], axis=1)

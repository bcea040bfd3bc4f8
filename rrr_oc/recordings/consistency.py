"""Whether the columns of a recording set fit each other and the robot: signs, order, units, clocks, and what the motions show.

A joint's torque is compared with the rigid arm's, plus friction that opposes motion, the rotor's inertia and an offset, all by linear
least squares. Where another reading of the columns explains the torques much better, it is named.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from scipy.optimize import nnls

from rrr_oc.effects import Effect
from rrr_oc.model.symbolic_model import Model
from rrr_oc.numerics.along import along
from rrr_oc.recordings.header import EFFORTS
from rrr_oc.recordings.plausibility import DEGREES
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.robot.rigid_body import rigid_body

SAMPLES = 600  # of all recordings together that are compared; doubled, the check takes twice as long
WIDTH = 0.02  # [rad/s] over which dry friction changes sign; doubled, slow motions fit a little worse
LEAST_ERROR = 0.03  # NRMSE below which smaller is no better: what smoothing leaves; doubled, mends of small errors are missed
BAD, BETTER, GOOD = 0.5, 0.5, 0.35  # a mend is for an error above the first, leaves this share of it, and no more than the last
SURE = 2.5  # fall of the summed logarithms with which a mend is for any error; at 1.5, an arm with a missing spring gets one
WORTH = 0.7  # fall of the summed logarithms of the errors that a mend must bring: a factor of two; doubled, one of four
MENDS = 4  # most mends, one after the other; doubled, sets with more than four mistakes are told of more of them
SCALES = (1 / 8, 8.0)  # a torque so much smaller or larger than the arm's is in another unit; at 3, a missing payload is one
LEAST_LOAD = 0.3  # share of a torque's deviation that the arm's must have to tell its unit; doubled, geared arms have none
LAGS = 0.3  # [s] up to which clocks are compared; doubled, slower links are seen and the check takes longer
LATE = 0.04, 1.5  # [s] and sampling steps of a lag that is said; filters, drivers and friction at reversals have less
LAG_GAIN = 0.6  # share of the error that a lag leaves at most; at 0.8, friction at reversals is taken for one
LAG_STEP = 0.01  # [s] between two lags that are tried; doubled, a lag is told half as exactly
# Most rotor inertia, over the link's own and over the arm's largest; doubled, springs pass for it in slow sweeps
ROTOR = 30.0, 0.3
MOVES = 0.05  # [rad] of travel, below which a joint tells nothing of its friction
SEEN = 0.1  # share of a torque's noise that accelerations must make to show inertia; at 0.3, light wrists are warned of
DIAGNOSIS = 2.0, 30.0  # [s] of a diagnosis for each joint, where nothing is missing and where much is (two and six joints)
NOTHING = 1e-9  # [Nm], below which the robot's file has no inertia there
UNITS = {1e3: "mNm", 1e2: "Ncm", 9.80665: "kgf m", 980.665: "gf m", 98.0665: "kgf cm", 1e-3: "kNm", 0.112985: "in lbf"}


@dataclass(frozen=True)
class Reading:
    """How columns are read: joint j's position is `signs[j]` times the column of joint `order[j]`, and its torque, or
    its command, likewise.

    Attributes:
        signs, order: Of positions and their rates, (n,) each; a sign is another factor than ±1 where the unit is another.
        torque_signs, torque_order: Of torques or commands, (n,) each.
    """

    signs: tuple[float, ...]
    order: tuple[int, ...]
    torque_signs: tuple[float, ...]
    torque_order: tuple[int, ...]

    @classmethod
    def as_given(cls, n: int) -> "Reading":
        """Every column as its name says."""
        return cls((1.0,) * n, tuple(range(n)), (1.0,) * n, tuple(range(n)))


@dataclass(frozen=True)
class Doubt:
    """What looks wrong in a set.

    Attributes:
        kind: "sign", "order", "unit", "payload", "clock" or "excitation".
        columns: The columns that it is about.
        said: A sentence with the columns, the figures and the mend, without a full stop.
        before, after: NRMSE of the worst joint concerned without and with the mend; None where nothing is mended.
    """

    kind: str
    columns: tuple[str, ...]
    said: str
    before: float | None = None
    after: float | None = None


@dataclass(frozen=True)
class Consistency:
    """What a check found.

    Attributes:
        doubts: What looks wrong.
        nrmse: Of each joint's torque as the set is given, (n,).
        diagnosis_s: Least and greatest processor time that a diagnosis usually takes [s].
    """

    doubts: tuple[Doubt, ...]
    nrmse: tuple[float, ...]
    diagnosis_s: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Samples:
    """Some samples of all recordings, at even distances.

    Attributes:
        recordings: The set.
        rows: Of each recording, the rows that are used.
        lag: Time that torques are read later by [s].
    """

    recordings: RecordingSet
    rows: tuple[np.ndarray, ...]
    lag: float = 0.0

    @cached_property
    def torque(self) -> np.ndarray:
        """Recorded torque at the output [Nm], or commands [rad], (n, K)."""
        parts = []
        for r, rows in zip(self.recordings.recordings, self.rows, strict=True):
            torque = self.recordings.output_torque(r) if r.command is None else r.command
            parts.append(
                torque[:, rows] if not self.lag else np.array([np.interp(r.t[rows] + self.lag, r.t, x) for x in torque])
            )
        return np.concatenate(parts, axis=1)

    def motion(self, reading: Reading, rates: bool = True) -> list[tuple[Recording, np.ndarray, np.ndarray]]:
        """By recording, its motion (3, n, K) as it is read, at rest if not `rates`, and its payload (1, K)."""
        order, signs, found = list(reading.order), np.array(reading.signs)[:, None], []
        for r, rows in zip(self.recordings.recordings, self.rows, strict=True):
            motion = np.array([signs * x[order][:, rows] for x in (r.q, r.dq, r.ddq)])
            motion[1:] *= rates
            found.append((r, motion, r.payload[None, rows]))
        return found

    def read(self, reading: Reading, given: np.ndarray) -> np.ndarray:
        """The torque at the output [Nm], (n, K), by `torque` as it is read; of commands with the motion as it is read."""
        given = np.array(reading.torque_signs)[:, None] * given[list(reading.torque_order)]
        loop = self.recordings.recordings[0].loop
        if loop is None:
            return given
        q, dq, _ = np.concatenate([motion for _, motion, _ in self.motion(reading)], axis=2)
        return loop.torque(given, q, dq)

    def load(self, reading: Reading, rates: bool = True) -> np.ndarray:
        """Torque that the rigid arm and its listed springs need [Nm], (n, K)."""
        parts = []
        for r, motion, payload in self.motion(reading, rates):
            theta = np.array([values[p.name] for effect, values in r.springs for p in effect.parameters])
            model = self._models[tuple(effect for effect, _ in r.springs)]
            parts.append(along(model.inverse, *motion, payload, theta, model.widths)[0])
        return np.concatenate(parts, axis=1)

    @cached_property
    def _by_inertial(self) -> ca.Function:
        """(q, dq, ddq, gravity) -> d torque / d inertial parameters, (n, 10 n)."""
        n = self.recordings.robot.n
        q, dq, ddq, gravity = (ca.SX.sym(name, size) for name, size in (("q", n), ("dq", n), ("ddq", n), ("gravity", 3)))
        inertial = ca.SX.sym("inertial", 10, n)
        torque = rigid_body(self.recordings.robot).inverse_dynamics(q, dq, ddq, inertial, gravity)  # linear in them
        unit = np.tile(np.array([1.0, 0, 0, 0, 1, 0, 1, 0, 0, 1]), (n, 1)).T  # any values: the expressions divide by the mass
        slope = ca.substitute(ca.jacobian(torque, ca.vec(inertial)), inertial, ca.DM(unit))
        return ca.Function("by_inertial", [q, dq, ddq, gravity], [ca.densify(slope)])

    @cached_property
    def _models(self) -> dict[tuple[Effect, ...], Model]:
        """The arm by the springs that are mounted."""
        every = {tuple(effect for effect, _ in r.springs) for r in self.recordings.recordings}
        return {springs: Model(self.recordings.robot, self.recordings.tool, springs) for springs in every}

    def regressors(self, reading: Reading) -> np.ndarray:
        """Derivatives of the rigid arm's torque by the inertial parameters, (n, K, 10 n), where masses are not known."""
        robot, parts = self.recordings.robot, []
        for _, motion, _ in self.motion(reading):
            count = motion.shape[2]
            values = along(self._by_inertial, *motion, robot.gravity[:, None])[0]
            parts.append(values.reshape(robot.n, count, -1))
        return np.concatenate(parts, axis=1)


class Comparison:
    """Errors of the joints' torques under different readings of the columns; what was computed for a motion is kept.

    Args:
        springs: Whether each joint may have a spring that is not listed, which would hide a wrong sign.
    """

    def __init__(self, samples: Samples, springs: bool = False) -> None:
        self.samples, self.springs, self._load = samples, springs, dict[tuple, tuple[np.ndarray, list[np.ndarray]]]()
        self.nominal = samples.recordings.inertial == "nominal"

    def nrmse(self, reading: Reading, scale: Sequence[float] | None = None, torque: np.ndarray | None = None) -> np.ndarray:
        """NRMSE of each joint's torque, (n,), read as `scale` times the recorded one; NaN where it never changes."""
        load, columns = self._motion(reading)
        tau = self.samples.read(reading, self.samples.torque if torque is None else torque)
        tau = tau if scale is None else tau * np.array(scale)[:, None]
        return np.array([_error(tau[j] - load[j], tau[j], columns[j], self._rotors[j]) for j in range(len(tau))])

    @cached_property
    def _rotors(self) -> np.ndarray:
        """Largest rotor inertias that are believed [kg m²], (n,), from those of the links along the motion."""
        given = Reading.as_given(self.samples.recordings.robot.n)
        if not self.nominal:
            return np.full(len(given.signs), np.inf)
        ddq = np.concatenate([m[2] for _, m, _ in self.samples.motion(given)], axis=1)
        inertial = self.samples.load(given) - self.samples.load(given, rates=False)
        links = np.std(inertial, axis=1) / np.maximum(np.std(ddq, axis=1), 1e-9)
        return ROTOR[0] * links + ROTOR[1] * np.max(links)

    def factors(self, reading: Reading) -> np.ndarray:
        """How many times the arm's torque each recorded one is, (n,); NaN where the arm's hardly changes or does not explain it."""
        load, columns = self._motion(reading)
        tau = self.samples.read(reading, self.samples.torque)
        found = []
        for j in range(len(tau)):
            solution, size = _least(np.column_stack([load[j], columns[j]]), tau[j])[0], float(np.std(tau[j]))
            explained = size > 0 and float(np.std(solution[0] * load[j])) > LEAST_LOAD * size
            found.append(float(solution[0]) if explained else np.nan)
        return np.array(found)

    def _motion(self, reading: Reading) -> tuple[np.ndarray, list[np.ndarray]]:
        """Load torque (n, K), and the columns of friction, inertia and offset (K, p) of each joint."""
        key = reading.signs, reading.order
        if key not in self._load:
            motion = np.concatenate([m for _, m, _ in self.samples.motion(reading)], axis=2)
            ones = np.ones(motion.shape[2])
            of = [np.column_stack([np.tanh(dq / WIDTH), dq, ddq, ones, -ones]) for _, dq, ddq in motion.swapaxes(0, 1)]
            if self.springs:
                of = [np.column_stack([a, q]) for a, q in zip(of, motion[0], strict=True)]
            load = self.samples.load(reading) if self.nominal else 0 * motion[0]
            if not self.nominal:
                of = [np.column_stack([a, *_both_ways(x)]) for a, x in zip(of, self.samples.regressors(reading), strict=True)]
            self._load[key] = load, of
        return self._load[key]


def _both_ways(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Independent combinations of columns (K, p), and minus them, of which coefficients of any sign are sums."""
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    kept = left[:, sizes > 1e-6 * max(float(sizes.max()), 1e-12)] * np.sqrt(len(columns))
    return kept, -kept


def _error(residual: np.ndarray, torque: np.ndarray, columns: np.ndarray, rotor: float) -> float:
    """Root mean square of what non-negative multiples of the columns leave of a residual (K,), over the torque's deviation.

    The third column is the acceleration, of which `rotor` is the greatest multiple.
    """
    size = float(np.std(torque))
    if not size > 0:
        return float("nan")
    found, left = _least(columns, residual)
    if found[2] > rotor:
        _, left = _least(np.delete(columns, 2, axis=1), residual - rotor * columns[:, 2])
    return left / np.sqrt(len(residual)) / size


def _least(columns: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, float]:
    """Non-negative multiples of the columns (K, p) nearest to a torque (K,), and the distance; NaN where there are none."""
    sizes = np.linalg.norm(columns, axis=0)
    sizes = np.where(sizes > 0, sizes, 1.0)
    try:
        found, left = nnls(columns / sizes, torque)
    except (RuntimeError, ValueError):  # no end, or numbers that are not finite
        return np.full(columns.shape[1], np.nan), float("nan")
    return found / sizes, float(left)


def check_consistency(recordings: RecordingSet) -> Consistency:
    """What looks wrong in a set beside what its reader says, and how well a rigid arm with friction explains it."""
    samples, given = Samples(recordings, _rows(recordings)), Reading.as_given(recordings.robot.n)
    rigid, compared, reading = Comparison(samples), Comparison(samples, springs=True), given
    doubts = [*_payloads(compared, given)] or [*_units(rigid, given)]
    for _ in range(MENDS if not doubts else 0):
        better = _best_mend(compared, reading)
        if better is None:
            break
        reading, _, doubt = better
        doubts.append(doubt)
    if not doubts:
        doubts += _of_one_recording(recordings, given)
    doubts += [*_clocks(rigid, reading), *_excitation(rigid, reading)]
    return Consistency(
        tuple(doubts),
        tuple(rigid.nrmse(given).tolist()),
        (DIAGNOSIS[0] * recordings.robot.n, DIAGNOSIS[1] * recordings.robot.n),
    )


def _of_one_recording(recordings: RecordingSet, given: Reading) -> Iterator[Doubt]:
    """Mistakes of one recording alone, in which a joint's error is far larger than in the others."""
    sets = [replace(recordings, recordings=(r,)) for r in recordings.recordings]
    every = [Comparison(Samples(one, _rows(one)), springs=True) for one in sets] if len(sets) > 1 else []
    errors = np.array([compared.nrmse(given) for compared in every])
    for k, compared in enumerate(every):
        others = np.ma.median(np.ma.masked_invalid(np.delete(errors, k, axis=0)), axis=0).filled(np.inf)
        far = others < BETTER * errors[k]
        better = _best_mend(compared, given) if far.any() else None
        if better is not None and far[better[1]]:
            doubt = better[2]
            yield replace(doubt, said=f"{recordings.recordings[k].file}: {doubt.said}")


def _rows(recordings: RecordingSet) -> tuple[np.ndarray, ...]:
    """Rows of each recording at even distances, `SAMPLES` together, at least a few of each."""
    total = sum(len(r.t) for r in recordings.recordings)
    return tuple(
        np.unique(np.linspace(0, len(r.t) - 1, max(8, round(SAMPLES * len(r.t) / total))).round().astype(int))
        for r in recordings.recordings
    )


def _score(nrmse: np.ndarray) -> float:
    """Sum of the logarithms of the errors, (n,), none below `LEAST_ERROR`."""
    return float(np.nansum(np.log(np.maximum(nrmse, LEAST_ERROR))))


def _best_mend(compared: Comparison, reading: Reading) -> tuple[Reading, int, Doubt] | None:
    """The reading, one mistake apart, that explains the torques best, and the joint that gains most, if it is worth being said."""
    before = compared.nrmse(reading)
    tried = [(other, kind, joints, said, compared.nrmse(other)) for other, kind, joints, said in _others(compared, reading)]
    if not tried:
        return None
    other, kind, joints, said, after = min(tried, key=lambda one: _score(one[-1]))
    gain = np.log(np.maximum(before, LEAST_ERROR)) - np.log(np.maximum(after, LEAST_ERROR))
    j = int(np.nanargmax(gain)) if np.isfinite(gain).any() else 0
    fall = _score(before) - _score(after)
    if not (fall > WORTH and _mends(float(before[j]), float(after[j]))) and not (fall > SURE and after[j] < GOOD):
        return None
    joint = compared.samples.recordings.joints[j]
    told = f"{said}: NRMSE of the torque of {joint} {before[j]:.2g} → {after[j]:.2g}"
    return other, j, Doubt(kind, joints, told, float(before[j]), float(after[j]))


def _mends(before: float, after: float) -> bool:
    """Whether a joint's error is so much less that a mistake is sure."""
    return before > BAD and after < BETTER * before and after < GOOD


def _others(compared: Comparison, reading: Reading) -> Iterator[tuple[Reading, str, tuple[str, ...], str]]:
    """Readings that differ by one mistake: kind, columns, and what is said of it."""
    names, torque = compared.samples.recordings.joints, _torque_column(compared.samples.recordings)
    for j, joint in enumerate(names):
        flipped = _flipped(reading.torque_signs, j)
        columns = (f"{torque}_{joint}",)
        yield replace(reading, torque_signs=flipped), "sign", columns, f"{columns[0]} fits with the opposite sign"
        if not compared.nominal:
            continue
        turned, q = _flipped(reading.signs, j), (f"q_{joint}",)
        yield replace(reading, signs=turned), "sign", q, f"{q[0]} and its rates fit with the opposite sign"
        said = f"{q[0]}, its rates and {columns[0]} fit with the opposite signs"
        yield replace(reading, signs=turned, torque_signs=flipped), "sign", (*q, *columns), said
    for factor, how in ((DEGREES, "angles in rad that were taken for degrees"), (1 / DEGREES, "angles in degrees")):
        q, scaled = tuple(f"q_{joint}" for joint in names), tuple(factor * s for s in reading.signs)
        both = scaled if torque == "command" else reading.torque_signs
        if compared.nominal:
            said = f"positions fit when they are multiplied by {factor:.3g}, as {how}"
            yield replace(reading, signs=scaled, torque_signs=both), "unit", q, said
    for i, j in itertools.combinations(range(len(names)), 2):
        pair = tuple(f"{torque}_{names[k]}" for k in (i, j))
        order = _swapped(reading.torque_order, i, j)
        yield replace(reading, torque_order=order), "order", pair, f"{pair[0]} and {pair[1]} fit when they are swapped"
        if not compared.nominal:
            continue
        places, of = tuple(f"q_{names[k]}" for k in (i, j)), _swapped(reading.order, i, j)
        yield (
            replace(reading, order=of),
            "order",
            places,
            f"{places[0]} and {places[1]}, with their rates, fit when they are swapped",
        )
        said = f"all columns of {names[i]} and {names[j]} fit when they are swapped"
        yield replace(reading, order=of, torque_order=order), "order", (*places, *pair), said


def _torque_column(recordings: RecordingSet) -> str:
    return EFFORTS.get(recordings.torque, "tau")


def _flipped(signs: tuple[float, ...], j: int) -> tuple[float, ...]:
    return tuple(-s if k == j else s for k, s in enumerate(signs))


def _swapped(order: tuple[int, ...], i: int, j: int) -> tuple[int, ...]:
    return tuple(order[j] if k == i else order[i] if k == j else o for k, o in enumerate(order))


def _units(compared: Comparison, reading: Reading) -> Iterator[Doubt]:
    """Torques that are a multiple of the arm's which no gain explains."""
    if not compared.nominal:
        return
    factors = compared.factors(reading)
    far = [j for j, f in enumerate(factors) if f > 0 and not SCALES[0] < f < SCALES[1]]
    if not far:
        return
    before = compared.nrmse(reading)
    after = compared.nrmse(reading, [1 / factors[j] if j in far else 1.0 for j in range(len(factors))])
    names, torque = compared.samples.recordings.joints, _torque_column(compared.samples.recordings)
    for j in far:
        if _mends(max(before[j], 1.0), after[j]):
            unit = next((f", as if in {unit}" for factor, unit in UNITS.items() if abs(factors[j] / factor - 1) < 0.1), "")
            what = f"{torque}_{names[j]}" if torque != "command" else f"what kp and kd make of command_{names[j]}"
            said = f"{what} is {factors[j]:.3g} times the torque that the arm needs{unit}"
            told = f"{said}: divided by that, NRMSE {before[j]:.2g} → {after[j]:.2g}"
            yield Doubt("unit", (f"{torque}_{names[j]}",), told, float(before[j]), float(after[j]))


def _payloads(compared: Comparison, reading: Reading) -> Iterator[Doubt]:
    """Listed payloads without which the torques are explained much better."""
    recordings = compared.samples.recordings
    heaviest = max(float(np.max(r.payload)) for r in recordings.recordings)
    if not (compared.nominal and heaviest > 0):
        return
    empty = tuple(replace(r, payload=0 * r.payload) for r in recordings.recordings)
    bare = Comparison(replace(compared.samples, recordings=replace(recordings, recordings=empty)), springs=True)
    before, after = compared.nrmse(reading), bare.nrmse(reading)
    better = [j for j in range(len(before)) if _mends(float(before[j]), float(after[j]))]
    if better:
        j = max(better, key=lambda j: before[j] / after[j])
        said = f"the torques fit better without the listed payload of up to {heaviest:g} kg"
        told = f"{said}: NRMSE of the torque of {recordings.joints[j]} {before[j]:.2g} → {after[j]:.2g}"
        yield Doubt("payload", ("payload",), told, float(before[j]), float(after[j]))


def _clocks(compared: Comparison, reading: Reading) -> Iterator[Doubt]:
    """Torques that are late or early beside the positions."""
    recordings = compared.samples.recordings
    if recordings.torque == "command":
        return  # commands that are early look like viscous friction, whatever the time
    step = max(float(np.median(np.diff(r.t))) for r in recordings.recordings)
    before = compared.nrmse(reading)
    grid = [k * LAG_STEP for k in range(-round(LAGS / LAG_STEP), round(LAGS / LAG_STEP) + 1)]
    later = [replace(compared.samples, lag=lag).torque for lag in grid]
    errors = np.array([compared.nrmse(reading, torque=torque) for torque in later])
    for j, joint in enumerate(recordings.joints):
        if not np.isfinite(errors[:, j]).all():
            continue
        k = int(np.argmin(errors[:, j]))
        lag, after = grid[k], float(errors[k, j])
        if abs(lag) > max(LATE[0], LATE[1] * step) and after < LAG_GAIN * before[j] and after < GOOD and 0 < k < len(grid) - 1:
            column, how = f"{_torque_column(recordings)}_{joint}", "late" if lag > 0 else "early"
            said = f"{column} is {abs(lag):.2g} s {how} beside the positions: with that, NRMSE {before[j]:.2g} → {after:.2g}"
            yield Doubt("clock", (column,), said, float(before[j]), after)


def _excitation(compared: Comparison, reading: Reading) -> Iterator[Doubt]:
    """Joints that never move, and inertias that no motion shows."""
    recordings = compared.samples.recordings
    travel = np.max([np.ptp(r.q, axis=1) for r in recordings.recordings], axis=0)
    for joint, way in zip(recordings.joints, travel, strict=True):
        if way < MOVES:
            said = f"{joint} never moves more than {np.degrees(way):.2g}°: its friction and rotor inertia cannot be told; record it moving"
            yield Doubt("excitation", (f"q_{joint}",), said)
    if not compared.nominal:
        return
    inertial = np.std(compared.samples.load(reading) - compared.samples.load(reading, rates=False), axis=1)
    noise = np.mean([_noise(recordings.output_torque(r)) for r in recordings.recordings], axis=0)
    for joint, way, part, least in zip(recordings.joints, travel, inertial, SEEN * noise, strict=True):
        if way >= MOVES and NOTHING < part < least:
            said = f"accelerations change the torque of {joint} by {part:.2g} Nm, and its noise is {least / SEEN:.2g} Nm"
            said += ": the inertia of the links is hardly seen there; record it faster"
            yield Doubt("excitation", (f"ddq_{joint}",), said)


def _noise(torque: np.ndarray) -> np.ndarray:
    """Standard deviation of white noise in torques (n, K), from their second differences, (n,)."""
    return np.std(np.diff(torque, 2, axis=1), axis=1) / np.sqrt(6)

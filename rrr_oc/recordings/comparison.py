"""How well a rigid arm with plain friction explains the torques of a recording set, for any reading of its columns.

A joint's torque is compared with the rigid arm's, plus the plain effects of its drive (friction that opposes motion, the rotor's inertia)
and an offset, all by non-negative least squares on some hundred samples.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from scipy.optimize import nnls

from rrr_oc.effects import Effect, Signals, plain_effects
from rrr_oc.model.symbolic_model import Model
from rrr_oc.numerics.along import along
from rrr_oc.numerics.savitzky_golay import smooth
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.robot.rigid_body import rigid_body

SAMPLES = 600  # of all recordings together that are compared; doubled, the check takes twice as long
HELD = 0.25  # share of rows that repeat the last command, from which steps of commands are smoothed; doubled, holds of two rows stay
SLOW = 0.1  # [rad/s] below which dry friction may hold a joint; doubled, less of slow recordings is compared with others
FASTER = 1.2  # times the speed of the other recordings, up to which they tell what a joint needs; doubled, fast ones look like other arms
WIDTH = 0.02  # [rad/s] over which dry friction changes sign; doubled, slow motions fit a little worse
LEAST_LOAD = 0.3  # share of a torque's deviation that the arm's must have to tell its unit; doubled, geared arms have none
LEAST_WHOLE = 0.3  # share of rows that no limit cuts off, below which all are compared; doubled, dead bands of weak joints are
# Times its error that a load must be, beside friction and braking, to tell what kp makes of commands; doubled, weak joints need a kp
TOLD = 1.0
# Most rotor inertia, over the link's own and over the arm's largest; doubled, springs pass for it in slow sweeps
ROTOR = 30.0, 0.3


@dataclass(frozen=True, eq=False)
class Reading:
    """How columns are read: joint angles = q (columns of positions) + zero, torques or commands = tau (their columns).

    Attributes:
        q: Of positions and their rates, (n, n): a sign, a unit, another order, or a sum of columns.
        tau: Of torques or commands, (n, n).
        zero: Added to positions [rad], (n,).
    """

    q: np.ndarray
    tau: np.ndarray
    zero: np.ndarray

    @classmethod
    def as_given(cls, n: int) -> "Reading":
        """Every column as its name says."""
        return cls(np.eye(n), np.eye(n), np.zeros(n))


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

    @classmethod
    def of(cls, recordings: RecordingSet) -> "Samples":
        """`SAMPLES` of all recordings together, at least a few of each; none that a limit cuts off, unless few were left."""
        total = sum(len(r.t) for r in recordings.recordings)
        counts = [max(8, round(SAMPLES * len(r.t) / total)) for r in recordings.recordings]
        whole = [~recordings.clipped(r).any(axis=0) for r in recordings.recordings]
        usable = [
            np.flatnonzero(some if np.mean(some) > LEAST_WHOLE or recordings.torque == "command" else np.ones_like(some))
            for some in whole
        ]
        rows = (
            kept[np.unique(np.linspace(0, len(kept) - 1, count).round().astype(int))] if len(kept) else kept
            for kept, count in zip(usable, counts, strict=True)
        )
        return cls(recordings, tuple(rows))

    @cached_property
    def torque(self) -> np.ndarray:
        """Recorded torque at the output [Nm], or commands [rad] without the steps of a loop that holds them, (n, K)."""
        parts = []
        for r, rows in zip(self.recordings.recordings, self.rows, strict=True):
            torque = self.recordings.output_torque(r) if r.command is None else _without_steps(r)
            parts.append(
                torque[:, rows] if not self.lag else np.array([np.interp(r.t[rows] + self.lag, r.t, x) for x in torque])
            )
        return np.concatenate(parts, axis=1)

    def motion(self, reading: Reading, rates: bool = True) -> list[tuple[Recording, np.ndarray, np.ndarray]]:
        """By recording, its motion (3, n, K) as it is read, at rest if not `rates`, and its payload (1, K)."""
        found = []
        for r, rows in zip(self.recordings.recordings, self.rows, strict=True):
            motion = reading.q @ np.array([x[:, rows] for x in (r.q, r.dq, r.ddq)])
            motion[0] += reading.zero[:, None]
            motion[1:] *= rates
            found.append((r, motion, r.payload[None, rows]))
        return found

    def read(self, reading: Reading, given: np.ndarray) -> np.ndarray:
        """The torque at the output [Nm], (n, K), by `torque` as it is read; of commands with the motion as it is read."""
        given, first = reading.tau @ given, 0
        if self.recordings.torque != "command":
            return given
        parts = []
        for r, (q, dq, _), _ in self.motion(reading):
            assert r.loop is not None
            parts.append(r.loop.torque(given[:, first : first + q.shape[1]] + reading.zero[:, None], q, dq))
            first += q.shape[1]
        return np.concatenate(parts, axis=1)

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
        """Derivatives of the rigid arm's torque by the inertial parameters, link by link, (n, K, 10 n)."""
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

    def nrmse(
        self,
        reading: Reading,
        torque: np.ndarray | None = None,
        more: np.ndarray | float = 0.0,
        scale: np.ndarray | float = 1.0,
        alone: bool = False,
    ) -> np.ndarray:
        """NRMSE of each joint's torque, (n,); NaN where it never changes.

        Args:
            torque: Takes the place of the recorded torques or commands, (n, K).
            more: Load torque beside the arm's [Nm], (n, K).
            scale: Of the torque as it is read, (n, 1).
            alone: Whether the drives are alone, without an arm.
        """
        load, columns = self._motion(reading)
        tau = scale * self.samples.read(reading, self.samples.torque if torque is None else torque)
        left = tau - (not alone) * load - more
        return np.array([_error(left[j], tau[j], columns[j], self._rotors[j]) for j in range(len(tau))])

    @cached_property
    def _rotors(self) -> np.ndarray:
        """Largest rotor inertias that are believed [kg m²], (n,), from those of the links along the motion."""
        given = Reading.as_given(self.samples.recordings.robot.n)
        if not self.nominal:
            return np.full(len(given.zero), np.inf)
        ddq = np.concatenate([m[2] for _, m, _ in self.samples.motion(given)], axis=1)
        inertial = self.samples.load(given) - self.samples.load(given, rates=False)
        links = np.std(inertial, axis=1) / np.maximum(np.std(ddq, axis=1), 1e-9)
        return ROTOR[0] * links + ROTOR[1] * np.max(links)

    def factors(self, reading: Reading) -> np.ndarray:
        """How many times the arm's torque each recorded one is, (n,); NaN where the arm's hardly changes or does not explain it.

        What a loop brakes may be most of its torque; there the load need only be more than what is left unexplained.
        """
        load, columns = self._motion(reading)
        tau, by_loop = self.samples.read(reading, self.samples.torque), self.samples.recordings.torque == "command"
        result = []
        for j in range(len(tau)):
            solution, left = _least(np.column_stack([load[j], columns[j]]), tau[j])
            own, least = solution[0] * load[j], LEAST_LOAD * float(np.std(tau[j]))
            if by_loop:
                own, least = _beside(columns[j], own), TOLD * left / np.sqrt(len(own))
            result.append(float(solution[0]) if np.std(own) > least else np.nan)
        return np.array(result)

    def beyond(self, reading: Reading, j: int, rows: np.ndarray) -> tuple[float, float]:
        """By how much the arm's torque exceeds a joint's in some rows (K,) [Nm], the median, and the others' error [Nm]."""
        load, columns = self._motion(reading)
        tau = self.samples.read(reading, self.samples.torque)[j]
        found, left = _least(columns[j][~rows], (tau - load[j])[~rows])
        more = np.sign(tau) * (load[j] + columns[j] @ found - tau)
        return float(np.median(more[rows])), left / np.sqrt(max(np.sum(~rows), 1))

    def left_out(self, reading: Reading, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What the drives of all others leave of a recording's torques, (n, K), the others' own error, (n,), and their deviation, (n,) [Nm].

        Left are 0 where a joint is faster than in the others, or beyond their angles, and as much less at rest as dry friction may hold there.
        """
        load, columns = self._motion(reading)
        residual = self.samples.read(reading, self.samples.torque) - load
        q, dq, ddq = np.concatenate([m for _, m, _ in self.samples.motion(reading)], axis=2)
        own = np.repeat(np.arange(len(self.samples.rows)), [len(rows) for rows in self.samples.rows]) == k
        # what an arm of other masses needs grows with the speeds and accelerations of all its joints
        known = [np.abs(v[:, own]) < FASTER * np.max(np.abs(v[:, ~own]), axis=1, keepdims=True) for v in (dq, ddq)]
        low, high = q[:, ~own].min(axis=1, keepdims=True), q[:, ~own].max(axis=1, keepdims=True)
        known = np.all([*known, (low <= q[:, own]) & (q[:, own] <= high)], axis=(0, 1))
        result = []
        for j, x in enumerate(residual):
            found, left = _least(columns[j][~own], x[~own])
            slow = _drive(0, *(np.array([[v, -v]]) * of for v, of in ((SLOW, 0), (SLOW, 1), (SLOW, 0))))
            held = abs(float(np.diff(slow @ found[: slow.shape[1]])[0])) / 2 * (np.abs(dq[j, own]) < SLOW)
            off = np.abs(x[own] - columns[j][own] @ found)
            size = float(np.std(x[~own] + load[j, ~own]))
            result.append((np.maximum(off - held, 0.0) * known, left / np.sqrt(np.sum(~own)), size))
        off, errors, sizes = zip(*result, strict=True)
        return np.array(off), np.array(errors), np.array(sizes)

    @cached_property
    def without_braking(self) -> "Comparison":
        """The comparison with loops that have no kd, which is a part of viscous friction there; itself where there are no loops."""
        recordings = self.samples.recordings
        if recordings.torque != "command":
            return self
        loops = [r.loop and replace(r.loop, kd=np.zeros_like(r.loop.kd)) for r in recordings.recordings]
        free = tuple(replace(r, loop=loop) for r, loop in zip(recordings.recordings, loops, strict=True))
        return Comparison(replace(self.samples, recordings=replace(recordings, recordings=free)), self.springs)

    def share_of(self, reading: Reading, load: np.ndarray) -> float:
        """How many times a load torque (n, K) is missing: by least squares over all joints, beside their friction and offset."""
        own, columns = self._motion(reading)
        tau = self.samples.read(reading, self.samples.torque)
        products = np.zeros(2)
        for j, size in enumerate(np.std(tau, axis=1)):
            if size > 0:
                x, y = (_beside(columns[j], z) for z in (load[j] / size, (tau[j] - own[j]) / size))
                products += x @ x, x @ y
        return float(products[1] / products[0]) if products[0] > 0 else 0.0

    def _motion(self, reading: Reading) -> tuple[np.ndarray, list[np.ndarray]]:
        """Load torque (n, K), and the columns of friction, inertia and offset (K, p) of each joint, inertia first."""
        key = reading.q.tobytes(), reading.zero.tobytes()
        if key not in self._load:
            motion = np.concatenate([m for _, m, _ in self.samples.motion(reading)], axis=2)
            of = [_drive(j, *motion) for j in range(motion.shape[1])]
            if self.springs:
                of = [np.column_stack([a, q]) for a, q in zip(of, motion[0], strict=True)]
            load = self.samples.load(reading) if self.nominal else 0 * motion[0]
            if not self.nominal:
                of = [np.column_stack([a, *_both_ways(x)]) for a, x in zip(of, self.samples.regressors(reading), strict=True)]
            self._load[key] = load, of
        return self._load[key]

    def with_robot(self, **changes: object) -> "Comparison":
        """The comparison with an arm whose file says something else."""
        recordings = self.samples.recordings
        other = replace(recordings, robot=replace(recordings.robot, **changes))  # type: ignore[arg-type]
        return Comparison(replace(self.samples, recordings=other), self.springs)


def _without_steps(r: Recording) -> np.ndarray:
    """Commands (n, K) [rad], smoothed where they are held for some samples while the joints move."""
    assert r.command is not None
    held = np.mean((np.diff(r.command, axis=1) == 0) & (np.diff(r.q, axis=1) != 0), axis=1) > HELD
    return np.where(held[:, None], smooth(r.t, r.command, r.segments), r.command)


def _drive(j: int, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """Torque of 1 of each parameter of the plain effects of a joint's drive, rotor first, and an offset of either sign, (K, p)."""
    kinds = sorted((k for k in plain_effects() if k.side == "drive"), key=lambda kind: kind.provides != "rotor")
    effects, signals = [kind((j,)) for kind in kinds], Signals(q, dq, ddq)
    columns = [-effect.torque(signals, {p.name: 1.0}, WIDTH)[0] for effect in effects for p in effect.parameters]
    return np.column_stack([*columns, np.ones(q.shape[1]), -np.ones(q.shape[1])])


def _beside(columns: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The part of x (K,) that no multiples of the columns (K, p) are."""
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    basis = left[:, sizes > 1e-9 * max(float(sizes.max()), 1e-300)]
    return x - basis @ (basis.T @ x)


def _both_ways(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Independent combinations of columns (K, p), and minus them, of which coefficients of any sign are sums."""
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    kept = left[:, sizes > 1e-6 * max(float(sizes.max()), 1e-12)] * np.sqrt(len(columns))
    return kept, -kept


def _error(residual: np.ndarray, torque: np.ndarray, columns: np.ndarray, rotor: float) -> float:
    """Root mean square of what non-negative multiples of the columns leave of a residual (K,), over the torque's deviation.

    The first column is the rotor's, of which `rotor` is the greatest multiple.
    """
    size = float(np.std(torque))
    if not size > 0:
        return float("nan")
    found, left = _least(columns, residual)
    if found[0] > rotor:
        _, left = _least(columns[:, 1:], residual - rotor * columns[:, 0])
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

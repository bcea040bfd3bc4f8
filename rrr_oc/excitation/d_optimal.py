"""Motions to record that tell chosen parameters best.

A motion's information on parameters theta, from torques with noise of standard deviation sigma_i on joint i, is
F = mean over time of Yᵀ W Y with Y = d tau / d theta (n, p) and W = diag(1/sigma²). Where only some parameters are of
interest (a) and others (b) must be estimated beside them, what is left on the first is the Schur complement
S = F_aa − F_ab F_bb⁻¹ F_ba. Design of greatest log det S is called D-optimal (the volume of the confidence ellipsoid goes with
exp(−log det S / 2)); the condition number of S says how unevenly the parameters are told. Swevers et al., "Optimal robot
excitation and identification", IEEE Trans. Robotics and Automation 13 (1997) 730–740, have the periodic motions used here;
Gautier & Khalil, Int. J. Robotics Research 11 (1992) 362–375, the condition number. (Both cited from memory.)
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, get_args

import casadi as ca
import numpy as np
import scipy.linalg

from rrr_oc.errors import UserError
from rrr_oc.excitation.sweeps import STEP, PlannedRecording, times
from rrr_oc.model.symbolic_model import Model
from rrr_oc.numerics.rank import COLUMN_PROJECTED, independent_columns
from rrr_oc.recordings.header import Spring
from rrr_oc.robot.robot import Robot

Criterion = Literal["log_det", "condition"]

INERTIAL = ("mass", "mx", "my", "mz", "xx", "xy", "yy", "xz", "yz", "zz")  # the rows of `Robot.inertial`
PLANNING_WIDTH = 0.1  # rad, rad/s, in each width's unit; narrower laws are planned for with this, wide enough for the grid
UNITS = {"range": "rad", "speed": "rad/s", "acceleration": "rad/s²", "torque": "Nm", "floor": "m"}  # of the limits
LOOSE = 2.0, 10.0  # speed [rad/s] and acceleration [rad/s²] that sampled states spread to where nothing limits them


@dataclass(frozen=True, eq=False)
class Limits:
    """What a motion must keep to; shapes (n,), infinite where nothing limits it.

    Attributes:
        lower, upper: Joint ranges [rad]; a joint whose two are equal stands still; an infinite one is taken as ±π.
        speed: [rad/s].
        acceleration: [rad/s²].
        torque: Of the load torque, Eq. 6 [Nm].
        floor: Height that the tool stays above [m], against gravity.
    """

    lower: np.ndarray
    upper: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    torque: np.ndarray
    floor: float = -math.inf

    def __post_init__(self) -> None:
        shapes = {name: np.shape(getattr(self, name)) for name in ("lower", "upper", "speed", "acceleration", "torque")}
        if len(set(shapes.values())) != 1 or len(shapes["lower"]) != 1:
            raise UserError(f"limits need one shape (n,), got {shapes}")
        object.__setattr__(self, "lower", np.where(np.isfinite(self.lower), self.lower, -np.pi))
        object.__setattr__(self, "upper", np.where(np.isfinite(self.upper), self.upper, np.pi))
        if not np.all(self.lower <= self.upper):
            raise UserError(f"joint ranges are crossed: lower {self.lower}, upper {self.upper} [rad]")
        if not np.any(self.lower < self.upper):
            raise UserError("every joint range is a point; at least one joint must move")
        for name in ("speed", "acceleration", "torque"):
            if not np.all(getattr(self, name) > 0):
                raise UserError(f"{name} limits must be above 0, got {getattr(self, name)}")

    @property
    def moving(self) -> np.ndarray:
        """Indices of the joints that move."""
        return np.flatnonzero(self.lower < self.upper)


def robot_limits(robot: Robot, acceleration: float | np.ndarray = math.inf, floor: float = -math.inf) -> Limits:
    """The limits of a robot's URDF, and those that a URDF has no word for."""
    return Limits(
        robot.lower, robot.upper, robot.velocity, np.broadcast_to(np.asarray(acceleration, float), robot.n), robot.effort, floor
    )


@dataclass(frozen=True, eq=False)
class PathLimits:
    """Limits on what is not linear in the motion: (q, dq, ddq) -> values (r,), and `low` ≤ values ≤ `high`.

    `names` says of each value whether it is a "torque" [Nm] or the height over the "floor" [m].
    """

    function: ca.Function
    low: np.ndarray
    high: np.ndarray
    names: tuple[str, ...]

    def excess(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """By how much a motion (n, K) breaks each limit at worst, shape (r,); negative where it is kept."""
        values = np.asarray(self.function(q, dq, ddq)) if self.names else np.zeros((0, 1))
        return np.max(np.maximum(self.low[:, None] - values, values - self.high[:, None]), axis=1)

    def near(self, states: tuple[np.ndarray, ...]) -> "PathLimits":
        """The limits that some of the states (n, K) come near: those beyond half of a torque limit, and the floor."""
        values = np.asarray(self.function(*states))
        near = [k for k, name in enumerate(self.names) if name == "floor" or np.max(np.abs(values[k])) > self.high[k] / 2]
        arguments = _signals(states[0].shape[0])
        function = ca.Function("path", [*arguments], [self.function(*arguments)[near]])
        return PathLimits(function, self.low[near], self.high[near], tuple(self.names[k] for k in near))


@dataclass(frozen=True, eq=False)
class Rig:
    """An arm as it stands in the laboratory: model with the springs mounted, values, payload and limits."""

    model: Model
    limits: Limits
    theta: np.ndarray = field(default_factory=lambda: np.zeros(0))
    payload: float = 0.0

    def __post_init__(self) -> None:
        n, count = self.model.robot.n, len(self.model.parameters)
        if self.limits.lower.size != n:
            raise UserError(f"limits of {self.limits.lower.size} joints for {self.model.robot.name!r}, which has {n}")
        if np.shape(self.theta) != (count,):
            raise UserError(f"the effects have {count} parameters, got values of shape {np.shape(self.theta)}")
        if not 0 <= self.payload < math.inf:
            raise UserError(f"payload {self.payload} kg must be finite and not negative")

    @property
    def springs(self) -> tuple[Spring, ...]:
        """The springs among the model's effects."""
        values = self.model.values(self.theta)
        return tuple((e, values[self.model.label(e)]) for e in self.model.effects if e.listing is not None)

    @cached_property
    def path(self) -> "PathLimits":
        """What torque limits and floor bound."""
        q, dq, ddq = _signals(self.model.robot.n)
        torque = self.model.inverse(q, dq, ddq, self.payload, self.theta, self.model.widths)[0]
        bounded = np.flatnonzero(np.isfinite(self.limits.torque))
        rows, high = [torque[int(i)] for i in bounded], [*self.limits.torque[bounded]]
        low, names = [-limit for limit in high], ["torque"] * len(high)
        if math.isfinite(self.limits.floor):
            height = self.model.tool_height(q)
            rows, low, high, names = [*rows, height], [*low, self.limits.floor], [*high, math.inf], [*names, "floor"]
        return PathLimits(ca.Function("path", [q, dq, ddq], [ca.vertcat(*rows)]), np.array(low), np.array(high), tuple(names))

    def excess(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> dict[str, float]:
        """By how much a motion (n, K) breaks each limit at worst, in the limit's unit; negative or zero where it is kept."""
        limits, path = self.limits, self.path
        found = {
            "range": max(np.max(limits.lower[:, None] - q), np.max(q - limits.upper[:, None])),
            "speed": np.max(np.abs(dq) - limits.speed[:, None]),
            "acceleration": np.max(np.abs(ddq) - limits.acceleration[:, None]),
        }
        for name, value in zip(path.names, path.excess(q, dq, ddq), strict=True):
            found[name] = max(found.get(name, -math.inf), value)
        return {name: float(value) for name, value in found.items()}


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """How torques depend on parameters: `function` is (q, dq, ddq) -> d tau / d theta (n, p), whose columns have `names`."""

    names: tuple[str, ...]
    function: ca.Function

    def __post_init__(self) -> None:
        shape, p = self.function.size_out(0), len(self.names)
        if shape[1] != p or len(set(self.names)) != p:
            raise UserError(f"a sensitivity of {p} names gives {shape[1]} columns; each needs one name of its own")


def sensitivity(n: int, names: Sequence[str], law: Callable[[ca.SX, ca.SX, ca.SX], ca.SX]) -> Sensitivity:
    """From a law of casadi (q, dq, ddq), each (n,), that gives the columns (n, p)."""
    signals = _signals(n)
    return Sensitivity(
        tuple(names), ca.Function("sensitivity", [*signals], [ca.densify(law(*signals))], ["q", "dq", "ddq"], ["Y"])
    )


def model_sensitivity(rig: Rig, widths: np.ndarray | None = None) -> Sensitivity:
    """Of the motor torque to the parameters of a rig's model, at the rig's values.

    Columns: `<link>.<one of INERTIAL>`, `payload`, and `<effect>[<joints>].<parameter>`. Widths of the effects default to
    `Model.widths`, but at least `PLANNING_WIDTH`.

    Raises `UserError` for an effect whose torque depends on internal states or on the time.
    """
    model, n = rig.model, rig.model.robot.n
    for effect in model.effects:
        if effect.states:
            raise UserError(f"{model.label(effect)} has internal states; planning needs torques that the instant decides")
    inertial, payload, theta = ca.SX.sym("inertial", 10, n), ca.SX.sym("payload"), ca.SX.sym("theta", len(model.parameters))
    chosen, now = np.maximum(model.widths, PLANNING_WIDTH) if widths is None else widths, ca.SX.sym("time")
    mass = np.maximum(model.robot.inertial[0], 1e-3)  # the law is linear in them, but its expression divides by the mass
    nominal = np.vstack([mass, model.robot.inertial[1:]])

    def law(q: ca.SX, dq: ca.SX, ddq: ca.SX) -> ca.SX:
        torque = model.motor_inverse(q, dq, ddq, now, payload, theta, chosen, inertial)[0]
        unknown = ca.vertcat(ca.vec(inertial), payload, theta)
        columns = ca.substitute(ca.jacobian(torque, unknown), unknown, ca.DM([*nominal.ravel("F"), rig.payload, *rig.theta]))
        if ca.depends_on(columns, now):
            raise UserError("an effect depends on the time; planning needs torques that the instant decides")
        return columns

    links = [f"{link}.{name}" for link in model.robot.links for name in INERTIAL]
    effects = [f"{model.label(e)}.{p.name}" for e in model.effects for p in e.parameters]
    return sensitivity(n, [*links, "payload", *effects], law)


@dataclass(frozen=True, eq=False)
class Question:
    """What a motion is to tell.

    Attributes:
        sensitivity: The parameters there are.
        interest: Names of those to be told.
        nuisance: Names of those that are unknown beside them; None: all others. The rest are known.
        noise: Standard deviation of the torques [Nm], scalar or (n,).
    """

    sensitivity: Sensitivity
    interest: tuple[str, ...]
    nuisance: tuple[str, ...] | None = None
    noise: float | np.ndarray = 1.0

    def __post_init__(self) -> None:
        names = self.sensitivity.names
        for name in (*self.interest, *(self.nuisance or ())):
            if name not in names:
                raise UserError(f"no parameter {name!r}; there are {', '.join(names)}")
        if not self.interest:
            raise UserError(f"a question needs a parameter of interest; there are {', '.join(names)}")
        if set(self.interest) & set(self.nuisance or ()):
            raise UserError(
                f"{', '.join(sorted(set(self.interest) & set(self.nuisance or ())))}: both of interest and nuisance"
            )
        if not (np.all(np.asarray(self.noise) > 0) and np.all(np.isfinite(self.noise))):
            raise UserError(f"noise must be above 0 and finite, got {self.noise} Nm")

    @property
    def others(self) -> tuple[str, ...]:
        """The nuisance parameters."""
        chosen = self.sensitivity.names if self.nuisance is None else self.nuisance
        return tuple(name for name in chosen if name not in self.interest)


@dataclass(frozen=True, eq=False)
class Information:
    """A question put to a rig: the columns that its motions can tell apart, each scaled to a torque of RMS `noise`.

    The scale is the column's RMS over random states within the limits, so that all that follows is free of units. Of columns
    that depend on one another (the inertial ones always do), an independent choice is kept, nuisance first; what it stands
    for are base parameters.

    Attributes:
        rig, question: What was asked.
        nuisance, interest: Names of the columns kept, in the order of `rows`.
        inseparable: Parameters of interest that no motion within the limits tells apart from the columns kept.
        scale: Of the columns kept [Nm per unit of the parameter], nuisance first.
        rows: (q, dq, ddq) -> scaled columns (n, p).
    """

    rig: Rig
    question: Question
    nuisance: tuple[str, ...]
    interest: tuple[str, ...]
    inseparable: tuple[str, ...]
    scale: np.ndarray
    rows: ca.Function

    def matrix(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """S of a motion (n, K), one row and column a parameter of interest."""
        p, b = len(self.scale), len(self.nuisance)
        stacked = _stack(np.asarray(self.rows.map(q.shape[1])(q, dq, ddq)), p)
        factor = np.asarray(np.linalg.qr(stacked / math.sqrt(q.shape[1]), mode="r"))[
            b:, b:
        ]  # S = Rᵀ R, without squaring the condition
        return factor.T @ factor

    def log_det(self, plan: PlannedRecording) -> float:
        """log det S [nat]; −infinity where the motion leaves a parameter open."""
        sign, value = np.linalg.slogdet(self.matrix(plan.q, plan.dq, plan.ddq))
        return float(value) if sign > 0 else -math.inf

    def condition(self, plan: PlannedRecording) -> float:
        """Condition number of S."""
        return float(np.linalg.cond(self.matrix(plan.q, plan.dq, plan.ddq)))


def information(rig: Rig, question: Question, samples: int = 400, seed: int = 0) -> Information:
    """Put a question to a rig; raises `UserError` where no motion within the limits can answer any of it."""
    n, f = rig.model.robot.n, question.sensitivity.function
    if f.size_out(0)[0] != n:
        raise UserError(f"the sensitivity has {f.size_out(0)[0]} joints, but {rig.model.robot.name!r} has {n}")
    names = [*question.others, *question.interest]
    b = len(question.others)
    columns = [question.sensitivity.names.index(name) for name in names]
    weight = 1 / np.broadcast_to(np.asarray(question.noise, float), (n,))
    signals = _signals(n)
    wanted = ca.diag(ca.DM(weight)) @ f(*signals)[:, columns]
    values = _stack(
        np.asarray(ca.Function("rows", [*signals], [wanted]).map(samples)(*_states(rig.limits, samples, seed))), len(names)
    )
    size = np.sqrt(np.mean(values**2, axis=0) * n)
    scale = np.where(size > 1e-12 * np.max(size, initial=1e-300), size, np.inf)  # a column of zeros tells nothing
    unit = values / scale
    kept_b = _independent(unit[:, :b])
    basis = np.linalg.qr(unit[:, kept_b])[0]
    kept_a = b + _independent(unit[:, b:] - basis @ (basis.T @ unit[:, b:]))
    lost = tuple(name for i, name in enumerate(names) if i >= b and i not in kept_a)
    if not kept_a.size:
        raise UserError(
            f"no motion within the limits tells {', '.join(question.interest)} apart from "
            f"{', '.join(question.others) or 'a torque of zero'}"
        )
    kept = [*kept_b, *kept_a]
    rows = ca.densify(wanted[:, kept] @ ca.diag(ca.DM(1 / scale[kept])))
    chosen = [names[i] for i in kept]
    parts = tuple(chosen[: len(kept_b)]), tuple(chosen[len(kept_b) :])
    return Information(rig, question, *parts, lost, scale[kept], ca.Function("rows", [*signals], [rows]))


def _independent(columns: np.ndarray) -> np.ndarray:
    """Indices of an independent choice of columns whose RMS is of order 1: QR with pivoting, as Gautier's base parameters."""
    if columns.shape[1] == 0:
        return np.zeros(0, int)
    _, order = scipy.linalg.qr(columns, mode="r", pivoting=True)  # pyright: ignore[reportAssignmentType]
    return np.sort(independent_columns(columns, COLUMN_PROJECTED, math.sqrt(len(columns)), order))


def _stack(values: np.ndarray, p: int) -> np.ndarray:
    """(n, p K) of a mapped Function as rows (n K, p)."""
    return values.reshape(len(values), -1, p).reshape(-1, p)


def _states(limits: Limits, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random q, dq, ddq (n, count) within the limits; joints that stand still do so."""
    rng, n = np.random.default_rng(seed), limits.lower.size
    still = (limits.lower < limits.upper)[:, None]
    speed, acceleration = (
        np.where(np.isfinite(x), x, loose)[:, None] for x, loose in zip((limits.speed, limits.acceleration), LOOSE, strict=True)
    )
    q = limits.lower[:, None] + (limits.upper - limits.lower)[:, None] * rng.random((n, count))
    return q, still * speed * rng.uniform(-1, 1, (n, count)), still * acceleration * rng.uniform(-1, 1, (n, count))


def _signals(n: int) -> tuple[ca.SX, ca.SX, ca.SX]:
    return ca.SX.sym("q", n), ca.SX.sym("dq", n), ca.SX.sym("ddq", n)


@dataclass(frozen=True)
class Search:
    """How a motion is sought.

    Attributes:
        criterion: "log_det": the largest log det S; "condition": the smallest condition number of S.
        duration: Of the motion [s].
        harmonics: Of the base frequency 1/duration.
        starts: Random starts from which IPOPT runs: the best of `draws` a start.
        draws: Random motions drawn for each start.
        seed: Of the random motions.
        iterations: Limit, of each run of IPOPT.
        step: Sampling of the result [s].
    """

    criterion: Criterion = "log_det"
    duration: float = 20.0
    harmonics: int = 8
    starts: int = 3
    draws: int = 30
    seed: int = 0
    iterations: int = 150
    step: float = STEP

    def __post_init__(self) -> None:
        if self.criterion not in get_args(Criterion):
            raise UserError(f"criterion {self.criterion!r}; allowed are {', '.join(get_args(Criterion))}")
        if not 0 < self.duration < math.inf:
            raise UserError(f"duration must be above 0 and finite, got {self.duration} s")
        if self.harmonics < 3:
            raise UserError(f"harmonics must be 3 or more, so that a motion is left that starts at rest, got {self.harmonics}")
        for name in ("starts", "draws", "iterations"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be 1 or more, got {getattr(self, name)}")
        times(self.duration, self.step)


@dataclass(frozen=True, eq=False)
class Series:
    """Periodic motions of one joint whose speed and acceleration are zero at t = 0 and t = T: q(t) = B(t) x.

    B spans 1, sin(k w t)/k and cos(k w t)/k for k = 1…N, w = 2π/T, under Σ a_k = 0 (speed) and Σ k b_k = 0 (acceleration).

    A trigonometric polynomial of degree N is nowhere larger than its largest value at M > 2 N equidistant times over
    cos(π N/M) (Ehlich & Zeller, Math. Z. 86 (1964) 41–44). Limits lowered by that factor on the grid hold between its points.
    """

    duration: float
    harmonics: int

    @property
    def grid(self) -> np.ndarray:
        """16 N equidistant times of one period [s]."""
        count = 16 * self.harmonics
        return np.arange(count) * self.duration / count

    @property
    def margin(self) -> float:
        """cos(π N/M) on the grid, less what the solver's tolerance needs."""
        return math.cos(math.pi / 16) * (1 - 1e-6)

    @cached_property
    def _rest(self) -> np.ndarray:
        """Orthonormal basis of the coefficients (1, a, b) that are at rest at t = 0, shape (2 N + 1, 2 N − 1)."""
        k, zeros = np.arange(1, self.harmonics + 1), np.zeros(self.harmonics)
        return scipy.linalg.null_space(np.array([[0, *(k**0), *zeros], [0, *zeros, *k]]))

    def basis(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """B, dB/dt, d²B/dt² at times t (K,) [s], each (K, 2 N − 1)."""
        k, w, one = np.arange(1, self.harmonics + 1), 2 * np.pi / self.duration, np.ones((len(t), 1))
        s, c = np.sin(w * np.outer(t, k)), np.cos(w * np.outer(t, k))
        rows = np.hstack([one, s / k, c / k]), np.hstack([0 * one, w * c, -w * s]), w**2 * np.hstack([0 * one, -k * s, -k * c])
        return rows[0] @ self._rest, rows[1] @ self._rest, rows[2] @ self._rest

    @property
    def still(self) -> np.ndarray:
        """The coefficients of q = 1, shape (2 N − 1,)."""
        return self._rest[0]

    def random(self, limits: Limits, rng: np.random.Generator) -> np.ndarray:
        """Coefficients (2 N − 1, moving joints) of a random motion within ranges, speed and acceleration limits."""
        bases, moving = self.basis(self.grid), limits.moving
        x = rng.normal(size=(bases[0].shape[1], moving.size))
        x -= np.outer(self.still, self.still @ x)
        middle, half = (limits.upper + limits.lower)[moving] / 2, (limits.upper - limits.lower)[moving] / 2
        allowed = half, limits.speed[moving], limits.acceleration[moving]
        room = [self.margin * limit / np.max(np.abs(basis @ x), axis=0) for basis, limit in zip(bases, allowed, strict=True)]
        size = np.min(room, axis=0) * rng.uniform(0.5, 1, moving.size)
        shift = np.maximum(half - np.max(np.abs(bases[0] @ x), axis=0) * size / self.margin, 0)
        return x * size + np.outer(self.still, middle + shift * rng.uniform(-1, 1, moving.size))

    def motion(self, x: np.ndarray, limits: Limits, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, dq, ddq (n, K) of all joints at times t (K,)."""
        result = []
        for basis in self.basis(t):
            rows = np.zeros((limits.lower.size, len(t)))
            rows[limits.moving] = (basis @ x).T
            result.append(rows)
        result[0] += np.where(limits.lower == limits.upper, limits.lower, 0.0)[:, None]
        return result[0], result[1], result[2]


@dataclass(frozen=True, eq=False)
class Excitation:
    """A motion found, with its problem and statistics.

    Attributes:
        plan: The motion; it starts and ends at the same pose, at rest.
        information: What was asked.
        search: How it was sought.
        log_det, condition: Of S on the plan's samples.
        drawn: What is minimised (−log det S / its size, or the log of a condition number), of all random motions drawn.
        solved: The same where IPOPT ended from each start; infinite where a limit is broken.
        status: IPOPT's word on the run that is kept; at the iterations' limit the motion is usable, yet no local optimum.
        seconds: Wall time.
    """

    plan: PlannedRecording
    information: Information
    search: Search
    log_det: float
    condition: float
    drawn: np.ndarray
    solved: np.ndarray
    status: str
    seconds: float


def excite(rig: Rig, question: Question, search: Search = Search(), name: str = "excitation") -> Excitation:
    """The motion within a rig's limits that answers a question best.

    Raises:
        UserError: No motion within the limits answers the question, or none was found that keeps them.
    """
    began = time.perf_counter()
    asked = information(rig, question)
    problem = _Problem(asked, Series(search.duration, search.harmonics), search)
    starts, drawn = problem.starts()
    runs = [problem.solve(x) for x in starts]
    best = min(runs, key=lambda run: run.value)
    if not math.isfinite(best.value):
        worst = min(runs, key=lambda run: run.violation)
        raise UserError(
            f"no motion found that keeps the limits: at best the {worst.violated} is broken by {worst.violation:.3g} "
            f"[{UNITS[worst.violated]}] ({worst.status} after {worst.iterations} iterations); loosen it or give more starts"
        )
    t = times(search.duration, search.step)
    motion = problem.series.motion(best.x, rig.limits, t)
    plan = PlannedRecording(name, rig.model.robot.joints, t, *motion, rig.payload, rig.springs)
    return Excitation(
        plan, asked, search, asked.log_det(plan), asked.condition(plan), drawn, np.array([run.value for run in runs]),
        best.status, time.perf_counter() - began,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Run:
    """Where IPOPT ended: coefficients, the criterion (infinite where a limit is broken), and what it says."""

    x: np.ndarray
    value: float
    status: str
    iterations: int
    violation: float
    violated: str


@dataclass(frozen=True, eq=False)
class _Problem:
    """The nonlinear program: coefficients x, the criterion, limits on the grid."""

    information: Information
    series: Series
    search: Search

    @property
    def rig(self) -> Rig:
        return self.information.rig

    @cached_property
    def _symbols(self) -> tuple[ca.MX, list[ca.MX], list[ca.MX]]:
        """x (2 N − 1, moving), q, dq, ddq of all joints (n, M), and the moving ones (moving, M)."""
        limits, moving = self.rig.limits, self.rig.limits.moving
        x = ca.MX.sym("x", 2 * self.series.harmonics - 1, moving.size)
        place = ca.DM(np.eye(limits.lower.size)[:, moving])
        rows = [(ca.DM(basis) @ x).T for basis in self.series.basis(self.series.grid)]
        full = [place @ r for r in rows]
        full[0] += np.where(limits.lower == limits.upper, limits.lower, 0.0)[:, None]
        return x, full, rows

    @cached_property
    def criterion(self) -> ca.Function:
        """x -> what is minimised: −log det S / its size, or the logarithm of the condition number in the norm of order 8."""
        x, full, _ = self._symbols
        n, m = full[0].shape
        p, b = len(self.information.scale), len(self.information.nuisance)
        values = self.information.rows.map(m)(*full)
        stacked = ca.vertcat(*[ca.reshape(values[i, :], p, m).T for i in range(n)])
        factor, inverse = _cholesky(p, b)(stacked.T @ stacked / m)
        if self.search.criterion == "log_det":
            cost = -2 * ca.sum1(ca.log(ca.diag(factor))) / (p - b)
        else:
            cost = _log_norm(factor.T @ factor) + _log_norm(inverse @ inverse.T)
        return ca.Function("criterion", [ca.vec(x)], [cost])

    @cached_property
    def path(self) -> PathLimits:
        """The torque limits that motions may come near, and the floor."""
        return self.rig.path.near(_states(self.rig.limits, 400, 0))

    @cached_property
    def constraints(self) -> tuple[ca.Function, np.ndarray, np.ndarray]:
        """x -> (linear rows, path rows), with the bounds of the first; those of the second are the rig's."""
        x, full, rows = self._symbols
        limits, moving, m = self.rig.limits, self.rig.limits.moving, len(self.series.grid)
        middle, half = (limits.upper + limits.lower)[moving] / 2, (limits.upper - limits.lower)[moving] / 2
        sizes = half, limits.speed[moving], limits.acceleration[moving]
        linear, low, high = [], [], []
        for row, size, centre in zip(rows, sizes, (middle, 0 * middle, 0 * middle), strict=True):
            for j in np.flatnonzero(np.isfinite(size)):
                linear.append(row[int(j), :].T)
                low.append(np.full(m, centre[j] - self.series.margin * size[j]))
                high.append(np.full(m, centre[j] + self.series.margin * size[j]))
        outputs = [ca.vertcat(*linear), ca.vec(self.path.function.map(m)(*full))]
        return ca.Function("constraints", [ca.vec(x)], outputs), np.concatenate(low), np.concatenate(high)

    @cached_property
    def solver(self) -> ca.Function:
        x = ca.MX.sym("x", self.criterion.size1_in(0))
        options = {
            "print_time": False,
            "ipopt": {
                "print_level": 0,
                "sb": "yes",
                "hessian_approximation": "limited-memory",
                "linear_solver": "mumps",
                "mu_init": 1e-2,
                "tol": 1e-4,  # of a criterion per parameter: far below what noise leaves of a motion
                "constr_viol_tol": 1e-7,
                "bound_relax_factor": 0.0,
                "max_iter": self.search.iterations,
            },
        }
        return ca.nlpsol(
            "excitation", "ipopt", {"x": x, "f": self.criterion(x), "g": ca.vertcat(*self.constraints[0](x))}, options
        )

    def starts(self) -> tuple[list[np.ndarray], np.ndarray]:
        """The best random motion of each group of draws, those within torque limits and floor first; and all their criteria."""
        rng, s = np.random.default_rng(self.search.seed), self.search
        drawn = [self.series.random(self.rig.limits, rng) for _ in range(s.starts * s.draws)]
        values = np.array([self.value(x) for x in drawn])
        broken = np.array([max(self.rig.excess(*self._between(x)).values()) for x in drawn])
        keys = np.lexsort([values, np.maximum(broken, 0)])
        first = [next(k for k in keys if k // s.draws == i) for i in range(s.starts)]
        return [drawn[k] for k in first], values

    def solve(self, x: np.ndarray) -> _Run:
        """IPOPT from x; torque limits and floor are drawn in, and it runs on, until they hold between the grid's points."""
        path, drawn_in = self.path, np.zeros(len(self.path.names))
        run = self._run(x, drawn_in)
        for _ in range(3):
            drawn_in += 2 * np.maximum(path.excess(*self._between(run.x)), 0)
            crossed = np.any(path.low + drawn_in >= path.high - drawn_in)
            if run.violation <= 0 or run.violated not in path.names or crossed:
                break
            run = self._run(run.x, drawn_in)
        return run

    def _run(self, x: np.ndarray, drawn_in: np.ndarray) -> _Run:
        _, low, high = self.constraints
        path, m = self.path, len(self.series.grid)
        low, high = np.append(low, np.tile(path.low + drawn_in, m)), np.append(high, np.tile(path.high - drawn_in, m))
        end = np.asarray(self.solver(x0=x.ravel("F"), lbg=low, ubg=high)["x"])
        x, stats = end.reshape(x.shape, order="F"), self.solver.stats()
        excess = self.rig.excess(*self._between(x))
        worst = max(excess, key=lambda kind: excess[kind])
        value = self.value(x) if excess[worst] <= 0 else math.inf
        return _Run(x, value, stats["return_status"], stats["iter_count"], excess[worst], worst)

    def value(self, x: np.ndarray) -> float:
        """The criterion at coefficients (2 N − 1, moving joints)."""
        return float(np.asarray(self.criterion(x.ravel("F")))[0, 0])

    def _between(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The motion at 8 times as many points as the grid has."""
        count = 8 * len(self.series.grid)
        return self.series.motion(x, self.rig.limits, np.arange(count) * self.series.duration / count)


def _cholesky(p: int, b: int) -> ca.Function:
    """F (p, p) -> R (p − b, p − b) with S = Rᵀ R, and its inverse; 1e-10 on the diagonal keeps it real."""
    matrix = ca.SX.sym("F", p, p)
    factor = ca.chol(ca.tril2symm(ca.tril(matrix)) + 1e-10 * ca.SX.eye(p))[b:, b:]
    return ca.Function("cholesky", [matrix], [factor, ca.solve(factor, ca.SX.eye(p - b))])


def _log_norm(matrix: ca.MX) -> ca.MX:
    """log of (Σ eigenvalue⁸)^(1/8): smooth, and at most log(size)/8 above that of the largest eigenvalue."""
    square = matrix @ matrix
    return ca.log(ca.sumsqr(square @ square)) / 8

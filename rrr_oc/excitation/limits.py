"""What a motion must keep to: the limits of an arm, and by how much a motion breaks them."""

import math
from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.robot import Robot

PLANNING_WIDTH = 0.1  # rad, rad/s, in each width's unit; laws with narrower transitions are planned for with this width
UNITS = {"range": "rad", "speed": "rad/s", "acceleration": "rad/s²", "torque": "Nm", "floor": "m"}  # of the limits
LOOSE = 2.0, 10.0  # speed [rad/s] and acceleration [rad/s²] that sampled states spread to where nothing limits them
STANDS = 0.2  # share of postures with the tool above the base from which an arm stands; doubled, arms at a wall do not
NO_LIMIT = 1e6  # rad/s, Nm; a URDF's speed or effort of 0 or beyond this means that none is known


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """What a motion must keep to; shapes (n,), infinite where nothing limits it.

    Attributes:
        lower, upper: Joint ranges [rad]; a joint whose two are equal stands still; an infinite one is taken as ±π.
        speed: [rad/s].
        acceleration: [rad/s²].
        torque: Of the motor torque [Nm].
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


def robot_limits(robot: Robot, acceleration: float | np.ndarray = math.inf, floor: float = -math.inf) -> MotionLimits:
    """The limits of a robot's URDF where it has some, and those of which a URDF says nothing."""
    speed, torque = (np.where((x > 0) & (x < NO_LIMIT), x, np.inf) for x in (robot.velocity, robot.effort))
    return MotionLimits(
        robot.lower, robot.upper, speed, np.broadcast_to(np.asarray(acceleration, float), robot.n), torque, floor
    )


def stands(robot: Robot) -> bool:
    """Whether an arm stands: in the middle of its ranges, and in some of its postures, the tool is above the base's plane."""
    limits, model = robot_limits(robot), Model(robot, robot.tool)
    q = ca.SX.sym("q", robot.n)
    height = ca.Function("height", [q], [model.tool_height(q)])
    middle = np.where(limits.lower * limits.upper < 0, 0.0, (limits.lower + limits.upper) / 2)
    postures = np.asarray(height(states_within(limits, 400, 0)[0]))
    return float(np.asarray(height(middle)).item()) > -1e-6 and bool(np.mean(postures > 0) > STANDS)


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
        """The limits that can bind: the floor, and the torque limits of which some of the states (n, K) reach a half."""
        values = np.asarray(self.function(*states))
        near = [k for k, name in enumerate(self.names) if name == "floor" or np.max(np.abs(values[k])) > self.high[k] / 2]
        arguments = signals(states[0].shape[0])
        function = ca.Function("path", [*arguments], [self.function(*arguments)[near]])
        return PathLimits(function, self.low[near], self.high[near], tuple(self.names[k] for k in near))


@dataclass(frozen=True, eq=False)
class Rig:
    """An arm in the laboratory: its model with the springs that are mounted, their values, payload [kg] and limits."""

    model: Model
    limits: MotionLimits
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

    @cached_property
    def path(self) -> PathLimits:
        """Torque limits and floor as functions of the motion."""
        q, dq, ddq = signals(self.model.robot.n)
        widths = np.maximum(self.model.widths, PLANNING_WIDTH)
        torque = self.model.motor_inverse(q, dq, ddq, 0.0, self.payload, self.theta, widths, self.model.robot.inertial)[0]
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


def states_within(limits: MotionLimits, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random q, dq, ddq (n, count) within the limits; joints that stand still do so."""
    rng, n = np.random.default_rng(seed), limits.lower.size
    still = (limits.lower < limits.upper)[:, None]
    speed, acceleration = (
        np.where(np.isfinite(x), x, loose)[:, None] for x, loose in zip((limits.speed, limits.acceleration), LOOSE, strict=True)
    )
    q = limits.lower[:, None] + (limits.upper - limits.lower)[:, None] * rng.random((n, count))
    return q, still * speed * rng.uniform(-1, 1, (n, count)), still * acceleration * rng.uniform(-1, 1, (n, count))


def signals(n: int) -> tuple[ca.SX, ca.SX, ca.SX]:
    """q, dq, ddq of n joints as symbols, (n,) each."""
    return ca.SX.sym("q", n), ca.SX.sym("dq", n), ca.SX.sym("ddq", n)

"""The pick-and-place task: where from, where to, with what load, within which limits. All of it data, read from a file."""

import importlib.resources
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import casadi as ca
import numpy as np
from scipy.optimize import least_squares

from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.parameters import check_names, read_number, read_object, read_vector
from rrr_oc.robot.rigid_body import RigidBody, rigid_body
from rrr_oc.robot.robot import Robot, ToolPoint, load_robot

PRESETS = ("paper", "prototype")
PHASES = ("go", "return")
_KEYS = (
    "format",
    "name",
    "robot",
    "gravity",
    "moving",
    "tool",
    "start",
    "release",
    "payload_kg",
    "duration_s",
    "path_margin",
    "floor_m",
    "limits",
    "springs",
)


@dataclass(frozen=True, eq=False)
class Task:
    """Carry a payload from start to release (phase "go"), and come back without it ("return"); at rest at both ends of each.

    Attributes:
        name: Name in reports.
        robot: The whole arm.
        tool: Where it holds the payload.
        moving: Indices of the joints that move (m); the others are locked at zero.
        start, release: Angles of the moving joints [rad], (m,).
        payload: Carried in the go phase only [kg].
        duration: Bounds of each phase's duration [s].
        lower, upper: Angles allowed [rad], (m,).
        speed: Speed limits [rad/s], (m,).
        acceleration: Acceleration limits [rad/s²], (m,); infinite where there is none.
        torque: Load-torque limits [Nm], (m,); infinite where there is none.
        floor: Height that the tool stays above [m], against gravity; -infinity where nothing stands below.
        springs: The springs that a design may use, as in the file.
    """

    name: str
    robot: Robot
    tool: ToolPoint
    moving: tuple[int, ...]
    start: np.ndarray
    release: np.ndarray
    payload: float
    duration: tuple[float, float]
    lower: np.ndarray
    upper: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    torque: np.ndarray
    floor: float
    springs: tuple[Mapping[str, Any], ...]

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the moving joints."""
        return tuple(self.robot.joints[j] for j in self.moving)

    @property
    def payloads(self) -> tuple[float, float]:
        """Payload in each phase [kg]."""
        return self.payload, 0.0

    def ends(self, phase: int) -> tuple[np.ndarray, np.ndarray]:
        """Angles at the start and at the end of a phase [rad]."""
        return (self.start, self.release) if phase == 0 else (self.release, self.start)

    def model(self, effects: Sequence = ()) -> Model:
        """The whole arm with these effects."""
        return Model(self.robot, self.tool, tuple(effects))

    def full(self, moving: np.ndarray) -> np.ndarray:
        """Values of all joints, (n, ...), from those of the moving ones, (m, ...); the locked ones are zero."""
        values = np.zeros((self.robot.n, *np.shape(moving)[1:]))
        values[list(self.moving)] = moving
        return values


def load_task(source: str | Path) -> Task:
    """Read a task: the name of a preset (`PRESETS`) or the path of a JSON file of the same form.

    Raises:
        UserError: The file is missing or malformed; bounds are crossed; a position is out of reach; an end lies outside
            the joint ranges.
    """
    where, content = _read(source)
    check_names(content, _KEYS, where)
    missing = [k for k in ("robot", "moving", "start", "release", "payload_kg", "duration_s", "limits") if k not in content]
    if missing:
        raise UserError(f"{where}: key {missing[0]!r} is missing")
    robot = _robot(source, content)
    names = content["moving"]
    if not isinstance(names, list) or not names or not all(isinstance(j, str) for j in names):
        raise UserError(f"{where}: moving must be a list of joint names, got {names!r}")
    moving = tuple(robot.index(j) for j in names)
    if list(moving) != sorted(set(moving)):
        raise UserError(f"{where}: moving must list different joints, base first, got {names}")
    tool = robot.tool
    if "tool" in content:
        given = read_object(where, "tool", content["tool"], ("link", "position_m"), ("link", "position_m"))
        tool = robot.point(str(given["link"]), read_vector(where, "tool's position_m", given["position_m"], 3).tolist())
    limits = _limits(where, robot, moving, content["limits"])
    low, high = _pair(where, "duration_s", content["duration_s"])
    if not low > 0:
        raise UserError(f"{where}: duration_s must be above 0, got {low:g} … {high:g}")
    springs = content.get("springs", [])
    if not isinstance(springs, list) or not all(isinstance(entry, dict) for entry in springs):
        raise UserError(f"{where}: springs must be a list of objects, got {springs!r}")
    task = Task(
        name=str(content.get("name", Path(str(source)).stem)),
        robot=robot,
        tool=tool,
        moving=moving,
        start=np.zeros(len(moving)),
        release=np.zeros(len(moving)),
        payload=read_number(where, "payload_kg", content["payload_kg"], 0.0),
        duration=(low, high),
        floor=read_number(where, "floor_m", content["floor_m"]) if "floor_m" in content else -np.inf,
        springs=tuple(springs),
        **limits,
    )
    body = rigid_body(robot)
    start, release = (_angles(f"{where}: {end}", task, body, content[end]) for end in ("start", "release"))
    margin = read_number(where, "path_margin", content["path_margin"], 0.0) if "path_margin" in content else None
    task = _within_margin(replace(task, start=start, release=release), margin)
    _check_feasible(where, task, body)
    return task


def _check_feasible(where: str, task: Task, body: RigidBody) -> None:
    """Raise `UserError` where the limits leave no motion: too little time for the way, or an end below the floor."""
    for joint, way, speed, acceleration in zip(
        task.joints, np.abs(task.release - task.start), task.speed, task.acceleration, strict=True
    ):
        ramp = speed / acceleration if np.isfinite(acceleration) else 0.0  # time to full speed
        needed = way / speed + ramp if way > speed * ramp else 2 * np.sqrt(way / acceleration)
        if needed > task.duration[1]:
            raise UserError(
                f"{where}: the task cannot be done: {joint} needs {needed:.2f} s for its {np.degrees(way):.1f}° at "
                f"{np.degrees(speed):.1f} °/s and {np.degrees(acceleration):.4g} °/s², and duration_s allows "
                f"{task.duration[1]:g} s"
            )
    for end, q in (("start", task.start), ("release", task.release)):
        height = float(tool_height(task, body, task.full(q)))
        if height < task.floor:
            raise UserError(f"{where}: at the {end} the tool stands {height:.4f} m high, below floor_m = {task.floor:g} m")


def tool_height(task: Task, body: RigidBody, q):
    """Height of the tool against gravity, from the base [m]; casadi or numpy angles of all joints."""
    up = -task.robot.gravity / max(float(np.linalg.norm(task.robot.gravity)), 1e-12)
    frames = body.joint_frames(q)
    rotation = ca.reshape(frames[:9, task.tool.joint], 3, 3)
    return ca.dot(ca.DM(up), rotation @ ca.DM(task.tool.position) + frames[9:, task.tool.joint])


def _read(source: str | Path) -> tuple[str, dict]:
    if str(source) in PRESETS:
        return f"preset {source!r}", json.loads(importlib.resources.files("rrr_oc.data").joinpath(f"{source}.json").read_text())
    path = Path(source)
    if not path.is_file():
        raise UserError(f"no task at {str(source)!r}; give the path of a task file or one of the presets {', '.join(PRESETS)}")
    try:
        content = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(content, dict) or content.get("format") != "rrr_oc-task/1":
        raise UserError(f'{path}: expected an object with "format": "rrr_oc-task/1"')
    return str(path), content


def _robot(source: str | Path, content: dict) -> Robot:
    name = str(content["robot"])
    gravity = read_vector(f"task {name!r}", "gravity", content.get("gravity", (0.0, 0.0, -9.81)), 3).tolist()
    beside = Path(source).parent / name
    return load_robot(beside if str(source) not in PRESETS and beside.is_file() else name, gravity=gravity)


def _limits(where: str, robot: Robot, moving: tuple[int, ...], content: dict) -> dict[str, np.ndarray]:
    columns: dict[str, list[float]] = {k: [] for k in ("lower", "upper", "speed", "acceleration", "torque")}
    content = read_object(where, "limits", content, tuple(robot.joints[j] for j in moving))
    for j in moving:
        joint = robot.joints[j]
        here, keys = f"{where}: limits of {joint}", ("range_deg", "speed_deg_per_s", "acceleration_deg_per_s2", "torque_Nm")
        given = read_object(where, f"limits of {joint}", content.get(joint, {}), keys)
        low, high = _pair(here, "range_deg", given.get("range_deg", np.degrees([robot.lower[j], robot.upper[j]])))
        columns["lower"].append(np.radians(low))
        columns["upper"].append(np.radians(high))
        for column, key, default in (
            ("speed", "speed_deg_per_s", np.degrees(robot.velocity[j])),
            ("acceleration", "acceleration_deg_per_s2", np.inf),
        ):
            columns[column].append(np.radians(_positive(here, key, given.get(key, default))))
        columns["torque"].append(_positive(here, "torque_Nm", given.get("torque_Nm", np.inf)))
    return {k: np.array(v, float) for k, v in columns.items()}


def _pair(where: str, key: str, values: Any) -> tuple[float, float]:
    try:
        low, high = (float(v) for v in values)
    except (TypeError, ValueError):
        raise UserError(f"{where}: {key} must be two numbers [lower, upper], got {values!r}") from None
    if not low <= high:
        raise UserError(f"{where}: bounds of {key} are crossed: {low:g} … {high:g}; the lower must not be above the upper")
    return low, high


def _positive(where: str, key: str, value: Any) -> float:
    if not isinstance(value, int | float) or not value > 0:
        raise UserError(f"{where}: {key} must be a number above 0, got {value!r}")
    return float(value)


def _angles(where: str, task: Task, body: RigidBody, content: Any) -> np.ndarray:
    """Angles of the moving joints from `angles_deg` or `position_m`."""
    if not isinstance(content, dict) or set(content) not in ({"angles_deg"}, {"position_m"}):
        raise UserError(f'{where}: give either "angles_deg" or "position_m", got {content!r}')
    if "position_m" in content:
        return inverse_kinematics(task, body, read_vector(where, "position_m", content["position_m"], 3), where)
    angles = np.radians(read_vector(where, "angles_deg", content["angles_deg"], len(task.moving)))
    for joint, angle, low, high in zip(task.joints, angles, task.lower, task.upper, strict=True):
        if not low <= angle <= high:
            raise UserError(
                f"{where}: {joint} would stand at {np.degrees(angle):.2f}°, outside its range "
                f"{np.degrees(low):.2f}° … {np.degrees(high):.2f}°"
            )
    return angles


def inverse_kinematics(task: Task, body: RigidBody, position: np.ndarray, where: str = "position") -> np.ndarray:
    """Angles of the moving joints that put the tool at `position` [m], elbow up, within the joint ranges.

    Of all solutions, the one whose joints lie highest against gravity is taken, which is what "elbow up" means.
    Raises `UserError` with the nearest distance if the tool does not reach the position.
    """
    if task.tool.joint != task.robot.n - 1:
        raise UserError(f"{where}: a position needs the tool on the last link; give angles_deg")
    jacobian, columns = body.tool_jacobian, list(task.moving)

    def error(q: np.ndarray) -> np.ndarray:
        return np.array(body.tool_position(task.full(q), task.tool.position)).ravel() - position

    def slope(q: np.ndarray) -> np.ndarray:
        return np.array(jacobian(task.full(q), task.tool.position))[:, columns]

    low, high = np.maximum(task.lower, -np.pi), np.minimum(task.upper, np.pi)
    starts = low + (high - low) * np.random.default_rng(0).random((32, len(columns)))
    fits = [
        least_squares(error, s, cast(Any, slope), bounds=(low - 1e-9, high + 1e-9), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        for s in starts
    ]
    reached = [fit.x for fit in fits if np.abs(fit.fun).max() < 1e-8]
    if not reached:
        nearest = min(float(np.linalg.norm(fit.fun)) for fit in fits)
        raise UserError(
            f"{where} at {np.round(position, 4).tolist()} m is out of reach within the joint ranges: "
            f"the tool comes no nearer than {nearest:.4f} m"
        )
    up = -task.robot.gravity / max(float(np.linalg.norm(task.robot.gravity)), 1e-12)
    best = max(reached, key=lambda q: float((up @ np.array(body.joint_frames(task.full(q)))[9:]).sum()))
    return np.clip(best, task.lower, task.upper)


def _within_margin(task: Task, margin: float | None) -> Task:
    """Narrow the joint ranges to the range start–release, widened by `margin` of it on each side."""
    if margin is None:
        return task
    ends = np.array([task.start, task.release])
    width = margin * np.ptp(ends, axis=0)
    return replace(
        task, lower=np.maximum(task.lower, ends.min(axis=0) - width), upper=np.minimum(task.upper, ends.max(axis=0) + width)
    )

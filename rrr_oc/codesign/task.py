"""The pick-and-place task, read from a file: start and release, payload, limits, and the springs that a design may use."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np
from msgspec import Meta, field
from scipy.optimize import least_squares

from rrr_oc.effects import design_forms
from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.recordings.csv_table import read_table
from rrr_oc.robot.rigid_body import RigidBody, rigid_body, upwards
from rrr_oc.robot.robot import Robot, ToolPoint, load_robot, resting_angle
from rrr_oc.schema import (
    Interval,
    NonNegative,
    Payload,
    Position,
    Positive,
    Schema,
    Text,
    Vector,
    check_interval,
    check_names,
    read_preset,
)

PRESETS = ("paper", "prototype", "more_springs", "further_springs", "series_springs")
PHASES = ("go", "return")
NEAR = 1e-3  # [m] between the tool and a position that it reaches; angles and positions in files are rounded; doubled, nothing changes
NO_LIMIT = 1e6  # [Nm]; a robot file's torque limit of this or more means that none is known
Speed = Literal["rest", "moving", "free"]


class Tool(Schema, frozen=True):
    """Where the payload is held.

    Attributes:
        link: Name of the link that carries it.
        position_m: The point in the link's frame.
    """

    link: Text
    position_m: Position


class End(Schema, frozen=True):
    """Where a phase starts or ends, by angles or by position.

    Attributes:
        angles_deg: Angles of the moving joints, in their order.
        position_m: Position of the tool in the base frame.
        speed: Whether the arm rests there; or moves, at the end of one phase as at the start of the next; or has any speed before and
            any other after, as in the code of the paper's authors ("free").
    """

    angles_deg: tuple[float, ...] | None = None
    position_m: Position | None = None
    speed: Speed = "rest"

    def __post_init__(self) -> None:
        if (self.angles_deg is None) == (self.position_m is None):
            raise ValueError('give either "angles_deg" or "position_m"')


class Limits(Schema, frozen=True):
    """Limits of a joint; those left out are the robot file's range, speed and torque, and no limit of acceleration.

    Attributes:
        range_deg: Least and greatest angle.
        speed_deg_per_s: Greatest speed.
        acceleration_deg_per_s2: Greatest acceleration.
        torque_Nm: Greatest load torque; by default the robot file's, and with "none" there is no limit.
    """

    range_deg: Interval | None = None
    speed_deg_per_s: Positive | None = None
    acceleration_deg_per_s2: Positive | None = None
    torque_Nm: Positive | Literal["none"] | None = None

    def __post_init__(self) -> None:
        check_interval("range_deg", self.range_deg)


class TaskFile(Schema, frozen=True):
    """The content of a task's file.

    Attributes:
        format: What the file is.
        robot: A bundled model or the path of a URDF or MJCF, relative to this file.
        moving: The joints that move, base first; the others are locked.
        start: Where the arm takes the payload.
        release: Where it lets it go; it comes back without it.
        payload_kg: Mass that it carries from start to release.
        duration_s: Least and greatest duration of each way, above 0.
        limits: Limits by moving joint.
        cycle_s: Least and greatest duration of both ways together, above 0; by default what `duration_s` allows.
        name: Name in reports; by default the file's.
        gravity: Acceleration of gravity in the base frame [m/s²]. Default: the MJCF's; of a URDF [0, 0, -9.81].
        tool: Where the payload is held; by default the last link's tool frame.
        path_margin: If given, the joints' ranges become the way between both ends, widened on each side by this share of it [1].
        floor_m: Height that the tool stays above; by default none.
        springs: Springs that a design may use, each with bounds of its quantities.
        locked_deg: Angles of joints that do not move; 0 for those left out, or the middle of a range that lacks 0.
        joints: The arm's joints, in the order of the chain; others are held still, whatever their type, such as a gripper's fingers.
            By default all are the arm's.
    """

    format: Literal["rrr_oc-task/1"]
    robot: Text
    moving: Annotated[tuple[Text, ...], Meta(min_length=1)]
    start: End
    release: End
    payload_kg: Payload
    duration_s: Interval
    limits: dict[str, Limits]
    cycle_s: Interval | None = None
    name: Text | None = None
    gravity: Vector | None = None
    tool: Tool | None = None
    path_margin: NonNegative | None = None
    floor_m: float = -np.inf
    springs: list[dict[str, Any]] = field(default_factory=list)
    locked_deg: dict[str, float] = field(default_factory=dict)
    joints: tuple[Text, ...] | None = None

    def __post_init__(self) -> None:
        check_interval("duration_s", self.duration_s)
        if not self.duration_s[0] > 0:
            raise ValueError(f"duration_s: found {list(self.duration_s)}; durations above 0 are required")
        check_interval("cycle_s", self.cycle_s)
        least, most = (2 * side for side in self.duration_s)
        if self.cycle_s is not None and not (self.cycle_s[0] <= most and self.cycle_s[1] >= least):
            raise ValueError(f"cycle_s: found {list(self.cycle_s)}; two ways of duration_s take {least:g} … {most:g} s")


@dataclass(frozen=True, eq=False)
class Task:
    """Carry a payload from start to release (phase "go"), and come back without it ("return"), again and again.

    Attributes:
        name: Name in reports.
        robot: The whole arm.
        tool: Where it holds the payload.
        moving: Indices of the joints that move (m); the others are locked.
        start, release: Angles of the moving joints [rad], (m,).
        payload: Carried in the go phase only [kg].
        duration: Bounds of each phase's duration [s].
        lower, upper: Angles allowed [rad], (m,).
        speed: Speed limits [rad/s], (m,).
        acceleration: Acceleration limits [rad/s²], (m,); infinite where there is none.
        torque: Load-torque limits [Nm], (m,); infinite where there is none.
        floor: Height that the tool stays above [m], against gravity; -infinity where nothing stands below.
        springs: The springs that a design may use, as in the file, with the rows of tables that stand in files of their own.
        locked: Angles of all joints while the moving ones stand at zero [rad], (n,); empty where all are locked at zero.
        speeds: Of the arm at start and release, as in the file.
        cycle: Bounds of the duration of both phases together [s], if there are some beside theirs.
        files: The files that it was read from.
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
    locked: tuple[float, ...] = ()
    speeds: tuple[Speed, Speed] = ("rest", "rest")
    cycle: Interval | None = None
    files: tuple[Path, ...] = ()

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

    @property
    def at_rest(self) -> bool:
        """Whether the arm is at rest at both ends of each phase."""
        return self.speeds == ("rest", "rest")

    def model(self, effects: Sequence = ()) -> Model:
        """The whole arm with these effects."""
        return Model(self.robot, self.tool, tuple(effects))

    def full(self, moving: np.ndarray) -> np.ndarray:
        """Angles of all joints, (n, ...), from those of the moving ones, (m, ...)."""
        still = np.array(self.locked or (0.0,) * self.robot.n).reshape(-1, *[1] * (np.ndim(moving) - 1))
        return self.full_rates(moving) + still

    def full_rates(self, moving: np.ndarray) -> np.ndarray:
        """Speeds or accelerations of all joints, (n, ...), from those of the moving ones, (m, ...); the locked ones are zero."""
        values = np.zeros((self.robot.n, *np.shape(moving)[1:]))
        values[list(self.moving)] = moving
        return values


def load_task(source: str | Path) -> Task:
    """Read a task: the name of a preset (`PRESETS`) or the path of a JSON file of the same form.

    Raises `UserError` as `read_task` and `task_of` do.
    """
    return task_of(*read_task(source), source)


def read_task(source: str | Path) -> tuple[str, TaskFile]:
    """The name in messages and the content of a task's file; raises `UserError` where it is missing or malformed."""
    return read_preset("task", source, {name: f"{name}.json" for name in PRESETS}, TaskFile)


def task_of(where: str, given: TaskFile, source: str | Path) -> Task:
    """The task that the content of a file describes; its robot may stand beside the file `source`.

    Raises:
        UserError: The robot is missing; bounds are crossed; a position is out of reach; an end lies outside the joint ranges.
            The message begins with `where`.
    """
    beside = Path(source).parent / given.robot
    own = str(source) not in PRESETS and beside.is_file()
    springs, tables = _with_tables(where, given.springs, Path(source).parent)
    robot = load_robot(beside if own else given.robot, given.joints, gravity=given.gravity)
    moving = tuple(robot.index(j) for j in given.moving)
    if list(moving) != sorted(set(moving)):
        raise UserError(f"{where}: moving: found {', '.join(given.moving)}; different joints, base first, are required")
    task = Task(
        name=given.name or Path(str(source)).stem,
        robot=robot,
        tool=robot.tool if given.tool is None else robot.point(given.tool.link, given.tool.position_m),
        moving=moving,
        start=np.zeros(len(moving)),
        release=np.zeros(len(moving)),
        payload=given.payload_kg,
        duration=given.duration_s,
        floor=given.floor_m,
        springs=springs,
        locked=_locked(where, robot, given),
        speeds=(given.start.speed, given.release.speed),
        cycle=given.cycle_s,
        files=tuple(Path(file) for file in (source, beside if own else given.robot, *tables) if Path(file).is_file()),
        **_limits(where, robot, given),
    )
    body = rigid_body(robot)
    start, release = (_angles(f"{where}: {end}", task, body, getattr(given, end)) for end in ("start", "release"))
    task = replace(task, start=start, release=release)
    if given.path_margin is not None:  # the ranges become the one between the ends, widened by this share of it on each side
        ends = np.array([start, release])
        width = given.path_margin * np.ptp(ends, axis=0)
        lower, upper = np.maximum(task.lower, ends.min(axis=0) - width), np.minimum(task.upper, ends.max(axis=0) + width)
        task = replace(task, lower=lower, upper=upper)
    _check_feasible(where, task, body)
    return task


def _with_tables(
    where: str, springs: Sequence[Mapping[str, Any]], folder: Path
) -> tuple[tuple[dict[str, Any], ...], list[Path]]:
    """Entries of springs with the rows of their tables in the place of names of CSV files, and these files.

    Raises `UserError` where a file is missing, lacks a column or has a cell that is no number.
    """
    tables = {kind.name: kind.design.tables for kind in design_forms().values()}
    read, files = [], []
    for i, entry in enumerate(springs):
        rows = {}
        for key, columns in tables.get(str(entry.get("effect")), {}).items():
            if isinstance(entry.get(key), str):
                files.append(folder / entry[key])
                table = read_table(files[-1])
                if table.names != columns:
                    found = f"found the columns {', '.join(table.names)} in {files[-1]}"
                    raise UserError(f"{where}: springs[{i}].{key}: {found}; {', '.join(columns)} are required")
                rows[key] = table.columns(columns).T.tolist()
        read.append({**entry, **rows})
    return tuple(read), files


def _check_feasible(where: str, task: Task, body: RigidBody) -> None:
    """Raise `UserError` where the limits leave no motion: too little time for the way, or an end below the floor."""
    rests = task.speeds.count("rest")  # ends at which a motion starts or stops
    for joint, way, speed, acceleration in zip(
        task.joints, np.abs(task.release - task.start), task.speed, task.acceleration, strict=True
    ):
        lost = rests * speed / acceleration / 2 if rests and np.isfinite(acceleration) else 0.0  # time at less than full speed
        needed = way / speed + lost if not lost or way > speed * lost else np.sqrt(2 * rests * way / acceleration)
        for ways, (_, most), key in ((1, task.duration, "duration_s"), (2, task.cycle or (0.0, np.inf), "cycle_s")):
            if ways * needed > most:
                raise UserError(
                    f"{where}: the task cannot be done: {joint} needs {needed:.2f} s for its {np.degrees(way):.1f}°{' each way' * (ways - 1)} "
                    f"at {np.degrees(speed):.1f} °/s and {np.degrees(acceleration):.4g} °/s², and {key} allows {most:g} s"
                )
    for end, q in (("start", task.start), ("release", task.release)):
        height = float(body.tool_height(task.full(q), task.tool, task.robot.gravity))
        if height < task.floor:
            raise UserError(f"{where}: at the {end} the tool stands {height:.4f} m high, below floor_m = {task.floor:g} m")


def _locked(where: str, robot: Robot, given: TaskFile) -> tuple[float, ...]:
    """Angles of the locked joints [rad], (n,), those of the moving ones zero; raises `UserError` for one outside its range.

    One that the task does not say is 0, or the middle of a range that lacks 0.
    """
    check_names(given.locked_deg, [j for j in robot.joints if j not in given.moving], f"{where}: locked_deg", "locked joint")
    free = zip(robot.joints, robot.lower, robot.upper, strict=True)
    angles = np.array([0.0 if joint in given.moving else resting_angle(low, high) for joint, low, high in free])
    for joint, degrees in given.locked_deg.items():
        j = robot.index(joint)
        angles[j] = np.radians(degrees)
        known = robot.lower[j] < robot.upper[j]  # else the robot's notes say that there is no range
        if known and not robot.lower[j] <= angles[j] <= robot.upper[j]:
            low, high = np.degrees([robot.lower[j], robot.upper[j]])
            raise UserError(f"{where}: locked_deg.{joint}: found {degrees:g}; its range is {low:.2f}° … {high:.2f}°")
    return tuple(angles.tolist())


def _limits(where: str, robot: Robot, given: TaskFile) -> dict[str, np.ndarray]:
    """Limits of the moving joints in SI units, (m,) each, by the names of `Task`'s attributes."""
    check_names(given.limits, given.moving, f"{where}: limits", "joint")
    rows = []
    for joint in given.moving:
        j, own = robot.index(joint), given.limits.get(joint, Limits())
        low, high = own.range_deg or np.degrees([robot.lower[j], robot.upper[j]])
        if not low < high:
            raise UserError(f"{where}: limits.{joint}: key 'range_deg' is missing; the URDF's range is {low:g}° … {high:g}°")
        speed = own.speed_deg_per_s or np.degrees(robot.velocity[j])
        if not speed > 0:
            raise UserError(f"{where}: limits.{joint}: key 'speed_deg_per_s' is missing; the URDF allows no speed")
        acceleration = own.acceleration_deg_per_s2 or np.inf
        rows.append([*np.radians([low, high, speed, acceleration]), _torque_limit(own, robot.effort[j])])
    return dict(zip(("lower", "upper", "speed", "acceleration", "torque"), np.array(rows).T, strict=True))


def _torque_limit(own: Limits, effort: float) -> float:
    """The limit of a joint's torque [Nm], from a task and the robot's file; infinite where there is none."""
    if isinstance(own.torque_Nm, float):
        return own.torque_Nm
    return np.inf if own.torque_Nm == "none" or effort >= NO_LIMIT else effort


def overloads(task: Task) -> dict[str, str]:
    """By joint, a sentence on the torque that it needs to stand at an end of a phase where its limit is less; without springs."""
    gravity_torque, found = task.model().inverse, dict[str, str]()
    for end, q in (("start", task.start), ("release", task.release)):
        for payload in task.payloads:
            torque, _ = gravity_torque(task.full(q), np.zeros(task.robot.n), np.zeros(task.robot.n), payload, [], [])
            needed = np.abs(np.array(torque).ravel()[list(task.moving)])
            for joint, tau, limit in zip(task.joints, needed, task.torque, strict=True):
                if tau > limit:
                    told = f"{joint} needs {tau:.4g} Nm to hold {payload:g} kg at the {end}, and its limit is {limit:.4g} Nm"
                    found.setdefault(joint, told)
    return found


def _angles(where: str, task: Task, body: RigidBody, end: End) -> np.ndarray:
    """Angles of the moving joints at an end of a phase [rad], (m,)."""
    if end.angles_deg is None:
        return inverse_kinematics(task, body, np.array(end.position_m), where)
    angles = np.radians(end.angles_deg)
    if len(angles) != len(task.moving):
        raise UserError(f"{where}.angles_deg: found {list(end.angles_deg)}; one number per moving joint is required")
    for joint, angle, low, high in zip(task.joints, angles, task.lower, task.upper, strict=True):
        if not low <= angle <= high:
            outside = f"outside its range {np.degrees(low):.2f}° … {np.degrees(high):.2f}°"
            raise UserError(f"{where}: {joint} would stand at {np.degrees(angle):.2f}°, {outside}")
    return angles


def inverse_kinematics(task: Task, body: RigidBody, position: np.ndarray, where: str = "position") -> np.ndarray:
    """Angles of the moving joints that put the tool at `position` [m], within `NEAR`, elbow up, within the joint ranges.

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
    reached = [fit.x for fit in fits if fit.success and np.linalg.norm(fit.fun) < NEAR]
    if not reached:
        nearest = min(fits, key=lambda fit: float(np.linalg.norm(fit.fun)))
        told = f"{where} at {np.round(position, 4).tolist()} m is out of reach within the joint ranges"
        point = (np.round(position + nearest.fun, 4) + 0.0).tolist()
        fixed = [
            axis
            for axis, row in zip("xyz", np.array([slope(s) for s in starts]).swapaxes(0, 1), strict=True)
            if np.abs(row).max() < 1e-9
        ]
        why = f"; {', '.join(task.joints)} cannot change {' and '.join(fixed)}" if fixed else ""
        raise UserError(f"{told}: the tool comes no nearer than {np.linalg.norm(nearest.fun):.4f} m, at {point} m{why}")
    up = upwards(task.robot.gravity)
    best = max(reached, key=lambda q: float((up @ np.array(body.joint_frames(task.full(q)))[9:]).sum()))
    return np.clip(best, task.lower, task.upper)

"""The pick-and-place task, read from a file: start and release, payload, limits, and the springs that a design may use."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import casadi as ca
import numpy as np
from msgspec import Meta, field
from scipy.optimize import least_squares, minimize

from rrr_oc.codesign.clearance import FLOOR, TOOL, Clearance, KeepOut, Surroundings, link_ends
from rrr_oc.codesign.parts.limits import SpringLimits
from rrr_oc.effects import design_forms
from rrr_oc.effects.springs import PHASES
from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.recordings.csv_table import read_table
from rrr_oc.robot.drives import MotorAndGear
from rrr_oc.robot.goals import Goal
from rrr_oc.robot.rigid_body import RigidBody, rigid_body, upwards
from rrr_oc.robot.robot import Robot, ToolPoint, load_robot, resting_angle
from rrr_oc.schema import (
    Interval,
    NonNegative,
    Payload,
    Position,
    Positive,
    Schema,
    Share,
    Text,
    Vector,
    check_interval,
    check_names,
    read_preset,
)

PRESETS = ("paper", "prototype", "more_springs", "further_springs", "series_springs")
NEAR = 1e-3  # [m] between the tool and a position that it reaches; angles and positions in files are rounded; doubled, nothing changes
MILLIMETRES = 100.0  # times as far away as the tool comes, from which a position looks like one in mm; doubled, nothing changes
TRIED = 8  # postures from which the one of least torque is sought; doubled, slower and surer
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


class Direction(Schema, frozen=True):
    """Which way the tool points.

    Attributes:
        axis: An axis of the tool's link, of any length above 0.
        towards: Where it points, in the base frame, of any length above 0.
    """

    axis: Vector
    towards: Vector

    def __post_init__(self) -> None:
        for name in ("axis", "towards"):
            if not any(getattr(self, name)):
                raise ValueError(f"{name}: found {list(getattr(self, name))}; a length above 0 is required")


class End(Schema, frozen=True):
    """Where a phase starts or ends, by angles or by position.

    Attributes:
        angles_deg: Angles of the moving joints, in their order.
        position_m: Position of the tool in the base frame.
        direction: Which way the tool points at that position; by default any.
        posture: Of joints that reach the position in many postures: "free", and it is designed with the motion, or "held", and it is the one
            in which the arm needs the least torque to stand still, without springs.
        speed: Whether the arm rests there; or moves, at the end of one phase as at the start of the next; or has any speed before and
            any other after, as in the code of the paper's authors ("free").
    """

    angles_deg: tuple[float, ...] | None = None
    position_m: Position | None = None
    direction: Direction | None = None
    posture: Literal["free", "held"] = "free"
    speed: Speed = "rest"

    def __post_init__(self) -> None:
        _check_place(self)


class Via(Schema, frozen=True):
    """A point that a phase passes, by angles or by position.

    Attributes:
        phase: Which way: "go" with the payload, or "return".
        angles_deg: Angles of the moving joints, in their order.
        position_m: Position of the tool in the base frame; the posture is free.
        direction: Which way the tool points at that position; by default any.
        time_share: Share of the phase's time after which it is there, between 0 and 1; where no point of a phase has one, they divide its
            time evenly.
    """

    phase: Literal["go", "return"]
    angles_deg: tuple[float, ...] | None = None
    position_m: Position | None = None
    direction: Direction | None = None
    time_share: Share | None = None

    def __post_init__(self) -> None:
        _check_place(self)
        if self.time_share is not None and not 0 < self.time_share < 1:
            raise ValueError(f"time_share: found {self.time_share:g}; a share between 0 and 1 is required")


def _check_place(given: End | Via) -> None:
    """Raise `ValueError` unless a place is given by either angles or position."""
    if (given.angles_deg is None) == (given.position_m is None):
        raise ValueError('give either "angles_deg" or "position_m"')
    if given.direction is not None and given.position_m is None:
        raise ValueError("direction: a direction needs a position_m; angles_deg say it already")


class Limits(Schema, frozen=True):
    """Limits of a joint; those left out are the robot file's range, speed and torque, and no limit of acceleration.

    Attributes:
        range_deg: Least and greatest angle.
        speed_deg_per_s: Greatest speed.
        acceleration_deg_per_s2: Greatest acceleration.
        jerk_deg_per_s3: Greatest jerk, the rate of the acceleration; with one the acceleration is 0 where the arm rests at start and release.
            By default there is no limit, and accelerations may jump.
        torque_Nm: Greatest load torque; by default the robot file's, and with "none" there is no limit.
    """

    range_deg: Interval | None = None
    speed_deg_per_s: Positive | None = None
    acceleration_deg_per_s2: Positive | None = None
    jerk_deg_per_s3: Positive | None = None
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
        via: Points that the arm passes on its ways, of each way in their order; it need not stop there.
        name: Name in reports; by default the file's.
        gravity: Acceleration of gravity in the base frame [m/s²]. Default: the MJCF's; of a URDF [0, 0, -9.81].
        tool: Where the payload is held; by default the last link's tool frame.
        path_margin: If given, the joints' ranges become the way between both ends, widened on each side by this share of it [1].
        floor_m: Height that the tool and all links stay above, against gravity; the base's plane is 0. By default and with null there is
            none.
        keep_outs: What tool and links keep out of.
        link_radius_m: Of the links about the lines from joint to joint, for floor and keep-outs; the tool's point has none.
        springs: Springs that a design may use, each with bounds of its quantities.
        actuators: Motor and gear of each moving joint, by which costs and reports know what the motors pay; by default none is known.
        spring_limits: Limits of these springs as parts, in the design and in the parts that are worked out for it; by default those of
            the parts alone.
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
    via: tuple[Via, ...] = ()
    name: Text | None = None
    gravity: Vector | None = None
    tool: Tool | None = None
    path_margin: NonNegative | None = None
    floor_m: float | None = None
    keep_outs: tuple[KeepOut, ...] = ()
    link_radius_m: NonNegative = 0.0
    springs: list[dict[str, Any]] = field(default_factory=list)
    actuators: dict[str, MotorAndGear] = field(default_factory=dict)
    spring_limits: SpringLimits | None = None
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
        for phase in PHASES:
            shares = [via.time_share for via in self.via if via.phase == phase]
            known = [share for share in shares if share is not None]
            if known and (len(known) < len(shares) or any(a >= b for a, b in pairwise(known))):
                raise ValueError(f'via: of "{phase}" all or none need a time_share, each greater than the one before')


@dataclass(frozen=True, eq=False)
class Passed:
    """A point that a phase passes.

    Attributes:
        phase: Index of the phase.
        share: Share of its time after which it is there [1].
        angles: Of the moving joints (m,) [rad]; where there is a goal, of one posture in which it is reached.
        goal: Place of the tool, where the posture is free.
    """

    phase: int
    share: float
    angles: np.ndarray
    goal: Goal | None


@dataclass(frozen=True, eq=False)
class Task:
    """Carry a payload from start to release (phase "go"), and come back without it ("return"), again and again.

    Attributes:
        name: Name in reports.
        robot: The whole arm.
        tool: Where it holds the payload.
        moving: Indices of the joints that move (m); the others are locked.
        start, release: Angles of the moving joints [rad], (m,); where their posture is free, those at which a search begins.
        payload: Carried in the go phase only [kg].
        duration: Bounds of each phase's duration [s].
        lower, upper: Angles allowed [rad], (m,).
        speed: Speed limits [rad/s], (m,).
        acceleration: Acceleration limits [rad/s²], (m,); infinite where there is none.
        jerk: Jerk limits [rad/s³], (m,); infinite where there is none.
        torque: Load-torque limits [Nm], (m,); infinite where there is none.
        around: What tool and links must not touch.
        springs: The springs that a design may use, as in the file, with the rows of tables that stand in files of their own.
        actuators: Motor and gear by moving joint; none where they are not known.
        locked: Angles of all joints while the moving ones stand at zero [rad], (n,); empty where all are locked at zero.
        speeds: Of the arm at start and release, as in the file.
        goals: Places of the tool at start and release where the posture is free there.
        cycle: Bounds of the duration of both phases together [s], if there are some beside theirs.
        via: The points that it passes on its ways.
        files: The files that it was read from.
        spring_limits: Limits of the springs as parts.
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
    jerk: np.ndarray
    torque: np.ndarray
    around: Surroundings
    springs: tuple[Mapping[str, Any], ...]
    actuators: Mapping[str, MotorAndGear]
    locked: tuple[float, ...] = ()
    speeds: tuple[Speed, Speed] = ("rest", "rest")
    goals: tuple[Goal | None, Goal | None] = (None, None)
    cycle: Interval | None = None
    via: tuple[Passed, ...] = ()
    files: tuple[Path, ...] = ()
    spring_limits: SpringLimits = SpringLimits()  # noqa: RUF009

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

    def holding_torque(self, q, payload: float):
        """Torque of the moving joints (m,) that holds the arm still with a payload [kg], without springs [Nm]; `q` (n,) of all joints
        and the result are casadi's or numbers."""
        still = np.zeros(self.robot.n)
        return self.model().inverse(q, still, still, payload, [], [])[0][list(self.moving)]

    @property
    def jerky(self) -> list[int]:
        """Rows of the moving joints whose jerk has a limit."""
        return np.flatnonzero(np.isfinite(self.jerk)).tolist()

    def kept(self, q) -> list[Clearance]:
        """The distances that tool and links keep at angles of all joints (n,), numbers or casadi's."""
        return self.around.kept(self.robot, self.tool, self.moving, q, self.full(self.start))

    def heights(self, q: np.ndarray) -> np.ndarray:
        """Heights against gravity of the origins of the joints after the first moving one, and of the tool, the last row, at angles of the
        moving joints (m, K); (·, K) [m]."""
        column = ca.SX.sym("q", self.robot.n)
        points = link_ends(self.robot, self.tool)(column)[:, self.moving[0] + 1 :]
        above = ca.Function("above", [column], [(ca.DM(upwards(self.robot.gravity)).T @ points).T])
        return np.array(above.map(q.shape[1])(self.full(q)))

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
        around=Surroundings(-np.inf if given.floor_m is None else given.floor_m, given.keep_outs, given.link_radius_m),
        springs=springs,
        locked=_locked(where, robot, given),
        speeds=(given.start.speed, given.release.speed),
        goals=(None, None),
        cycle=given.cycle_s,
        via=(),
        spring_limits=given.spring_limits or SpringLimits(),
        actuators=_actuators(where, given),
        files=tuple(Path(file) for file in (source, beside if own else given.robot, *tables) if Path(file).is_file()),
        **_limits(where, robot, given),
    )
    body = rigid_body(robot)
    (start, first), (release, last) = (_end(f"{where}: {end}", task, body, getattr(given, end)) for end in ("start", "release"))
    task = replace(task, start=start, release=release, goals=(first, last))
    if given.path_margin is not None:  # the ranges become the one between the ends, widened by this share of it on each side
        ends = np.array([start, release])
        width = given.path_margin * np.ptp(ends, axis=0)
        lower, upper = np.maximum(task.lower, ends.min(axis=0) - width), np.minimum(task.upper, ends.max(axis=0) + width)
        task = replace(task, lower=lower, upper=upper)
    task = replace(task, via=_passed(where, task, body, given.via))
    _check_feasible(where, task, body)
    return task


def _passed(where: str, task: Task, body: RigidBody, given: Sequence[Via]) -> tuple[Passed, ...]:
    """The points that the arm passes; raises `UserError` for one that it does not reach, or that floor or keep-outs forbid."""
    found = []
    for i, via in enumerate(given):
        named = f"{where}: via[{i}]"
        if via.position_m is not None:
            goal, angles = inverse_kinematics(task, body, _goal(via), named)
        else:
            goal, angles = None, _angles(named, task, via.angles_deg)
        for kept in _broken(task, angles, goal):
            raise UserError(f"{named}: {_too_near(kept)}")
        own = [j for j, other in enumerate(given) if other.phase == via.phase]
        share = via.time_share or (own.index(i) + 1) / (len(own) + 1)
        found.append(Passed(PHASES.index(via.phase), share, angles, goal))
    return tuple(found)


def _broken(task: Task, angles: np.ndarray, goal: Goal | None) -> list[Clearance]:
    """The distances that a posture does not keep; where others reach the same goal, those of the tool alone."""
    kept = task.kept(task.full(angles))
    return [one for one in kept if float(one.value) < one.least and (goal is None or one.of == TOOL)]


def _too_near(kept: Clearance) -> str:
    return f"{kept.of} is {float(kept.value):.4f} m from {kept.name}; {kept.least:.4f} m or more is required"


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
    turns = np.abs(task.release - task.start) * (not any(task.goals))  # a free posture may make it shorter
    rests = task.speeds.count("rest")  # ends at which a motion starts or stops
    for joint, way, speed, acceleration in zip(task.joints, turns, task.speed, task.acceleration, strict=True):
        lost = rests * speed / acceleration / 2 if rests and np.isfinite(acceleration) else 0.0  # time at less than full speed
        needed = way / speed + lost if not lost or way > speed * lost else np.sqrt(2 * rests * way / acceleration)
        for ways, (_, most), key in ((1, task.duration, "duration_s"), (2, task.cycle or (0.0, np.inf), "cycle_s")):
            if ways * needed > most:
                limits = f"{np.degrees(speed):.1f} °/s"
                limits += f" and {np.degrees(acceleration):.4g} °/s²" if np.isfinite(acceleration) else ""
                raise UserError(
                    f"{where}: the task cannot be done: {joint} needs {needed:.2f} s for its {np.degrees(way):.1f}°{' each way' * (ways - 1)} "
                    f"at {limits}, and {key} allows {most:g} s"
                )
    for (end, q), goal in zip((("start", task.start), ("release", task.release)), task.goals, strict=True):
        for kept in _broken(task, q, goal):
            at, floor = float(kept.value), task.around.floor
            if kept.name == FLOOR:
                over = f"{floor:g} m" + f" and link_radius_m = {task.around.link_radius:g} m" * (at >= floor)
                raise UserError(f"{where}: at the {end} {kept.of} stands {at:.4f} m high, below floor_m = {over}")
            raise UserError(f"{where}: at the {end} {_too_near(kept)}")


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
        rates = speed, own.acceleration_deg_per_s2 or np.inf, own.jerk_deg_per_s3 or np.inf
        rows.append([*np.radians([low, high, *rates]), _torque_limit(own, robot.effort[j])])
    return dict(zip(("lower", "upper", "speed", "acceleration", "jerk", "torque"), np.array(rows).T, strict=True))


def _actuators(where: str, given: TaskFile) -> dict[str, MotorAndGear]:
    """Motors and gears by moving joint; raises `UserError` where some joints have one and others have none."""
    if given.actuators:
        check_names(given.actuators, given.moving, f"{where}: actuators", "joint")
        if missing := [joint for joint in given.moving if joint not in given.actuators]:
            raise UserError(f"{where}: actuators: key {missing[0]!r} is missing; every moving joint, or none, is required")
    return {joint: given.actuators[joint] for joint in given.moving if given.actuators}


def _torque_limit(own: Limits, effort: float) -> float:
    """The limit of a joint's torque [Nm], from a task and the robot's file; infinite where there is none."""
    if isinstance(own.torque_Nm, float):
        return own.torque_Nm
    return np.inf if own.torque_Nm == "none" or effort >= NO_LIMIT else effort


def overloads(task: Task) -> dict[str, str]:
    """By joint, a sentence on the torque that it needs to stand at an end of a phase where its limit is less; without springs."""
    found = dict[str, str]()
    ends = (("start", task.start), ("release", task.release))
    for end, q in [one for one, goal in zip(ends, task.goals, strict=True) if goal is None]:
        for payload in task.payloads:
            needed = np.abs(np.array(task.holding_torque(task.full(q), payload)).ravel())
            for joint, tau, limit in zip(task.joints, needed, task.torque, strict=True):
                if tau > limit:
                    told = f"{joint} needs {tau:.4g} Nm to hold {payload:g} kg at the {end}, and its limit is {limit:.4g} Nm"
                    found.setdefault(joint, told)
    return found


def _end(where: str, task: Task, body: RigidBody, end: End) -> tuple[np.ndarray, Goal | None]:
    """Angles of the moving joints at an end of a phase [rad], (m,), and the place of the tool where its posture is free."""
    if end.position_m is not None:
        goal, angles = inverse_kinematics(task, body, _goal(end), where)
        return angles, goal if end.posture == "free" and len(goal.rows) < len(task.moving) else None
    return _angles(where, task, end.angles_deg), None


def _angles(where: str, task: Task, angles_deg: Sequence[float] | None) -> np.ndarray:
    """Angles of the moving joints [rad], (m,); raises `UserError` where they are too many or too few, or outside their ranges."""
    assert angles_deg is not None
    angles = np.radians(angles_deg)
    if len(angles) != len(task.moving):
        raise UserError(f"{where}.angles_deg: found {list(angles_deg)}; one number per moving joint is required")
    for joint, angle, low, high in zip(task.joints, angles, task.lower, task.upper, strict=True):
        if not low <= angle <= high:
            outside = f"outside its range {np.degrees(low):.2f}° … {np.degrees(high):.2f}°"
            raise UserError(f"{where}: {joint} would stand at {np.degrees(angle):.2f}°, {outside}")
    return angles


def _goal(end: End | Via) -> Goal:
    assert end.position_m is not None
    if end.direction is None:
        return Goal(end.position_m)
    axis, towards = (tuple((np.array(v) / np.linalg.norm(v)).tolist()) for v in (end.direction.axis, end.direction.towards))
    return Goal(end.position_m, axis, towards)


def inverse_kinematics(task: Task, body: RigidBody, goal: Goal, where: str = "position") -> tuple[Goal, np.ndarray]:
    """The goal with what the moving joints can change of it, and angles of these that put the tool there, within `NEAR`, within the
    joint ranges.

    Of several postures, the one whose joints lie highest against gravity is taken, which is what "elbow up" means. Where there is a
    continuum of them, the one in which the arm needs the least torque to stand still with and without its payload.
    Raises `UserError` with the nearest distance if the tool does not reach the position.
    """
    if task.tool.joint != task.robot.n - 1:
        raise UserError(f"{where}: a position needs the tool on the last link; give angles_deg")
    columns, postures = list(task.moving), ca.SX.sym("q", task.robot.n)
    missed = goal.errors(body, task.tool, postures)
    if goal.axis is not None:  # the opposite direction is none
        missed = ca.vertcat(missed[:3], goal.pointing(body, task.tool, postures) - ca.DM(goal.towards))
    both = ca.Function("missed", [postures], [missed, ca.jacobian(missed, postures)])
    of_goal = ca.Function("slopes", [postures], [ca.jacobian(goal.errors(body, task.tool, postures), postures)])

    def error(q: np.ndarray) -> np.ndarray:
        return np.array(both(task.full(q))[0]).ravel()

    def slope(q: np.ndarray) -> np.ndarray:
        return np.array(both(task.full(q))[1])[:, columns]

    low, high = np.maximum(task.lower, -np.pi), np.minimum(task.upper, np.pi)
    starts = low + (high - low) * np.random.default_rng(0).random((32, len(columns)))
    fits = [
        least_squares(error, s, cast(Any, slope), bounds=(low - 1e-9, high + 1e-9), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        for s in starts
    ]
    reached = [fit.x for fit in fits if fit.success and np.linalg.norm(fit.fun) < NEAR]
    if not reached:
        nearest = min(fits, key=lambda fit: float(np.linalg.norm(fit.fun)))
        raise UserError(_out_of_reach(where, task, goal, nearest, [slope(s) for s in starts]))
    slopes = np.array([np.array(of_goal(task.full(s)))[:, columns] for s in starts])
    goal = goal.reachable(slopes)
    if len(goal.rows) < len(columns):
        return goal, _least_torque(task, body, goal, reached)
    up = upwards(task.robot.gravity)
    best = max(reached, key=lambda q: float((up @ np.array(body.joint_frames(task.full(q)))[9:]).sum()))
    return goal, np.clip(best, task.lower, task.upper)


def _out_of_reach(where: str, task: Task, goal: Goal, nearest: Any, slopes: Sequence[np.ndarray]) -> str:
    """That a position is out of reach, how near the tool comes, and along which axes the joints cannot move it."""
    position = np.array(goal.position)
    told = f"{where} at {np.round(position, 4).tolist()} m is out of reach within the joint ranges"
    point = (np.round(position + nearest.fun[:3], 4) + 0.0).tolist()
    rows = np.array(slopes).swapaxes(0, 1)[:3]
    fixed = [axis for axis, row in zip("xyz", rows, strict=True) if np.abs(row).max() < 1e-9]
    why = f"; {', '.join(task.joints)} cannot change {' and '.join(fixed)}" if fixed else ""
    away = float(np.linalg.norm(nearest.fun[3:]))
    turned = f", {np.degrees(2 * np.arcsin(min(away / 2, 1.0))):.1f}° from the direction" * (goal.axis is not None)
    looks = ""
    if np.linalg.norm(position) > MILLIMETRES * np.linalg.norm(point):
        looks = "; the position looks like mm"
    elif np.all(np.degrees(task.upper - task.lower) < 2 * np.pi):
        looks = "; the joint ranges are in degrees, and these look like rad"
    return f"{told}: the tool comes no nearer than {np.linalg.norm(nearest.fun[:3]):.4f} m, at {point} m{turned}{why}{looks}"


def _least_torque(task: Task, body: RigidBody, goal: Goal, reached: Sequence[np.ndarray]) -> np.ndarray:
    """Of all postures with the tool at a goal, the one in which the arm needs the least torque² to stand still, with its payload and
    without; sought from some postures that have it there."""
    q, columns = ca.SX.sym("q", task.robot.n), list(task.moving)
    cost = sum(ca.sumsqr(task.holding_torque(q, payload)) for payload in task.payloads)
    place = goal.equalities(body, task.tool, q)
    of = ca.Function("held", [q], [cost, ca.gradient(cost, q), place, ca.jacobian(place, q)])

    def value(output: int, moving: np.ndarray) -> np.ndarray:
        found = np.array(of(task.full(moving))[output])
        return found.ravel() if output in (0, 2) else found[columns, 0] if output == 1 else found[:, columns]

    unit = max(min(float(value(0, x)[0]) for x in reached), 1e-6)
    condition = {"type": "eq", "fun": lambda x: value(2, x), "jac": lambda x: value(3, x)}
    fits = [
        minimize(
            lambda x: value(0, x)[0] / unit,
            np.clip(x, task.lower, task.upper),
            jac=lambda x: value(1, x) / unit,
            bounds=list(zip(task.lower, task.upper, strict=True)),
            constraints=condition,
            method="SLSQP",
            options={"maxiter": 200, "ftol": 1e-10},
        )
        for x in sorted(reached, key=lambda x: float(value(0, x)[0]))[:TRIED]
    ]
    good = [fit for fit in fits if np.linalg.norm(value(2, fit.x)) < NEAR]
    best = min(good, key=lambda fit: fit.fun).x if good else min(reached, key=lambda x: float(value(0, x)[0]))
    return np.clip(best, task.lower, task.upper)

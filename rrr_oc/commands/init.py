"""`rrr-oc init`: the files that a user writes, begun for an arm."""

import itertools
import json
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from rrr_oc.codesign.task import load_task
from rrr_oc.commands.output import Json, Output, Quiet
from rrr_oc.commands.shared import Joints, named
from rrr_oc.effects import design_forms, listed_springs
from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.recordings.header import FORMAT, HEADER
from rrr_oc.robot.rigid_body import rigid_body, upwards
from rrr_oc.robot.robot import BUNDLED, Robot, ToolPoint, arm_of, load_robot, resting_angle, urdf_text
from rrr_oc.storage import new_folder, write_text

app = typer.Typer(add_completion=False)


@app.command()
def init(
    robot: Annotated[str, typer.Argument(help="path of the arm's URDF or MJCF, or a bundled model")],
    out: Annotated[Path, typer.Option(help="folder to make")],
    joints: Joints = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Begin with an arm: write a commented recordings.json, CSV header and task.json for it, and the next commands."""
    output = Output(quiet, as_json)
    made = write_example(robot, out, named(joints))
    files = (
        "recordings/recordings.json, recordings/first.csv with a header, " + "task.json " * bool(made.moving) + "and README.md"
    )
    output.show(f"{out} holds {files}, with comments, for {', '.join(made.joints)}.")
    for note in made.notes:
        output.note(f"Note: {note}.")
    if made.no_task:
        output.note(f"Note: there is no task.json: {made.no_task}.")
    output.show((out / "README.md").read_text(encoding="utf-8").partition("```\n")[2].partition("```")[0].rstrip())
    output.result({"folder": str(out), "joints": made.joints, "moving": made.moving, "no_task": made.no_task})


CARRIED = 0.1  # payload of the example as a share of the moved mass; twice as much, and some arms' motors do not hold it
HELD = 0.7  # share of a torque limit that holding the payload takes at most; nearer to 1, nothing is left for the motion
SPEED = 90.0  # [°/s] of a joint whose URDF gives no speed
MIDDLE = 0.7  # share of a joint's range in which the task's ends are looked for; nearer to 1, ends lie at the limits
WAY = (0.15, 0.5)  # least and greatest distance between both ends over the arm's reach
HEIGHT = (0.1, 0.5)  # height of both ends over the reach: above a table, and not above the arm
FRONT = 0.1  # both ends are so far in front of the base, over the reach; at 0, ends would be above it
FLOORS = ("0.0", "null")  # of the task: the base's plane, and none for an arm that stands lower at an end, as one that hangs
OFFERS = 20  # pairs of ends that the task's reader is asked about; it refuses few
TRIALS = 400  # random pairs of ends; the best that the task's reader accepts is taken
ALONG = 0.3  # share of the tool's greatest travel that it must have along x for this to be the front; doubled, skewed planes are not
LEVEL = 0.1  # largest cosine between a horizontal axis and the vertical; doubled, axes 11° off would count
IN_THE_WAY = (
    "allowed are revolute",
    "no serial chain",
    "every joint must move on its own",
)  # of errors that naming joints mends
SET = "recordings"  # folder of the recording set within the example
RECORDING = "first.csv"


@dataclass(frozen=True)
class Example:
    """What was written.

    Attributes:
        folder: The folder.
        joints: The arm's joints.
        moving: Joints that move in the task; none where there is no task.
        no_task: Why there is no task, "" where there is one.
        notes: What a user should know of the robot file.
    """

    folder: Path
    joints: tuple[str, ...]
    moving: tuple[str, ...]
    no_task: str = ""
    notes: tuple[str, ...] = ()


def write_example(source: str | Path, folder: str | Path, joints: Sequence[str] | None = None) -> Example:
    """Write a new folder with recordings.json, the header of a CSV file, task.json, the URDF and README.md with the next commands.

    Raises `UserError` where the arm cannot be read or the folder has something in it.
    """
    folder, bundled, why, exact = Path(folder), str(source) in BUNDLED, "", True
    try:
        robot = load_robot(source, joints)
    except UserError as error:  # without masses its kinematics still say what to record
        robot, why, exact = _without_masses(source, joints), str(error), False
    name = str(source) if bundled else f"{Path(source).stem}.urdf"
    moving: tuple[str, ...] = ()
    if folder.is_dir() and any(folder.iterdir()):
        raise UserError(f"{folder}: something is there already; a new or an empty folder is required")
    with new_folder(folder) as temporary:
        if not bundled:
            write_text(temporary / name, urdf_text(source))
        (temporary / SET).mkdir()
        write_text(temporary / SET / HEADER, _header(name if bundled else f"../{name}", robot, exact))
        write_text(temporary / SET / RECORDING, _csv(robot.joints))
        if not why:
            try:
                moving = _write_task(temporary / "task.json", name, robot)
            except UserError as error:
                why = str(error).replace(str(temporary), str(folder))
        write_text(temporary / "README.md", _readme(folder, robot, why))
    return Example(folder, robot.joints, moving, why, robot.notes)


def _without_masses(source: str | Path, joints: Sequence[str] | None) -> Robot:
    """The arm's kinematics; raises `UserError`, which names the joints of the arm where a hand or another arm is in the way."""
    try:
        return load_robot(source, joints, inertial=False)
    except UserError as error:
        if joints is not None or not any(said in str(error) for said in IN_THE_WAY):
            raise
        hint = (
            f"--joints {shlex.quote(','.join(arm))} leaves the others still"
            if (arm := arm_of(source))
            else "--joints names those of one arm"
        )
        raise UserError(f"{error}; {hint}") from None


def _header(name: str, robot: Robot, exact: bool) -> str:
    """The content of recordings.json, with a hint of every optional key."""
    gravity, tool = json.dumps(robot.gravity.tolist()), json.dumps(robot.tool_link)
    first, last = json.dumps(robot.joints[0]), json.dumps(robot.joints[-1])
    return f"""{{
  // What the recordings are. Comments go from // to the end of the line. Units: s, rad, Nm, A, kg, m.
  "format": "{FORMAT}",
  "robot": {json.dumps(name)}, // {_where(name)}
  "joints": {json.dumps(list(robot.joints))}, // recorded ones, in the order of the chain
  "torque": "motor", // or "load" (behind the gear), "current" with "actuators", or "command" with "kp" and "kd"
  "inertial": "{"nominal" if exact else "identify"}", // "nominal": masses of the URDF; "identify": they are estimated
  "gravity": {gravity}, // in the base frame [m/s²]; another one for an arm on a wall
  // "fixed_deg": {{}}, // angles of joints that are not recorded, by name; else 0, or the middle of a range that lacks 0
  // "tool": {{"link": {tool}, "position": [0.0, 0.0, 0.0]}}, // where a payload is held
  // "actuators": {{{first}: {{"torque_constant": 10.0}}}}, // Nm of {_plain(robot.joints[0])} per A, for all joints if currents are recorded
  // "coupling": {{"q": {_identity(robot.n)}, "tau": {_identity(robot.n)}}}, // where columns are sums of joints: joints = matrix · columns
  // "kp": 20.0, "kd": 0.5, // Nm/rad and Nm s/rad of a loop whose commands are recorded; or by joint
  "recordings": [
    {{
      "file": "{RECORDING}"
      // , "payload_kg": 2.0 // mass at the tool
      // , "group": "first day" // recordings of one group share what is estimated for it
      // , "springs": {_springs(last)} // mounted springs
    }}
    // , {{"file": "second.csv"}} // three or more, so that some can be left out of a fit and predicted
  ]
}}
"""


def _where(name: str) -> str:
    return "a bundled model; or the path of a URDF" if name in BUNDLED else "relative to this file"


def _plain(name: str) -> str:
    return " ".join(name.split())


def _identity(n: int) -> list[list[float]]:
    """A matrix that changes nothing, (n, n)."""
    return np.eye(n).tolist()


def _springs(joint: str) -> str:
    """How a spring of one joint is listed."""
    kind = next(kind for kind in listed_springs().values() if kind.placement != "pair")
    entry = ", ".join(f'"{key}": 1.0' for key in kind.listing.quantities)
    return f'{{"{kind.listing.key}": {{{joint}: {{{entry}}}}}}}'


def _csv(joints: Sequence[str]) -> str:
    """A header and no rows, with what the columns are behind #."""
    columns = ["t", *(f"{kind}_{joint}" for kind in ("q", "dq", "tau") for joint in joints)]
    return (
        f"{','.join(columns)}\n"
        "# one row a sample, at 50 Hz or more: t [s], q_ [rad], tau_ [Nm] (current_ [A] for currents)\n"
        "# dq_ [rad/s] may be left out; ddq_ [rad/s²] and payload [kg] may be added\n"
    )


def _readme(folder: Path, robot: Robot, why: str) -> str:

    def shown(name: str) -> str:
        return shlex.quote(str(folder / name))

    task = (
        f"`task.json` is a task that {robot.name} can do; change its ends, payload and springs to yours. It needs no recordings."
        if not why
        else f"There is no task.json: {why}."
    )
    design = f"rrr-oc design {shown('task.json')} --out {shown('design')}\n" * (not why)
    return f"""# {robot.name}

Put your recordings beside `{SET}/{RECORDING}`, with its columns, and list them in `{SET}/{HEADER}`. Move all joints to and fro,
fast and slowly, over much of their range; 20 s each and three of them are a start. Take a joint that you do not record, such as a gripper's,
out of "joints" of every file. {task}

```
rrr-oc calibrate {shown(SET)} --out {shown("calibrated")}
rrr-oc diagnose {shown(SET)} --out {shown("diagnosis")}
{design}```
"""


@dataclass(frozen=True)
class MovedTask:
    """How the arm moves in the task.

    Attributes:
        robot: The arm, with the tool that the task has.
        joints: Indices of the moving joints (m).
        limits: Least and greatest angle [°] and speed [°/s] of each.
        locked: Angles of the others [°], and 0 for the moving ones (n,).
        tool: Place of the tool in the frame of its link [m] where it is not the robot's own, (3,).
    """

    robot: Robot
    joints: tuple[int, ...]
    limits: tuple[tuple[float, float, float], ...]
    locked: np.ndarray
    tool: np.ndarray | None = None

    def full(self, degrees: np.ndarray) -> np.ndarray:
        """Angles of all joints [rad], (n,), from those of the moving ones [°]."""
        q = self.locked.copy()
        q[list(self.joints)] = degrees
        return np.radians(q)


@dataclass(frozen=True)
class Ends:
    """Both ends of a task, as they stand in the file, and the payload [kg] that the arm can hold at them."""

    start: str
    release: str
    payload: float


def _write_task(path: Path, name: str, robot: Robot) -> tuple[str, ...]:
    """Write a task whose ends are in reach, and return its moving joints; raises `UserError` where none is found."""
    said = "no two ends of a task were found"
    for moved in _ways_to_move(robot):
        for ends, floor in ((ends, floor) for ends in _ends(moved) for floor in FLOORS):
            write_text(path, _task(name, moved, ends, floor))
            try:
                load_task(path)
                return tuple(robot.joints[j] for j in moved.joints)
            except UserError as error:
                said = str(error)
    path.unlink(missing_ok=True)
    raise UserError(said)


def _ways_to_move(robot: Robot) -> Iterator[MovedTask]:
    """The joints that lift; where these do not move the tool, as those that turn a stretched arm about itself, any other two."""
    locked = np.array([resting_angle(low, high) for low, high in zip(robot.lower, robot.upper, strict=True)])
    yield _moved(robot, locked, _lifting(robot, locked))
    for joints in itertools.combinations(range(robot.n), 2):
        yield _moved(robot, locked, joints)


def _moved(robot: Robot, q: np.ndarray, joints: tuple[int, ...]) -> MovedTask:
    """Some joints that move, their limits, where the others stand, of q [rad], and a tool that the last joint moves if the file has none."""
    locked, tool = np.degrees(q), None
    if (
        robot.n - 1 in joints
        and robot.tool.joint == robot.n - 1
        and not np.any(robot.tool.position)
        and robot.inertial[0, -1] > 0
    ):
        tool = np.round(
            2 * robot.inertial[1:4, -1] / robot.inertial[0, -1], 3
        )  # as far again as the last link's centre of mass
        robot = replace(robot, tool=ToolPoint(robot.n - 1, tool))
    locked = np.array([0.0 if j in joints else np.round(angle, 1) for j, angle in enumerate(locked)])
    return MovedTask(robot, joints, tuple(_limits(robot, j) for j in joints), locked, tool)


def _lifting(robot: Robot, q: np.ndarray) -> tuple[int, ...]:
    """The first joint whose axis is horizontal while all stand at q [rad], and the next one parallel to it; else the first two."""
    frames = np.array(rigid_body(robot).joint_frames(q)).reshape(12, -1)
    axes = np.array([frames[:9, j].reshape(3, 3, order="F") @ robot.axes[j] for j in range(robot.n)])
    level = [j for j in range(robot.n) if abs(axes[j] @ upwards(robot.gravity)) < LEVEL]
    parallel = [j for j in level if abs(axes[j] @ axes[level[0]]) > 1 - LEVEL]
    return tuple(parallel[:2] or range(min(2, robot.n)))


def _limits(robot: Robot, j: int) -> tuple[float, float, float]:
    """Least and greatest angle [°], and speed [°/s]; those that the URDF does not give are a half turn either way, and `SPEED`."""
    known = np.isfinite([robot.lower[j], robot.upper[j]]).all() and robot.lower[j] < robot.upper[j]
    low, high = np.degrees([robot.lower[j], robot.upper[j]]) if known else (-180.0, 180.0)
    low, high = np.ceil(10 * max(low, -180.0)) / 10, np.floor(10 * min(high, 180.0)) / 10  # one digit, not beyond the URDF's
    speed = np.degrees(robot.velocity[j]) if 0 < robot.velocity[j] < np.inf else SPEED
    return float(low), float(high), float(np.floor(10 * speed) / 10)


def _ends(moved: MovedTask) -> Iterator[Ends]:
    """Both ends of tasks, the best first: in front of the base, above a table, and with little way of the joints.

    The best pair is offered as positions, which a few digits can tell where the moving joints' plane is that of two coordinates,
    then all pairs as angles.
    """
    pairs = _pairs(moved)
    for pair, places in pairs[:1]:
        for digits in (3, 4):
            first, second = (
                f'{{"position_m": {json.dumps((np.round(p, digits) + 0.0).tolist())}}}, // of the tool' for p in places
            )
            said = f'{second}, or "angles_deg" of the moving joints'
            yield Ends(f"{first} in the base frame, in reach of the moving joints", said, _payload(moved, pair))
    for pair, places in pairs[:OFFERS]:
        told = [f", // the tool is at {json.dumps((np.round(p, 4) + 0.0).tolist())} m in the base frame" for p in places]
        first, second = (f'{{"angles_deg": {json.dumps((a + 0.0).tolist())}}}{t}' for a, t in zip(pair, told, strict=True))
        yield Ends(first, f'{second}; also "position_m"', _payload(moved, pair))


def _pairs(moved: MovedTask) -> list[tuple[np.ndarray, np.ndarray]]:
    """Angles [°] (2, m) and places [m] (2, 3) of both ends of tasks, the best first."""
    robot, body, rng = moved.robot, rigid_body(moved.robot), np.random.default_rng(0)
    low, high = np.array(moved.limits)[:, :2].T
    drawn = (low + high) / 2 + MIDDLE * (high - low) / 2 * (2 * rng.random((TRIALS, 2, len(moved.joints))) - 1)
    angles = np.round(drawn, 1)
    q = np.array([moved.full(one) for one in angles.reshape(-1, len(moved.joints))]).T
    places = np.array(body.tool_position.map(q.shape[1])(q, robot.tool.position)).T.reshape(TRIALS, 2, 3)
    reach = float(np.linalg.norm(robot.placements[:, :3, 3], axis=1).sum() + np.linalg.norm(robot.tool.position))
    apart = np.linalg.norm(places[:, 1] - places[:, 0], axis=1)
    height, front = places @ upwards(robot.gravity), places @ _front(robot, places)
    outside = np.maximum(HEIGHT[0] * reach - height.min(axis=1), 0) + np.maximum(height.max(axis=1) - HEIGHT[1] * reach, 0)
    behind, way = front.min(axis=1) < FRONT * reach, np.abs(angles[:, 1] - angles[:, 0]).sum(axis=1)
    best = [i for i in np.lexsort((way, outside, behind)).tolist() if WAY[0] * reach < apart[i] < WAY[1] * reach]
    return [(angles[i], places[i]) for i in best]


def _front(robot: Robot, places: np.ndarray) -> np.ndarray:
    """Direction in front of the base, (3,): its x where the tool's places (…, 3) lie along it, else where most of them are."""
    level = np.eye(3) - np.outer(upwards(robot.gravity), upwards(robot.gravity))
    flat = places.reshape(-1, 3) @ level
    x, middle = level[0], flat.mean(axis=0)
    if np.ptp(flat @ x) > ALONG * np.ptp(flat, axis=0).max() or not np.any(middle):
        return x / max(float(np.linalg.norm(x)), LEVEL)
    return middle / np.linalg.norm(middle)


def _payload(moved: MovedTask, pair: np.ndarray) -> float:
    """A payload [kg], of one digit, that suits the moved mass, and that the joints hold at both ends (2, m) [°] if they hold the arm."""
    robot, joints = moved.robot, list(moved.joints)
    inverse, still = Model(robot, robot.tool).inverse, np.zeros(robot.n)
    most = CARRIED * float(robot.inertial[0, joints[0] :].sum())
    for end in pair:
        empty, heavy = (np.array(inverse(moved.full(end), still, still, kg, [], [])[0]).ravel()[joints] for kg in (0.0, 1.0))
        for own, added, limit in zip(empty, heavy - empty, robot.effort[joints], strict=True):
            room = HELD * limit - np.sign(added) * own
            if added and room > 0:
                most = min(most, room / abs(added))
    digit = 10.0 ** np.floor(np.log10(max(most, 1e-3)))
    return float(f"{np.floor(most / digit * (1 + 1e-9)) * digit:.1g}") or 1e-3


def _task(name: str, moved: MovedTask, ends: Ends, floor: str) -> str:
    """The content of task.json, with a hint of every optional key."""
    robot, limits = moved.robot, moved.limits
    names = [robot.joints[j] for j in moved.joints]
    still = [
        f"{json.dumps(joint)}: {angle}"
        for j, (joint, angle) in enumerate(zip(robot.joints, moved.locked, strict=True))
        if j not in moved.joints
    ]
    lines = [
        f'    {json.dumps(joint)}: {{"range_deg": [{low:g}, {high:g}], "speed_deg_per_s": {speed:g}}}'
        for joint, (low, high, speed) in zip(names, limits, strict=True)
    ]
    bounds = ",\n".join(lines)
    springs = ",\n".join(_spring_bounds(robot, j, limit, ends.payload) for j, limit in zip(moved.joints, limits, strict=True))
    locked = f'\n  "locked_deg": {{{", ".join(still)}}}, // angles of the others' if still else ""
    longest = max(5.0, np.ceil(max((high - low) / speed for low, high, speed in limits)))
    actuators = ", ".join(
        f'{json.dumps(joint)}: {{"dry_Nm": 1.0, "viscous_Nm_s_per_rad": 1.0, "inertia_kg_m2": 0.1, "efficiency": 0.9}}'
        for joint in names
    )
    place = [0.0, 0.0, 0.0] if moved.tool is None else (moved.tool + 0.0).tolist()
    return f"""{{
  // What the arm has to do. Comments go from // to the end of the line. Bounds are [least, greatest].
  "format": "rrr_oc-task/1",
  "name": "example", // in reports
  "robot": {json.dumps(name)}, // {_where(name)}
  "joints": {json.dumps(list(robot.joints))}, // of the arm; others, such as a gripper's, are held still
  "moving": {json.dumps(names)}, // base first; the others are locked{locked}
  "gravity": {json.dumps(robot.gravity.tolist())}, // in the base frame [m/s²]
  {"// " * (moved.tool is None)}"tool": {{"link": {json.dumps(robot.tool_link)}, "position_m": {place}}}, // where the payload is held
  "start": {ends.start}
  "release": {ends.release}
  // "via": [{{"phase": "go", {ends.start[1 : ends.start.index("}")]}}}], // points on the way, by position or angles
  "payload_kg": {ends.payload:g}, // from start to release; the arm comes back without it
  "duration_s": [0.5, {longest:g}], // of each way
  // "cycle_s": [1.0, {2 * longest:g}], // of both ways together
  "floor_m": {floor}, // tool and links stay above; the base's plane is 0.0, and with null there is none
  // "link_radius_m": 0.03, // of the links about the lines from joint to joint, which keep it from floor and keep-outs
  // "keep_outs": [{{"name": "post", "box": {{"center_m": [9.0, 0.0, 0.0], "size_m": [0.1, 0.1, 2.0]}}}}], // also "capsule"
  // "actuators": {{{actuators}}}, // motor and gear of each moving joint, at the joint
  // "spring_limits": {{"torque_Nm": 20, "turn_deg": 180, "outside_mm": 80}}, // of the springs as parts
  // "path_margin": 0.25, // keep the joints' ranges to the way between both ends and this share of it
  "limits": {{ // also "acceleration_deg_per_s2", "jerk_deg_per_s3", and "torque_Nm" in place of the robot file's
{bounds}
  }},
  "springs": [ // that a design may use, each with bounds; make them those of springs that you can mount
    // kinds: {", ".join(kind.name for kind in design_forms().values())}
{springs}
  ]
}}
"""


def _spring_bounds(robot: Robot, j: int, limit: tuple[float, float, float], payload: float) -> str:
    """A spring of one joint: adjustable quantities over the joint's range, others up to what the arm's weight asks for."""
    kind = next(k for k in design_forms().values() if k.placement != "pair" and not k.design.derived)
    mass = float(robot.inertial[0, j:].sum()) + payload
    lever = float(np.linalg.norm(robot.placements[j + 1 :, :3, 3], axis=1).sum() + np.linalg.norm(robot.tool.position)) / 2
    most = float(f"{np.linalg.norm(robot.gravity) * mass * max(lever, 0.05):.2g}")
    low, high, _ = limit
    given = ", ".join(
        f'"{q.key}": [{low:g}, {high:g}]' if q.free else f'"{q.key}": [0, {most:g}]' for q in kind.design.quantities
    )
    return f'    {{"effect": "{kind.name}", "joint": {json.dumps(robot.joints[j])}, {given}}}'

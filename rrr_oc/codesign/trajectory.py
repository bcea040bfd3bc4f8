"""A design's motion as text that controllers of robots read, at the rate of the controller."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from rrr_oc.codesign.optimum import SAVED, SampledMotion
from rrr_oc.codesign.task import Task
from rrr_oc.errors import UserError
from rrr_oc.model.motion import Motion
from rrr_oc.storage import read_npz

LARGEST = 1_000_000  # points of a file; more are a rate in the wrong unit; doubled, a file has some 300 MB
FASTEST = 500.0  # [Hz] of Universal Robots' controllers
URSCRIPT_JOINTS = 6
LOOKAHEAD, GAIN = 0.03, 2000  # [s], [1] of servoj: its least and its largest, which follow most closely


@dataclass(frozen=True, eq=False, kw_only=True)
class Trajectory(Motion):
    """The motion of all drives at equal steps, and at its last instant.

    Attributes:
        joints: Names of all joints of the robot, base first.
        torque: Load torque of the design [Nm], which a controller may feed forward; 0 of joints that the task holds, (n, K).
    """

    joints: tuple[str, ...]
    torque: np.ndarray


def saved_motion(path: Path, task: Task) -> SampledMotion:
    """The motion of a design in the npz that `rrr-oc design` wrote; raises `UserError` for another file or task."""
    file = read_npz(path)
    missing = [name for name in SAVED if name not in file]
    if missing:
        raise UserError(f"{path}: has no array {missing[0]!r}; the npz of a design that `rrr-oc design` wrote is required")
    arrays: dict[str, Any] = {name: file[name] for name in SAVED}
    motion = SampledMotion(**arrays)
    if len(motion.q) != len(task.joints):
        raise UserError(
            f"{path}: has {len(motion.q)} moving joints and task {task.name!r} {len(task.joints)}; they must be the same"
        )
    return motion


def sampled(motion: SampledMotion, task: Task, rate: float) -> Trajectory:
    """A design's motion at a rate [Hz]: cubics with the positions and speeds of its samples, each phase for itself.

    Raises `UserError` for a rate that is not above 0, or gives more than `LARGEST` points.
    """
    duration = float(motion.t[-1])
    if not 0 < rate < np.inf or duration * rate > LARGEST:
        raise UserError(
            f"--rate is {rate:g} Hz; above 0, and up to {LARGEST / duration:.6g} Hz for {duration:.4g} s, is required"
        )
    steps = np.arange(int(duration * rate * (1 - 1e-12)) + 1) / rate
    t = np.append(steps, duration) if duration - steps[-1] > 1e-3 / rate else np.append(steps[:-1], duration)
    drives, rows = motion.of_drives(motion.twist), []
    for k, part in enumerate(motion.segments):
        begin, end = motion.t[part.start], motion.t[part.stop - 1]
        at = t[(t >= begin) & (t <= end if k == len(motion.segments) - 1 else t < end)]
        own = motion.t[part]
        position = CubicHermiteSpline(own, drives.q[:, part], drives.dq[:, part], axis=1)
        speed = CubicHermiteSpline(own, drives.dq[:, part], drives.ddq[:, part], axis=1)
        between = [np.interp(at, own, row) for row in (*drives.ddq[:, part], *motion.tau_load[:, part], motion.payload[part])]
        rows.append(np.vstack([position(at), speed(at), between]))
    m = len(task.moving)
    q, dq, ddq, torque, payload = np.split(np.hstack(rows), [m, 2 * m, 3 * m, 4 * m])
    dq, ddq, torque = (task.full_rates(x) for x in (dq, ddq, torque))
    return Trajectory(t, task.full(q), dq, ddq, payload[0], joints=task.robot.joints, torque=torque)


def as_csv(trajectory: Trajectory) -> str:
    """`t` [s], and of each joint `q_` [rad], `dq_` [rad/s], `ddq_` [rad/s²], `tau_` [Nm]; `payload` [kg]."""
    kinds = {"q": trajectory.q, "dq": trajectory.dq, "ddq": trajectory.ddq, "tau": trajectory.torque}
    columns = {"t": trajectory.t}
    columns |= {
        f"{kind}_{joint}": row for kind, rows in kinds.items() for joint, row in zip(trajectory.joints, rows, strict=True)
    }
    columns["payload"] = trajectory.payload
    lines = (",".join(map(repr, row)) for row in np.column_stack(list(columns.values())).tolist())
    return "\n".join([",".join(columns), *lines]) + "\n"


def as_ros2(trajectory: Trajectory) -> str:
    """A `trajectory_msgs/msg/JointTrajectory` in YAML, a point a line.

    Efforts are left empty: the joint trajectory controller refuses them where the robot has no interface of efforts.
    """
    points = []
    for k, nanoseconds in enumerate(np.rint(trajectory.t * 1e9).astype(np.int64).tolist()):
        seconds, rest = divmod(nanoseconds, 1_000_000_000)
        names = {"positions": trajectory.q, "velocities": trajectory.dq, "accelerations": trajectory.ddq}
        numbers = {name: values[:, k].tolist() for name, values in names.items()}
        points.append(json.dumps({**numbers, "effort": [], "time_from_start": {"sec": seconds, "nanosec": rest}}))
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    start = f"header: {json.dumps(header)}\njoint_names: {json.dumps(trajectory.joints)}\npoints:\n"
    return start + "".join(f"- {point}\n" for point in points)


def as_urscript(trajectory: Trajectory) -> str:
    """A program of Universal Robots' controllers: slowly to the start, then `servoj` point by point.

    Raises `UserError` for a robot that has not six joints, and for a rate above that of the controller.
    """
    n, step = len(trajectory.joints), float(trajectory.t[1] - trajectory.t[0])
    if n != URSCRIPT_JOINTS:
        raise UserError(f"--trajectory urscript: the robot has {n} joints; URScript moves robots of {URSCRIPT_JOINTS}")
    if step < (1 - 1e-6) / FASTEST:
        raise UserError(f"--trajectory urscript: --rate is {1 / step:.6g} Hz; up to {FASTEST:g} Hz is allowed")
    points = [f"[{', '.join(f'{x:.9g}' for x in row)}]" for row in trajectory.q.T.tolist()]
    times = np.diff(trajectory.t).tolist()
    moves = [
        f"  servoj({p}, t={h:.9g}, lookahead_time={LOOKAHEAD}, gain={GAIN})" for p, h in zip(points[1:], times, strict=True)
    ]
    lines = [
        "def rrr_oc_trajectory():",
        f"  movej({points[0]}, a=0.5, v=0.3)",
        *moves,
        "  stopj(2.0)",
        "end",
        "rrr_oc_trajectory()",
    ]
    return "\n".join(lines) + "\n"


FORMATS: Mapping[str, tuple[str, Callable[[Trajectory], str]]] = {  # the ending of the file, and what writes its text
    "csv": ("csv", as_csv),
    "ros2": ("yaml", as_ros2),
    "urscript": ("script", as_urscript),
}

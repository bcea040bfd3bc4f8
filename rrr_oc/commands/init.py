"""`rrr-oc init`: the files that a user writes, begun for a robot."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.codesign.task import load_task
from rrr_oc.commands.common import Output
from rrr_oc.errors import UserError
from rrr_oc.robot.robot import BUNDLED, Robot, load_robot
from rrr_oc.storage import check_folder, write_text

USUAL = 90.0  # [deg] around zero within which the example moves joints that turn further
MOVING = 3  # joints at most that the example's task moves: each more makes the search longer


def run(urdf: str, out: Path, output: Output) -> None:
    """Write a recording set without rows, a task and the next commands for a robot; nothing is written over."""
    robot = load_robot(urdf)
    check_folder(out)
    source = urdf if urdf in BUNDLED else os.path.relpath(Path(urdf).resolve(), out.resolve())
    below = urdf if urdf in BUNDLED else os.path.relpath(Path(urdf).resolve(), (out / "recordings").resolve())
    files = {
        "recordings/recordings.json": _json(_header(robot, below)),
        "recordings/first.csv": ",".join(["t", *(f"{k}_{j}" for k in ("q", "tau") for j in robot.joints)]) + "\n",
        "task.json": _json(_task(robot, source)),
        "README.md": _next(out, robot),
    }
    there = [name for name in files if (out / name).exists()]
    if there:
        raise UserError(f"{out / there[0]}: is there already; a folder without {', '.join(files)} is required")
    for name, text in files.items():
        write_text(out / name, text)
    load_task(out / "task.json")  # what is written can be read
    output.show(f"{out} holds {', '.join(files)}. README.md says what to do next.")
    output.result([str(out / name) for name in files])


def _json(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def _header(robot: Robot, source: str) -> dict[str, Any]:
    return {
        "format": "rrr_oc-recordings/1",
        "comment": "SI units, radians. Every key but format, robot, joints and recordings may be left out. Texts such as this are not read.",
        "robot": source,
        "joints": list(robot.joints),
        "torque": "motor",
        "inertial": "nominal",
        "gravity": robot.gravity.tolist(),
        "tool": {"link": robot.tool_link, "position": [0.0, 0.0, 0.0], "comment": "where a payload is held"},
        "recordings": [
            {
                "file": "first.csv",
                "comment": "columns t [s], q_JOINT [rad], tau_JOINT [Nm]; if measured, dq_JOINT [rad/s], ddq_JOINT [rad/s²], payload [kg]",
                "group": "set-up 1",
                "payload": 0.0,
            }
        ],
    }


def _task(robot: Robot, source: str) -> dict[str, Any]:
    moving = [j for j in range(robot.n) if np.isfinite([robot.lower[j], robot.upper[j]]).all() and robot.velocity[j] > 0]
    moving = [j for j in moving if j > 0][:MOVING] or moving[:MOVING]
    if not moving:
        raise UserError(f"robot {robot.name!r}: no joint has a range and a speed limit in the URDF; a task needs them")
    low, high = (np.degrees(limit[moving]).clip(-USUAL, USUAL) for limit in (robot.lower, robot.upper))
    names = [robot.joints[j] for j in moving]
    springs: list[dict[str, Any]] = [
        {
            "effect": "parallel_spring",
            "joint": name,
            "stiffness_Nm_per_rad": [0.0, 50.0],
            "equilibrium_deg": [float(np.floor(a)), float(np.ceil(b))],
        }
        for name, a, b in zip(names, low, high, strict=True)
    ]
    return {
        "format": "rrr_oc-task/1",
        "comment": "Carry the payload from start to release and come back without it. Ends are angles, or positions of the tool as position_m.",
        "name": robot.name,
        "robot": source,
        "moving": names,
        "tool": {"link": robot.tool_link, "position_m": [0.0, 0.0, 0.0]},
        "start": {"angles_deg": np.round(low + 0.3 * (high - low), 1).tolist()},
        "release": {"angles_deg": np.round(low + 0.7 * (high - low), 1).tolist()},
        "payload_kg": 1.0,
        "duration_s": [1.0, 5.0],
        "limits": {
            name: {"speed_deg_per_s": float(np.round(np.degrees(robot.velocity[j]), 1)), "acceleration_deg_per_s2": 360.0}
            for name, j in zip(names, moving, strict=True)
        },
        "locked_deg": {
            joint: 0.0 for j, joint in enumerate(robot.joints) if j not in moving and robot.lower[j] <= 0 <= robot.upper[j]
        },
        "springs": springs,
    }


def _next(out: Path, robot: Robot) -> str:
    return f"""# {robot.name}

1. Put your recordings beside `recordings/first.csv`, with its columns, and list each in `recordings/recordings.json`.
2. Calibrate, and ask what the model lacks:

```
rrr-oc diagnose {out / "recordings"} --out {out / "diagnosis"}
```

3. Change `task.json` to your task, and design springs and motion for the model that was found:

```
rrr-oc design {out / "task.json"} --model {out / "diagnosis" / "model.json"} --out {out / "design"}
```

4. Take the model to plain MuJoCo:

```
rrr-oc export {out / "diagnosis" / "model.json"} --out {out / "export"}
```
"""

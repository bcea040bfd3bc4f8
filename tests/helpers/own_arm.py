"""A task and a calibrated model of an arm that is not the paper's, and options of a small design."""

import importlib.resources
import json
from pathlib import Path

import numpy as np
from chains import arm

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.model_file import save_model
from rrr_oc.effects import CATALOGUE
from rrr_oc.robot.robot import load_robot

PAPER = json.loads(importlib.resources.files("rrr_oc.data").joinpath("paper.json").read_text())


def with_robot(folder: Path, urdf: str) -> str:
    """A task of the arm in `urdf`, whose joints are j1, j2, …"""
    (folder / "arm.urdf").write_text(urdf)
    limits = {"j2": {"speed_deg_per_s": 90, "acceleration_deg_per_s2": 180}}
    angles = {"start": {"angles_deg": [10]}, "release": {"angles_deg": [50]}}
    content = {
        **PAPER,
        **angles,
        "robot": "arm.urdf",
        "moving": ["j2"],
        "limits": limits,
        "tool": {"link": "l2", "position_m": [0, 0, 0]},
    }
    (folder / "task.json").write_text(json.dumps(content))
    return str(folder / "task.json")


def own_task(folder: Path, **changes) -> str:
    """A task of an arm of its own whose joints are j1 to j3 and which has one spring."""
    spring = {"effect": "parallel_spring", "joint": "j2", "active": "below"}
    spring |= {"stiffness_Nm_per_rad": [0, 20], "equilibrium_deg": [-10, 140]}
    content = json.loads(Path(with_robot(folder, arm(3))).read_text()) | {"name": "own", "springs": [spring]}
    content |= {"tool": {"link": "l3", "position_m": [0.2, 0, 0]}, "payload_kg": 1.0, "duration_s": [0.8, 3.0]} | changes
    (folder / "task.json").write_text(json.dumps(content))
    return str(folder / "task.json")


def own_model(folder: Path) -> str:
    """A calibrated model of that arm, with viscous friction in every joint."""
    robot = load_robot(folder / "arm.urdf")
    terms = tuple(Term(CATALOGUE["viscous_friction"]((j,)), (Estimate(1.0),)) for j in range(robot.n))
    zero, urdf = np.zeros(robot.n), (folder / "arm.urdf").read_text()
    constants = (None,) * robot.n
    tool = robot.point("l3", (0.2, 0.0, 0.0))
    model = CalibratedModel(robot, "arm.urdf", urdf, tool, "motor", constants, "nominal", terms, zero, zero)
    save_model(model, folder / "model.json")
    return str(folder / "model.json")


OWN = ["--configurations", "SA,PEA", "--starts", "1", "--motions", "0", "--tolerance", "1e-2", "--jobs", "1"]

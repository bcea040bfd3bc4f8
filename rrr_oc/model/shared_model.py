"""Models shared between equal robots, so that the CasADi functions of one are derived once in a process."""

from dataclasses import replace

import numpy as np

from rrr_oc.effects import Effect
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.robot import Robot, ToolPoint

KEPT = (
    500  # models, and functions of them, the least recently used is dropped; a diagnosis uses some 130, so doubled, no change
)
_MODELS: dict[tuple, Model] = {}  # for the life of the process, the most recently used last


def shared_model(robot: Robot, tool: ToolPoint, effects: tuple[Effect, ...]) -> Model:
    """The model of a robot with effects, the same object whenever these are equal.

    For functions that take inertial parameters as an argument: the robot in it has NaN in their place.
    """
    names = ("placements", "axes", "gravity", "lower", "upper", "velocity", "effort")
    arrays = (*(getattr(robot, name) for name in names), tool.position)
    key = (robot.name, robot.joints, robot.links, tool.joint, effects, *(array.tobytes() for array in arrays))
    model = _MODELS.pop(key, None) or Model(replace(robot, inertial=np.full_like(robot.inertial, np.nan)), tool, effects)
    _MODELS[key] = model
    if len(_MODELS) > KEPT:
        del _MODELS[next(iter(_MODELS))]
    return model

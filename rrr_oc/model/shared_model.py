"""Models by what they are made of, so that the CasADi functions of one are derived once in a process."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from rrr_oc.effects import Effect
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.robot import Robot, ToolPoint

KEPT = 100  # models; the one asked for longest ago goes first; a diagnosis uses fewer than ten, so doubled it changes nothing there


class _Parts:
    """What a model is made of, but for inertial parameters, as a key."""

    def __init__(self, robot: Robot, tool: ToolPoint, effects: tuple[Effect, ...]) -> None:
        self.robot, self.tool, self.effects = robot, tool, effects
        names = ("placements", "axes", "gravity", "lower", "upper", "velocity", "effort")
        arrays = (*(getattr(robot, name) for name in names), tool.position)
        self.key = (robot.name, robot.joints, robot.links, tool.joint, effects, *(array.tobytes() for array in arrays))

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Parts) and self.key == other.key


def shared_model(robot: Robot, tool: ToolPoint, effects: tuple[Effect, ...]) -> Model:
    """The model of a robot with effects, the same object whenever these are equal.

    For functions that take inertial parameters as an argument: the robot in it has NaN in their place.
    """
    return _model(_Parts(robot, tool, effects))


@lru_cache(maxsize=KEPT)
def _model(parts: _Parts) -> Model:
    return Model(replace(parts.robot, inertial=np.full_like(parts.robot.inertial, np.nan)), parts.tool, parts.effects)

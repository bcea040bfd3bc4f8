"""What an arm must not touch: a floor under links and tool, and keep-outs, which are capsules and boxes.

A link is the straight line from its joint's origin to the next one's, the last from its joint's to the tool, with a radius about it. A
straight link is above a floor where both its ends are. For keep-outs points stand along each link, so dense that balls about them
cover it. Distances are smooth functions of the angles, as IPOPT needs them, and never greater than the true ones by more than `ROUND`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from msgspec import Struct

from rrr_oc.numerics.smooth import fmax, ramp
from rrr_oc.robot.rigid_body import rigid_body, upwards
from rrr_oc.robot.robot import Robot, ToolPoint
from rrr_oc.schema import Position, Positive, Schema, Text, Vector

SPACING = 0.05  # [m] between points along a link, at most; doubled, fewer constraints, and links keep further away
# [1/m] by how much faces of a box compete near its edges; doubled, corners are sharper and solves harder
SHARPNESS = 100.0
BLEND = 0.02  # [1] of a capsule's length over which its sides go over into its ends; doubled, smoother and a little further off
ROUND = 1e-3  # [m] by which a distance is rounded where it would have a kink; doubled, nothing changes outside of keep-outs
FIXED = 1e-9  # [m] that a point must move for its height or distance to be a constraint
FLOOR, TOOL = "the floor", "the tool"
POSTURES = 16  # at which it is looked whether a point moves; doubled, nothing changes


class Capsule(Schema, frozen=True):
    """A cylinder with a half ball at each end.

    Attributes:
        from_m: One end of its axis, in the base frame.
        to_m: The other one.
        radius_m: Its radius.
    """

    from_m: Vector
    to_m: Vector
    radius_m: Positive


class Box(Schema, frozen=True):
    """A box.

    Attributes:
        center_m: Its middle, in the base frame.
        size_m: Its edges, each above 0.
        rpy_deg: How it is turned: about the fixed x, then y, then z.
    """

    center_m: Position
    size_m: Vector
    rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not all(edge > 0 for edge in self.size_m):
            raise ValueError(f"size_m: found {list(self.size_m)}; edges above 0 are required")


class KeepOut(Schema, frozen=True):
    """What links and tool keep out of; either a capsule or a box.

    Attributes:
        name: Its name in messages and reports.
        capsule: A cylinder with round ends.
        box: A box.
    """

    name: Text
    capsule: Capsule | None = None
    box: Box | None = None

    def __post_init__(self) -> None:
        if (self.capsule is None) == (self.box is None):
            raise ValueError('give either "capsule" or "box"')

    def distance(self, point):
        """Distance of a point (3,) from its surface [m], negative inside; numbers or casadi's."""
        return _from_capsule(self.capsule, point) if self.capsule is not None else _from_box(self.box, point)


def _from_capsule(capsule: Capsule, point):
    start, axis = np.array(capsule.from_m), np.array(capsule.to_m) - np.array(capsule.from_m)
    length = float(axis @ axis)
    if length:
        share = ca.dot(point - start, axis) / length
        start = start + axis * (ramp(share, BLEND) - ramp(share - 1, BLEND))
    return ca.sqrt(ca.sumsqr(point - start) + ROUND**2) - capsule.radius_m


def _from_box(box: Box | None, point):
    """The greatest distance from one of the six planes, which is no more than that from the box. Where two are nearly the same, a weighted
    mean of them stands for the greatest, so that the edges are rounded outward."""
    assert box is not None
    inside = ca.DM(_turned(box.rpy_deg)).T @ (point - np.array(box.center_m))
    half = np.array(box.size_m) / 2
    planes = ca.vertcat(inside - half, -inside - half)
    largest = planes[0]
    for i in range(1, 6):
        largest = fmax(largest, planes[i])
    weights = ca.exp(SHARPNESS * (planes - largest))
    return ca.dot(weights, planes) / ca.sum1(weights)


def _turned(rpy_deg: Sequence[float]) -> np.ndarray:
    (a, b, c), (sa, sb, sc) = np.cos(np.radians(rpy_deg)), np.sin(np.radians(rpy_deg))
    return np.array(
        [
            [b * c, sa * sb * c - a * sc, a * sb * c + sa * sc],
            [b * sc, sa * sb * sc + a * c, a * sb * sc - sa * c],
            [-sb, sa * b, a * b],
        ]
    )


@dataclass(frozen=True)
class Clearance:
    """A distance that a point of the arm keeps.

    Attributes:
        name: From what, for messages and reports.
        of: Which point it is.
        value: The distance, or the height [m]; numbers or casadi's.
        least: What it must be at least [m].
    """

    name: str
    of: str
    value: Any
    least: float


class Surroundings(Struct, frozen=True):
    """What stands about an arm.

    Attributes:
        floor: Height that links and tool stay above [m], against gravity; -infinity where nothing stands below.
        keep_outs: What they keep out of.
        link_radius: Of each link, about the line from its joint to the next one [m]; the tool's point has none.
    """

    floor: float = -np.inf
    keep_outs: tuple[KeepOut, ...] = ()
    link_radius: float = 0.0

    def kept(self, robot: Robot, tool: ToolPoint, moving: Sequence[int], q, rest: np.ndarray) -> list[Clearance]:
        """The distances that an arm keeps at angles of all joints (n,), numbers or casadi's, of those points that move.

        Args:
            moving: Indices of the joints that move.
            rest: Angles of all joints (n,) where the moving ones may stand, [rad].
        """
        if not np.isfinite(self.floor) and not self.keep_outs:
            return []
        links, ends = _links(robot, tool, moving[0]), link_ends(robot, tool)
        angles = np.tile(rest, (POSTURES, 1))
        angles[:, list(moving)] += np.random.default_rng(0).uniform(-2, 2, (POSTURES, len(moving)))
        drawn, points = np.array([np.array(ends(posture)) for posture in angles]), ends(q)
        up, found = upwards(robot.gravity), list[Clearance]()
        for _, last, of in links if np.isfinite(self.floor) else ():
            if np.ptp(up @ drawn[:, :, last].T) > FIXED:
                radius = self.link_radius * (last < robot.n)
                found.append(Clearance(FLOOR, of, ca.dot(ca.DM(up), points[:, last]), self.floor + radius))
        for first, last, of in links if self.keep_outs else ():
            length = float(np.linalg.norm(drawn[0, :, last] - drawn[0, :, first]))
            count = int(np.ceil(length / SPACING))
            for share in np.arange(1, count + 1) / count:
                way = (1 - share) * drawn[:, :, first] + share * drawn[:, :, last]
                if np.ptp(way, axis=0).max() > FIXED:
                    ball = float(np.hypot(self.link_radius, length / count / 2))
                    least = 0.0 if share == 1 and last == robot.n else ball
                    point = (1 - share) * points[:, first] + share * points[:, last]
                    found += [Clearance(f"the keep-out {one.name}", of, one.distance(point), least) for one in self.keep_outs]
        return found


def _links(robot: Robot, tool: ToolPoint, first: int) -> list[tuple[int, int, str]]:
    """Where the links from the first moving one on begin and end, as columns of `link_ends`, and their names."""
    chain = [(j, j + 1, f"the link of {robot.joints[j]}") for j in range(first, robot.n - 1)]
    return [*chain, (tool.joint, robot.n, TOOL)]


def link_ends(robot: Robot, tool: ToolPoint) -> ca.Function:
    """Angles (n,) -> the joints' origins and the tool's point [m], (3, n + 1), in the base frame."""
    q = ca.SX.sym("q", robot.n)
    frames = rigid_body(robot).joint_frames(q)
    held = ca.reshape(frames[:9, tool.joint], 3, 3) @ ca.DM(tool.position) + frames[9:, tool.joint]
    return ca.Function("ends", [q], [ca.horzcat(frames[9:, :], held)])

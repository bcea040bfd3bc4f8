"""What is shown of a motion, and its shapes in space: the arm, the payload and the springs, all as capsules."""

from dataclasses import dataclass

import numpy as np

from rrr_oc.robot.rigid_body import rigid_body
from rrr_oc.robot.robot import Robot, ToolPoint

THICKNESS = 0.08  # radius of a link, as a share of the arm's mean link; doubled, a thicker arm
ARM, JOINT, HELD = (0.72, 0.76, 0.82, 1.0), (0.24, 0.31, 0.41, 1.0), (0.77, 0.35, 0.07, 1.0)  # colours, and their opacity
TENSION = np.array([[0.62, 0.62, 0.62], [0.98, 0.78, 0.25], [0.78, 0.07, 0.07]])  # colours of a spring: no load, half, most
HEAVY = 0.045  # [m] radius of a payload of 1 kg, which grows with the cube root of the mass: a ball of 2.6 kg a litre
COIL = 97  # points along a coil; doubled, smoother ones


@dataclass(frozen=True)
class ShownSpring:
    """A spring of a scene.

    Attributes:
        joints: Indices of the joint, or the two joints, that it spans.
        tension: Its torque on the first of them, without a sign [Nm], (K,).
    """

    joints: tuple[int, ...]
    tension: np.ndarray


@dataclass(frozen=True)
class Scene:
    """What is shown.

    Attributes:
        robot, tool: The arm, and where it holds the payload.
        t: Time [s], (K,).
        q: Positions of all joints [rad], (n, K).
        torques: Name and values [Nm], (m, K), of each kind of torque that is drawn.
        labels: The m joints that these belong to.
        payload: Mass held at each instant [kg], (K,).
        title: Above the picture.
        springs: The springs that are mounted.
    """

    robot: Robot
    tool: ToolPoint
    t: np.ndarray
    q: np.ndarray
    torques: dict[str, np.ndarray]
    labels: tuple[str, ...]
    payload: np.ndarray
    title: str
    springs: tuple[ShownSpring, ...] = ()

    @property
    def most(self) -> float:
        """The largest tension of any spring [Nm], 0 without springs."""
        return max((float(spring.tension.max()) for spring in self.springs), default=0.0)

    def points(self, at: np.ndarray) -> np.ndarray:
        """Base, origins of the joints and the tool at some instants [m], (instants, n + 2, 3)."""
        return np.array([chain(self.robot, self.tool, q) for q in self.q[:, at].T])


@dataclass(frozen=True)
class Capsules:
    """Rounded rods; those whose ends are the same are balls.

    Attributes:
        ends: [m], (m, 2, 3).
        radius: [m], (m,).
        colour: Red, green, blue and opacity, each 0 to 1, (m, 4).
    """

    ends: np.ndarray
    radius: np.ndarray
    colour: np.ndarray


def poses(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Pose of each joint's frame in the base frame at positions (n,), (n, 4, 4)."""
    frames = np.array(rigid_body(robot).joint_frames(q)).reshape(12, -1)
    result = np.tile(np.eye(4), (robot.n, 1, 1))
    result[:, :3, :3] = frames[:9].T.reshape(-1, 3, 3).swapaxes(1, 2)
    result[:, :3, 3] = frames[9:].T
    return result


def chain(robot: Robot, tool: ToolPoint, q: np.ndarray) -> np.ndarray:
    """Base, origins of the joints and the tool at positions (n,) [m], (n + 2, 3)."""
    placed = poses(robot, q)
    at = placed[tool.joint, :3, :3] @ tool.position + placed[tool.joint, :3, 3]
    return np.array([np.zeros(3), *placed[:, :3, 3], at])


def thickness(robot: Robot, tool: ToolPoint) -> float:
    """Radius of the links that are drawn [m]."""
    lengths = np.linalg.norm([*robot.placements[1:, :3, 3], tool.position], axis=1)
    return THICKNESS * float(np.mean(lengths[lengths > 0])) if np.any(lengths > 0) else THICKNESS


@dataclass(frozen=True)
class Rod:
    """A part of the arm: a rod that moves with a joint (-1: the base); its ends in that joint's frame [m], (2, 3)."""

    joint: int
    ends: np.ndarray
    radius: float
    colour: tuple[float, float, float, float]


def rods(robot: Robot, tool: ToolPoint) -> list[Rod]:
    """The arm: a rod from joint to joint and to the tool, and a thicker one along each joint's axis."""
    r, at = thickness(robot, tool), robot.placements[:, :3, 3]
    ways = [*((i - 1, place) for i, place in enumerate(at)), (tool.joint, tool.position)]
    links = [Rod(joint, np.array([np.zeros(3), end]), r, ARM) for joint, end in ways if np.linalg.norm(end) > 1e-9]
    return links + [Rod(i, r * np.array([-axis, axis]), 1.3 * r, JOINT) for i, axis in enumerate(robot.axes)]


def arm_shapes(robot: Robot, tool: ToolPoint, q: np.ndarray) -> Capsules:
    """The arm at positions (n,)."""
    parts, placed = rods(robot, tool), [np.eye(4), *poses(robot, q)]
    ends = [rod.ends @ placed[rod.joint + 1][:3, :3].T + placed[rod.joint + 1][:3, 3] for rod in parts]
    return Capsules(np.array(ends), np.array([rod.radius for rod in parts]), np.array([rod.colour for rod in parts]))


def payload_radius(scene: Scene, k: int) -> float:
    """Radius of the ball that is held at the instant with index `k` [m]."""
    return max(float(HEAVY * np.cbrt(scene.payload[k])), 1.2 * thickness(scene.robot, scene.tool))


def shapes(scene: Scene, k: int) -> Capsules:
    """All that is seen at the instant with index `k`: the arm, its springs, and the payload where there is one."""
    parts = [arm_shapes(scene.robot, scene.tool, scene.q[:, k]), *(spring_shapes(scene, spring, k) for spring in scene.springs)]
    if scene.payload[k] > 0:
        at = chain(scene.robot, scene.tool, scene.q[:, k])[-1]
        parts.append(Capsules(np.array([[at, at]]), np.array([payload_radius(scene, k)]), np.array([HELD])))
    return Capsules(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("ends", "radius", "colour")))


def spring_shapes(scene: Scene, spring: ShownSpring, k: int) -> Capsules:
    """A spring at the instant with index `k`: a spiral at one joint, or a coil between two; its colour is its tension."""
    share = float(spring.tension[k]) / scene.most if scene.most > 0 else 0.0
    points = coil_points(scene, spring, k, share)
    ends = np.stack([points[:-1], points[1:]], axis=1)
    radius = 0.2 * thickness(scene.robot, scene.tool)
    return Capsules(ends, np.full(len(ends), radius), np.tile([*tension_colour(share), 1.0], (len(ends), 1)))


def tension_colour(share: float) -> np.ndarray:
    """Red, green and blue of a spring under this share of the largest tension, (3,)."""
    return np.array([np.interp(share, np.linspace(0, 1, len(TENSION)), TENSION[:, c]) for c in range(3)])


def coil_points(scene: Scene, spring: ShownSpring, k: int, share: float) -> np.ndarray:
    """The line of a spring's wire [m], (`COIL`, 3); wound tighter with its tension."""
    r, placed, s = thickness(scene.robot, scene.tool), poses(scene.robot, scene.q[:, k]), np.linspace(0, 1, COIL)
    first = spring.joints[0]
    axis = placed[first, :3, :3] @ scene.robot.axes[first]
    if len(spring.joints) == 1:
        across, other = _perpendicular(placed[first, :3, 0] - axis * (axis @ placed[first, :3, 0]), axis)
        angle, radius = 2 * np.pi * (2.5 + share) * s, r * (0.6 + 2.2 * s)
        spiral = radius * np.cos(angle) * across[:, None] + radius * np.sin(angle) * other[:, None]
        return (placed[first, :3, 3] + 3.2 * r * axis)[None] + spiral.T
    start, end = (placed[j, :3, 3] + 2.0 * r * axis for j in spring.joints)
    along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
    across, other = _perpendicular(axis, along)
    inside = np.clip((s - 0.2) / 0.6, 0, 1)  # the ends of the cable are straight
    radius = (0.9 - 0.4 * share) * r * np.minimum(1, 12 * np.minimum(inside, 1 - inside))
    angle = 2 * np.pi * 8 * inside
    winding = radius * np.cos(angle) * across[:, None] + radius * np.sin(angle) * other[:, None]
    return start + s[:, None] * (end - start) + winding.T


def _perpendicular(near: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors at right angles to an axis and each other, the first as near as can be to `near`."""
    flat = near - axis * (axis @ near)
    if np.linalg.norm(flat) < 1e-6:
        flat = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    across = flat / np.linalg.norm(flat)
    return across, np.cross(axis, across)

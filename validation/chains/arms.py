# pyright: reportAttributeAccessIssue=false
"""Random serial arms, the files that describe them, and how arms and files differ."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

MASS, CENTRE, INERTIA = 0.03, 0.01, 0.05  # standard deviations of a file's errors: share, [m], share
AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
Range = tuple[float, float]


@dataclass(frozen=True)
class Body:
    """A rigid body in its joint's frame: mass [kg], centre (3,) [m], principal moments about it (3,) [kg m²] and their turn (3,) [rad]."""

    mass: float
    centre: np.ndarray
    moments: np.ndarray
    turn: np.ndarray

    @property
    def inertia(self) -> pin.Inertia:
        """The same for Pinocchio."""
        R = pin.rpy.rpyToMatrix(self.turn)
        return pin.Inertia(self.mass, self.centre, R @ np.diag(self.moments) @ R.T)


@dataclass(frozen=True)
class ArmKind:
    """What arms of a family have in common.

    Attributes:
        axes: Of the joints, such as "zyy". Links lie along z.
        lengths, masses: Of the first and of the last link [m], [kg]; those between follow geometrically.
        dry, viscous: Friction, at 1 rad/s, as a share of the usual torque: least and greatest.
        rotor: Inertia of a rotor at the joint as a share of the inertia that the joint moves: least and greatest.
        acceleration: Usual size in its motions [rad/s²].
        hangs: Whether links hang down.
        width: Speed over which dry friction changes sign [rad/s]; 0 for a constraint that holds the joint.
    """

    axes: str
    lengths: Range
    masses: Range
    dry: Range
    viscous: Range
    rotor: Range
    acceleration: float = 3.0
    hangs: bool = False
    width: float = 0.01


@dataclass(frozen=True)
class Arm:
    """An arm: bodies, where joint i sits in the frame before it `offsets` (n, 3) and the tool in the last [m], and its drives.

    Attributes:
        dry, viscous, rotor: Friction [Nm], [Nm s/rad] and rotor inertia [kg m²] of each joint (n,).
        usual: Usual size of the torque of each joint (n,) [Nm].
    """

    kind: ArmKind
    bodies: tuple[Body, ...]
    offsets: np.ndarray
    tool: np.ndarray
    dry: np.ndarray
    viscous: np.ndarray
    rotor: np.ndarray
    usual: np.ndarray

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.bodies)

    @property
    def joints(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(f"j{i + 1}" for i in range(self.n))

    @property
    def links(self) -> tuple[str, ...]:
        """Names of the links, each behind its joint."""
        return tuple(f"l{i + 1}" for i in range(self.n))

    @property
    def urdf(self) -> str:
        """The arm as a file."""
        text = '<robot name="arm"><link name="base"/>\n'
        for i, (body, link, joint) in enumerate(zip(self.bodies, self.links, self.joints, strict=True)):
            moments = " ".join(f'{k}="{m:.9g}"' for k, m in zip(("ixx", "iyy", "izz"), body.moments, strict=True))
            text += f'<link name="{link}"><inertial><origin xyz="{numbers(body.centre)}" rpy="{numbers(body.turn)}"/>'
            text += f'<mass value="{body.mass:.9g}"/><inertia {moments} ixy="0" ixz="0" iyz="0"/></inertial></link>\n'
            text += f'<joint name="{joint}" type="revolute"><parent link="{("base", *self.links)[i]}"/><child link="{link}"/>'
            text += f'<origin xyz="{numbers(self.offsets[i])}"/><axis xyz="{AXES[self.kind.axes[i]]}"/>'
            text += '<limit lower="-3" upper="3" effort="1000" velocity="30"/></joint>\n'
        text += f'<link name="tool"/><joint name="grip" type="fixed"><parent link="{self.links[-1]}"/><child link="tool"/>'
        return text + f'<origin xyz="{numbers(self.tool)}"/></joint></robot>\n'

    @property
    def model(self) -> pin.Model:
        """The arm for Pinocchio."""
        return pin.buildModelFromXML(self.urdf)

    def with_body(self, link: int, body: Body) -> "Arm":
        """The same arm with another body at a link."""
        return replace(self, bodies=(*self.bodies[:link], body, *self.bodies[link + 1 :]))

    def with_mass(self, mass: float) -> "Arm":
        """The arm with a point mass at its tool [kg]."""
        whole = self.bodies[-1].inertia + pin.Inertia(mass, self.tool, np.zeros((3, 3)))
        moments, frame = np.linalg.eigh(whole.inertia)
        frame[:, 0] *= np.linalg.det(frame)
        return self.with_body(self.n - 1, Body(whole.mass, np.array(whole.lever), moments, pin.rpy.matrixToRpy(frame)))


def numbers(values: Sequence[float] | np.ndarray) -> str:
    """As in XML."""
    return " ".join(f"{x:.9g}" for x in values)


def random_arm(kind: ArmKind, rng: np.random.Generator) -> Arm:
    """An arm as it was designed."""
    n, way = len(kind.axes), -1.0 if kind.hangs else 1.0
    lengths = np.geomspace(*kind.lengths, n) * rng.uniform(0.85, 1.2, n)
    masses = np.geomspace(*kind.masses, n) * rng.uniform(0.75, 1.3, n)
    bodies = []
    for length, mass in zip(lengths, masses, strict=True):
        radius = length * rng.uniform(0.18, 0.3)
        across = mass * (3 * radius**2 + length**2) / 12
        moments = np.array([across, across, mass * radius**2 / 2]) * rng.uniform(0.92, 1.08, 3)
        centre = np.array([*rng.normal(0, 0.05 * length, 2), way * rng.uniform(0.35, 0.65) * length])
        bodies.append(Body(float(mass), centre, moments, rng.normal(0, 0.1, 3)))
    ends = np.column_stack([rng.normal(0, 0.05 * lengths), rng.normal(0, 0.05 * lengths), way * lengths])
    offsets = np.vstack([[0, 0, 0.1], ends[:-1]])
    none = np.zeros(n)
    arm = Arm(kind, tuple(bodies), offsets, ends[-1], none, none, none, none)
    model = arm.model
    data = model.createData()
    postures = rng.uniform(-1.3, 1.3, (60, n))
    inertia = np.mean([np.diag(pin.crba(model, data, q)) for q in postures], axis=0)
    holding = np.sqrt(np.mean([pin.computeGeneralizedGravity(model, data, q) ** 2 for q in postures], axis=0))
    usual = holding + inertia * kind.acceleration
    dry, viscous, rotor = (rng.uniform(low, high, n) for low, high in (kind.dry, kind.viscous, kind.rotor))
    return replace(arm, dry=usual * dry, viscous=usual * viscous, rotor=inertia * rotor, usual=usual)


def described(arm: Arm, rng: np.random.Generator) -> Arm:
    """An arm as its file has it: every body a little wrong, as usual."""
    return replace(arm, bodies=tuple(erroneous(body, rng) for body in arm.bodies))


def erroneous(body: Body, rng: np.random.Generator) -> Body:
    """A body with the usual errors of mass, centre and moments; drawn again until it is one that exists."""
    while True:
        moments = body.moments * np.exp(INERTIA * rng.standard_normal(3))
        if 2 * moments.max() < 0.999 * moments.sum():
            scale = float(np.exp(MASS * rng.standard_normal()))
            return Body(body.mass * scale, body.centre + CENTRE * rng.standard_normal(3), moments * scale, body.turn)


def made_wrong(arm: Arm, rng: np.random.Generator) -> tuple[Arm, dict[str, object]]:
    """An arm one body of which is not the designed one, and what it is: a heavier link, a centre off, or a tool that was forgotten."""
    felt = [i for i in range(arm.n) if i > 0 or arm.kind.axes[0] != "z"]
    what, link = str(rng.choice(["heavier", "centre", "tool"])), int(rng.choice(felt))
    body, length = arm.bodies[link], float(np.linalg.norm([*arm.offsets[1:], arm.tool][link]))
    if what == "heavier":
        scale = rng.uniform(1.15, 1.4)
        return arm.with_body(link, replace(body, mass=body.mass * scale, moments=body.moments * scale)), told(
            arm, link, what, scale
        )
    if what == "centre":
        way = rng.standard_normal(3)
        way[2] *= 2
        shift = rng.uniform(0.04, min(0.12, max(0.06, 0.6 * length))) * way / np.linalg.norm(way)
        return arm.with_body(link, replace(body, centre=body.centre + shift)), told(arm, link, what, shift.tolist())
    mass = float(arm.bodies[-1].mass * rng.uniform(0.3, 0.8))
    return arm.with_mass(mass), told(arm, arm.n - 1, what, mass)


def told(arm: Arm, link: int, what: str, by: object) -> dict[str, object]:
    """Which link is wrong, in what, and by how much: a factor of the mass, a shift [m], or a mass [kg]."""
    return {"link": arm.links[link], "joint": arm.joints[link], "what": what, "by": by}

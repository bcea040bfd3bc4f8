# pyright: reportAttributeAccessIssue=false
"""Arms of the plant: the two bundled robots and generated serial chains of 1 to 7 revolute joints."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pinocchio as pin

BUNDLED = Path(__file__).resolve().parents[2] / "models" / "urdf"

# The authors' calibrated MuJoCo values; joint 1 was never calibrated, its numbers are of the same size.
RRR_COULOMB = np.array([6.0, 7.877, 6.128])  # [Nm]
RRR_VISCOUS = np.array([30.0, 39.958, 22.831])  # [Nm s/rad]
RRR_ARMATURE = np.array([0.25, 0.2254, 0.03064])  # [kg m²]


@dataclass(frozen=True)
class Motor:
    """Eq. 7–9 in amperes: k_t I = k_t (c_0 s + ν v + c_v2 s v² + c_1 τ_l + c_12 s |τ_l| + J_m a), s = tanh(20 v)."""

    constant: np.ndarray  # k_t [Nm/A at the output]
    c0: np.ndarray  # [A]
    nu: np.ndarray  # [A s/rad]
    cv2: np.ndarray  # [A s²/rad²]
    c1: np.ndarray  # [A/Nm]
    c12: np.ndarray  # [A/Nm]
    inertia: np.ndarray  # [A s²/rad]


PROTOTYPE_MOTOR = Motor(
    constant=np.array([10.89, 12.34, 10.89]),
    c0=np.array([0.5669, 0.7080, 0.5085]),
    nu=np.array([2.5853, 3.3084, 2.1345]),
    cv2=np.array([-0.7760, -1.2718, -0.5508]),
    c1=np.array([0.098, 0.082, 0.098]),
    c12=np.array([-0.014, 0.011, 0.005]),
    inertia=np.array([0.0, 0.0559, 0.0034]),
)


@dataclass(frozen=True)
class Arm:
    """One robot with its plain physics and controllers. Arrays have one entry per recorded joint, (n,)."""

    name: str
    urdf: str  # the true model
    joints: tuple[str, ...]
    tool_link: str
    tool_point: np.ndarray  # in the link's frame [m]
    lower: np.ndarray  # [rad]
    upper: np.ndarray  # [rad]
    effort: np.ndarray  # torque limit of the controller [Nm]
    speed: np.ndarray  # fastest reference [rad/s]
    coulomb: np.ndarray  # [Nm]
    viscous: np.ndarray  # [Nm s/rad]
    armature: np.ndarray  # [kg m²]
    kp: np.ndarray  # [Nm/rad]
    kd: np.ndarray  # [Nm s/rad]
    width: float = 0.05  # dry friction is coulomb tanh(v / width) [rad/s]
    motor: Motor | None = None
    stated_urdf: str | None = None  # what the tool is told, where it differs from the truth
    bundled: bool = False
    model: pin.Model = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        object.__setattr__(self, "model", reduced_model(self.urdf, self.joints))

    @property
    def n(self) -> int:
        return len(self.joints)

    def index(self, joint: str) -> int:
        return self.joints.index(joint)


def reduced_model(urdf: str, joints: tuple[str, ...]) -> pin.Model:
    """The model in which every joint that is not listed is locked at zero."""
    full = pin.buildModelFromXML(urdf)
    locked = [i for i in range(1, full.njoints) if full.names[i] not in joints]
    return pin.buildReducedModel(full, locked, pin.neutral(full)) if locked else full


def largest_inertia(model: pin.Model, lower: np.ndarray, upper: np.ndarray, payload: float, frame: str) -> np.ndarray:
    """Largest diagonal of the mass matrix over random postures, with a payload at the frame [kg m²], (n,)."""
    rng = np.random.default_rng(0)
    model, data = model.copy(), None
    f = model.frames[model.getFrameId(frame)]
    model.appendBodyToJoint(f.parentJoint, pin.Inertia(payload, np.zeros(3), np.zeros((3, 3))), f.placement)
    data = model.createData()
    return np.max([np.diag(pin.crba(model, data, rng.uniform(lower, upper))) for _ in range(50)], axis=0)


def rrr_arm(name: str, rng: np.random.Generator, width: float = 0.05, motor: Motor | None = None) -> Arm:
    """`rrr` or `rrr_prototype`, friction and armature scattered about the calibrated values (or Eq. 7–9's)."""
    urdf = (BUNDLED / f"{name}.urdf").read_text(encoding="utf-8")
    model = pin.buildModelFromXML(urdf)
    coulomb, viscous, armature = (
        rng.uniform(low, 1.1, 3) * x for low, x in ((0.4, RRR_COULOMB), (0.3, RRR_VISCOUS), (0.8, RRR_ARMATURE))
    )
    if motor is not None:
        coulomb, viscous, armature = (motor.constant * x for x in (motor.c0, motor.nu, motor.inertia))
    return Arm(
        name=name,
        urdf=urdf,
        joints=("joint1", "joint2", "joint3"),
        tool_link="link3",
        tool_point=np.array([0.31 if name == "rrr_prototype" else 0.30, 0.0, 0.0]),
        lower=np.maximum(model.lowerPositionLimit, [-2.0, -0.1, -2.4]),
        upper=np.minimum(model.upperPositionLimit, [2.0, 2.6, 2.4]),
        effort=np.array([157.5, 157.5, 95.25]),
        speed=np.minimum(model.velocityLimit, 1.5),
        coulomb=coulomb,
        viscous=viscous,
        armature=armature,
        kp=np.full(3, 572.96),
        kd=np.zeros(3),
        width=width,
        motor=motor,
        bundled=True,
    )


def generated_arm(n: int, rng: np.random.Generator, width: float = 0.05, extra: int = 0, wrong_inertials: bool = False) -> Arm:
    """A random serial arm of n recorded joints and `extra` locked ones further out (their bodies still weigh)."""
    axes = chain_axes(n + extra, rng)
    lengths = np.linspace(rng.uniform(0.3, 0.4), rng.uniform(0.1, 0.16), n + extra)  # [m]
    masses = np.geomspace(rng.uniform(4.0, 7.0), rng.uniform(0.8, 1.4), n + extra)  # [kg]
    spread = np.where([a == "0 0 1" for a in axes], 1.8, rng.uniform(1.0, 1.5, n + extra))
    shift = np.where([a == "0 0 1" for a in axes], 0.0, rng.uniform(-0.4, 0.4, n + extra))
    shape = rng.uniform(0.85, 1.15, (n + extra, 5))
    urdf = chain_urdf(axes, lengths, masses, spread, shift, shape)
    stated = None
    if wrong_inertials:
        stated = chain_urdf(axes, lengths, masses * rng.uniform(0.7, 1.3, n + extra), spread, shift, shape * 0.9)
    joints = tuple(f"joint{i + 1}" for i in range(n))
    model = reduced_model(urdf, joints)
    lower, upper = (shift - spread)[:n], (shift + spread)[:n]
    inertia = largest_inertia(model, lower, upper, payload=1.0, frame="tool")
    holding = holding_torque(model, lower, upper)
    armature = np.maximum(rng.uniform(0.04, 0.15, n) * inertia, 0.01)
    coulomb = np.maximum(rng.uniform(0.04, 0.12, n) * np.maximum(holding, 4.0 * inertia), 0.15)
    viscous = coulomb * rng.uniform(0.4, 1.5, n)
    kp = np.minimum((inertia + armature) * 40.0**2, 3000.0)  # bandwidth about 40 rad/s
    return Arm(
        name=f"arm{n}",
        urdf=urdf,
        joints=joints,
        tool_link=f"link{n + extra}",
        tool_point=np.array([lengths[-1], 0.0, 0.0]),
        lower=lower,
        upper=upper,
        effort=3.0 * np.maximum(holding, 4.0 * inertia) + 3.0 * coulomb,
        speed=np.full(n, 1.8),
        coulomb=coulomb,
        viscous=viscous,
        armature=armature,
        kp=kp,
        kd=np.maximum(1.2 * np.sqrt(kp * (inertia + armature)) - viscous, 0.0),
        width=width,
        stated_urdf=stated,
    )


def rotor_inertia(arm: Arm) -> np.ndarray:
    """Armature of the two-inertia joints; Eq. 7's first joint has none, and a rotor must weigh something [kg m²]."""
    return np.maximum(arm.armature, 0.005)


def twisting_inertia(arm: Arm) -> np.ndarray:
    """Smallest inertia that a joint's transmission twists between rotor and links, over random postures [kg m²], (n,)."""
    rng, data, rotor = np.random.default_rng(2), arm.model.createData(), rotor_inertia(arm)
    least = np.full(arm.n, np.inf)
    for _ in range(50):
        mass = pin.crba(arm.model, data, rng.uniform(arm.lower, arm.upper)) + np.diag(rotor)
        for j in range(arm.n):
            others = mass.copy()
            others[j, j] -= rotor[j]
            least[j] = min(least[j], 1 / (1 / rotor[j] + np.linalg.inv(others)[j, j]))
    return least


def chain_axes(n: int, rng: np.random.Generator) -> list[str]:
    """Axes that make a plausible arm: one joint is a pendulum; longer chains mostly turn first about the vertical."""
    if n == 1:
        return ["0 -1 0"]
    rest = ["0 -1 0", "0 -1 0", "1 0 0", "0 -1 0", "1 0 0", "0 -1 0"]
    return (["0 0 1", *rest] if n > 2 or rng.random() < 0.5 else rest)[:n]


def holding_torque(model: pin.Model, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Largest gravity torque over random postures [Nm], (n,)."""
    rng, data = np.random.default_rng(1), model.createData()
    return np.max([np.abs(pin.computeGeneralizedGravity(model, data, rng.uniform(lower, upper))) for _ in range(100)], axis=0)


def chain_urdf(axes, lengths, masses, spread, shift, shape) -> str:
    """URDF of a chain whose links lie along x; `shape` (n, 5) scatters centre and inertia about a cylinder's."""
    parts = ['<?xml version="1.0"?>', '<robot name="arm">', '  <link name="base"/>']
    parent, offset = "base", "0 0 0.15"
    for i, (axis, length, mass) in enumerate(zip(axes, lengths, masses, strict=True)):
        radius = 0.05 if i < 3 else 0.035
        ixx = mass * radius**2 / 2 * shape[i, 0]
        iyy = mass * (3 * radius**2 + length**2) / 12 * shape[i, 1]
        izz = iyy + 3 * ixx * (shape[i, 2] - 1)  # the largest of the three stays below the sum of the others
        parts.append(
            f"""  <joint name="joint{i + 1}" type="revolute">
    <parent link="{parent}"/><child link="link{i + 1}"/>
    <origin xyz="{offset}" rpy="0 0 0"/><axis xyz="{axis}"/>
    <limit lower="{shift[i] - spread[i]:.4f}" upper="{shift[i] + spread[i]:.4f}" effort="500" velocity="3"/>
  </joint>
  <link name="link{i + 1}">
    <inertial>
      <origin xyz="{length / 2 * shape[i, 3]:.5f} {0.01 * (shape[i, 4] - 1):.5f} 0" rpy="0 0 0"/><mass value="{mass:.4f}"/>
      <inertia ixx="{ixx:.7f}" ixy="0" ixz="0" iyy="{iyy:.7f}" iyz="0" izz="{izz:.7f}"/>
    </inertial>
  </link>"""
        )
        parent, offset = f"link{i + 1}", f"{length:.5f} 0 0"
    parts.append(
        f"""  <joint name="tool_joint" type="fixed">
    <parent link="{parent}"/><child link="tool"/><origin xyz="{lengths[-1]:.5f} 0 0" rpy="0 0 0"/>
  </joint>
  <link name="tool"/>
</robot>
"""
    )
    return "\n".join(parts)

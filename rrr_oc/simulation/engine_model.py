"""A model in the physics engine: robot, effects, payload and controllers compiled for MuJoCo."""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import casadi as ca
import mujoco
import numpy as np

from rrr_oc.effects import Body, BodyChange, ExportTwin, MovesLink, NativeTwin
from rrr_oc.errors import UserError
from rrr_oc.model.parameters import by_effect
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.inertial_parameters import about_centre
from rrr_oc.robot.mjcf import built, refusal
from rrr_oc.robot.robot import Robot, ToolPoint
from rrr_oc.simulation import generated_c
from rrr_oc.simulation.generated_c import PAYLOAD, EffectLibrary

Form = Literal["generated", "native"]
Integrator = Literal["rk4", "implicitfast", "implicit", "euler"]
Start = Literal["continue", "reference"]

K_P = 572.96  # Nm/rad, the prototype's P-controllers: 10 Nm a degree
LEAST_ARMATURE = 0.01  # of the link's inertia, of a drive before an elastic gear; with less, the twist is too fast for the step
FASTEST = 2000.0  # [1/s] of a joint slowed by its controller; RK4 at 1 ms diverges from 2785 on
ANGLES = 100  # of all joints, at which that is looked at
STIFFEST = 500.0  # [rad/s] of a joint under its controller; RK4 at 1 ms follows it down to a third of the inertia, doubled to 0.6 of it
INERTIA_FLOOR = 1e-12  # kg m²; MuJoCo refuses a body without rotational inertia, so a point mass gets this much

if mujoco.get_mju_user_warning() is None:  # else MuJoCo writes MUJOCO_LOG.TXT into the working directory, from every thread
    mujoco.set_mju_user_warning(lambda text: None)  # divergence shows in the states


@dataclass(frozen=True)
class Settings:
    """How a motion is simulated.

    Attributes:
        effects: Form of the effects on the links. "generated": the smoothed law as C generated from the effects' expressions;
            "native": MuJoCo's own tendons, which follow the exact law, for those that have such a form.
        timestep: Longest step [s]; a phase is cut into equal steps no longer than this.
        integrator: "rk4" evaluates controller and effects at every stage; the others are first order in `timestep`.
        start: "continue": a phase starts in the final state of the phase before; "reference": at its own first point.
        damping: Viscous friction of the joints [Nm s/rad], scalar or (n,).
        armature: Reflected inertia of the motors [kg m²], scalar or (n,).
        frictionloss: Dry friction of the joints [Nm], scalar or (n,).
    """

    effects: Form = "generated"
    timestep: float = 1e-3
    integrator: Integrator = "rk4"
    start: Start = "continue"
    damping: float | np.ndarray = 0.0
    armature: float | np.ndarray = 0.0
    frictionloss: float | np.ndarray = 0.0

    def __post_init__(self) -> None:
        for name, kind in (("effects", Form), ("integrator", Integrator), ("start", Start)):
            if getattr(self, name) not in get_args(kind):
                raise UserError(f"simulation: {name} is {getattr(self, name)!r}; allowed are {', '.join(get_args(kind))}")
        if not 0 < self.timestep < np.inf:
            raise UserError(f"simulation: timestep {self.timestep} s must be positive and finite")
        for name in ("damping", "armature", "frictionloss"):
            if not np.all((np.asarray(getattr(self, name)) >= 0) & np.isfinite(getattr(self, name))):
                raise UserError(f"simulation: {name} {getattr(self, name)} must be finite and not negative")


DEFAULT = Settings()


@dataclass(frozen=True)
class Controller:
    """Joint controllers: tau = k_p (q_ref − q) + k_d (dq_ref − dq) + tau_ff, cut off at ±limit.

    Attributes:
        k_p: [Nm/rad], shape (n,).
        k_d: [Nm s/rad], shape (n,).
        limit: Torque limits [Nm], shape (n,); infinite where there is none.
    """

    k_p: np.ndarray
    k_d: np.ndarray
    limit: np.ndarray

    def signal(self, q: np.ndarray, dq: np.ndarray, forward: np.ndarray) -> np.ndarray:
        """u = k_p q_ref + k_d dq_ref + tau_ff [Nm], which the actuators hold; arrays (..., n, K)."""
        return self.k_p[:, None] * q + self.k_d[:, None] * dq + forward

    def torque(self, u: np.ndarray, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """u − k_p q − k_d dq within the limits [Nm]; arrays (..., n, K)."""
        torque = u - self.k_p[:, None] * q - self.k_d[:, None] * dq
        return np.clip(torque, -self.limit[:, None], self.limit[:, None])


def controller(model: Model, k_p: float | np.ndarray | None = None, damping_ratio: float = 1.0) -> Controller:
    """The paper's P-controllers with a derivative gain, limited to the robot's efforts.

    The paper's gain k_p acts on an arm that its gears damp (the authors' calibrated joints have 40 and 23 Nm s/rad). Without
    friction and with k_p alone every disturbance would oscillate undamped, so k_d = 2 ζ sqrt(k_p I) replaces the gears'
    damping; it acts on the error of speed and costs no torque on the reference. I is each joint's inertia at q = 0 with the
    other joints free and no payload (`RigidBody.free_inertia`), so that no joint is stiffer than the step can follow. Where other
    angles make that less than `FASTEST` allows, as of arms that fold, all gains are lowered.

    Args:
        k_p: [Nm/rad], scalar or (n,); None: the paper's, or less where a joint's inertia is so small that it would swing faster than
            `STIFFEST`.
    """
    n = model.robot.n
    inertia = model.body.free_inertia(model.robot.inertial)
    gain = np.minimum(K_P, STIFFEST**2 * inertia) if k_p is None else np.broadcast_to(np.asarray(k_p, float), (n,)).copy()
    damping = 2 * damping_ratio * np.sqrt(gain * inertia)
    if k_p is None:
        slower = FASTEST / max(FASTEST, _fastest(model, damping))
        gain, damping = gain * slower**2, damping * slower
    return Controller(gain, damping, model.robot.effort.copy())


def _fastest(model: Model, damping: np.ndarray) -> float:
    """The largest rate at which dampers slow the joints anywhere in their ranges [1/s]: of M(q)⁻¹ diag(damping), at seeded angles."""
    robot, rng = model.robot, np.random.default_rng(0)
    known = np.isfinite(robot.lower) & np.isfinite(robot.upper)
    low, high = np.where(known, robot.lower, -np.pi), np.where(known, robot.upper, np.pi)
    root, rates = np.diag(np.sqrt(damping)), []
    for q in (np.zeros(robot.n), *rng.uniform(low, high, (ANGLES, robot.n))):
        mass = np.asarray(model.body.mass_matrix(q, robot.inertial))
        rates.append(np.linalg.eigvalsh(root @ np.linalg.solve(mass, root)).max())
    return max(rates)


@dataclass(frozen=True)
class Twin:
    """A model in the engine.

    Attributes:
        theta, widths: Parameters and smoothing widths of the effects, as in `Model.theta` and `Model.widths`.
        mj: The mjModel. Joint i of the robot is coordinate `dofs[i]`, as its encoder measures it, and actuator i is its controller:
            the activation is u = k_p q_ref + k_d dq_ref + tau_ff [Nm], `ctrl` its rate [Nm/s], the torque u − k_p q − k_d dq within
            limits. Then follow actuators without torque whose activations are the effects' internal states. The coordinate after
            that of a joint with an elastic gear is the link's position less its drive's.
        library: The compiled effects; None where all effects have forms of MuJoCo's own, or there are none.
        extra_mass: Mass held beyond the listed payload [kg], from the effects on the payload.
    """

    model: Model
    theta: np.ndarray
    widths: np.ndarray
    mj: mujoco.MjModel
    library: EffectLibrary | None
    extra_mass: float = 0.0

    @cached_property
    def dofs(self) -> np.ndarray:
        """Coordinates of the joints in the engine, (n,)."""
        return np.array([self.mj.joint(joint).dofadr[0] for joint in self.model.robot.joints])

    @cached_property
    def elastic_joints(self) -> tuple[int, ...]:
        """Joints with elastic gears."""
        return tuple(sorted({e.joints[0] for e in self.model.effects if e.moves_link}))

    def coordinates(self, q: np.ndarray, dq: np.ndarray, twist: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates of the engine and their rates (nv,) from those of the drives (n,) and of the twists (2, n), 0 by default."""
        whole, gears = np.zeros((2, self.mj.nv)), list(self.elastic_joints)
        whole[:, self.dofs] = q, dq
        if twist is not None:
            whole[:, self.dofs[gears] + 1] = twist[:, gears]
        return whole[0], whole[1]

    def effects(self) -> AbstractContextManager[None]:
        """The context within which the compiled effects act on `mj`: step, forward and roll out inside it."""
        return nullcontext() if self.library is None else generated_c.installed(self.library)

    def set_payload(self, payload: float) -> None:
        """Set the payload's listed mass [kg], 0 to release it, without a new compilation."""
        self.mj.body(PAYLOAD).mass[0] = payload + self.extra_mass
        mujoco.mj_setConst(self.mj, mujoco.MjData(self.mj))  # constants that depend on masses: invweights, subtree masses


def twin(
    model: Model,
    theta: Sequence[float] | np.ndarray = (),
    control: Controller | None = None,
    settings: Settings = DEFAULT,
    widths: np.ndarray | None = None,
) -> Twin:
    """A model compiled for the engine.

    Effects are modelled according to their side. "body": masses, gravity and the payload's point of the compiled model. "link": as
    `settings.effects` says. "drive": MuJoCo's own form where there is one (dry and viscous friction, armature), else generated;
    generated laws do not hold a joint at rest, as MuJoCo's dry friction does, and effects that scale with the plain dry friction
    scale with its smoothed law. "sensor": not at all; they change recorded torques, not the motion. "motion": an offset of an
    encoder turns the joint's zero; an elastic gear adds a coordinate, the link's position less its drive's, and the drive has the
    armature. Behind such a gear load-dependent friction uses the load torque of one step before.

    Args:
        theta: Parameters of the effects, as in `Model.theta`.
        control: Joint controllers. Default: `controller(model)`.
        settings: Which form the effects on the links take, the step, and friction and armature of the joints beside those
            among the effects.
        widths: Smoothing widths of generated effects; 0 is the exact law. Default: `Model.widths`.

    Raises:
        UserError: A joint has both an elastic gear and one with play; a C compiler is required and missing; MuJoCo refuses the robot.
    """
    theta, widths = _checked(model, theta, widths)
    spec, body, generated = assembled(model, theta, controller(model) if control is None else control, settings)
    robot, library = replace(model.robot, inertial=body.inertial), None
    if any(generated):
        library = generated_c.compile_effects(model, generated)
        data = generated_c.values(theta, widths, body.payload, model.robot.inertial)
        spec.add_numeric(name=library.marker, data=data, size=data.size)
    try:
        mj = _compiled(spec, robot)
    except ValueError as error:
        raise UserError(f"MuJoCo refuses robot {model.robot.name!r}: {refusal(error)}") from None
    engine = Twin(model, theta, widths, mj, library, body.payload)
    engine.set_payload(0.0)
    return engine


def assembled(
    model: Model, theta: np.ndarray, control: Controller, settings: Settings, forms: type[ExportTwin] = NativeTwin
) -> tuple[mujoco.MjSpec, Body, tuple[bool, ...]]:
    """A model before it is compiled: robot, effects in MuJoCo's own forms and gears; its body; which effects remain for code.

    Args:
        forms: Which effects take MuJoCo's own forms: those of simulations, `NativeTwin`, or those of files, `ExportTwin`.
    """
    offset = np.array(ca.evalf(generated_c.shift(model, theta))).reshape(-1)
    body = body_of(model, theta)
    robot = replace(model.robot, inertial=body.inertial, gravity=body.gravity)
    spec = build_spec(robot, replace(model.tool, position=body.position), control, settings)
    elastic = any(effect.moves_link for effect in model.effects)
    sides = ("link", "drive") if settings.effects == "native" and not (elastic or offset.any()) else ("drive",)
    own = _native(model, sides if forms is NativeTwin else (*sides, "sensor"), forms)
    generated = _add_effects(spec, model, theta, own)
    _add_gears(spec, model, theta, robot.inertial, settings.timestep)
    for joint, zero in zip(robot.joints, offset, strict=True):
        spec.joint(joint).ref = -zero
    return spec, body, generated


def body_of(model: Model, theta: np.ndarray) -> Body:
    """The rigid body changed by the effects of the side "body", in numbers; its `payload` is mass beyond the listed payload."""
    body = Body(model.robot.inertial, model.robot.gravity, 0.0, model.tool.position.tolist())
    for effect, named in by_effect(model.effects, theta.tolist()):
        body = effect.change(body, named) if isinstance(effect, BodyChange) else body
    inertial = body.inertial if isinstance(body.inertial, np.ndarray) else np.array(ca.evalf(body.inertial))
    return Body(inertial, np.array(body.gravity, float), float(body.payload), np.array(body.position, float))


def _checked(model: Model, theta, widths) -> tuple[np.ndarray, np.ndarray]:
    theta = np.asarray(theta, float).reshape(-1)
    widths = model.widths if widths is None else np.asarray(widths, float).reshape(-1)
    if theta.size != len(model.parameters) or widths.size != len(model.widths):
        sizes = f"{len(model.parameters)} parameters and {len(model.widths)} widths"
        raise UserError(f"the effects have {sizes}, got {theta.size} and {widths.size}")
    return theta, widths


def build_spec(robot: Robot, tool: ToolPoint, control: Controller, settings: Settings) -> mujoco.MjSpec:
    """A robot in MuJoCo, without contacts and joint limits, and with a massless body `PAYLOAD` at the tool."""
    spec = mujoco.MjSpec()
    spec.modelname = robot.name
    spec.compiler.degree = False
    spec.option.gravity = robot.gravity
    spec.option.timestep = settings.timestep
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{settings.integrator.upper()}")
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET | mujoco.mjtDisableBit.mjDSBL_CONTACT
    damping, armature, frictionloss = (
        np.broadcast_to(np.asarray(v, float), (robot.n,)) for v in (settings.damping, settings.armature, settings.frictionloss)
    )
    body = spec.worldbody
    for i in range(robot.n):
        body = body.add_body(name=f"{robot.links[i]}", **_pose(robot.placements[i]), **_inertial(robot.inertial[:, i]))
        joint = body.add_joint(name=robot.joints[i], type=mujoco.mjtJoint.mjJNT_HINGE, axis=robot.axes[i])
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
        joint.damping[0], joint.armature, joint.frictionloss = damping[i], armature[i], frictionloss[i]
        if i == tool.joint:
            body.add_body(name=PAYLOAD, pos=tool.position, mass=0.0, ipos=np.zeros(3), explicitinertial=True)
        _add_actuator(spec, robot.joints[i], control.k_p[i], control.k_d[i], control.limit[i])
    return spec


def _pose(placement: np.ndarray) -> dict[str, np.ndarray]:
    return {"pos": placement[:3, 3], "quat": _quaternion(placement[:3, :3])}


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).reshape(9))
    return quaternion


def _inertial(parameters: np.ndarray) -> dict:
    """Mass, centre of mass, principal axes and moments about it, from `Robot.inertial`'s ten numbers."""
    mass = parameters[0]
    if not mass > 0:
        raise UserError(f"a link has mass {mass:g} kg; the simulation needs a mass above 0 (load_robot with inertial=True)")
    com, axes, moments = _principal(parameters)
    moments = np.maximum(moments, INERTIA_FLOOR)
    return {"mass": mass, "ipos": com, "iquat": _quaternion(axes), "inertia": moments, "explicitinertial": True}


def _principal(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre of mass [m], principal axes (3, 3) and moments about it [kg m²] of a link's ten numbers."""
    com, inertia = about_centre(parameters)
    moments, axes = np.linalg.eigh(inertia)
    return com, axes * np.sign(np.linalg.det(axes)), moments


def _compiled(spec: mujoco.MjSpec, robot: Robot) -> mujoco.MjModel:
    """The spec compiled. Moments of inertia that no body has, and which MuJoCo refuses, are set after compilation.

    Recordings determine only some combinations of inertial parameters; the others are arbitrary and affect no motion.
    """
    try:
        return built(spec)
    except ValueError as error:
        if "inertia" not in str(error):
            raise
    links = [(link, _principal(parameters)[2]) for link, parameters in zip(robot.links, robot.inertial.T, strict=True)]
    for link, moments in links:
        spec.body(link).inertia = np.full(3, max(np.mean(moments), INERTIA_FLOOR))
    mj = built(spec)
    for link, moments in links:
        mj.body(link).inertia[:] = moments
    return mj


def _add_actuator(spec: mujoco.MjSpec, joint: str, k_p: float, k_d: float, limit: float) -> None:
    actuator = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.dyntype, actuator.biastype = mujoco.mjtDyn.mjDYN_INTEGRATOR, mujoco.mjtBias.mjBIAS_AFFINE
    actuator.biasprm[1:3] = -k_p, -k_d
    if np.isfinite(limit):
        actuator.forcelimited, actuator.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, [-limit, limit]


def _native(model: Model, sides: Sequence[str], forms: type[ExportTwin]) -> tuple[ExportTwin | None, ...]:
    """For each effect itself, or None where generated code stands for it."""
    return tuple(e if e.side in sides and isinstance(e, forms) else None for e in model.effects)


def _add_effects(spec: mujoco.MjSpec, model: Model, theta: np.ndarray, own: Sequence[ExportTwin | None]) -> tuple[bool, ...]:
    """Add MuJoCo's own forms, and actuators for internal states, to a spec; returns which effects remain for generated code."""
    generated = []
    for i, ((effect, named), form) in enumerate(zip(by_effect(model.effects, theta.tolist()), own, strict=True)):
        tendons, actuators = len(spec.tendons), len(spec.actuators)
        if form is not None:
            form.native(spec, model.robot.joints, named)
        for element in (*spec.tendons[tendons:], *spec.actuators[actuators:]):
            element.name = f"{i}_{element.name}"  # two of a kind on one joint would get the same name
        generated.append(effect.side in ("link", "drive") and form is None)
        for state in () if form is not None else effect.states:
            _add_state(spec, f"{i}_{state.name}", model.robot.joints[effect.joints[0]])
    return tuple(generated)


def _add_gears(spec: mujoco.MjSpec, model: Model, theta: np.ndarray, inertial: np.ndarray, timestep: float) -> None:
    """Add a second hinge to each joint with an elastic gear: the link's position less its drive's."""
    robot, seen, least = model.robot, set(), model.body.free_inertia(inertial)
    for effect, named in by_effect(model.effects, theta.tolist()):
        if not isinstance(effect, MovesLink):
            continue
        (j,) = effect.joints
        if j in seen:
            raise UserError(
                f"{model.label(effect)}: the simulation has gears that twist and gears with play, but not both at one joint"
            )
        seen.add(j)
        drive, body = spec.joint(robot.joints[j]), spec.body(robot.links[j])
        twist = body.add_joint(name=f"{robot.joints[j]}_twist", type=mujoco.mjtJoint.mjJNT_HINGE, axis=robot.axes[j])
        drive.armature = max(float(drive.armature), LEAST_ARMATURE * least[j])
        effect.gear(twist, named, least[j] * drive.armature / (least[j] + drive.armature) / timestep**2)


def _add_state(spec: mujoco.MjSpec, name: str, joint: str) -> None:
    """An activation whose rate is its control, and which gives no torque."""
    actuator = spec.add_actuator(name=name, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.dyntype, actuator.gainprm[0] = mujoco.mjtDyn.mjDYN_INTEGRATOR, 0.0

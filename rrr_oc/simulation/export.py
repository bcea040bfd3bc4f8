"""Models as files for other programs: MJCF that plain MuJoCo runs, and the URDF with the inertial parameters in use."""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from rrr_oc.effects import BodyChange, Clutched, Effect, ExportTwin, LinkSpring, NativeTwin, OnlyRecorded, SpringChange
from rrr_oc.errors import UserError
from rrr_oc.model.parameters import by_effect, for_each
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.inertial_parameters import about_centre
from rrr_oc.robot.mjcf import built, refusal
from rrr_oc.robot.robot import Robot
from rrr_oc.robot.urdf import posed
from rrr_oc.simulation.engine_model import Settings, assembled, body_of, controller
from rrr_oc.simulation.generated_c import PAYLOAD

THICKNESS = 0.08  # radius of a link that is drawn, as a share of the arm's mean link; doubled, a thicker arm
ROUNDED = (
    2e-5  # [1] of a moment of inertia, in which six digits of three moments may differ; halved, some files would be refused
)
COLOUR = (0.55, 0.6, 0.68, 1.0)  # of what is drawn: grey


@dataclass(frozen=True)
class Exported:
    """A file's text, and what of the model is not in it, one sentence each."""

    text: str
    left_out: tuple[str, ...]


def mjcf(model: Model, theta: Sequence[float] | np.ndarray, payload: float = 0.0, without: Sequence[str] = ()) -> Exported:
    """A model as MJCF, which needs nothing of this package: effects in MuJoCo's own forms, joint limits, one motor a joint.

    Links are drawn as capsules without mass that touch nothing. Dry friction, viscous friction and armature are the joints' own
    attributes, springs are fixed tendons that are slack on one side, and a gear with elasticity is a second hinge. What has no such
    form is left out and named in `left_out`, and in a comment at the file's head.

    Args:
        theta: Parameters of the effects, as in `Model.theta`.
        payload: Listed mass at the tool [kg].
        without: What else is not in the file, one sentence each.

    Raises:
        UserError: MuJoCo refuses the robot.
    """
    (model, theta, left_out), robot = as_in_a_file(model, theta), model.robot
    settings = Settings(effects="native", integrator="implicitfast")
    spec, body, generated = assembled(model, theta, controller(model), settings, ExportTwin)
    _set_limits(spec, robot)
    spec.body(PAYLOAD).mass = payload + body.payload
    spec.option.disableflags = 0
    _draw(spec, robot, model.tool.position)
    left_out += [*without_form(model, generated), *without]
    if not _made_possible(spec):
        left_out.append("moments of inertia that no body has: the largest is the two others' sum")
    try:
        built(spec)
    except ValueError as error:
        raise UserError(f"MuJoCo refuses robot {robot.name!r}: {refusal(error)}") from None
    return Exported(listed(left_out) + spec.to_xml(), tuple(left_out))


def _made_possible(spec: mujoco.MjSpec) -> bool:
    """Give bodies moments of inertia of which none exceeds the two others' sum, when they are written with six digits; whether none did."""
    possible = True
    for body in spec.bodies[1:]:
        moments = np.array(body.inertia)
        most = int(np.argmax(moments))
        others = moments.sum() - moments[most]
        possible &= moments[most] <= (1 + ROUNDED) * others
        moments[most] = min(moments[most], (1 - ROUNDED) * others)
        body.inertia = moments
    return possible


def as_in_a_file(model: Model, theta: Sequence[float] | np.ndarray) -> tuple[Model, np.ndarray, list[str]]:
    """The model as files have it, its parameters, and what is left out of it, one sentence each.

    Listed springs are as effects have found them to be, in place of these effects; those with a clutch, and
    what is only recorded, are left out.
    """
    clutched = [model.label(effect) for effect in model.effects if isinstance(effect, Clutched)]
    left_out = [f"{label}: a clutch connects it in one phase of a task only" for label in clutched]
    recorded = [model.label(effect) for effect in model.effects if isinstance(effect, OnlyRecorded)]
    left_out += [f"{label}: changes what is recorded, not the motion" for label in recorded]
    lasting = [not isinstance(effect, Clutched | OnlyRecorded) for effect in model.effects]
    return *_springs_as_they_are(*with_effects(model, np.asarray(theta, float), lasting)), left_out


def with_effects(model: Model, theta: np.ndarray, kept: Sequence[bool]) -> tuple[Model, np.ndarray]:
    """The model with some of its effects, and their parameters."""
    return replace(model, effects=tuple(itertools.compress(model.effects, kept))), theta[for_each(kept, model.effects)]


def _springs_as_they_are(model: Model, theta: np.ndarray) -> tuple[Model, np.ndarray]:
    """The model with its listed springs as effects have found them to be, in place of these effects, and its parameters.

    Changes of springs that the model does not have, or that are no tendons, remain.
    """
    pairs = by_effect(model.effects, theta.tolist())
    springs = {e.joints: (e, named) for e, named in reversed(pairs) if isinstance(e, LinkSpring) and isinstance(e, NativeTwin)}
    found = []
    for effect, named in pairs:
        if isinstance(effect, SpringChange) and effect.joints in springs:
            spring, values = springs[effect.joints]
            found += [(spring, one) for one in effect.added(spring, values, named)]
        else:
            found.append((effect, named))
    kept = _merged(found)
    parameters = [value for _, named in kept for value in named.values()]
    return replace(model, effects=tuple(e for e, _ in kept)), np.array(parameters, float)


def _merged(pairs: list[tuple[Effect, dict[str, float]]]) -> list[tuple[Effect, dict[str, float]]]:
    """Effects with their parameters, where springs that differ in amplitude alone are one, and those of amplitude 0 are none.

    So a spring of twice its listed stiffness is one number, and so is one with another equilibrium.
    """
    result: dict[Any, tuple[Effect, dict[str, float]]] = {}
    for i, (effect, named) in enumerate(pairs):
        if not isinstance(effect, LinkSpring):
            result[i] = effect, named
            continue
        shape = (effect, *(value for name, value in named.items() if name not in effect.amplitudes))
        _, before = result.get(shape, (effect, {}))
        result[shape] = effect, named | {a: named[a] + before.get(a, 0.0) for a in effect.amplitudes}
    return [(e, named) for e, named in result.values() if not isinstance(e, LinkSpring) or any(named[a] for a in e.amplitudes)]


def _set_limits(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Torque motors in place of the controllers, with the robot's efforts as limits, and the joints' ranges."""
    for actuator in list(spec.actuators):
        if actuator.name not in robot.joints and actuator.dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR:
            spec.delete(actuator)  # internal states of generated code
    for joint, low, high, effort in zip(robot.joints, robot.lower, robot.upper, robot.effort, strict=True):
        motor = spec.actuator(joint)
        motor.set_to_motor()
        motor.biasprm[:] = motor.forcerange[:] = 0.0
        motor.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE
        if np.isfinite(effort):
            motor.ctrllimited, motor.ctrlrange = mujoco.mjtLimited.mjLIMITED_TRUE, [-effort, effort]
        if np.isfinite(low) and np.isfinite(high):
            spec.joint(joint).limited, spec.joint(joint).range = mujoco.mjtLimited.mjLIMITED_TRUE, [low, high]


def without_form(model: Model, generated: Sequence[bool]) -> list[str]:
    """The effects that a file does not have, one sentence each."""
    result = []
    for effect, code in zip(model.effects, generated, strict=True):
        if isinstance(effect, SpringChange):
            result.append(f"{model.label(effect)}: the spring that it changes is not in the file")
        elif code:
            result.append(f"{model.label(effect)}: MuJoCo has no form of it")
        elif effect.side == "sensor" and not isinstance(effect, ExportTwin):
            result.append(f"{model.label(effect)}: changes what is recorded, not the motion")
    return result


def _draw(spec: mujoco.MjSpec, robot: Robot, tool: np.ndarray) -> None:
    """A capsule from each joint to the next, and to the tool."""
    ends = [*robot.placements[1:, :3, 3], tool]
    lengths = np.linalg.norm(ends, axis=1)
    radius = THICKNESS * float(np.mean(lengths[lengths > 0])) if np.any(lengths > 0) else THICKNESS
    for link, end, length in zip(robot.links, ends, lengths, strict=True):
        looks = {"rgba": COLOUR, "contype": 0, "conaffinity": 0, "mass": 0.0}
        if length > radius:
            spec.body(link).add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0.0, 0.0, 0.0, *end], size=[radius, 0.0, 0.0], **looks
            )
        else:
            spec.body(link).add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0.0, 0.0], **looks)


def urdf_of(text: str, model: Model, theta: Sequence[float] | np.ndarray, without: Sequence[str] = ()) -> Exported:
    """The URDF with the links of a model, changed as its effects say, and a comment that lists what it has no form of.

    Args:
        text: URDF that the robot was read from.
        theta: Parameters of the effects, as in `Model.theta`.
        without: What else is not in the file, one sentence each.
    """
    model, theta, left_out = as_in_a_file(model, theta)
    left_out += without
    body = body_of(model, theta)
    left_out += [
        f"{model.label(effect)}: a URDF has no form of it" for effect in model.effects if not isinstance(effect, BodyChange)
    ]
    if not np.allclose(body.gravity, model.robot.gravity):
        left_out.append("gravity: a URDF has none")
    if body.payload:
        left_out.append(f"a mass of {body.payload:.4g} kg at the tool")
    written, head = urdf(text, replace(model.robot, inertial=body.inertial)), '<?xml version="1.0"?>\n'
    return Exported(head + listed(left_out) + written.removeprefix(head), tuple(left_out))


def listed(left_out: Sequence[str]) -> str:
    """A comment with what a file does not have, one a line; "" where that is nothing."""
    lines = "".join(f"  {one.replace('--', '-')}\n" for one in left_out)
    return f"<!-- Not in this file:\n{lines}-->\n" if left_out else ""


def urdf(text: str, robot: Robot) -> str:
    """The URDF with a robot's inertial parameters: each moved link has those of all links fixed to it, which have none of their own.

    Joints that the robot does not have were locked, and become fixed where they are held.

    Args:
        text: URDF that the robot was read from.
    """
    tree = ElementTree.fromstring(posed(text, robot.held))
    for joint in tree.findall("joint"):
        if joint.get("name") not in robot.joints:
            joint.set("type", "fixed")
    for link in tree.findall("link"):
        name = link.get("name") or ""
        moved, _ = robot.frames.get(name, (-1, None))
        for old in link.findall("inertial") if moved >= 0 else []:
            link.remove(old)
        if name in robot.links:
            link.insert(0, _inertial(robot.inertial[:, robot.links.index(name)]))
    ElementTree.indent(tree)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(tree, encoding="unicode") + "\n"


def _inertial(parameters: np.ndarray) -> ElementTree.Element:
    """The element of a link's ten numbers (`Robot.inertial`)."""
    com, inertia = about_centre(parameters)
    element = ElementTree.Element("inertial")
    ElementTree.SubElement(element, "origin", xyz=" ".join(f"{x:.12g}" for x in com), rpy="0 0 0")
    ElementTree.SubElement(element, "mass", value=f"{parameters[0]:.12g}")
    pairs = zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), inertia[np.triu_indices(3)], strict=True)
    ElementTree.SubElement(element, "inertia", {name: f"{x:.12g}" for name, x in pairs})
    return element

"""A model's parameters and springs written into an MJCF file that a user has, of which all else is kept."""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import casadi as ca
import mujoco
import numpy as np

from rrr_oc.effects import Body, Delay, ExportTwin, MotionShift, MovesLink
from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.inertial_parameters import about_centre, is_possible, of_pseudo_inertia, pseudo_inertia
from rrr_oc.robot.mjcf import built, compiled
from rrr_oc.robot.robot import Robot, load_robot
from rrr_oc.simulation.engine_model import INERTIA_FLOOR, Settings, assembled, controller
from rrr_oc.simulation.export import Exported, as_in_a_file, with_effects, without_form
from rrr_oc.simulation.generated_c import PAYLOAD

SAME = 1e-9  # relative: what is read again agrees so far with what was written; doubled or halved, nothing changes
SAME_RIGID = 1e-7  # of the largest mass or torque: what rounding of axes and moments leaves
STATES = 5  # at which links are compared; more find nothing else, for the errors are functions of the same ten numbers a link
ELSEWHERE = {  # effects that would change more than numbers and springs, by what they can do
    MotionShift: "the zeros of the file's joints stay as they are",
    MovesLink: "the file's joints stay as they are; arm.xml has a second hinge",
    Delay: "the file's sensors stay as they are; arm.xml has delayed ones",
}
_ROOT = re.compile(r"<!--.*?-->|<mujoco\b", re.DOTALL)


def into(path: Path, place: Path, model: Model, theta: np.ndarray, payload: float = 0.0) -> Exported:
    """The text of a user's MJCF with a model's numbers, to be written to `place`.

    The joints' damping, dry friction and armature become the model's; bodies whose inertial parameters differ from the model's get an
    `<inertial>`; springs are added as tendons, and friction and ripple as motors without input. Paths of other files are written anew
    where `place` is in another folder. Everything else is kept, comments included.

    Args:
        theta: Parameters of the effects, as in `Model.theta`.
        payload: Listed mass at the tool [kg]; a body is added that has it.

    Raises:
        UserError: The file is no MJCF, its arm is not the model's, a joint stands in a file that it includes, or MuJoCo refuses it.
    """
    robot, mj = _same_arm(path, model.robot), compiled(path)
    model, theta, left_out = _that_fit(*as_in_a_file(model, theta))
    spec, body, generated = assembled(model, theta, controller(model), Settings(effects="native"), ExportTwin)
    text = path.read_text(encoding="utf-8")
    root, head = _parsed(text)
    bodies = _bodies(path, root, robot.joints)
    for i, (joint, holder) in enumerate(zip(robot.joints, bodies, strict=True)):
        _set_joint(root, _joint(holder, joint), spec.joint(joint))
        _set_inertial(holder, mj, mj.joint(joint).bodyid[0], robot, body.inertial[:, i] - robot.inertial[:, i])
    _add_payload(bodies[model.tool.joint], mj, robot, model.tool.joint, body, payload)
    if not np.array_equal(robot.gravity, body.gravity):
        _part(root, "option").set("gravity", _text(body.gravity))
    _add_elements(root, spec)
    _move_paths(root, path.absolute().parent, place.absolute().parent)
    left_out += [*without_form(model, generated), *_own_springs(mj, robot)]
    written = ElementTree.tostring(root, encoding="unicode")
    if " />" not in text:  # how the file closes its elements
        written = written.replace(" />", "/>")
    return Exported(f"{head}{written}\n", tuple(left_out))


def check_into(place: Path, model: Model, theta: np.ndarray, payload: float = 0.0) -> None:
    """Read a file of `into` again; raises `UserError` where its joints, springs or links are not the model's."""
    model, theta, _ = _that_fit(*as_in_a_file(model, theta))
    spec, body, _ = assembled(model, theta, controller(model), Settings(effects="native"), ExportTwin)
    spec.body(PAYLOAD).mass = payload + body.payload
    wanted, found = built(spec), compiled(place)
    elements = [
        ("dof", model.robot.joints, ("damping", "dampingpoly", "frictionloss", "armature")),
        ("tendon", [t.name for t in spec.tendons], ("stiffness", "lengthspring", "damping", "frictionloss", "limited")),
        ("actuator", _motors(spec), ("dynprm", "gainprm", "biasprm", "gear", "forcelimited")),
    ]
    pairs = []
    for kind, names, numbers in elements:
        for name in names:
            one, other = (mj.joint(name).dofadr[0] if kind == "dof" else getattr(mj, kind)(name).id for mj in (found, wanted))
            arrays = [(getattr(found, f"{kind}_{n}"), getattr(wanted, f"{kind}_{n}"), n) for n in numbers]
            pairs += [(a[one], b[other], f"{n} of {name}") for a, b, n in arrays]
    for one, other, what in pairs:
        if not np.allclose(one, other, rtol=SAME, atol=SAME):
            raise UserError(
                f"{place}: {what} was read again as {_text(one)}, not {_text(other)}; do settings of the file override it?"
            )
    one, other = (_rigid(mj, model.robot.joints) for mj in (found, wanted))
    if not np.allclose(one, other, rtol=0, atol=SAME_RIGID * np.abs(other).max()):
        raise UserError(
            f"{place}: links were read again with other masses than the model's; do settings of the file override them?"
        )


def _rigid(mj: mujoco.MjModel, joints: Sequence[str]) -> np.ndarray:
    """Mass matrix and torque of gravity of the joints at states within their ranges, the other joints at zero, (STATES, n, n + 1)."""
    data, rng, n = mujoco.MjData(mj), np.random.default_rng(0), len(joints)
    places, dofs = ([getattr(mj.joint(j), name)[0] for j in joints] for name in ("qposadr", "dofadr"))
    single = mj.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)
    data.qpos[mj.jnt_qposadr[single]] = 0.0
    result, mass = np.zeros((STATES, n, n + 1)), np.zeros((mj.nv, mj.nv))
    for one in result:
        data.qpos[places] = rng.uniform(-np.pi, np.pi, n)
        mujoco.mj_forward(mj, data)
        mujoco.mj_fullM(mj, data, mass)
        one[:, :n], one[:, n] = mass[np.ix_(dofs, dofs)], data.qfrc_bias[dofs]
    return result


def _motors(spec: mujoco.MjSpec) -> list[str]:
    """Names of the motors without input."""
    return [a.name for a in spec.actuators if a.dyntype == mujoco.mjtDyn.mjDYN_DCMOTOR]


def _same_arm(path: Path, robot: Robot) -> Robot:
    """The arm of the file; raises `UserError` where its joints are elsewhere than the model's."""
    own = load_robot(path, robot.joints)
    for name, unit in (("placements", "m"), ("axes", "1")):
        apart = np.abs(getattr(own, name) - getattr(robot, name)).reshape(own.n, -1).max(axis=1)
        if apart.max() > 1e-6:
            worst = int(np.argmax(apart))
            raise UserError(
                f"{path}: joint {own.joints[worst]!r} is not where the model has it (its {name} differ by {apart[worst]:.3g} {unit}); "
                "the file that the model was made with, or one of the same arm, is required"
            )
    return own


def _that_fit(model: Model, theta: np.ndarray, left_out: list[str]) -> tuple[Model, np.ndarray, list[str]]:
    """The model without what would change more than numbers and springs, its parameters, and what is left out."""
    why = [next((said for kind, said in ELSEWHERE.items() if isinstance(e, kind)), None) for e in model.effects]
    named = zip(model.effects, why, strict=True)
    told = [f"{model.label(e)}: {said}" for e, said in named if said is not None and e.role != "plain"]
    return *with_effects(model, theta, [said is None for said in why]), [*left_out, *told]


def _parsed(text: str) -> tuple[Element, str]:
    """The root with its comments, and what stands before it."""
    begin = next((m.start() for m in _ROOT.finditer(text) if not m.group().startswith("<!--")), 0)
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    return ElementTree.fromstring(text, parser), text[:begin]


def _bodies(path: Path, root: Element, joints: Sequence[str]) -> list[Element]:
    """The bodies of the joints."""
    holders = {joint.get("name"): body for body in root.iter("body") for joint in body.findall("joint")}
    missing = [joint for joint in joints if joint not in holders]
    if missing:
        raise UserError(
            f"{path}: joint {missing[0]!r} does not stand in this file itself; give the file that has it, or one without includes"
        )
    return [holders[joint] for joint in joints]


def _joint(body: Element, name: str) -> Element:
    return next(joint for joint in body.findall("joint") if joint.get("name") == name)


def _set_joint(root: Element, element: Element, joint: mujoco.MjsJoint) -> None:
    """Damping, dry friction and armature; further coefficients of damping where there are any, here or in the file's defaults."""
    defaults = (d.get("damping", "") for d in root.iter("joint"))
    several = np.any(joint.damping[1:]) or any(len(damping.split()) > 1 for damping in defaults)
    element.set("damping", _text(joint.damping if several else joint.damping[:1]))
    element.set("frictionloss", _text(joint.frictionloss))
    element.set("armature", _text(joint.armature))


def _set_inertial(holder: Element, mj: mujoco.MjModel, body: int, robot: Robot, change: np.ndarray) -> None:
    """Give a body what its link has more than the file says, (10,) in the joint's frame; what is fixed to the body keeps its own."""
    scale = np.abs(robot.inertial).max()
    if np.abs(change).max() <= SAME * scale:
        return
    back = np.linalg.inv(robot.frames[mj.body(body).name or f"body{body}"][1])
    own = pseudo_inertia(_own_inertial(mj, body)) + back @ pseudo_inertia(change) @ back.T
    parameters = np.array(ca.evalf(of_pseudo_inertia(ca.SX(own)))).reshape(-1)
    if not is_possible(parameters):
        raise UserError(
            f"the model's inertia of body {mj.body(body).name!r} is one that no body can have, less what is fixed to it in the file; "
            "export without --into has the link as a whole"
        )
    centre, inertia = about_centre(parameters)
    element = holder.find("inertial")
    if element is None:
        element = Element("inertial")
        holder.insert(0, element)
    tail = element.tail
    element.clear()
    element.tail = tail
    numbers = [inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    element.attrib.update(pos=_text(centre), mass=_text(parameters[0]), fullinertia=_text(numbers))


def _own_inertial(mj: mujoco.MjModel, body: int) -> np.ndarray:
    """Ten inertial parameters of a body alone, in its own frame."""
    turn, centre, mass = np.zeros(9), mj.body_ipos[body], mj.body_mass[body]
    mujoco.mju_quat2Mat(turn, mj.body_iquat[body])
    axes = turn.reshape(3, 3)
    inertia = axes @ np.diag(mj.body_inertia[body]) @ axes.T + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return np.array([mass, *(mass * centre), *inertia[np.tril_indices(3)]])


def _add_payload(holder: Element, mj: mujoco.MjModel, robot: Robot, joint: int, body: Body, payload: float) -> None:
    """A body with the mass at the tool, where there is any."""
    mass = payload + body.payload
    if mass > 0:
        name = mj.body(mj.joint(robot.joints[joint]).bodyid[0]).name or f"body{mj.joint(robot.joints[joint]).bodyid[0]}"
        place = np.linalg.inv(robot.frames[name][1]) @ np.append(body.position, 1.0)
        held = ElementTree.SubElement(holder, "body", name=PAYLOAD, pos=_text(place[:3]))
        least = _text([INERTIA_FLOOR] * 3)
        ElementTree.SubElement(held, "inertial", pos="0 0 0", mass=_text(mass), diaginertia=least)


def _add_elements(root: Element, spec: mujoco.MjSpec) -> None:
    """Springs as fixed tendons, and motors without input; what defaults of the file could change is written out."""
    mj = built(spec)
    for tendon in spec.tendons:
        lengths = tendon.springlength if tendon.springlength[0] != tendon.springlength[1] else tendon.springlength[:1]
        fixed = ElementTree.SubElement(_part(root, "tendon"), "fixed", name=tendon.name, stiffness=_text(tendon.stiffness[0]))
        fixed.attrib.update(springlength=_text(lengths), damping="0", frictionloss="0", limited="false")
        fixed.tail = "\n"
        i = mj.tendon(tendon.name).id
        for wrap in mj.tendon_adr[i] + np.arange(mj.tendon_num[i]):
            joint, coefficient = mj.joint(mj.wrap_objid[wrap]).name, _text(mj.wrap_prm[wrap])
            ElementTree.SubElement(fixed, "joint", joint=joint, coef=coefficient)
    donors = {one.get("name"): one for one in ElementTree.fromstring(spec.to_xml()).iter("general")}
    for motor in map(spec.actuator, _motors(spec)):
        donor = donors[motor.name]  # numbers as MuJoCo writes them have six digits
        donor.attrib.update(dynprm=_text(motor.dynprm), gainprm=_text(motor.gainprm), biasprm=_text(motor.biasprm))
        donor.attrib.update(gear="1 0 0 0 0 0", ctrllimited="false", forcelimited="false")
        donor.tail = "\n"
        _part(root, "actuator").append(donor)


def _part(root: Element, name: str) -> Element:
    """A part of the file, added at its end where there is none."""
    found = root.find(name)
    if found is None:
        found = ElementTree.SubElement(root, name)
        found.text = found.tail = "\n"
    return found


def _move_paths(root: Element, old: Path, new: Path) -> None:
    """Paths that are relative to the old folder, from the new one."""
    if old == new:
        return
    for include in root.iter("include"):
        include.set("file", _moved(include.get("file", ""), old, new))
    settings = _part(root, "compiler")
    both = settings.attrib.pop("assetdir", "")
    for kind in ("meshdir", "texturedir") if root.find("asset") is not None else ():
        settings.set(kind, _moved(settings.get(kind, both), old, new))


def _moved(path: str, old: Path, new: Path) -> str:
    return path if Path(path).is_absolute() else os.path.relpath(old / path, new)


def _own_springs(mj: mujoco.MjModel, robot: Robot) -> Iterable[str]:
    """Springs that the file's joints have already, which the model does not know."""
    for joint in robot.joints:
        if np.any(mj.joint(joint).stiffness):
            yield f"the file's own stiffness of {joint}, {_text(mj.joint(joint).stiffness[0])} Nm/rad, is not the model's and stays"


def _text(values: float | Sequence[float] | np.ndarray) -> str:
    """Numbers to their last bit."""
    return " ".join(repr(float(x)).removesuffix(".0") for x in np.atleast_1d(values))

"""MJCF made into the text of a URDF, so that one reader of kinematics serves both.

MuJoCo reads and compiles the file. What a URDF has no element for stands in elements of our own, which other readers of URDF skip:
`<gravity xyz>` of the robot, `<note>` with a sentence on what is not used, and `<tied by>` in a joint that an equality or a tendon
ties to others. A joint that is no hinge keeps MuJoCo's word for its type."""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

import itertools
import re
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pinocchio as pin

from rrr_oc.errors import UserError

ENDLESS = "1e300"  # a limit that is none; parsers of URDF refuse "inf"
_TYPES = ("free", "ball", "slide", "revolute")  # of joints, in MuJoCo's order
# As numbers: MuJoCo's enumerations are not found among numpy's integers by `in`.
_ON_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_LOOPS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
_ROUND = (int(mujoco.mjtWrap.mjWRAP_SPHERE), int(mujoco.mjtWrap.mjWRAP_CYLINDER))
_UNUSED = (  # arrays of a compiled model, by joint, and what they are; zeros say nothing
    ("dof_armature", "armature"),
    ("dof_damping", "damping"),
    ("dof_frictionloss", "dry friction"),
    ("jnt_stiffness", "a spring"),
)


def mjcf_as_urdf(path: Path) -> str:
    """The arm of an MJCF file as the text of a URDF, numbers to their last bit; raises `UserError` where MuJoCo refuses it.

    Frames of links are those of bodies; a joint that is not at its body's origin gets a link of its own, and sites are links
    without mass. A joint's torque limit is the force range of its actuators, times their gear, or its own, whichever is less.
    """
    mj = compiled(path)
    for body in np.flatnonzero(~np.isfinite(np.c_[mj.body_mass, mj.body_inertia, mj.body_ipos]).all(axis=1)).tolist():
        raise UserError(
            f"{path}: body {_name(mj, 'body', body)!r} has the mass {mj.body_mass[body]:g} kg; finite masses are required"
        )
    root = ElementTree.Element("robot", name=path.stem)
    ElementTree.SubElement(root, "gravity", xyz=_text(mj.opt.gravity))
    for note in _notes(mj):
        ElementTree.SubElement(root, "note").text = note
    ties = _ties(mj)
    links = {0: _name(mj, "body", 0)}
    ElementTree.SubElement(root, "link", name=links[0])
    for body in range(1, mj.nbody):
        links[body] = _name(mj, "body", body)
        _add_body(root, mj, body, links, ties)
    for site in range(mj.nsite):
        name, parent = _name(mj, "site", site), links[mj.site_bodyid[site]]
        name = f"{name}_site" if name in links.values() else name
        ElementTree.SubElement(root, "link", name=name)
        _add_joint(root, f"{name}_fixed", "fixed", (parent, name), _pose(mj.site_pos[site], mj.site_quat[site]))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def compiled(path: Path) -> mujoco.MjModel:
    """An MJCF file without what is only seen; raises `UserError` where MuJoCo refuses it."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        _drop_looks(spec)
        return built(spec)
    except (ValueError, FileNotFoundError) as error:
        raise UserError(f"{path}: {_not_xml(path, str(error)) or f'MuJoCo refuses it: {refusal(error)}'}") from None


def built(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """A spec compiled, without MuJoCo's warnings of inertia near singular: what no body has is refused by the readers of robots."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Inertia matrix is too close to singular")
        return spec.compile()


def _not_xml(path: Path, said: str) -> str | None:
    """Why a file is no XML, or none that MuJoCo reads, which it tells by a number; None where it is."""
    try:
        ElementTree.parse(path)
    except (ElementTree.ParseError, OSError, LookupError, ValueError) as error:
        return f"not well-formed XML: {error}"
    return "XML in UTF-8 is required; MuJoCo reads no other encoding" if "XML_ERROR" in said else None


def refusal(error: Exception) -> str:
    """What MuJoCo says of a model, of one or two lines, as a part of a sentence."""
    lines = [re.sub(r"\b(XML )?Error: ", "", line).strip() for line in str(error).splitlines()]
    return ", ".join(line for line in lines if line)


def _drop_looks(spec: mujoco.MjSpec) -> None:
    """Delete what is only seen, and meshes that give no mass, so that their files need not be there."""
    auto = spec.compiler.inertiafromgeom != mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    for body in spec.bodies:
        for geom in list(body.geoms) if auto and (body.explicitinertial or body.name == "world") else []:
            if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
                spec.delete(geom)
    for part in (*spec.geoms, *spec.sites, *spec.tendons):
        part.material = ""
    used = {geom.meshname for geom in spec.geoms}
    unused = [mesh for mesh in spec.meshes if mesh.name not in used]
    for part in (*spec.pairs, *spec.sensors, *spec.keys, *spec.skins, *spec.materials, *spec.textures, *unused):
        spec.delete(part)
    spec.compiler.fusestatic = False


def _add_body(root: ElementTree.Element, mj: mujoco.MjModel, body: int, links: dict[int, str], ties: dict[int, str]) -> None:
    """A body's link, and its joints one after the other, each with a link where the body's frame is not at its last joint."""
    previous, pose = links[mj.body_parentid[body]], _pose(mj.body_pos[body], mj.body_quat[body])
    joints = mj.body_jntadr[body] + np.arange(mj.body_jntnum[body])
    for joint in joints:
        name, anchor = _name(mj, "joint", joint), mj.jnt_pos[joint] if mj.jnt_type[joint] > 0 else np.zeros(3)
        last = joint == joints[-1] and not np.any(anchor)
        link = links[body] if last else f"{links[body]}_at_{name}"
        ElementTree.SubElement(root, "link", name=link)
        element = _add_joint(
            root, name, _TYPES[mj.jnt_type[joint]], (previous, link), pose * pin.SE3(np.eye(3), anchor) * _zero(mj, joint)
        )
        _describe(element, mj, joint)
        if joint in ties:
            ElementTree.SubElement(element, "tied", by=ties[joint])
        previous, pose = link, pin.SE3(np.eye(3), -anchor)
    if previous != links[body]:
        ElementTree.SubElement(root, "link", name=links[body])
        _add_joint(root, f"{links[body]}_fixed", "fixed", (previous, links[body]), pose)
    if mj.body_mass[body] > 0:
        link = next(link for link in root.iter("link") if link.get("name") == links[body])
        _add_inertial(link, mj, body)


def _zero(mj: mujoco.MjModel, joint: int) -> pin.SE3:
    """Motion of a joint from the pose of the file, where its coordinate is `ref`, to where it is zero."""
    kind, axis = _TYPES[mj.jnt_type[joint]], mj.jnt_axis[joint]
    if kind in ("free", "ball"):
        return pin.SE3.Identity()
    back = -mj.qpos0[mj.jnt_qposadr[joint]] * axis
    return pin.SE3(pin.exp3(back), np.zeros(3)) if kind == "revolute" else pin.SE3(np.eye(3), back)


def _describe(element: ElementTree.Element, mj: mujoco.MjModel, joint: int) -> None:
    """Axis and limits."""
    if _TYPES[mj.jnt_type[joint]] in ("free", "ball"):
        return
    ElementTree.SubElement(element, "axis", xyz=_text(mj.jnt_axis[joint]))
    low, high = mj.jnt_range[joint] if mj.jnt_limited[joint] else (-float(ENDLESS), float(ENDLESS))
    effort = min(map(float, np.abs(_effort(mj, joint))))
    ElementTree.SubElement(
        element, "limit", lower=_text(low), upper=_text(high), velocity=ENDLESS, effort=_text(min(effort, float(ENDLESS)))
    )


def _effort(mj: mujoco.MjModel, joint: int) -> np.ndarray:
    """Least and greatest torque [Nm] of a joint's actuators together, (2,); infinite where nothing says one."""
    total, none = np.zeros(2), True
    for actuator in range(mj.nu):
        if mj.actuator_trntype[actuator] in _ON_JOINTS and mj.actuator_trnid[actuator, 0] == joint:
            none = False
            gear = mj.actuator_gear[actuator, 0]
            total = total + (np.sort(gear * _force(mj, actuator)) if gear else 0.0)
    total = np.array([-np.inf, np.inf]) if none else total
    own = mj.jnt_actfrcrange[joint] if mj.jnt_actfrclimited[joint] else total
    return np.clip(own, total[0], total[1])


def _force(mj: mujoco.MjModel, actuator: int) -> np.ndarray:
    """Range of an actuator's force, (2,): as the file gives it, or of a plain motor from the range of its control."""
    if mj.actuator_forcelimited[actuator]:
        return mj.actuator_forcerange[actuator]
    plain = (
        mj.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
        and mj.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE
        and mj.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE
    )
    if plain and mj.actuator_ctrllimited[actuator]:
        return np.sort(mj.actuator_gainprm[actuator, 0] * mj.actuator_ctrlrange[actuator])
    return np.array([-np.inf, np.inf])


def _ties(mj: mujoco.MjModel) -> dict[int, str]:
    """By joint, the equality or tendon that ties it to others."""
    ties: dict[int, str] = {}
    for tendon in range(mj.ntendon):
        ties |= dict.fromkeys(_of_tendon(mj, tendon), f"tendon {_name(mj, 'tendon', tendon)!r}")
    for equality in range(mj.neq):
        kind, ends = mj.eq_type[equality], (mj.eq_obj1id[equality], mj.eq_obj2id[equality])
        if kind == mujoco.mjtEq.mjEQ_JOINT:
            joints: Iterable[int] = (joint for joint in ends if joint >= 0)
        elif mj.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_TENDON:
            joints = (joint for tendon in ends if tendon >= 0 for joint in _of_tendon(mj, tendon))
        elif kind in _LOOPS:
            on_sites = mj.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE
            joints = _between(mj, *(mj.site_bodyid[end] if on_sites else end for end in ends))
        else:
            continue  # of flexible bodies
        ties |= dict.fromkeys(map(int, joints), f"equality {_name(mj, 'equality', equality)!r}")
    return ties


def _of_tendon(mj: mujoco.MjModel, tendon: int) -> Iterator[int]:
    """The joints on which a tendon's length depends."""
    parts = range(mj.tendon_adr[tendon], mj.tendon_adr[tendon] + mj.tendon_num[tendon])
    bodies = []
    for part in parts:
        kind, at = mj.wrap_type[part], mj.wrap_objid[part]
        if kind == mujoco.mjtWrap.mjWRAP_JOINT:
            yield int(at)
        elif kind == mujoco.mjtWrap.mjWRAP_SITE:
            bodies.append(mj.site_bodyid[at])
        elif kind in _ROUND:
            bodies.append(mj.geom_bodyid[at])
    for one, other in itertools.pairwise(bodies):
        yield from _between(mj, one, other)


def _between(mj: mujoco.MjModel, one: int, other: int) -> Iterator[int]:
    """The joints that move one body against another."""

    def above(body: int) -> set[int]:
        found = set()
        while body > 0:
            found.add(int(body))
            body = mj.body_parentid[body]
        return found

    for body in above(one) ^ above(other):
        yield from (int(mj.body_jntadr[body]) + i for i in range(mj.body_jntnum[body]))


def _notes(mj: mujoco.MjModel) -> Iterator[str]:
    """A sentence each on what the file says of its hinges, bodies and actuators and a robot has no place for."""
    hinges = [j for j in range(mj.njnt) if _TYPES[mj.jnt_type[j]] == "revolute"]
    for array, what in _UNUSED:
        values = getattr(mj, array)
        at = {j: mj.jnt_dofadr[j] if array.startswith("dof") else j for j in hinges}
        if names := [_name(mj, "joint", j) for j in hinges if np.any(values[at[j]])]:
            yield f"the MJCF gives {what} to {', '.join(names)}, which is not used; recordings tell it (rrr-oc calibrate)"
    if names := [_name(mj, "body", b) for b in range(mj.nbody) if mj.body_gravcomp[b]]:
        yield f"the MJCF compensates the weight of {', '.join(names)} (gravcomp), which is not used"
    acting = [a for a in range(mj.nu) if mj.actuator_trntype[a] in _ON_JOINTS]
    if names := [_name(mj, "actuator", a) for a in acting if mj.actuator_biastype[a] != mujoco.mjtBias.mjBIAS_NONE]:
        yield f"the MJCF has gains of the actuators {', '.join(names)}, which are not used; only their torque limits are"
    elsewhere = [a for a in range(mj.nu) if mj.actuator_trntype[a] not in (*_ON_JOINTS, int(mujoco.mjtTrn.mjTRN_TENDON))]
    if names := [_name(mj, "actuator", a) for a in elsewhere]:
        yield f"the MJCF has actuators that act on no joint, {', '.join(names)}, which are not used"
    uneven = [j for j in hinges if not np.isclose(*np.abs(_effort(mj, j)))]
    if names := [_name(mj, "joint", j) for j in uneven]:
        yield f"the MJCF limits the torque of {', '.join(names)} unevenly; the smaller limit is used both ways"


def _add_joint(root: ElementTree.Element, name: str, kind: str, links: tuple[str, str], pose: pin.SE3) -> ElementTree.Element:
    """A joint between two links, parent first, at a pose in the parent's frame."""
    joint = ElementTree.SubElement(root, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=links[0])
    ElementTree.SubElement(joint, "child", link=links[1])
    ElementTree.SubElement(joint, "origin", xyz=_text(pose.translation), rpy=_text(pin.rpy.matrixToRpy(pose.rotation)))
    return joint


def _add_inertial(link: ElementTree.Element, mj: mujoco.MjModel, body: int) -> None:
    axes = _pose(np.zeros(3), mj.body_iquat[body]).rotation
    about_centre = axes @ np.diag(mj.body_inertia[body]) @ axes.T
    element = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(element, "origin", xyz=_text(mj.body_ipos[body]), rpy="0 0 0")
    ElementTree.SubElement(element, "mass", value=_text(mj.body_mass[body]))
    pairs = zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), about_centre[np.triu_indices(3)], strict=True)
    ElementTree.SubElement(element, "inertia", {name: _text(value) for name, value in pairs})


def _pose(position: np.ndarray, quaternion: np.ndarray) -> pin.SE3:
    """A pose from a position and a unit quaternion, real part first."""
    return pin.SE3(pin.Quaternion(*quaternion).matrix(), np.array(position))


def _name(mj: mujoco.MjModel, kind: str, i: int) -> str:
    """An element's name, or its kind with its number where the file gives none."""
    return getattr(mj, kind)(int(i)).name or f"{kind}{int(i)}"


def _text(values: float | np.ndarray) -> str:
    return " ".join(repr(float(x)) for x in np.atleast_1d(values))

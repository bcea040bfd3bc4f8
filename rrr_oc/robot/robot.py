"""A robot: a serial chain of revolute joints, read from a URDF or MJCF and validated."""

import importlib.resources
import os
import re
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from rrr_oc.errors import UserError
from rrr_oc.robot.mjcf import ENDLESS, mjcf_as_urdf
from rrr_oc.robot.urdf import Elements, possible
from rrr_oc.storage import read_regular

# pyright: reportAttributeAccessIssue=false
# (pin's wheel has no stubs)

BUNDLED = ("rrr", "rrr_prototype")
GRAVITY = (0.0, 0.0, -9.81)  # [m/s²] in the base frame, where nothing says another
_TOOL = re.compile(  # usual names of a tool frame
    r"(^|[_/])(tool0?|tcp|ee|end_effector|flange|attachment|attachment_site)($|[_/])", re.IGNORECASE
)

_MJCF = re.compile(r"(?>\s+|<\?.*?\?>|<!--.*?-->)*+<mujoco[\s>]", re.DOTALL)  # how such a file begins; without backtracking


@dataclass(frozen=True)
class ToolPoint:
    """A point fixed to a link, where a payload is held.

    Attributes:
        joint: Index of the joint that moves the link.
        position: The point in that joint's frame [m], shape (3,).
    """

    joint: int
    position: np.ndarray


@dataclass(frozen=True)
class Robot:
    """A serial chain of n revolute joints from base to tip.

    Attributes:
        name: Name in reports.
        joints: Names of the joints, base first (n).
        links: Name of the link that each joint moves (n).
        placements: Pose of each joint's frame in the frame of the joint before it, at q = 0, shape (n, 4, 4) [m].
        axes: Joint axes in the joints' frames, unit length, shape (n, 3).
        inertial: Dynamic parameters of the links in the joints' frames, shape (10, n): mass [kg], first moment [kg m] (3),
            rotational inertia about the frame's origin xx, xy, yy, xz, yz, zz [kg m²] (Pinocchio's order).
        lower, upper: Joint ranges [rad], shape (n,).
        velocity: Speed limits [rad/s], shape (n,).
        effort: Torque limits [Nm], shape (n,).
        tool: Origin of the last link's tool frame: a link fixed to it with a usual name such as tool0, else the last link fixed
            to it, else the link's own frame.
        frames: For each link of the URDF, or body and site of the MJCF, the joint that moves it (-1: the base) and its pose in
            that joint's frame.
        gravity: Acceleration of gravity in the base frame [m/s²], shape (3,).
        notes: What a user should know of the file, a sentence each: limits that it does not give, of any of its joints, links whose
            inertia no body has, and what it says beyond kinematics, inertia and limits, which is not used.
    """

    name: str
    joints: tuple[str, ...]
    links: tuple[str, ...]
    placements: np.ndarray
    axes: np.ndarray
    inertial: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    tool: ToolPoint
    frames: Mapping[str, tuple[int, np.ndarray]]
    gravity: np.ndarray
    notes: tuple[str, ...] = ()

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joints)

    def index(self, joint: str) -> int:
        """Position of a joint in the chain; raises `UserError` that lists the joints there are."""
        if joint not in self.joints:
            raise UserError(f"robot {self.name!r} has no joint {joint!r}; it has {', '.join(self.joints)}")
        return self.joints.index(joint)

    @property
    def tool_link(self) -> str:
        """The link whose frame is the default `tool`."""
        return _tool_link(self.frames, self.n - 1)

    def point(self, link: str, position: Sequence[float]) -> ToolPoint:
        """The `ToolPoint` at `position` [m] of a link's frame; raises `UserError` for a link that does not move."""
        if link not in self.frames:
            raise UserError(f"robot {self.name!r} has no link {link!r}; it has {', '.join(self.frames)}")
        if len(position) != 3 or not np.all(np.isfinite(position)):
            raise UserError(f"the position on link {link!r} must be three finite numbers [m], got {list(position)}")
        joint, pose = self.frames[link]
        if joint < 0:
            raise UserError(f"link {link!r} of robot {self.name!r} does not move; a tool needs one of {', '.join(self.links)}")
        return ToolPoint(joint, pose[:3, :3] @ np.asarray(position, float) + pose[:3, 3])


def load_robot(
    source: str | Path, joints: Sequence[str] | None = None, inertial: bool = True, gravity: Sequence[float] | None = None
) -> Robot:
    """Read a robot.

    Args:
        source: Name of a bundled model (`BUNDLED`) or path of a URDF or MJCF.
        joints: Joints to keep, in the order of the chain; the others, of whatever type, are locked at zero. Default: all.
        inertial: Whether the links' masses are used, and so must be there.
        gravity: Acceleration of gravity in the base frame [m/s²]. Default: the MJCF's, or `GRAVITY`.

    Raises:
        UserError: The file is missing or neither URDF nor MJCF; a number in it is missing or not finite; a joint kept is not revolute, or
            its limits are crossed; the chain branches; a moving link has no mass; `joints` names one that is not there or is out of order.
    """
    name = str(source) if str(source) in BUNDLED else Path(source).stem
    elements = Elements(name, urdf_text(source))
    root = elements.root
    notes = (
        *_missing_limits(root),
        *(str(note.text) for note in root.findall("note")),
        *(elements.doubts() if inertial else ()),
    )
    masses, own = _masses(root), root.find("gravity")
    if gravity is None:
        gravity = GRAVITY if own is None else [float(x) for x in own.get("xyz", "").split()]
    model = _lock_all_but(name, _parse(name, elements, joints), joints)
    if model.nq == 0:
        raise UserError(f"robot {name!r} has no revolute joint; at least one is needed")
    parameters = np.array([model.inertias[i].toDynamicParameters() for i in range(1, model.njoints)]).T  # (10, n)
    if inertial:
        _check_masses(name, model, masses)
        _check_inertial(name, model, parameters)
    frames = {f.name: (f.parentJoint - 1, f.placement.homogeneous) for f in model.frames if f.type == pin.FrameType.BODY}
    last = model.njoints - 2
    return Robot(
        name=name,
        joints=tuple(model.names)[1:],
        links=tuple(_moved_link(model, i) for i in range(1, model.njoints)),
        placements=np.array([model.jointPlacements[i].homogeneous for i in range(1, model.njoints)]),
        axes=np.array([_axis(model.joints[i]) for i in range(1, model.njoints)]),
        inertial=parameters,
        lower=_with_infinities(model.lowerPositionLimit),
        upper=_with_infinities(model.upperPositionLimit),
        velocity=_with_infinities(model.upperVelocityLimit),
        effort=_with_infinities(model.upperEffortLimit),
        tool=ToolPoint(last, frames[_tool_link(frames, last)][1][:3, 3]),
        frames=frames,
        gravity=np.asarray(gravity, float),
        notes=notes,
    )


def urdf_text(source: str | Path) -> str:
    """Text of a bundled model's URDF, of a file, or of the URDF that an MJCF becomes; raises `UserError` where there is none."""
    if str(source) in BUNDLED:
        return importlib.resources.files("rrr_oc.urdf").joinpath(f"{source}.urdf").read_text(encoding="utf-8")
    path = Path(source)
    if path.is_dir() or not path.exists():
        raise UserError(f"no robot at {str(source)!r}; give the path of a URDF or MJCF, or one of {', '.join(BUNDLED)}")
    text = _decoded(path, read_regular(path))
    return mjcf_as_urdf(path) if _MJCF.match(text) else text


def _decoded(path: Path, data: bytes) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        try:  # the XML may declare another encoding
            return ElementTree.tostring(ElementTree.fromstring(data), encoding="unicode")
        except (ElementTree.ParseError, LookupError, ValueError):
            raise UserError(f"{path}: not a text file, so neither URDF nor MJCF ({error.reason})") from None


def _missing_limits(root: ElementTree.Element) -> tuple[str, ...]:
    """A sentence on the joints whose <limit> has no range, and on those whose limit of speed is 0; without <limit> is an error."""
    limits = [(j.get("name"), j.find("limit")) for j in root.iter("joint") if j.get("type") == "revolute"]
    given = [(name, limit) for name, limit in limits if limit is not None]
    ranges = [str(name) for name, limit in given if _number(limit, "lower", "0") == _number(limit, "upper", "0")]
    speeds = [str(name) for name, limit in given if _number(limit, "velocity", "") == 0]
    notes = []
    if ranges:
        notes.append(f"the URDF gives no range of {', '.join(ranges)}: 'lower' and 'upper' of <limit> are missing or the same")
    if speeds:
        notes.append(f"the URDF gives no speed of {', '.join(speeds)}: 'velocity' of <limit> is 0")
    return tuple(notes)


def _number(element: ElementTree.Element | None, key: str, default: str) -> float | None:
    """A number of an element; None where it is none."""
    try:
        return None if element is None else float(element.get(key, default))
    except ValueError:
        return None


def _masses(root: ElementTree.Element) -> dict[str, str]:
    """What is missing of the inertia of each link where something is; what is incomplete is removed."""
    wrong = {}
    for link in root.iter("link"):
        inertial = link.find("inertial")
        mass, inertia = (None, None) if inertial is None else (inertial.find("mass"), inertial.find("inertia"))
        if inertial is None:
            wrong[link.get("name", "")] = "has no <inertial>"
            continue
        if mass is None or mass.get("value") is None:
            wrong[link.get("name", "")] = "has an <inertial> without the mass, <mass value='…'/>"
        elif inertia is None:
            wrong[link.get("name", "")] = "has an <inertial> without the moments, <inertia ixx='…' …/>"
        if link.get("name", "") in wrong:
            link.remove(inertial)  # the parser would complain
    return wrong


def _parse(name: str, elements: Elements, joints: Sequence[str] | None) -> pin.Model:
    for joint in elements.root.findall("joint"):
        kind = joint.get("type")
        turns, mimic, tied = kind in ("fixed", "revolute", "continuous"), joint.find("mimic"), joint.find("tied")
        if joints is not None and joint.get("name") not in joints and not (turns and mimic is None and tied is None):
            joint.set("type", "fixed")  # locked at zero, as a gripper's fingers
            joint[:] = [part for part in joint if part.tag in ("parent", "child", "origin")]
            continue
        if not turns:
            raise UserError(
                f"robot {name!r}: joint {joint.get('name')!r} is {kind}; allowed are revolute, continuous and fixed"
                f"{'' if joints else ', and any type of joints that are not listed'}"
            )
        if mimic is not None or tied is not None:
            how = "mimics another" if tied is None else f"is tied to others by the {tied.get('by')}"
            raise UserError(f"robot {name!r}: joint {joint.get('name')!r} {how}; every joint must move on its own")
        if kind != "fixed":
            _check_axis(name, joint)
        if kind == "continuous":  # an angle without end is still one coordinate here
            joint.set("type", "revolute")
            limit = joint.find("limit")
            limit = ElementTree.SubElement(joint, "limit") if limit is None else limit
            unlimited = dict.fromkeys(("effort", "velocity"), ENDLESS)
            limit.attrib = {**unlimited, **limit.attrib, "lower": f"-{ENDLESS}", "upper": ENDLESS}
        elif kind == "revolute":
            _check_limit(name, elements, joint)
    said: list[str] = []
    model = None
    try:
        with _captured_stderr(said):
            model = pin.buildModelFromXML(ElementTree.tostring(elements.root, encoding="unicode"))
    except (RuntimeError, ValueError) as error:
        said = said or [str(error).strip()]
    if said or model is None:  # after a complaint the parser goes on with 0
        about = elements.named(" ".join(said))
        why = f"not a usable URDF: {'; '.join(said[:2])}"
        raise UserError(f"robot {name!r}: {why}") if about is None else elements.fault(about, about, f"makes it {why}")
    return model


def _check_limit(name: str, elements: Elements, joint: ElementTree.Element) -> None:
    limit = joint.find("limit")
    if limit is None:
        raise UserError(f"robot {name!r}: revolute joint {joint.get('name')!r} has no <limit>; URDF requires one")
    low, high = (float(limit.get(key, "0")) for key in ("lower", "upper"))
    if low > high:
        raise elements.fault(limit, joint, f"has crossed limits: lower {low:g} is above upper {high:g} rad")
    for key in ("effort", "velocity"):
        if float(limit.get(key, "0")) < 0:
            raise elements.fault(limit, joint, f"has the limit {key}={limit.get(key)!r}; 0 or more is required")


def _check_axis(name: str, joint: ElementTree.Element) -> None:
    axis = joint.find("axis")
    text = "1 0 0" if axis is None else axis.get("xyz", "1 0 0")
    try:
        given = np.array([float(x) for x in text.split()])
    except ValueError:
        given = np.zeros(0)
    if given.shape != (3,) or not np.all(np.isfinite(given)) or not np.any(given):
        raise UserError(
            f"robot {name!r}: joint {joint.get('name')!r} has the axis {text!r}; three numbers, not all 0, are required"
        )


@contextmanager
def _captured_stderr(said: list[str]) -> Iterator[None]:
    """Collect in `said` the errors that the URDF parser, a C++ library, writes to stderr, without paths of its source."""
    sys.stderr.flush()
    with tempfile.TemporaryFile() as captured:
        stderr = os.dup(2)
        os.dup2(captured.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            captured.seek(0)
            lines = captured.read().decode(errors="replace").splitlines()
            errors = [re.sub(r"\s*at line \d+ in .*$", "", line) for line in lines]
            said += [e.partition("Error:")[2].strip() for e in errors if "Error:" in e]


def _lock_all_but(name: str, model: pin.Model, joints: Sequence[str] | None) -> pin.Model:
    present = list(model.names)[1:]
    for joint in joints or ():
        if joint not in present:
            raise UserError(f"robot {name!r} has no joint {joint!r}; it has {', '.join(present)}")
    locked = [model.getJointId(j) for j in present if joints is not None and j not in joints]
    if locked:
        model = pin.buildReducedModel(model, locked, pin.neutral(model))
    for i in range(1, model.njoints):
        if model.parents[i] != i - 1:
            raise UserError(
                f"robot {name!r} is no serial chain: joint {model.names[i]!r} is attached to "
                f"{repr(model.names[model.parents[i]]) if model.parents[i] else 'the base'}; branches are "
                "not supported, but those whose joints are not listed are held still"
            )
    if joints is not None and tuple(model.names)[1:] != tuple(joints):
        raise UserError(f"robot {name!r}: joints {', '.join(joints)} are not in the order of the chain: {', '.join(present)}")
    return model


def _check_masses(name: str, model: pin.Model, wrong: Mapping[str, str]) -> None:
    """Raise `UserError` for a moving link whose mass is missing: one without <inertial> may be fixed to others that have one."""
    for frame in model.frames:
        said = wrong.get(frame.name) if frame.type == pin.FrameType.BODY and frame.parentJoint > 0 else None
        none = said is not None and "no <inertial>" in said
        if said is None or (none and model.inertias[frame.parentJoint].mass > 0):
            continue
        moved = f", moved by joint {model.names[frame.parentJoint]!r},"
        raise UserError(
            f"robot {name!r}: link {frame.name!r}{moved} {said}; a moving link needs a mass [kg], or a recording set says "
            '"inertial": "identify"'
        )


def _check_inertial(name: str, model: pin.Model, parameters: np.ndarray) -> None:
    for i in range(model.njoints - 1):
        mass = parameters[0, i]
        if not mass > 0:
            raise UserError(
                f"robot {name!r}: link {_moved_link(model, i + 1)!r}, moved by joint {model.names[i + 1]!r}, has mass "
                f'{mass:g} kg; a moving link needs a mass above 0, or a recording set says "inertial": "identify"'
            )
        inertia = model.inertias[i + 1].inertia
        moments = np.linalg.eigvalsh(inertia)
        if not possible(moments):
            raise UserError(
                f"robot {name!r}: link {_moved_link(model, i + 1)!r} has principal moments of inertia "
                f"{', '.join(f'{m:.3g}' for m in moments)} kg m²; they must be positive and none above the sum of the other two"
            )


def _tool_link(frames: Mapping[str, tuple[int, np.ndarray]], last: int) -> str:
    tips = [link for link, (joint, _) in frames.items() if joint == last]
    return ([link for link in tips if _TOOL.search(link)] or tips)[-1]


def _with_infinities(values: np.ndarray) -> np.ndarray:
    return np.where(np.abs(values) >= float(ENDLESS), np.copysign(np.inf, values), values)


def _moved_link(model: pin.Model, joint: int) -> str:
    """The link that a joint moves directly, not through fixed joints."""
    return next(f.name for f in model.frames if f.type == pin.FrameType.BODY and f.parentJoint == joint)


def _axis(joint: pin.JointModel) -> np.ndarray:
    """Axis of a revolute joint in its own frame: the column of its motion subspace."""
    data = joint.createData()
    joint.calc(data, np.zeros(1))
    return np.array(data.S).reshape(6)[3:]

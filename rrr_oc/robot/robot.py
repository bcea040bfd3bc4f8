"""A robot: a serial chain of revolute joints, read from a URDF or MJCF and validated."""

import importlib.resources
import os
import re
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

import numpy as np
import pinocchio as pin

from rrr_oc.errors import UserError
from rrr_oc.robot.mjcf import ENDLESS, mjcf_as_urdf
from rrr_oc.robot.urdf import TURNS, Elements, axis, fix, possible
from rrr_oc.schema import check_names
from rrr_oc.storage import read_regular

# pyright: reportAttributeAccessIssue=false
# (pin's wheel has no stubs)

BUNDLED = ("rrr", "rrr_prototype")
WIDEST = 10.0  # lengths of a link that its radius of gyration has at most; doubled, moments in kg cm² of long links pass
DENSEST = 2e4  # [kg/m³] of a cube as large as a link, nearly that of osmium; doubled, fewer masses in g are found
SMALLEST = 0.15  # [m] of such a cube, so that short heavy wrists pass; doubled, links below 500 kg do
ROUNDED = 1e-6  # [rad] by which an angle may lie outside a range that is told in few digits; doubled, nothing changes
NEARLY = 0.05  # of the largest moment of inertia, by which a file may miss those of a body, as usual errors are; doubled, coarser files pass
FLAT = 1e-3  # second moment of mass across a body over that along it, at least
GRAVITY = (0.0, 0.0, -9.81)  # [m/s²] in the base frame, where nothing says another
_TOOL = re.compile(  # usual names of a tool frame
    r"(^|[_/])(tool0?|tcp|ee|end_effector|flange|attachment|attachment_site)($|[_/])", re.IGNORECASE
)

_XACRO = re.compile(r"<xacro:\w")  # an element of a xacro
XACRO_TIME = 60.0  # [s] that xacro may take; doubled, a user waits as long for a file that never ends
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
        lower, upper: Joint ranges [rad], infinite where the file says none or one angle alone, shape (n,).
        velocity: Speed limits [rad/s], shape (n,).
        effort: Torque limits [Nm], infinite where the file says none or 0, shape (n,).
        tool: Origin of the last link's tool frame: a link fixed to it with a usual name such as tool0, else the last link fixed
            to it, else the link's own frame.
        frames: For each link of the URDF, or body and site of the MJCF, the joint that moves it (-1: the base) and its pose in
            that joint's frame.
        gravity: Acceleration of gravity in the base frame [m/s²], shape (3,).
        notes: What a user should know of the file, a sentence each: limits that it does not give, of any of its joints, links whose
            inertia no body has, and what it says beyond kinematics, inertia and limits, which is not used.
        held: Angles [rad] of the joints that are locked and not at zero, by name.
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
    held: Mapping[str, float] = field(default_factory=dict)

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
    source: str | Path,
    joints: Sequence[str] | None = None,
    inertial: bool = True,
    gravity: Sequence[float] | None = None,
    fixed: Mapping[str, float] | None = None,
) -> Robot:
    """Read a robot.

    Args:
        source: Name of a bundled model (`BUNDLED`) or path of a URDF or MJCF.
        joints: Joints to keep, in the order of the chain; the others, of whatever type, are locked. Default: all.
        inertial: Whether the links' masses are used, and so must be there.
        gravity: Acceleration of gravity in the base frame [m/s²]. Default: the MJCF's, or `GRAVITY`.
        fixed: Angles of joints that are not kept [rad]. Default: zero, or the middle of a range that lacks zero.

    Raises:
        UserError: The file is missing or neither URDF nor MJCF; a number in it is missing or not finite; a joint kept is not revolute, or
            its limits are crossed; the chain branches; a moving link has no mass; `joints` names one that is not there or is out of order;
            `fixed` names one that does not turn or is kept, or an angle outside its range.
    """
    name = str(source) if str(source) in BUNDLED else Path(source).stem
    elements = Elements(name, urdf_text(source))
    root = elements.root
    root.set("name", name)  # a file need not say one
    missing = _missing_limits(root)
    turning, held = _lock(name, elements, joints, fixed or {})
    elements.check_numbers()
    middle = {joint: angle for joint, angle in held.items() if joint not in (fixed or {})}
    notes = missing + _notes(elements, middle, inertial)
    masses, own = _masses(root), root.find("gravity")
    if gravity is None:
        gravity = GRAVITY if own is None else [float(x) for x in own.get("xyz", "").split()]
    model = _chain(name, _parse(name, elements, joints), joints, turning)
    if model.nq == 0:
        raise UserError(f"robot {name!r} has no revolute joint; at least one is needed")
    if inertial:
        _check_masses(name, model, masses)
        notes += _check_inertial(name, model)
    parameters = np.array([model.inertias[i].toDynamicParameters() for i in range(1, model.njoints)]).T  # (10, n)
    frames = {f.name: (f.parentJoint - 1, f.placement.homogeneous) for f in model.frames if f.type == pin.FrameType.BODY}
    last, ranges = model.njoints - 2, model.lowerPositionLimit < model.upperPositionLimit
    robot = Robot(
        name=name,
        joints=tuple(model.names)[1:],
        links=tuple(_moved_link(model, i) for i in range(1, model.njoints)),
        placements=np.array([model.jointPlacements[i].homogeneous for i in range(1, model.njoints)]),
        axes=np.array([_axis(model.joints[i]) for i in range(1, model.njoints)]),
        inertial=parameters,
        lower=np.where(ranges, _with_infinities(model.lowerPositionLimit), -np.inf),
        upper=np.where(ranges, _with_infinities(model.upperPositionLimit), np.inf),
        velocity=_with_infinities(model.upperVelocityLimit),
        effort=np.where(model.upperEffortLimit > 0, _with_infinities(model.upperEffortLimit), np.inf),
        tool=ToolPoint(last, _tool_position(frames, last, parameters[:, last])),
        frames=frames,
        gravity=np.asarray(gravity, float),
        notes=notes,
        held=held,
    )
    return replace(robot, notes=(*notes, *_in_other_units(robot))) if inertial else robot


def _notes(elements: Elements, middle: Mapping[str, float], inertial: bool) -> tuple[str, ...]:
    """A sentence on each locked joint in the middle of its range [rad], and on what the file says that is not used or cannot be."""
    held = [f"joint {j!r} is held at {np.degrees(q):.4g}°, the middle of its range, which lacks 0" for j, q in middle.items()]
    return (*held, *(str(note.text) for note in elements.root.findall("note")), *(elements.doubts() if inertial else ()))


def arm_of(source: str | Path) -> tuple[str, ...]:
    """The joints from the base on that turn on their own, up to where several chains of the same length go on, as a hand's fingers do.

    None where the base itself has several such chains, or the file several bases. Raises `UserError` where the file is missing or no robot.
    """
    below: dict[str, list[ElementTree.Element]] = {}
    joints = Elements(Path(source).stem, urdf_text(source)).root.findall("joint")
    for joint in joints:
        below.setdefault(_end(joint, "parent"), []).append(joint)

    def longest(link: str, above: frozenset[str] = frozenset()) -> tuple[str, ...]:
        ways = [] if link in above else [(j, longest(_end(j, "child"), above | {link})) for j in below.get(link, [])]
        chains = sorted(((str(j.get("name")), *rest) if _turns(j) else rest for j, rest in ways), key=len, reverse=True)
        return () if len(chains) > 1 and len(chains[0]) == len(chains[1]) else next(iter(chains), ())

    roots = set(below) - {_end(joint, "child") for joint in joints}
    return longest(roots.pop()) if len(roots) == 1 else ()


def _end(joint: ElementTree.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else element.get("link", "")


def _turns(joint: ElementTree.Element) -> bool:
    """Whether a joint turns, and on its own."""
    return joint.get("type") in TURNS and joint.find("mimic") is None and joint.find("tied") is None


def urdf_text(source: str | Path) -> str:
    """Text of a bundled model's URDF, of a file, or of the URDF that an MJCF becomes; raises `UserError` where there is none."""
    if str(source) in BUNDLED:
        return importlib.resources.files("rrr_oc.urdf").joinpath(f"{source}.urdf").read_text(encoding="utf-8")
    path = Path(source)
    if path.is_dir() or not path.exists():
        raise UserError(f"no robot at {str(source)!r}; give the path of a URDF or MJCF, or one of {', '.join(BUNDLED)}")
    text = _decoded(path, read_regular(path))
    if _XACRO.search(text):
        return _expanded(path)
    return mjcf_as_urdf(path) if _MJCF.match(text) else text


def _expanded(path: Path) -> str:
    """The URDF that a xacro becomes; raises `UserError` where the tool is not there, or refuses it."""
    tool = shutil.which("xacro")
    if tool is None:
        raise UserError(
            f"{path}: is a xacro, of which the tool xacro makes a URDF, and which is not installed here; where ROS, or the package xacro, is: "
            f"xacro {path.name} > {path.name.split('.')[0]}.urdf, with the arguments that its package gives"
        )
    try:
        done = subprocess.run([tool, str(path)], capture_output=True, text=True, timeout=XACRO_TIME, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise UserError(f"{path}: xacro does not run: {error}") from None
    if done.returncode or _XACRO.search(done.stdout):
        last = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise UserError(
            f"{path}: xacro refuses it: {last[:300]}; xacro {path.name} > arm.urdf, with its arguments, makes a URDF"
        )
    return done.stdout


def _decoded(path: Path, data: bytes) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        try:  # the XML may declare another encoding
            return ElementTree.tostring(ElementTree.fromstring(data), encoding="unicode")
        except (ElementTree.ParseError, LookupError, ValueError):
            raise UserError(f"{path}: not a text file, so neither URDF nor MJCF ({error.reason})") from None


def _missing_limits(root: ElementTree.Element) -> tuple[str, ...]:
    """A sentence on the joints whose <limit> has no range, and on those whose limits of speed or torque are 0."""
    limits = [(j.get("name"), j.get("type"), j.find("limit")) for j in root.iter("joint") if j.get("type") in TURNS]
    given = [(str(name), kind, limit) for name, kind, limit in limits if limit is not None]
    ends = {
        name: (_number(limit, "lower", "0"), _number(limit, "upper", "0")) for name, kind, limit in given if kind == "revolute"
    }
    ranges = [name for name, (lower, upper) in ends.items() if lower == upper]
    notes = []
    if ranges:
        notes.append(f"the URDF gives no range of {', '.join(ranges)}: 'lower' and 'upper' of <limit> are missing or the same")
    for key, what in (("velocity", "speed"), ("effort", "limit of torque")):
        if names := [name for name, _, limit in given if _number(limit, key, "") == 0]:
            notes.append(f"the URDF gives no {what} of {', '.join(names)}: '{key}' of <limit> is 0")
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


def _lock(
    name: str, elements: Elements, joints: Sequence[str] | None, fixed: Mapping[str, float]
) -> tuple[tuple[str, ...], dict[str, float]]:
    """Make the joints that are not kept fixed ones, so that nothing is asked of their numbers but their place.

    Returns the names of all joints that turn on their own, in the order of the file, and the angles of the locked ones that are not 0.
    """
    turning = tuple(str(joint.get("name")) for joint in elements.root.findall("joint") if _turns(joint))
    locked = [joint for joint in turning if joints is not None and joint not in joints]
    check_names(fixed, locked, f"robot {name!r}: fixed_deg", "locked joint that turns")
    held = {}
    for joint in elements.root.findall("joint"):
        own = str(joint.get("name"))
        if joint.get("type") == "fixed":
            fix(joint)
        if joints is None or own in joints or joint.get("type") == "fixed":
            continue
        if own in locked and (angle := _held_at(name, elements, joint, fixed)):
            _check_axis(name, joint)
            held[own] = angle
        fix(joint, held.get(own, 0.0))
    return turning, held


def _held_at(name: str, elements: Elements, joint: ElementTree.Element, fixed: Mapping[str, float]) -> float:
    """Angle of a locked joint [rad]: as given, or 0, or the middle of a range that lacks 0; a range that cannot be read is none."""
    own, limit = str(joint.get("name")), joint.find("limit") if joint.get("type") == "revolute" else None
    ends = [_number(limit, key, "0") for key in ("lower", "upper")]
    low, high = (-np.inf, np.inf) if None in ends else cast(list[float], ends)
    low, high = (low, high) if low < high else (-np.inf, np.inf)
    angle = fixed.get(own)
    if angle is None:
        return resting_angle(low, high)
    if not low - ROUNDED <= angle <= high + ROUNDED:
        shown = f"{np.degrees(low):.2f}° … {np.degrees(high):.2f}°"
        raise UserError(f"robot {name!r}: fixed_deg.{own}: found {np.degrees(angle):g}; its range is {shown}")
    return angle


def resting_angle(low: float, high: float) -> float:
    """Where a joint of this range is held if nothing says an angle: at 0, or in the middle of a range that lacks 0."""
    return 0.0 if not low < high or low <= 0 <= high else (low + high) / 2


def _parse(name: str, elements: Elements, joints: Sequence[str] | None) -> pin.Model:
    for joint in elements.root.findall("joint"):
        kind = joint.get("type")
        turns, mimic, tied = kind in ("fixed", *TURNS), joint.find("mimic"), joint.find("tied")
        if not turns:
            found = "has no type" if kind is None else f"is {kind}"
            raise UserError(
                f"robot {name!r}: joint {joint.get('name')!r} {found}; allowed are revolute, continuous and fixed"
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
    try:
        axis(joint)
    except ValueError:
        element = joint.find("axis")
        text = "" if element is None else element.get("xyz")
        raise UserError(
            f"robot {name!r}: joint {joint.get('name')!r} has the axis {text!r}; three numbers, not all 0 or beside it, are required"
        ) from None


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


def _chain(name: str, model: pin.Model, joints: Sequence[str] | None, turning: Sequence[str]) -> pin.Model:
    """The model, which must be a chain of the joints asked for; `turning` are all that could be."""
    fixed_or_not = (pin.FrameType.JOINT, pin.FrameType.FIXED_JOINT)
    present = [f.name for f in model.frames if f.type in fixed_or_not and f.name in turning]  # in the order of the chain
    for joint in joints or ():
        if joint not in present:
            raise UserError(f"robot {name!r} has no joint {joint!r}; it has {', '.join(present)}")
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
        if said is None or (
            none and (model.inertias[frame.parentJoint].mass > 0 or _moved_link(model, frame.parentJoint) not in wrong)
        ):
            continue
        moved = f", moved by joint {model.names[frame.parentJoint]!r},"
        raise UserError(
            f"robot {name!r}: link {frame.name!r}{moved} {said}; a moving link needs a mass [kg], or a recording set says "
            '"inertial": "identify"'
        )


def _check_inertial(name: str, model: pin.Model) -> tuple[str, ...]:
    """Give links that are nearly bodies the moments of inertia of a body, and a sentence on each.

    Raises `UserError` for a link without mass, or one that is far from any body.
    """
    notes = []
    for i in range(1, model.njoints):
        body, link = model.inertias[i], _moved_link(model, i)
        if not body.mass > 0:
            raise UserError(
                f"robot {name!r}: link {link!r}, moved by joint {model.names[i]!r}, has mass "
                f'{body.mass:g} kg; a moving link needs a mass above 0, or a recording set says "inertial": "identify"'
            )
        moments = np.linalg.eigvalsh(body.inertia)
        if possible(moments):
            continue
        near = _nearest_inertia(body.inertia)
        said = f"link {link!r} has principal moments of inertia {', '.join(f'{m:.3g}' for m in moments)} kg m²"
        if np.abs(near - body.inertia).max() > NEARLY * moments[2]:
            raise UserError(f"robot {name!r}: {said}; they must be positive and none above the sum of the other two")
        model.inertias[i] = pin.Inertia(body.mass, body.lever, near)
        notes.append(f"link {link!r} moves with the moments of inertia of the nearest body")
    return tuple(notes)


def _nearest_inertia(inertia: np.ndarray) -> np.ndarray:
    """The inertia (3, 3) about a centre [kg m²] of a body whose mass lies about it nearly so: no second moment of mass is negative."""
    values, vectors = np.linalg.eigh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    spread = vectors @ np.diag(np.maximum(values, FLAT * values.max())) @ vectors.T
    return np.trace(spread) * np.eye(3) - spread


def too_dense(robot: Robot) -> tuple[str, ...]:
    """A sentence on each link that is heavier than any material of its size, which is as far as the next joint or the tool is."""
    heavy = (
        (link, float(parameters[0]), size)
        for link, parameters, size in zip(robot.links, robot.inertial.T, _sizes(robot), strict=True)
        if parameters[0] > DENSEST * size**3
    )
    return tuple(
        f"link {link!r} weighs {mass:.4g} kg, which nothing of its size, {size:.2g} m, does" for link, mass, size in heavy
    )


def _in_other_units(robot: Robot) -> tuple[str, ...]:
    """A sentence on each link whose mass, or moments of inertia, are of no body as long as it is."""
    radii = np.sqrt(np.max(robot.inertial[[4, 6, 9]], axis=0) / np.maximum(robot.inertial[0], 1e-12))
    wide = (
        f"link {link!r} has moments of inertia as if its mass were {radius:.3g} m from its joint, and is {size:.2g} m long; kg m² are required"
        for link, radius, size in zip(robot.links, radii.tolist(), _sizes(robot), strict=True)
        if radius > WIDEST * size
    )
    return (*(f"{said}; are masses in g?" for said in too_dense(robot)), *wide)


def _sizes(robot: Robot) -> list[float]:
    """How far the next joint or the tool is from each joint [m], or twice as far as the centre of mass, whichever is more."""
    ends, masses = [*robot.placements[1:, :3, 3], robot.tool.position], np.maximum(robot.inertial[0], 1e-12)
    centres = np.linalg.norm(robot.inertial[1:4] / masses, axis=0)
    return [max(SMALLEST, float(np.linalg.norm(end)), 2 * float(c)) for end, c in zip(ends, centres, strict=True)]


def _tool_position(frames: Mapping[str, tuple[int, np.ndarray]], last: int, body: np.ndarray) -> np.ndarray:
    """Origin of the tool's frame in the frame of the last joint (3,) [m]; in a file without one, twice as far as the last link's centre."""
    own = frames[_tool_link(frames, last)][1][:3, 3]
    return own if own.any() or not body[0] > 0 else 2 * body[1:4] / body[0]


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

"""The text of a URDF as elements, every number of which is checked: parsers of URDF complain, and go on with 0 in its place."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from xml.parsers import expat

import numpy as np
import pinocchio as pin

from rrr_oc.errors import UserError
from rrr_oc.schema import decimal

# pyright: reportAttributeAccessIssue=false
# (pin's wheel has no stubs)

LARGEST = 1e6  # magnitude of a mass, length or moment of inertia [SI]; ten times that, and dynamics still have no meaning
SHORTEST = 1e-9  # of an axis, whose length is of no meaning; the square of 1e-170 is 0
DEEPEST = 100  # elements within each other; doubled, nothing changes for real files
_COORDINATES = {"xyz": 3, "rpy": 3}
# Numbers of the elements that are used: how many each attribute holds
NUMBERS: Mapping[str, Mapping[str, int]] = {
    "origin": _COORDINATES,
    "axis": {"xyz": 3},
    "mass": {"value": 1},
    "inertia": dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), 1),
    "limit": dict.fromkeys(("lower", "upper", "effort", "velocity"), 1),
}
_USED = {  # elements within links and joints; others are not checked, and parsers do not see them
    "link": ("inertial",),
    "joint": ("parent", "child", "origin", "axis", "limit", "mimic", "tied"),
}
_FIXED = ("parent", "child", "origin")  # elements of a joint that does not move
TURNS = ("revolute", "continuous")  # types of joints that turn


class Elements:
    """The elements of a URDF that are used, with the line of each for messages.

    Attributes:
        root: The element <robot>.
    """

    def __init__(self, name: str, text: str) -> None:
        """Raises `UserError` where the text is no well-formed XML or no URDF."""
        self._name = name
        self._lines: dict[ElementTree.Element, int] = {}
        self.root = self._parsed(text)
        if self.root.tag != "robot":
            raise UserError(f"robot {name!r}: the outer element is <{self.root.tag}>; a URDF has <robot>, and an MJCF <mujoco>")
        for part in list(self.root):
            if part.tag not in ("link", "joint", "gravity", "note"):
                self.root.remove(part)
            elif part.tag in _USED:
                part[:] = [inner for inner in part if inner.tag in _USED[part.tag]]

    def check_numbers(self) -> None:
        """Raise `UserError` where a number that is used is missing, not finite or absurd."""
        for part in self.root:
            for parent in (part, *part.findall("inertial")):
                self._check_numbers(part, parent)

    def fault(self, element: ElementTree.Element, of: ElementTree.Element, said: str) -> UserError:
        """An error that names the line of an element, and the link or joint that it belongs to."""
        return UserError(f"robot {self._name!r}, line {self._lines[element]}: {of.tag} {of.get('name')!r} {said}")

    def named(self, text: str) -> ElementTree.Element | None:
        """The link or joint whose name stands in a sentence of the parser."""
        return next((part for part in self.root if part.get("name") and f"[{part.get('name')}]" in text), None)

    def _parsed(self, text: str) -> ElementTree.Element:
        builder, parser, depth = ElementTree.TreeBuilder(), expat.ParserCreate(), 0

        def start(tag: str, attributes: dict[str, str]) -> None:
            nonlocal depth
            depth += 1
            if depth > DEEPEST:
                raise UserError(f"robot {self._name!r}: elements stand within each other {depth} deep; {DEEPEST} are allowed")
            self._lines[builder.start(tag, attributes)] = parser.CurrentLineNumber

        def end(tag: str) -> None:
            nonlocal depth
            depth -= 1
            builder.end(tag)

        parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, builder.data
        try:
            parser.Parse(text.encode(errors="replace"), True)
        except expat.ExpatError as error:
            raise UserError(f"robot {self._name!r}: not well-formed XML: {error}; a URDF or an MJCF is required") from None
        return builder.close()

    def _check_numbers(self, of: ElementTree.Element, parent: ElementTree.Element) -> None:
        """Check the numbers of the elements in one, and write them as every parser reads them: a blank between two."""
        for element in parent:
            for key, count in NUMBERS.get(element.tag, {}).items():
                text = element.get(key)
                if text is None and element.tag == "inertia":
                    raise self.fault(
                        element, of, f"has an <inertia> without {key!r}; {', '.join(NUMBERS['inertia'])} are required"
                    )
                if text is None:
                    continue
                if len(text.split()) != count or any(decimal(part) is None for part in text.split()):
                    wanted = "a finite number with a decimal point is" if count == 1 else f"{count} finite numbers are"
                    raise self.fault(element, of, f"has <{element.tag} {key}={text!r}>; {wanted} required")
                if element.tag != "limit" and max(abs(float(part)) for part in text.split()) > LARGEST:
                    raise self.fault(
                        element, of, f"has <{element.tag} {key}={text!r}>; magnitudes up to {LARGEST:g} are allowed"
                    )
                if element.tag == "mass" and float(text) < 0:
                    raise self.fault(element, of, f"has the mass {float(text):g} kg; 0 or more is required")
                element.set(key, " ".join(text.split()))

    def doubts(self) -> Iterator[str]:
        """A sentence each on the links whose own inertia no body can have."""
        for link in self.root.iter("link"):
            inertial = link.find("inertial")
            inertia = None if inertial is None else inertial.find("inertia")
            if inertia is None:
                continue
            xx, xy, xz, yy, yz, zz = (float(inertia.get(key, "")) for key in NUMBERS["inertia"])
            moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            if not possible(moments):
                shown = ", ".join(f"{m:.3g}" for m in moments)
                yield (
                    f"line {self._lines[inertia]} of the URDF gives link {link.get('name')!r} the principal moments of inertia {shown} "
                    "kg m², which no body has: one is negative or above the sum of the other two"
                )


def possible(moments: np.ndarray) -> bool:
    """Whether principal moments of inertia (3,) [kg m²], in rising order, are those of a body, up to rounding in the file."""
    return bool(moments[0] >= -1e-9 and moments[2] <= (moments[0] + moments[1]) * (1 + 1e-6) + 1e-9)


def fix(joint: ElementTree.Element, angle: float = 0.0) -> None:
    """Make a joint one that does not move, at an angle [rad] about its axis, with nothing left of it but its place."""
    if angle:
        origin = joint.find("origin")
        origin = ElementTree.SubElement(joint, "origin") if origin is None else origin
        turned = pin.rpy.rpyToMatrix(numbers(origin, "rpy", (0.0, 0.0, 0.0))) @ pin.exp3(angle * axis(joint))
        origin.set("rpy", " ".join(repr(float(x)) for x in pin.rpy.matrixToRpy(turned)))
    joint.set("type", "fixed")
    joint[:] = [part for part in joint if part.tag in _FIXED]


def axis(joint: ElementTree.Element) -> np.ndarray:
    """A joint's axis, of unit length, (3,); raises `ValueError` where it is none."""
    element = joint.find("axis")
    given = numbers(element, "xyz", (1.0, 0.0, 0.0))
    if given.shape != (3,) or not SHORTEST <= np.max(np.abs(given)) <= LARGEST:  # NaN is neither
        raise ValueError("an axis needs three numbers, one of them of a magnitude that can be squared")
    return given / np.linalg.norm(given)


def numbers(element: ElementTree.Element | None, key: str, default: tuple[float, ...]) -> np.ndarray:
    """The numbers of an attribute; raises `ValueError` where one is none."""
    text = None if element is None else element.get(key)
    return np.array(default if text is None else [float(x) for x in text.split()], float)


def posed(text: str, angles: Mapping[str, float]) -> str:
    """A URDF whose joints of these names are fixed at these angles [rad]; the text itself where there are none."""
    if not angles:
        return text
    root = ElementTree.fromstring(text)
    for joint in root.findall("joint"):
        if joint.get("name") in angles:
            fix(joint, angles[str(joint.get("name"))])
    return ElementTree.tostring(root, encoding="unicode") + "\n"

"""`recordings.json`: what a recording set says about itself, read and checked key by key."""

import json
import math
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from rrr_oc.effects import Effect
from rrr_oc.effects.elastic.biarticular_spring import BiarticularSpring, reduced
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.errors import UserError
from rrr_oc.recordings.csv_table import read_text

HEADER = "recordings.json"
FORMAT = "rrr_oc-recordings/1"
FREE = ("comment", "description", "license", "source")  # text for people, allowed everywhere and not read
KEYS = ("format", "robot", "joints", "torque", "inertial", "gravity", "tool", "actuators", "recordings")
TORQUES = ("motor", "load", "current")
INERTIAL = ("nominal", "identify")
LARGEST_ANGLE = 20 * math.pi  # [rad], ten turns; a spring's equilibrium beyond it is in degrees
LARGEST_RADIUS = 5.0  # [m]; a pulley's radius beyond it is in millimetres
SMALLEST_RADIUS = 1e-6  # [m]

Spring = tuple[Effect, dict[str, float]]


@dataclass(frozen=True)
class Entry:
    """One recording as it is listed: file, group, payload [kg] and the springs believed to be mounted."""

    file: str
    group: str
    payload: float
    springs: tuple[Spring, ...]


@dataclass(frozen=True)
class Header:
    """The content of `recordings.json`; `tool` is a link and a position [m], `torque_constant` [Nm/A] per joint."""

    robot: str
    joints: tuple[str, ...]
    torque: str
    inertial: str
    gravity: tuple[float, ...]
    tool: tuple[str, tuple[float, ...]] | None
    torque_constant: tuple[float | None, ...]
    entries: tuple[Entry, ...]


def read_header(path: Path) -> Header:
    """Read and check `recordings.json`; raises `UserError` that names the key, what was found and what is allowed."""
    data = _Node(str(path), _json(path)).table(KEYS, required=("format", "robot", "joints", "recordings"))
    data["format"].choice((FORMAT,))
    joints = tuple(joint.text() for joint in data["joints"].entries())
    if len(set(joints)) != len(joints):
        raise UserError(f"{data['joints'].where}: found {', '.join(joints)}; each joint may stand once")
    torque = data["torque"].choice(TORQUES) if "torque" in data else "motor"
    return Header(
        robot=data["robot"].text(),
        joints=joints,
        torque=torque,
        inertial=data["inertial"].choice(INERTIAL) if "inertial" in data else "nominal",
        gravity=data["gravity"].numbers(3) if "gravity" in data else (0.0, 0.0, -9.81),
        tool=_tool(data["tool"]) if "tool" in data else None,
        torque_constant=_torque_constants(data.get("actuators", _Node(f"{path}: actuators", {})), joints, torque),
        entries=_entries(data["recordings"], joints),
    )


def spring_json(springs: Sequence[Spring], joints: Sequence[str]) -> dict[str, Any]:
    """The `springs` of a recording as they stand in the file; a spring across two joints is written with r_2 = 1 m."""
    result: dict[str, Any] = {}
    for effect, theta in springs:
        names = [joints[j] for j in effect.joints]
        if isinstance(effect, ParallelSpring):
            spring = {
                "stiffness_Nm_per_rad": theta["stiffness"],
                "equilibrium_rad": theta["equilibrium"],
                "active": effect.active,
            }
            result.setdefault("pea", {}).setdefault(names[0], []).append(spring)
        elif isinstance(effect, BiarticularSpring):
            r = effect.pulleys  # Eq. 5 decides κ, ρ and φ only, and a change of q_0 the ratio r_1/r_2
            radii = {"radius1_m": r, "radius2_m": 1.0, "radius3_m": theta["rho"]}
            spring = {"stiffness_Nm_per_rad": theta["kappa"] * r**2, "equilibrium_rad": theta["phi"] / r, **radii}
            result.setdefault("bpea", []).append({**spring, "joints": names, "winding": list(effect.winding)})
        else:
            raise UserError(f"a recording cannot list {effect.name!r}; allowed are parallel_spring and biarticular_spring")
    if "pea" in result:
        result["pea"] = {joint: pea[0] if len(pea) == 1 else pea for joint, pea in result["pea"].items()}
    return result


def _entries(node: "_Node", joints: tuple[str, ...]) -> tuple[Entry, ...]:
    entries = tuple(_entry(item, joints) for item in node.entries())
    files = [PurePosixPath(entry.file) for entry in entries]
    for i, file in enumerate(files):
        if file in files[:i]:
            raise UserError(f"{node.where}[{i}].file: {str(file)!r} stands twice; each file may stand once")
    return entries


def _entry(node: "_Node", joints: tuple[str, ...]) -> Entry:
    data = node.table(("file", "group", "payload", "springs"), required=("file",))
    file = data["file"].text()
    if PurePosixPath(file).is_absolute() or ".." in PurePosixPath(file).parts:
        raise UserError(f"{data['file'].where}: found {file!r}; a recording must lie in the set's own folder")
    payload = data["payload"].number(at_least=0.0) if "payload" in data else 0.0
    springs = _springs(data["springs"], joints) if "springs" in data else ()
    return Entry(file, data["group"].text() if "group" in data else file, payload, springs)


def _springs(node: "_Node", joints: tuple[str, ...]) -> tuple[Spring, ...]:
    data, springs = node.table(("pea", "bpea")), []
    if "pea" in data:
        for joint, pea in data["pea"].table(joints, what="joint").items():
            springs += [_pea(item, joints.index(joint)) for item in pea.one_or_list()]
    if "bpea" in data:
        springs += [_bpea(item, joints) for item in data["bpea"].one_or_list()]
    return tuple(springs)


def _pea(node: "_Node", joint: int) -> Spring:
    required = ("stiffness_Nm_per_rad", "equilibrium_rad")
    data = node.table((*required, "active"), required)
    active = data["active"].choice(("below", "above")) if "active" in data else "below"
    theta = {"stiffness": data[required[0]].number(at_least=0.0), "equilibrium": data[required[1]].angle()}
    return ParallelSpring((joint,), active=active), theta


def _bpea(node: "_Node", joints: tuple[str, ...]) -> Spring:
    """A spring across two joints; those not named are the last two of the three, or the two there are."""
    required = ("stiffness_Nm_per_rad", "equilibrium_rad", "radius1_m", "radius2_m", "radius3_m")
    data = node.table((*required, "joints", "winding"), required)
    radii = [data[key].radius(zero=key == "radius3_m") for key in required[2:]]
    kappa, rho, phi = reduced(data[required[0]].number(at_least=0.0), data[required[1]].angle(), *radii)
    if not all(math.isfinite(value) for value in (kappa, rho, phi)):
        raise UserError(f"{node.where}: radii {radii} m give no finite torque; check the unit")
    if "joints" in data:
        pair = tuple(item.choice(joints) for item in data["joints"].entries())
    elif len(joints) in (2, 3):
        pair = joints[-2:]
    else:
        raise UserError(
            f"{node.where}: 'joints' is missing; with {len(joints)} joints it must name the two that the spring spans"
        )
    if len(pair) != 2 or pair[0] == pair[1]:
        raise UserError(f"{node.where}.joints: found {', '.join(pair)}; two different joints are required")
    winding = (1, 1)
    if "winding" in data:
        winding = data["winding"].numbers(2)
        if any(w not in (-1, 1) for w in winding):
            raise UserError(f"{data['winding'].where}: found {list(winding)}; two numbers, each 1 or -1, are required")
    effect = BiarticularSpring(
        (joints.index(pair[0]), joints.index(pair[1])), winding=(int(winding[0]), int(winding[1])), pulleys=radii[0] / radii[1]
    )
    return effect, {"kappa": kappa, "rho": rho, "phi": phi}


def _tool(node: "_Node") -> tuple[str, tuple[float, ...]]:
    data = node.table(("link", "position"), required=("link", "position"))
    return data["link"].text(), data["position"].numbers(3)


def _torque_constants(node: "_Node", joints: tuple[str, ...], torque: str) -> tuple[float | None, ...]:
    constants: dict[str, float] = {}
    for joint, actuator in node.table(joints, what="joint").items():
        data = actuator.table(("torque_constant",))
        if "torque_constant" in data:
            constants[joint] = data["torque_constant"].number()
            if constants[joint] == 0:
                raise UserError(f"{data['torque_constant'].where}: found 0; a number of Nm/A other than 0 is required")
    missing = [joint for joint in joints if joint not in constants]
    if torque == "current" and missing:
        raise UserError(
            f"{node.where}: no torque_constant [Nm/A] of {', '.join(missing)}; torque 'current' needs one per joint"
        )
    return tuple(constants.get(joint) for joint in joints)


def _json(path: Path) -> Any:
    text = read_text(path)
    try:
        return json.loads(text, object_pairs_hook=lambda pairs: _once(path, pairs))
    except json.JSONDecodeError as error:
        raise UserError(
            f"{path}, line {error.lineno}, column {error.colno}: {error.msg}; one complete JSON object is required"
        ) from None
    except (ValueError, RecursionError) as error:  # a number of thousands of digits, brackets thousands deep
        raise UserError(f"{path}: not usable JSON: {error}") from None


def _once(path: Path, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key, value in pairs:
        if key in result:
            raise UserError(f"{path}: key {key!r} stands twice in one object; each may stand once")
        result[key] = value
    return result


@dataclass(frozen=True)
class _Node:
    """A value of the file with the way to it, for messages."""

    where: str
    value: Any

    def fail(self, allowed: str) -> UserError:
        return UserError(f"{self.where}: found {reprlib.repr(self.value)}; {allowed}")

    def table(self, allowed: Sequence[str], required: Sequence[str] = (), what: str = "key") -> dict[str, "_Node"]:
        """The nodes of an object by key; null stands for a key left out."""
        if not isinstance(self.value, dict):
            raise self.fail(f"an object with {', '.join(allowed)} is required")
        for key in self.value:
            if key not in allowed and key not in FREE:
                raise UserError(f"{self.where}: unknown {what} {key!r}; allowed are {', '.join(allowed)}")
        dot = "." if self.where.count(": ") else ": "
        nodes = {key: _Node(f"{self.where}{dot}{key}", v) for key, v in self.value.items() if v is not None and key in allowed}
        for key in required:
            if key not in nodes:
                raise UserError(f"{self.where}: {what} {key!r} is missing; required are {', '.join(required)}")
        return nodes

    def entries(self) -> list["_Node"]:
        if not isinstance(self.value, list) or not self.value:
            raise self.fail("a list with at least one entry is required")
        return [_Node(f"{self.where}[{i}]", item) for i, item in enumerate(self.value)]

    def one_or_list(self) -> list["_Node"]:
        return self.entries() if isinstance(self.value, list) else [self]

    def text(self) -> str:
        if not isinstance(self.value, str) or not self.value.strip() or not self.value.isprintable():
            raise self.fail("a text is required")
        return self.value

    def choice(self, allowed: Sequence[str]) -> Any:
        if self.value not in allowed:
            raise self.fail(f"allowed {'is' if len(allowed) == 1 else 'are'} {', '.join(map(repr, allowed))}")
        return self.value

    def number(self, at_least: float = -math.inf) -> float:
        allowed = (
            "a finite number is required" if at_least == -math.inf else f"a finite number of {at_least:g} or more is required"
        )
        if isinstance(self.value, bool) or not isinstance(self.value, int | float):
            raise self.fail(allowed)
        try:
            value = float(self.value)
        except OverflowError:
            value = math.inf
        if not (math.isfinite(value) and value >= at_least):
            raise self.fail(allowed)
        return value

    def numbers(self, count: int) -> tuple[float, ...]:
        if not isinstance(self.value, list) or len(self.value) != count:
            raise self.fail(f"a list of {count} numbers is required")
        return tuple(node.number() for node in self.entries())

    def angle(self) -> float:
        value = self.number()
        if abs(value) > LARGEST_ANGLE:
            raise self.fail("the unit is rad; it looks like degrees")
        return value

    def radius(self, zero: bool) -> float:
        value = self.number(at_least=0.0)
        if value > LARGEST_RADIUS:
            raise self.fail("the unit is m; it looks like millimetres")
        if value < SMALLEST_RADIUS and not (zero and value == 0):
            raise self.fail(f"a radius of {SMALLEST_RADIUS:g} m or more is required")
        return value

"""`recordings.json`: what a recording set says about itself, read and checked key by key."""

import math
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from msgspec import Meta, field

from rrr_oc.effects import Effect
from rrr_oc.effects.elastic.biarticular_spring import BiarticularSpring, reduced
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.errors import UserError
from rrr_oc.schema import NonNegative, Schema, Text, Vector, check_names, parsed, validated
from rrr_oc.storage import read_utf8

HEADER = "recordings.json"
FORMAT = "rrr_oc-recordings/1"
FREE = ("comment", "description", "license", "source")  # text for people, allowed in every object and not read
LARGEST_ANGLE = 20 * math.pi  # [rad], ten turns; an equilibrium beyond it is taken for degrees; doubled, 110° would pass as rad
LARGEST_RADIUS = 5.0  # [m]; a pulley's radius beyond it is taken for millimetres; doubled, radii of 5 mm to 10 mm would pass
SMALLEST_RADIUS = 1e-6  # [m]; smaller ones leave no finite torque

Spring = tuple[Effect, dict[str, float]]


class Tool(Schema):
    """Where a payload is held: a point [m] in a link's frame."""

    link: Text
    position: Vector


class Actuator(Schema):
    """A joint's drive: motor torque at the joint's output by current [Nm/A]."""

    torque_constant: float | None = None

    def __post_init__(self) -> None:
        if self.torque_constant == 0:
            raise ValueError("torque_constant: found 0; a number of Nm/A other than 0 is required")


class Pea(Schema):
    """A spring across one joint (Eq. 3)."""

    stiffness_Nm_per_rad: NonNegative
    equilibrium_rad: float
    active: Literal["below", "above"] = "below"

    def __post_init__(self) -> None:
        _check_angle("equilibrium_rad", self.equilibrium_rad)


class Bpea(Schema):
    """A spring across two joints (Eq. 5); those not named are the last two of the three, or the two there are."""

    stiffness_Nm_per_rad: NonNegative
    equilibrium_rad: float
    radius1_m: NonNegative
    radius2_m: NonNegative
    radius3_m: NonNegative
    joints: tuple[str, str] | None = None
    winding: tuple[float, float] = (1, 1)

    def __post_init__(self) -> None:
        _check_angle("equilibrium_rad", self.equilibrium_rad)
        if any(abs(turn) != 1 for turn in self.winding):
            raise ValueError(f"winding: found {list(self.winding)}; two numbers, each 1 or -1, are required")
        for key in ("radius1_m", "radius2_m", "radius3_m"):
            radius = getattr(self, key)
            if radius > LARGEST_RADIUS:
                raise ValueError(f"{key}: found {radius:g}; the unit is m; it looks like millimetres")
            if radius < SMALLEST_RADIUS and not (key == "radius3_m" and radius == 0):
                raise ValueError(f"{key}: found {radius:g}; a radius of {SMALLEST_RADIUS:g} m or more is required")


class Springs(Schema):
    """The springs of a recording, by kind; those across one joint by its name."""

    pea: dict[str, Pea | list[Pea]] = field(default_factory=dict)
    bpea: Bpea | list[Bpea] = field(default_factory=list)


class Entry(Schema):
    """One recording as it is listed; `payload` in kg."""

    file: Text
    group: Text | None = None
    payload: NonNegative = 0.0
    springs: Springs = Springs()

    def __post_init__(self) -> None:
        if PurePosixPath(self.file).is_absolute() or ".." in PurePosixPath(self.file).parts:
            raise ValueError(f"file: found {self.file!r}; a recording must lie in the set's own folder")


class Header(Schema):
    """The content of `recordings.json`."""

    format: Literal["rrr_oc-recordings/1"]
    robot: Text
    joints: Annotated[tuple[Text, ...], Meta(min_length=1)]
    recordings: Annotated[tuple[Entry, ...], Meta(min_length=1)]
    torque: Literal["motor", "load", "current"] = "motor"
    inertial: Literal["nominal", "identify"] = "nominal"
    gravity: Vector = (0.0, 0.0, -9.81)
    tool: Tool | None = None
    actuators: dict[str, Actuator] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(set(self.joints)) != len(self.joints):
            raise ValueError(f"joints: found {', '.join(self.joints)}; each joint may stand once")
        files = [PurePosixPath(entry.file) for entry in self.recordings]
        for i, file in enumerate(files):
            if file in files[:i]:
                raise ValueError(f"recordings[{i}].file: {str(file)!r} stands twice; each file may stand once")
        missing = [joint for joint, k in zip(self.joints, self.torque_constant, strict=True) if k is None]
        if self.torque == "current" and missing:
            raise ValueError(
                f"actuators: no torque_constant [Nm/A] of {', '.join(missing)}; torque 'current' needs one per joint"
            )

    @property
    def torque_constant(self) -> tuple[float | None, ...]:
        """Per joint [Nm/A]; None where it is not given."""
        return tuple(self.actuators.get(joint, Actuator()).torque_constant for joint in self.joints)


def read_header(path: Path) -> Header:
    """Read and check `recordings.json`; raises `UserError` that names the key, what was found and what is allowed."""
    header = validated(path, _without_free_text(parsed(path, read_utf8(path).decode())), Header)
    check_names(header.actuators, header.joints, f"{path}: actuators", "joint")
    return header


def _without_free_text(data: Any) -> Any:
    """The same without text for people and without nulls, which stand for keys left out."""
    if isinstance(data, dict):
        return {key: _without_free_text(value) for key, value in data.items() if value is not None and key not in FREE}
    return [_without_free_text(item) for item in data] if isinstance(data, list) else data


def mounted_springs(where: str, springs: Springs, joints: Sequence[str]) -> tuple[Spring, ...]:
    """The springs of a recording as effects with their parameters; `where` names them in errors."""
    check_names(springs.pea, joints, f"{where}.pea", "joint")
    found = [_pea(item, joints.index(joint)) for joint, pea in springs.pea.items() for item in _listed(pea)]
    return (*found, *(_bpea(f"{where}.bpea", item, joints) for item in _listed(springs.bpea)))


def _listed(one_or_list: Any) -> list[Any]:
    return one_or_list if isinstance(one_or_list, list) else [one_or_list]


def _pea(spring: Pea, joint: int) -> Spring:
    theta = {"stiffness": spring.stiffness_Nm_per_rad, "equilibrium": spring.equilibrium_rad}
    return ParallelSpring((joint,), active=spring.active), theta


def _bpea(where: str, spring: Bpea, joints: Sequence[str]) -> Spring:
    radii = spring.radius1_m, spring.radius2_m, spring.radius3_m
    kappa, rho, phi = reduced(spring.stiffness_Nm_per_rad, spring.equilibrium_rad, *radii)
    if not all(math.isfinite(value) for value in (kappa, rho, phi)):
        raise UserError(f"{where}: radii {radii} m give no finite torque; check the unit")
    if spring.joints is None and len(joints) not in (2, 3):
        raise UserError(f"{where}: 'joints' is missing; with {len(joints)} joints it must name the two that the spring spans")
    pair = spring.joints or joints[-2:]
    check_names(pair, joints, f"{where}.joints", "joint")
    if pair[0] == pair[1]:
        raise UserError(f"{where}.joints: found {', '.join(pair)}; two different joints are required")
    both = joints.index(pair[0]), joints.index(pair[1])
    return BiarticularSpring(both, winding=spring.winding, pulleys=radii[0] / radii[1]), {
        "kappa": kappa,
        "rho": rho,
        "phi": phi,
    }


def _check_angle(key: str, angle: float) -> None:
    if abs(angle) > LARGEST_ANGLE:
        raise ValueError(f"{key}: found {angle:g}; the unit is rad; it looks like degrees")


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

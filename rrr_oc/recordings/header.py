"""`recordings.json`: what a recording set says about itself, read and checked key by key."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, field

from rrr_oc.effects import Effect, listed_springs
from rrr_oc.errors import UserError
from rrr_oc.schema import NonNegative, Schema, Text, Vector, check_names, parsed, validated
from rrr_oc.storage import read_utf8

HEADER = "recordings.json"
FORMAT = "rrr_oc-recordings/1"
FREE = ("comment", "description", "license", "source")  # text for people, allowed in every object and not read
LARGEST_ANGLE = 20 * math.pi  # [rad], ten turns; an equilibrium beyond it is taken for degrees; doubled, 110° would pass as rad
LARGEST_RADIUS = 5.0  # [m]; a pulley's radius beyond it is taken for millimetres; doubled, radii of 5 mm to 10 mm would pass
SMALLEST_RADIUS = 1e-6  # [m]; smaller ones leave no finite torque

Angle = Annotated[
    float,
    Meta(
        ge=-LARGEST_ANGLE,
        le=LARGEST_ANGLE,
        description=f"a finite number up to {LARGEST_ANGLE:.3g} is required; the unit is rad; a larger one looks like degrees",
    ),
]
Radius = Annotated[
    float,
    Meta(
        ge=SMALLEST_RADIUS,
        le=LARGEST_RADIUS,
        description=f"a number of {SMALLEST_RADIUS:g} or more, up to {LARGEST_RADIUS:g}, is required; the unit is m; "
        "a larger one looks like millimetres",
    ),
]
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


class Entry(Schema):
    """One recording as it is listed; `payload` in kg."""

    file: Text
    group: Text | None = None
    payload: NonNegative = 0.0
    springs: dict[str, Any] = field(default_factory=dict)

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


def mounted_springs(path: Path, header: Header) -> list[tuple[Spring, ...]]:
    """The springs of each recording as effects with their parameters. Raises `UserError` that names the key in the file."""
    kinds = listed_springs()
    schemas = {key: _schema_of(kind) for key, kind in kinds.items()}
    keys = [(key, _one_or_many(kinds[key], schema), None) for key, schema in schemas.items()]
    schema = msgspec.defstruct("Springs", keys, bases=(Schema,))
    result = []
    for i, entry in enumerate(header.recordings):
        place = f"recordings[{i}].springs"
        given = msgspec.structs.asdict(validated(path, entry.springs, schema, place))
        result.append(
            tuple(s for key, kind in kinds.items() for s in _springs(f"{path}: {place}.{key}", kind, given[key], header.joints))
        )
    return result


def _schema_of(kind: type[Effect]) -> type[Schema]:
    """The entry of a spring, from its `Listing`."""
    listing = kind.listing
    assert listing is not None
    keys: list[Any] = [(key, _quantity(key, key in listing.zero)) for key in listing.quantities]
    if kind.placement == "pair":
        keys.append(("joints", tuple[str, str] | None, None))
    for key, allowed in listing.options.items():
        count = listing.counts.get(key)
        keys.append((key, (Literal[allowed] if count is None else tuple[(float,) * count]) | None, None))
    return msgspec.defstruct(kind.__name__, keys, bases=(Schema,))


def _quantity(key: str, zero: bool) -> Any:
    """The type of a number whose unit is the ending of its key."""
    if key.endswith("_m"):
        return Radius | Literal[0] if zero else Radius
    return Angle if key.endswith("_rad") and not key.endswith("_per_rad") else NonNegative


def _one_or_many(kind: type[Effect], schema: type[Schema]) -> Any:
    some = schema | list[schema] | None
    return some if kind.placement == "pair" else dict[str, some] | None


def _springs(where: str, kind: type[Effect], given: Any, joints: tuple[str, ...]) -> Iterator[Spring]:
    """Springs of one kind: those of one joint by its name, those of two in a list."""
    if kind.placement != "pair":
        check_names(given or {}, joints, where, "joint")
    for joint, some in [(None, given)] if kind.placement == "pair" else (given or {}).items():
        for spring in some if isinstance(some, list) else [] if some is None else [some]:
            place = where if joint is None else f"{where}.{joint}"
            entry = {key: value for key, value in msgspec.structs.asdict(spring).items() if value is not None}
            _check_options(place, kind, entry)
            pair = _pair(place, entry.pop("joints", None), joints) if joint is None else (joint,)
            try:
                yield kind.from_entry(tuple(map(joints.index, pair)), entry)
            except UserError as error:
                raise UserError(f"{place}: {error}") from None


def _check_options(where: str, kind: type[Effect], entry: Mapping[str, Any]) -> None:
    """Raise `UserError` for a list with another value than those allowed."""
    assert kind.listing is not None
    for key, count in kind.listing.counts.items():
        allowed = kind.listing.options[key]
        if any(value not in allowed for value in entry.get(key, ())):
            wanted = f"{count} numbers, each {' or '.join(map(str, allowed))}, are required"
            raise UserError(f"{where}.{key}: found {list(entry[key])}; {wanted}")


def _pair(where: str, given: tuple[str, str] | None, joints: tuple[str, ...]) -> tuple[str, ...]:
    """The joints that a spring spans; those not named are the last two of three, or the two there are."""
    if given is None and len(joints) not in (2, 3):
        raise UserError(f"{where}: 'joints' is missing; with {len(joints)} joints it must name the two that the spring spans")
    pair = given or joints[-2:]
    check_names(pair, joints, f"{where}.joints", "joint")
    if pair[0] == pair[1]:
        raise UserError(f"{where}.joints: found {', '.join(pair)}; two different joints are required")
    return pair


def spring_json(springs: Sequence[Spring], joints: Sequence[str]) -> dict[str, Any]:
    """The `springs` of a recording as they stand in the file: by joint, or in a list where they span two."""
    result: dict[str, Any] = {}
    for effect, theta in springs:
        names = [joints[j] for j in effect.joints]
        if effect.listing is None:
            allowed = " and ".join(kind.name for kind in listed_springs().values())
            raise UserError(f"a recording cannot list {effect.name!r}; allowed are {allowed}")
        key, spring = effect.listing.key, effect.entry(theta)
        if effect.placement == "pair":
            result.setdefault(key, []).append({**spring, "joints": names})
        else:
            result.setdefault(key, {}).setdefault(names[0], []).append(spring)
    for key, by_joint in result.items():
        if isinstance(by_joint, dict):
            result[key] = {joint: each[0] if len(each) == 1 else each for joint, each in by_joint.items()}
    return result

"""The springs that a recording set lists: read and written as the effects declare it by their `listing`."""

import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from rrr_oc.effects import ListedSpring, listed_springs
from rrr_oc.errors import UserError
from rrr_oc.recordings.header import Header, Spring
from rrr_oc.schema import NonNegative, Schema, check_names, validated

LARGEST_ANGLE = 20 * math.pi  # [rad], ten turns; an equilibrium beyond it is taken for degrees; doubled, 110° would pass as rad
LARGEST_LENGTH = 5.0  # [m]; a pulley's radius beyond it is taken for millimetres; doubled, radii of 5 mm to 10 mm would pass
SMALLEST_LENGTH = 1e-6  # [m]; a smaller radius gives no finite torque; doubled, nothing changes for real pulleys

DEGREES = f"a finite number up to {LARGEST_ANGLE:.3g} is required; the unit is rad; a larger one looks like degrees"
MILLIMETRES = f"{{}} or more, up to {LARGEST_LENGTH:g}, is required; the unit is m; a larger one looks like millimetres"
Angle = Annotated[float, Meta(ge=-LARGEST_ANGLE, le=LARGEST_ANGLE, description=DEGREES)]
Length = Annotated[float, Meta(ge=0, le=LARGEST_LENGTH, description=MILLIMETRES.format(0))]
PositiveLength = Annotated[float, Meta(ge=SMALLEST_LENGTH, le=LARGEST_LENGTH, description=MILLIMETRES.format(SMALLEST_LENGTH))]


def read_springs(path: Path, header: Header) -> list[tuple[Spring, ...]]:
    """The springs of each recording as effects with their parameters. Raises `UserError` that names the key in the file."""
    kinds, schema, result = listed_springs(), springs_schema(), []
    for i, recording in enumerate(header.recordings):
        place = f"recordings[{i}].springs"
        given = validated(path, recording.springs, schema, place)
        of_kinds = (_of_kind(f"{path}: {place}.{k}", kind, getattr(given, k), header.joints) for k, kind in kinds.items())
        result.append(tuple(itertools.chain.from_iterable(of_kinds)))
    return result


def springs_schema() -> Any:
    """The structure of the springs of a recording, from the listings of the effects."""
    keys: list[Any] = [(key, _entries(kind) | None, None) for key, kind in listed_springs().items()]
    return msgspec.defstruct("Springs", keys, bases=(Schema,))


def _entries(kind: type[ListedSpring]) -> Any:
    """The type of the springs of one kind in a recording, from the listing."""
    listing = kind.listing
    keys: list[Any] = [(key, _quantity(key, key in listing.zero)) for key in listing.quantities]
    if kind.placement == "pair":
        keys.append(("joints", tuple[str, str] | None, None))
    for key, allowed in kind.options.items():
        default = getattr(kind, key)
        values: Any = tuple[(float,) * len(default)] if isinstance(default, tuple) else Literal[allowed]
        keys.append((key, values | None, None))
    entry = msgspec.defstruct(kind.__name__, keys, bases=(Schema,))
    return entry | list[entry] if kind.placement == "pair" else dict[str, entry | list[entry]]


def _quantity(key: str, zero: bool) -> Any:
    """The type of a number whose unit is the ending of its key."""
    if key.endswith("_m"):
        return Length if zero else PositiveLength
    return Angle if key.endswith("_rad") and not key.endswith("_per_rad") else NonNegative


def _of_kind(where: str, kind: type[ListedSpring], given: Any, joints: tuple[str, ...]) -> Iterator[Spring]:
    """Springs of one kind: those on one joint stand under its name, those across two joints alone or in a list."""
    by_joint: dict[Any, Any] = {} if given is None else {None: given} if kind.placement == "pair" else given
    if None not in by_joint:
        check_names(by_joint, joints, where, "joint")
    for joint, some in by_joint.items():
        place = where if joint is None else f"{where}.{joint}"
        for spring in some if isinstance(some, list) else [some]:
            entry = {key: value for key, value in msgspec.structs.asdict(spring).items() if value is not None}
            pair = _pair(place, entry.pop("joints", None), joints) if joint is None else (joint,)
            yield _spring(place, kind, tuple(map(joints.index, pair)), entry)


def _spring(where: str, kind: type[ListedSpring], joints: tuple[int, ...], entry: dict[str, Any]) -> Spring:
    for key, allowed in kind.options.items():
        values = entry.get(key)
        if isinstance(values, tuple) and not set(values) <= set(allowed):
            wanted = f"{len(values)} numbers, each {' or '.join(map(str, allowed))}, are required"
            raise UserError(f"{where}.{key}: found {list(values)}; {wanted}")
    try:
        return kind.from_entry(joints, entry)
    except UserError as error:
        raise UserError(f"{where}: {error}") from None


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
        if not isinstance(effect, ListedSpring):
            allowed = " and ".join(kind.name for kind in listed_springs().values())
            raise UserError(f"a recording cannot list {effect.name!r}; allowed are {allowed}")
        key, spring = effect.listing.key, effect.entry(theta)
        if effect.placement == "pair":
            result.setdefault(key, []).append({**spring, "joints": names})
        else:
            result.setdefault(key, {}).setdefault(names[0], []).append(spring)
    for by_joint in (some for some in result.values() if isinstance(some, dict)):
        by_joint.update({joint: each[0] for joint, each in by_joint.items() if len(each) == 1})
    return result

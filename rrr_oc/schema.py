"""JSON files read against typed structures: whatever is wrong with a file is one sentence.

It names the file, the key, what was found and what is allowed. A structure is a subclass of `Schema` beside what it describes;
its annotations are the allowed values. What annotations cannot say is checked in `__post_init__`, which raises
ValueError("key: what is wrong with it").
"""

import importlib.resources
import json
import math
import re
import reprlib
import sys
import tomllib
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec
from msgspec import Meta, inspect

from rrr_oc.errors import UserError, meant
from rrr_oc.storage import read_utf8

T = TypeVar("T")
FREE = ("comment", "description", "license", "source")  # text for people, allowed in every object and not read
Text = Annotated[str, Meta(pattern=r"^(?=.*\S)[^\x00-\x1f\x7f\ud800-\udfff]*\Z")]  # not blank, without control characters
NonNegative = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]
# A smaller one becomes 0 in other units
Positive = Annotated[float, Meta(ge=1e-12, description="a finite number above 0 is required")]
_DECIMAL = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_HALF = re.compile("[\ud800-\udfff]")  # surrogates, which JSON may have alone
DEEPEST = 100  # brackets within each other; doubled, nothing changes for real files
LARGEST = 1e9  # magnitude of a number that a user writes, in any unit: beyond it nothing is measured, and powers overflow
Interval = tuple[float, float]
_Coordinate = Annotated[
    float, Meta(ge=-1e4, le=1e4)
]  # [m] or [m/s²]; ten times the largest arm and gravity there are, and more
Vector = tuple[_Coordinate, _Coordinate, _Coordinate]
# What files may call by either name, as they do not agree on whether a key ends with its unit: mass at the tool, and a point
HEAVIEST = 1e4  # [kg] of a payload; doubled, nothing changes for arms that there are
Payload = Annotated[float, Meta(ge=0, le=HEAVIEST, extra={"spellings": ("payload", "payload_kg")})]
Position = Annotated[Vector, Meta(extra={"spellings": ("position", "position_m")})]


class _AsInFiles(reprlib.Repr):
    """What was found, shortened, with the words that JSON has."""

    def repr_NoneType(self, x: None, level: int) -> str:
        return "null"

    def repr_bool(self, x: bool, level: int) -> str:
        return "true" if x else "false"


_FOUND = _AsInFiles()


class Schema(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An object of a JSON file; a key without a default is required, any other key is refused.

    The reference of each file (`docs/from_code/files.py`) takes what a key means, and its unit in brackets, from "Attributes" in the
    structure's docstring.
    """


def read_json(path: str | Path, schema: type[T]) -> T:
    """Read a file. Raises `UserError` where it is missing, no JSON, or not as `schema` describes it."""
    return validated(path, parsed(path, read_utf8(path).decode()), schema)


def read_toml(path: str | Path) -> dict[str, Any]:
    """Plain data of a TOML file; raises `UserError` where it is missing or no TOML, or a number in it is not finite or above `LARGEST`."""
    text = read_utf8(path).decode()
    try:
        return _within(path, tomllib.loads(text), LARGEST)
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{path}: not valid TOML: {error}") from None
    except (ValueError, RecursionError) as error:  # a number of thousands of digits, brackets thousands deep
        raise UserError(f"{path}: not usable TOML: {error}") from None


def read_preset(what: str, source: str | Path, presets: Mapping[str, str], schema: type[T]) -> tuple[str, T]:
    """Read a bundled file, by the name of a preset, or a file of the user's; returns its name in messages, too.

    `what` says what the file describes, as in "task"; `presets` names the file in `rrr_oc/data` of each preset.
    """
    if str(source) in presets:
        where = f"{what} {str(source)!r}"
        text = importlib.resources.files("rrr_oc.data").joinpath(presets[str(source)]).read_text()
    elif Path(source).is_file():
        where, text = str(source), read_utf8(source).decode()
    else:
        raise UserError(
            f"no {what} at {str(source)!r}; give the path of a JSON file or the name of a bundled one: {', '.join(presets)}"
            f"{meant(str(source), presets)}"
        )
    return where, validated(where, without_free_text(parsed(where, text, LARGEST)), schema)


def parsed(where: str | Path, text: str, largest: float = sys.float_info.max) -> Any:
    """Plain data from JSON with comments, which go from // to the end of the line.

    Raises `UserError` for broken JSON, a key that stands twice and a number that is not finite or of a magnitude above `largest`.
    """

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [key for key, _ in pairs]
        for i, key in enumerate(keys):
            if key in keys[:i]:
                raise UserError(f"{where}: key {key!r} stands twice in one object; each may stand once")
        return dict(pairs)

    try:
        return _within(where, json.loads(without_comments(text), object_pairs_hook=once), largest)
    except json.JSONDecodeError as error:
        raise UserError(f"{where}, line {error.lineno}, column {error.colno}: not valid JSON: {error.msg}") from None
    except (ValueError, RecursionError) as error:  # a number of thousands of digits, brackets thousands deep
        raise UserError(f"{where}: not usable JSON: {error}") from None


def without_free_text(data: Any) -> Any:
    """The same without text for people and without nulls, which stand for keys left out."""
    if isinstance(data, dict):
        return {key: without_free_text(value) for key, value in data.items() if value is not None and key not in FREE}
    return [without_free_text(item) for item in data] if isinstance(data, list) else data


def validated(where: str | Path, data: Any, schema: type[T], path: str = "") -> T:
    """Plain data, from `path` in the file `where`, as `schema` describes it; raises `UserError` that names what is allowed."""
    data = _one_spelling(where, path, data, schema)
    try:
        return msgspec.convert(data, schema)
    except msgspec.ValidationError:
        path, said = _fault(path, data, schema)
        raise UserError(f"{_place(where, path)}: {said}") from None


def built(data: Any, schema: type[T]) -> T:
    """Plain data that this program made of its own results, as what they were: null is NaN where a number stands that may be any."""
    return msgspec.convert(with_nan(data, schema), schema)


def with_nan(data: Any, schema: Any) -> Any:
    """Plain data with NaN in the place of each null for which there is a number in a structure."""
    return _with_nan(data, inspect.type_info(schema))


def _with_nan(data: Any, kind: Any) -> Any:
    """The same for a type as `msgspec.inspect` has it."""
    if data is None:
        kinds = [type(member) for member in getattr(kind, "types", [kind])]
        return math.nan if inspect.FloatType in kinds and inspect.NoneType not in kinds else None
    if isinstance(kind, inspect.UnionType):
        ways = ("fields", "value_type") if isinstance(data, dict) else ("item_type", "item_types")
        kind = next((member for member in kind.types if any(hasattr(member, way) for way in ways)), None)
    if isinstance(data, dict):
        of_all, fields = getattr(kind, "value_type", None), {f.encode_name: f.type for f in getattr(kind, "fields", ())}
        return {key: _with_nan(value, fields.get(key, of_all)) for key, value in data.items()}
    if isinstance(data, list):
        kinds = getattr(kind, "item_types", ())
        kinds = kinds if len(kinds) == len(data) else [getattr(kind, "item_type", None)] * len(data)
        return [_with_nan(value, one) for value, one in zip(data, kinds, strict=True)]
    return data


def without_comments(text: str) -> str:
    """The same text with blanks in place of its comments, so that lines and columns stay; // in quotation marks begins none."""
    return re.sub(r'"(?:\\.|[^"\\\n])*"|//[^\n]*', lambda m: m[0] if m[0][0] == '"' else " " * len(m[0]), text)


def decimal(text: str) -> float | None:
    """The finite number that a text is, as every program reads it: in ASCII, with a decimal point, without blanks; None for any other."""
    value = float(text) if _DECIMAL.fullmatch(text) else math.inf
    return value if math.isfinite(value) else None


def one_spelling(found: Iterable[str], spellings: Sequence[str], where: str) -> str | None:
    """The one of several spellings of a key that was found, None where none was; raises `UserError` for more than one."""
    given = [name for name in found if name in spellings]
    if len(given) > 1:
        raise UserError(f"{where}: {' and '.join(map(repr, given))} stand in one object and mean the same; one is allowed")
    return given[0] if given else None


def spellings(schema: Any) -> tuple[str, ...]:
    """The names by which files may call a key of this type; none where there is only its own."""
    if get_origin(schema) in (Union, types.UnionType):
        return next((found for member in get_args(schema) if (found := spellings(member))), ())
    metas = get_args(schema)[1:] if get_origin(schema) is Annotated else ()
    return next((meta.extra["spellings"] for meta in metas if meta.extra), ())


def _one_spelling(where: str | Path, path: str, data: Any, schema: Any) -> Any:
    """The same data with every key that has several spellings under the name of its field."""
    schema, _ = _simplified(data, schema)
    if _is_structure(schema) and isinstance(data, dict):
        for field in msgspec.structs.fields(schema):
            given = one_spelling(data, spellings(field.type), _place(where, path))
            if given is not None and given != field.encode_name:
                data = {field.encode_name if key == given else key: value for key, value in data.items()}
    inside = [(step, _one_spelling(where, path + step, value, inner)) for step, value, inner in _parts(data, schema)]
    if isinstance(data, dict):
        return data | {step[1:]: value for step, value in inside}
    return [value for _, value in inside] if inside else data


def check_names(found: Iterable[str], allowed: Iterable[str], where: str | Path, what: str = "key") -> None:
    """Raise `UserError` if `found` has a name that is not in `allowed`."""
    known = tuple(allowed)
    unknown = [name for name in found if name not in known]
    if unknown:
        raise UserError(f"{where}: unknown {what} {unknown[0]!r}; allowed are {', '.join(known)}{meant(unknown[0], known)}")


def check_interval(key: str, bounds: Interval | None) -> None:
    """For `__post_init__`: raise ValueError where the lower bound is above the upper."""
    if bounds is not None and not bounds[0] <= bounds[1]:
        raise ValueError(f"{key}: bounds are crossed: {bounds[0]:g} … {bounds[1]:g}; the lower must not be above the upper")


def _place(where: str | Path, path: str) -> str:
    return f"{where}: {path.lstrip('.')}" if path else str(where)


def _within(where: str | Path, data: T, largest: float) -> T:
    """The same data; raises `UserError` for a number beyond a magnitude and for half a character."""
    for path, value in _unusable("", data, largest):
        if isinstance(value, str):
            raise UserError(f"{where}: found {ascii(value)[:60]}; a text without halves of characters is required")
        finite = largest <= abs(value) <= sys.float_info.max
        wanted = f"magnitudes up to {largest:g} are allowed" if finite else "a finite number is required"
        raise UserError(f"{_place(where, path)}: found {_FOUND.repr(value)}; {wanted}")
    return data


def _unusable(path: str, data: Any, largest: float, depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Numbers beyond a magnitude, those that are none, and texts that UTF-8 has not, each with its place."""
    if isinstance(data, dict | list):
        if depth > DEEPEST:
            raise RecursionError(f"brackets stand within each other more than {DEEPEST} deep")
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            if isinstance(key, str):
                yield from _unusable(path, key, largest)
            yield from _unusable(f"{path}.{key}" if isinstance(data, dict) else f"{path}[{key}]", value, largest, depth + 1)
    elif isinstance(data, str):
        if not data.isascii() and _HALF.search(data):
            yield path, data
    elif isinstance(data, float | int) and not abs(data) <= largest:  # integers may be beyond floats, too
        yield path, data


def _fault(path: str, data: Any, schema: Any) -> tuple[str, str]:
    """Place of the first wrong value, as deep as it lies, and what is wrong with it."""
    schema, meta = _simplified(data, schema)
    for step, value, inner in _parts(data, schema):
        try:
            msgspec.convert(value, inner)
        except msgspec.ValidationError:
            return _fault(path + step, value, inner)
    if _is_structure(schema) and isinstance(data, dict):
        fields = {f.encode_name: f for f in msgspec.structs.fields(schema)}
        for key in data if schema.__struct_config__.forbid_unknown_fields else ():
            if key not in fields:
                return path, f"unknown key {key!r}; allowed are {', '.join(fields)}{meant(key, fields)}"
        required = [key for key, field in fields.items() if field.required]
        missing = [key for key in required if key not in data]
        if missing:
            return path, f"key {missing[0]!r} is missing; required are {', '.join(required)}"
        try:
            msgspec.convert(data, schema)
        except msgspec.ValidationError as error:  # from `__post_init__`; what begins with a key belongs to that key
            key, colon, rest = str(error).partition(": ")
            return (f"{path}.{key}", rest) if colon and key.split("[")[0] in fields else (path, str(error))
    return path, f"found {_FOUND.repr(data)}; {_allowed(schema, meta)}"


def _is_structure(schema: Any) -> bool:
    return isinstance(schema, type) and issubclass(schema, msgspec.Struct)


def _container(schema: Any) -> type | None:
    """How JSON writes values of a type: as an object, as a list or as neither."""
    if _is_structure(schema) or get_origin(schema) is dict:
        return dict
    return list if get_origin(schema) in (list, tuple) else None


def _simplified(data: Any, schema: Any) -> tuple[Any, Meta]:
    """A type without its constraints, which stand apart; of a union the member that a value comes closest to."""
    meta = Meta()
    while get_origin(schema) in (Annotated, Union, types.UnionType):
        if get_origin(schema) is Annotated:
            schema, meta, *_ = get_args(schema)
            continue
        members = [member for member in get_args(schema) if member is not types.NoneType]
        alike = [m for m in members if isinstance(data, _container(_simplified(data, m)[0]) or str | float | int | None)]
        schema = [*alike, *members][0]
    return schema, meta


def _parts(data: Any, schema: Any) -> Iterator[tuple[str, Any, Any]]:
    """Values inside a value, each with the step to it and its type."""
    arguments = get_args(schema)
    if isinstance(data, dict) and _is_structure(schema):
        for field in msgspec.structs.fields(schema):
            if field.encode_name in data:
                yield f".{field.encode_name}", data[field.encode_name], field.type
    elif isinstance(data, dict) and get_origin(schema) is dict:
        for key, value in data.items():
            yield f".{key}", value, arguments[1]
    elif isinstance(data, list) and get_origin(schema) in (list, tuple):
        fixed = get_origin(schema) is tuple and arguments[1:] != (...,)
        if not fixed or len(data) == len(arguments):
            for i, value in enumerate(data):
                yield f"[{i}]", value, arguments[i if fixed else 0]


def _allowed(schema: Any, meta: Meta) -> str:
    """What a type admits, in words."""
    if meta.description:
        return meta.description
    arguments = get_args(schema)
    if get_origin(schema) is Literal:
        return f"allowed {'is' if len(arguments) == 1 else 'are'} {', '.join(map(repr, arguments))}"
    if _is_structure(schema):
        return f"an object with {', '.join(f.encode_name for f in msgspec.structs.fields(schema))} is required"
    if get_origin(schema) is tuple and arguments[1:] != (...,):
        numbers = all(_simplified(None, argument)[0] is float for argument in arguments)
        return f"a list of {len(arguments)} {'numbers' if numbers else 'entries'} is required"
    if get_origin(schema) in (list, tuple):
        return f"a list{' with at least one entry' if meta.min_length else ''} is required"
    if schema is float:
        least = f" of {meta.ge:g} or more" if meta.ge is not None else f" above {meta.gt:g}" if meta.gt is not None else ""
        bound = f" from {meta.ge:g} to {meta.le:g}" if None not in (meta.ge, meta.le) else least
        return f"a finite number{bound} is required"
    return {str: "a text", bool: "true or false"}.get(schema, "an object") + " is required"

"""Reference pages of the files that users write or get, made from the structures that read them.

`python -m docs.from_code.files [FOLDER]` writes them, by default to docs/reference; a test holds that they are current.
"""

import inspect
import re
import sys
import types
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec

from rrr_oc.calibration.model_file import ModelFile
from rrr_oc.codesign.catalogue import catalogue_schema
from rrr_oc.codesign.design_file import DesignFile
from rrr_oc.codesign.task import TaskFile
from rrr_oc.codesign.task_sets.task_set import TaskSetFile
from rrr_oc.diagnosis.files.diagnosis_file import DiagnosisFile
from rrr_oc.effects import ListedSpring, design_forms
from rrr_oc.effects.priors import Context, Given
from rrr_oc.effects.words import words
from rrr_oc.recordings.header import Header
from rrr_oc.recordings.importers.column_mapping import UNITS, ColumnMapping
from rrr_oc.recordings.springs import springs_schema
from rrr_oc.robot.drives import Drive
from rrr_oc.schema import spellings
from rrr_oc.storage import write_text

DESIGN = (
    "What a design found, for one task or for several; `rrr-oc design` writes it. `rrr-oc export` reads the springs of a configuration, and "
    "the page, the report and the figures are made from it. The cost's unit is in `quantity`."
)
DIAGNOSIS = "What a diagnosis found; `rrr-oc diagnose` writes it. Probabilities and p values are from 0 to 1."
UNIT = r" \[([^\],`]+)\](?=\.|$)"  # at the end of a sentence; a list of numbers in brackets is a default
COLUMNS = ("key", "type", "unit", "default", "allowed", "meaning")
# Units by the ending of a key, the longest ending first
ENDINGS = {
    "_A_s2_per_rad2": "A s²/rad²",
    "_deg_per_s2": "°/s²",
    "_deg_per_s3": "°/s³",
    "_A_s2_per_rad": "A s²/rad",
    "_A_s_per_rad": "A s/rad",
    "_Nm_per_rad3": "Nm/rad³",
    "_Nm_s_per_rad": "Nm s/rad",
    "_Nm_per_rad": "Nm/rad",
    "_kg_m2": "kg m²",
    "_deg_per_s": "°/s",
    "_N_per_m": "N/m",
    "_Nm_per_A": "Nm/A",
    "_A_per_Nm": "A/Nm",
    "_Ohm": "Ω",
    "_deg": "°",
    "_rad": "rad",
    "_Nm": "Nm",
    "_kg": "kg",
    "_mm": "mm",
    "_N": "N",
    "_J": "J",
    "_m": "m",
    "_s": "s",
    "_A": "A",
}


@dataclass(frozen=True)
class Page:
    """The page of one file.

    Attributes:
        title: Name of the file.
        what: What it is, who writes it and what reads it.
        structures: Heading and type of each object in it.
        example: File in `rrr_oc/data/examples` that shows it, "" for a file that programs write.
        notes: What is not in the structures.
    """

    title: str
    what: str
    structures: dict[str, Any]
    example: str = ""
    notes: str = ""


def pages() -> dict[str, str]:
    """The pages, by the name of their file."""
    return {f"{name}.md": _page(page) for name, page in _described().items()}


def _described() -> dict[str, Page]:
    json = (
        "JSON; comments go from `//` to the end of the line, and an object may also have `comment`, `description`, `license` and "
        "`source` with any text. "
    )
    priors = "TOML: a table `[context]`, and a table for each effect that differs, named as `rrr-oc effects` lists it."
    return {
        "recordings": Page(
            "recordings.json",
            f"What a recording set says about itself; you write it, beside the CSV files. {json}",
            {"recordings.json": Header, "springs of a recording": springs_schema()},
            "recordings.json",
            "The CSV columns are `t` [s], `q_<joint>` [rad], `tau_<joint>` [Nm] or `current_<joint>` [A] and, if measured, "
            "`dq_<joint>` [rad/s], `ddq_<joint>` [rad/s²] and `payload` [kg].",
        ),
        "task": Page(
            "task.json",
            f"What an arm has to do and which springs it may use; you write it. {json}",
            {"task.json": TaskFile},
            "task.json",
            _spring_notes(),
        ),
        "tasks": _of_tasks(json),
        "actuators": Page(
            "actuators.json",
            f"Drives of an arm, by joint; you write it. {json}Coefficients are those of Eq. 7 and 9, at the joint's output.",
            {"drive of a joint": Drive},
            "actuators.json",
        ),
        "catalogue": Page(
            "catalogue.json",
            f"Springs and pulleys that can be bought; you write it. {json}",
            {"catalogue.json": catalogue_schema()},
            "catalogue.json",
            _shop_notes(),
        ),
        "priors": Page(
            "priors.toml",
            f"What is known of the arm before it is diagnosed; you may write it. {priors}",
            {"context": Context, "table of an effect": Given},
            "priors.toml",
        ),
        "csv_mapping": Page(
            "mapping.toml",
            "Which columns of your own CSV files are what, and in which units; you write it, for `rrr-oc import csv`, "
            "`rrr-oc import arrays` and `rrr-oc import lerobot`. TOML.",
            {"mapping.toml": ColumnMapping},
            "csv_mapping.toml",
            _unit_notes(),
        ),
        "model": Page(
            "model.json",
            "A calibrated model; `rrr-oc calibrate` and `rrr-oc diagnose` write it, and `rrr-oc evaluate` reads it. Keys that are "
            "not known are ignored, so that files of later versions can be read.",
            {"model.json": ModelFile},
        ),
        "design": Page("summary.json", DESIGN, {"summary.json": DesignFile}),
        "diagnosis": Page("diagnosis.json", DIAGNOSIS, {"diagnosis.json": DiagnosisFile}),
    }


def _unit_notes() -> str:
    columns = (
        'Keys of `columns` are `t`, `q_<joint>` and `tau_<joint>`, or `current_<joint>` where `torque` is "current", or `command_<joint>` '
        'where it is "command", and, if '
        "measured, `dq_<joint>`, `ddq_<joint>` and `payload`. A value is factor (cell − zero). Units are:"
    )
    return (
        "\n".join([columns, "", *(f"- {what}: {', '.join(f'`{u}`' for u in units)};" for what, units in UNITS.items())])[:-1]
        + "."
    )


def _of_tasks(json: str) -> Page:
    return Page(
        "tasks.json",
        "Tasks of one arm that the same springs are to serve; you write it, and `rrr-oc design` takes it in the place of a task. Each task "
        f"has a motion of its own. {json}",
        {"tasks.json": TaskSetFile},
        "tasks.json",
        "What is uncertain is not known while springs and motions are designed, so the motion is the same in every case. Each combination "
        "of the ends of the intervals is a scenario, and the cost of a task is that of the worst. The load torque is affine in payload and "
        "inertial parameters, and E1 a convex quadratic, so no case in between is worse. The springs are those of the tasks' files, which "
        "must agree.",
    )


def _spring_notes() -> str:
    lines = ["Each of `springs` has the keys of its effect; bounds are `[least, greatest]`:", ""]
    for kind in design_forms().values():
        place = "`joints`: the two joints" if kind.placement == "pair" else "`joint`: the joint"
        options = [f"`{key}`: {_values(allowed)}; tried in every way if left out" for key, allowed in kind.options.items()]
        bounds = [f"`{key}`: bounds [{_unit(key, '')}]" for key in dict.fromkeys(q.key for q in kind.design.quantities)]
        beside = "or the name of a CSV file with these columns, beside the task's"
        tables = [f"`{key}`: a list of rows [{', '.join(columns)}], {beside}" for key, columns in kind.design.tables.items()]
        lines.append(f"- `effect`: `{kind.name}`; {place}; {'; '.join([*options, *bounds, *tables])}.")
    return "\n".join(lines)


def _shop_notes() -> str:
    lines = []
    for form in (kind.design for kind in design_forms().values()):
        if form.shop:
            one = len(form.bought) == 1
            keys = "joints" if one else ", ".join(f"`{q.key}`" for q in form.bought)
            lines.append(f"- The keys in `{form.shop}` are {keys}; each holds a list of sizes{', all are needed' * (not one)}.")
    return "\n".join(lines)


def _page(page: Page) -> str:
    parts = [f"# {page.title}", page.what.strip()]
    seen: dict[Any, list[str]] = {}
    for heading, schema in page.structures.items():
        for name, structure in _structures(heading, schema):
            seen[structure] = list(dict.fromkeys([*seen.get(structure, []), name]))
    for structure, headings in seen.items():
        heading = ", ".join(headings)
        parts += [f"## {heading[:1].upper() + heading[1:] if '.' not in heading else heading}", _table(structure)]
    if page.notes:
        parts.append(page.notes)
    if page.example:
        text = (files("rrr_oc.data") / "examples" / page.example).read_text(encoding="utf-8")
        parts += ["## Example", f"```{'toml' if page.example.endswith('toml') else 'jsonc'}\n{text.rstrip()}\n```"]
    return "\n\n".join(parts) + "\n"


def _structures(heading: str, schema: Any, keys: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """A structure and all that stand inside it, each with a heading: the keys that lead there."""
    yield heading, schema
    for one in msgspec.structs.fields(schema):
        for inner in _inside(one.type):
            there = *keys, one.encode_name
            yield from _structures(f"`{'.'.join(there)}`", inner, there)


def _inside(kind: Any) -> Iterator[Any]:
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        yield kind
    else:
        known: list[Any] = []
        for argument in get_args(kind):
            for inner in _inside(argument):
                if inner not in known:
                    known.append(inner)
                    yield inner


def _table(structure: Any) -> str:
    meanings = _meanings(structure)
    rows = [list(COLUMNS), ["---"] * len(COLUMNS)]
    for one in msgspec.structs.fields(structure):
        key, meaning = one.encode_name, meanings.get(one.name, "")
        unit = re.search(UNIT, meaning)
        allowed = _Allowed.of(one.type)
        default = "required" if one.required else _default(one)
        also = [f"`{name}`" for name in spellings(one.type) if name != key]
        shown = f"`{key}`" + f" or {', '.join(also)}" * bool(also)
        meaning = re.sub(UNIT, "", meaning, count=1) if unit else meaning
        rows.append([shown, allowed.kind, unit[1] if unit else _unit(key, allowed.kind), default, allowed.values, meaning])
    return "\n".join(f"| {' | '.join(cell.replace('|', '&#124;') for cell in row)} |" for row in rows)


def _meanings(structure: Any) -> dict[str, str]:
    """The sentence of each key, from "Attributes" in the docstring, or, of a structure made from effects, from the key's words."""
    texts = [inspect.cleandoc(kind.__doc__ or "") for kind in reversed(structure.__mro__) if issubclass(kind, msgspec.Struct)]
    listed = (text.partition("Attributes:\n")[2] for text in texts)
    found = [one for text in listed for one in re.findall(r"^    (\w+(?:, \w+)*): (.+(?:\n {8,}.+)*)", text, re.M)]
    given = {name: " ".join(meaning.split()) for names, meaning in found for name in names.split(", ")}
    made = {} if given else {one.name: _made(one.encode_name) for one in msgspec.structs.fields(structure)}
    return made | given


def _made(key: str) -> str:
    fixed = {
        "format": "What the file is.",
        "name": "Name in messages; by default the file's.",
        "joints": "The two joints that it spans.",
    }
    ending = next((e for e in ENDINGS if key.endswith(e)), "")
    for kind in design_forms().values():
        if issubclass(kind, ListedSpring) and key == kind.listing.key:
            return f"Springs of the kind `{kind.name}`{', by joint' * (kind.placement != 'pair')}; several in a list."
        if key == kind.design.shop:
            return f"What can be bought for a `{kind.name}`."
        if key in kind.options:
            return f"How it is mounted: each is {_values(kind.options[key])}."
    return fixed.get(key, f"{words(key.removesuffix(ending)).capitalize()} of the spring.")


def _unit(key: str, kind: str) -> str:
    if kind in ("text", "true or false"):
        return "–"
    return next((unit for ending, unit in ENDINGS.items() if key.endswith(ending)), "–")


def _default(one: Any) -> str:
    value = one.default if one.default is not msgspec.NODEFAULT else one.default_factory()
    if value is None or (isinstance(value, float) and not abs(value) < float("inf")):
        return "none"
    if isinstance(value, dict | list):
        return "none" if not value else f"`{value}`"
    text = list(value) if isinstance(value, tuple) else value
    return f"`{text}`" if not isinstance(text, str) else f'`"{text}"`'


def _values(values: Any) -> str:
    return " or ".join(f'`"{v}"`' if isinstance(v, str) else f"`{v}`" for v in values)


@dataclass(frozen=True)
class _Allowed:
    """A type in words, and the values that it admits."""

    kind: str
    values: str = field(default="any")

    @classmethod
    def of(cls, kind: Any) -> "_Allowed":
        origin, arguments = get_origin(kind), get_args(kind)
        if origin is Annotated:
            inner = cls.of(arguments[0])
            bounds = [text for meta in arguments[1:] for text in _bounds(meta)]
            return cls(inner.kind, " and ".join(bounds) or inner.values)
        if origin in (Union, types.UnionType):
            members = [cls.of(member) for member in arguments if member is not types.NoneType]
            kinds = dict.fromkeys(member.kind for member in members)
            return cls(" or ".join(kinds), "; ".join(dict.fromkeys(m.values for m in members)))
        if origin is Literal:
            return cls("text" if isinstance(arguments[0], str) else "number", _values(arguments))
        if origin is dict:
            inner = cls.of(arguments[1])
            return cls("object" if inner.kind == "anything" else f"object: {inner.kind} by name", inner.values)
        if origin is tuple and arguments[1:] != (...,):
            return cls(f"list of {len(arguments)} {_several(cls.of(arguments[0]).kind)}", cls.of(arguments[0]).values)
        if origin in (list, tuple):
            inner = cls.of(arguments[0])
            return cls(f"list of {_several(inner.kind)}", inner.values)
        known = {str: "text", float: "number", int: "whole number", bool: "true or false", Any: "anything"}
        return cls(known.get(kind, "object"))


def _several(kind: str) -> str:
    """The plural of a kind."""
    return kind.replace("list of ", "lists of ", 1) if kind.startswith("list of ") else f"{kind}s"


def _bounds(meta: msgspec.Meta) -> list[str]:
    signs = (("≥", meta.ge), (">", meta.gt), ("≤", meta.le), ("<", meta.lt))
    found = [f"{sign} {value:.5g}" for sign, value in signs if value is not None]
    found += [f"at least {meta.min_length} entries"] * bool(meta.min_length and meta.min_length > 1)
    return found + ["at least one entry"] * (meta.min_length == 1)


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/reference")
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in pages().items():
        write_text(folder / name, content)

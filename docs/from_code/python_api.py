"""The reference page of `import rrr_oc`: its functions with all their options, and their results, made from the code.

It is written when the site of the documentation is built.
"""

import inspect
import re
import types
from enum import Enum
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import rrr_oc
from rrr_oc.commands import load
from rrr_oc.python import functions, results

RESULTS = ("Recordings", "Model", "Diagnosis", "Design", "Simulation", "Export", "Comparison", "Picture")
FUNCTIONS = tuple(name for name in rrr_oc.__all__ if not name.startswith("_"))
KINDS = {bool: "true or false", int: "whole number", float: "number", str: "text", Path: "path"}
MODULES = r"(?:pathlib\._local\.|pathlib\.|rrr_oc\.python\.results\.|collections\.abc\.|typing\.)"  # which signatures name
NOT_OPTIONS = ("out", "as_json", "help")  # out is an argument of the functions


def page() -> str:
    """The page, in Markdown."""
    parts = [
        "# Reference of `import rrr_oc`",
        "Made from the code. [In Python](../python.md) has examples, and says what all results have in common: `repr`, `table()`, "
        "`to_dataframe()`, `content` and `folder`. Options of the command of a function's name are its keywords; a list may take the place of "
        "what is comma-separated at the console.",
        "## Functions",
        *(_function(name) for name in FUNCTIONS),
        "## Results",
        *(_result(name) for name in RESULTS),
    ]
    return "\n\n".join(parts) + "\n"


def _function(name: str) -> str:
    function = getattr(functions, name)
    says, arguments, rest = _docstring(function)
    parts = [f"### `{name}`", f"```python\nrrr_oc.{name}{_signature(function)}\n```", says]
    if arguments:
        parts.append("\n".join(["| argument | meaning |", "| --- | --- |", *(f"| `{a}` | {text} |" for a, text in arguments)]))
    if "options" in inspect.signature(function).parameters:
        parts.append(options(name))
    return "\n\n".join([*parts, *([rest] if rest else [])])


def options(name: str) -> str:
    """Table of a command's options as keywords."""
    rows = ["| option | type | default | meaning |", "| --- | --- | --- | --- |"]
    command = load(name)
    hints = get_type_hints(inspect.unwrap(command.callback))
    for one in command.params:
        if one.param_type_name == "option" and one.name not in NOT_OPTIONS:
            kind = _type(hints[one.name])
            default = "–" if one.default is None else f"`{one.default}`"
            rows.append(f"| `{one.name}` | {kind} | {default} | {_cell(one.help)} |")
    return "\n".join(rows)


def _type(hint: Any) -> str:
    """A type in words."""
    kinds = [one for one in (get_args(hint) if isinstance(hint, types.UnionType) else (hint,)) if one is not type(None)]
    values = (
        get_args(kinds[0]) if get_origin(kinds[0]) is Literal else [one.value for one in kinds[0]] if _is_enum(kinds[0]) else ()
    )
    if values:
        return " or ".join(f"`{value!r}`" for value in values)
    return " or ".join(KINDS.get(one, getattr(one, "__name__", str(one))) for one in kinds)


def _is_enum(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Enum)


def _result(name: str) -> str:
    kind = getattr(results, name)
    rows = []
    for key, member in vars(kind).items():
        if key.startswith("_") and key != "__getitem__":
            continue
        shown, found = _member(key, member)
        if found and inspect.getdoc(found):
            rows.append(f"| `{shown}` | {_cell(inspect.getdoc(found))} |")
    table = "\n".join(["| has | which is |", "| --- | --- |", *rows]) if rows else ""
    return "\n\n".join(x for x in (f"### `{name}`", _cell(inspect.getdoc(kind)), table) if x)


def _member(key: str, member: Any) -> tuple[str, Any]:
    """A member as it is written in a program, and what has its docstring; no docstring of a type that it merely holds."""
    if inspect.isfunction(member):
        names = list(inspect.signature(member).parameters)[1:]
        return (f"[{names[0]}]" if key == "__getitem__" else f".{key}({', '.join(names)})"), member
    found = member if isinstance(member, property) else getattr(member, "func", None)
    return f".{key}", found


def _signature(function: Any) -> str:
    """Arguments, one a line, and what is returned."""
    signature = inspect.signature(function)
    lines = [f"    {re.sub(MODULES, '', str(one))},\n" for one in signature.parameters.values()]
    return f"(\n{''.join(lines)}) -> {signature.return_annotation.__name__}"


def _docstring(function: Any) -> tuple[str, list[tuple[str, str]], str]:
    """What a function does, its arguments with their meanings, and what it raises."""
    text = inspect.getdoc(function) or ""
    says, _, rest = text.partition("\nArgs:\n")
    block, _, raises = rest.partition("\n\n")
    arguments = re.findall(r"^    (\w[\w, ]*): (.*(?:\n     +.*)*)", block, re.M)
    return " ".join(says.split()), [(a, _cell(t)) for a, t in arguments], " ".join(raises.split())


def _cell(text: str | None) -> str:
    return " ".join((text or "").split()).replace("\\[", "[").replace("|", "\\|")

"""The reference of Python: every function with every option of its command, and every result that a function returns."""

import inspect
import re

import rrr_oc
from docs.from_code.python_api import FUNCTIONS, RESULTS, options, page
from rrr_oc.commands import load
from rrr_oc.python import functions, results

PAGE = page()


def section(name: str) -> str:
    return PAGE.split(f"### `{name}`\n")[1].split("\n## ")[0].split("\n### ")[0]


def test_every_function_and_every_result_has_a_section():
    assert set(FUNCTIONS) == {name for name in rrr_oc.__all__ if not name.startswith("_")}
    returned = {inspect.signature(getattr(functions, name)).return_annotation.__name__ for name in FUNCTIONS} - {"Result"}
    assert returned < set(RESULTS)
    assert all(len(section(name)) > 50 for name in (*FUNCTIONS, *RESULTS))


def test_every_option_is_a_row_with_its_type_and_its_meaning():
    for name in set(FUNCTIONS) - {"load", "compare"}:
        known = {p.name for p in load(name).params if p.param_type_name == "option"} - {"out", "as_json", "help"}
        rows = [re.split(r" (?<!\\\\)\| ", line.strip("| ")) for line in options(name).splitlines()[2:]]
        assert {row[0].strip("`") for row in rows} == known
        assert all(len(row) == 4 and all(row) for row in rows), rows
    assert "| `samples` | whole number | `0` |" in section("export")
    assert "| `way` | `'inverse'` or `'response'` or `'evolution'` |" in section("calibrate")


def test_every_public_member_of_a_result_is_a_row():
    for name in RESULTS:
        kind, text = getattr(results, name), section(name)
        for member in (m for m in vars(kind) if not m.startswith("_")):
            assert re.search(rf"^\| `\.{member}\b", text, re.M), (name, member)
    assert "| `[name]` |" in section("Design")

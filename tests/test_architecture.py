"""The house as docs/architecture.md describes it: its folders, and imports that go one way between them."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "rrr_oc"
MAP = ROOT / "docs" / "architecture.md"
START = {"cli": {"commands"}, "__main__": {"cli"}}  # where the command line begins, and what it hands over to
ROOT_MODULES = ("errors", "storage", "schema", "kept", "progress", "parallel", "compiler")  # which every folder may import
VISIBLE = ("commands", "report")  # the only places that plot or print
MODULES = sorted(PACKAGE.rglob("*.py"))


def folders_of_the_map() -> dict[str, set[str]]:
    """Folders and what each may import, from the table of the map, from the ground up."""
    rows = re.findall(r"^\| `(\w+)/?` \| .*? \| (.*?) \|$", MAP.read_text(), re.M)
    return {folder: set(re.findall(r"`(\w+)`", allowed)) for folder, allowed in rows}


def folder_of(path: Path) -> str:
    """The folder below `rrr_oc` that a module stands in, or its own name at the root."""
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imported(text: str, package: tuple[str, ...] = ()) -> set[str]:
    """Full names of everything that a file imports, anywhere in it; `from a import b` counts as a and as a.b."""
    names = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*above, *([node.module] if node.module else [])])
            names |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    return names


def imports_of(path: Path) -> set[str]:
    return imported(path.read_text(), ("rrr_oc", *path.relative_to(PACKAGE).parts[:-1]))


def test_the_map_shows_the_folders_that_there_are():
    there = {p.name for p in PACKAGE.iterdir() if p.is_dir() and any(p.glob("*.py"))}
    assert set(folders_of_the_map()) == there


def test_the_map_goes_from_the_ground_up():
    below: set[str] = set()
    for folder, allowed in folders_of_the_map().items():
        assert allowed <= below, f"{folder} may import {', '.join(allowed - below)}, which stand further down in the map"
        below.add(folder)


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_one_way(path):
    own, allowed = folder_of(path), folders_of_the_map()
    places = {name.split(".")[1] for name in imports_of(path) if name.startswith("rrr_oc.")} - {"__version__"}
    may = set(ROOT_MODULES) | (allowed[own] | {own} if own in allowed else START.get(own, set()))
    assert places <= may, f"{path.relative_to(ROOT)} imports from {', '.join(sorted(places - may))}"


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_the_package_does_not_know_studies_validation_and_tests(path):
    assert not {name.split(".")[0] for name in imports_of(path)} & {"studies", "validation", "tests", "chains", "conftest"}


@pytest.mark.parametrize("path", [p for p in MODULES if folder_of(p) not in VISIBLE], ids=lambda p: str(p.relative_to(PACKAGE)))
def test_plots_and_printing_live_away_from_numbers(path):
    assert not {name.split(".")[0] for name in imports_of(path)} & {"matplotlib", "rich", "typer"}
    calls = [node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    assert not [f for f in calls if isinstance(f, ast.Name) and f.id == "print"], f"{path} prints"


@pytest.mark.parametrize("folder", sorted({p.parent for p in MODULES} - {PACKAGE}), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_every_folder_says_what_lives_in_it(folder):
    assert ast.get_docstring(ast.parse((folder / "__init__.py").read_text())), f"{folder}/__init__.py has no docstring"
    assert len(list(folder.glob("*.py"))) <= 14, f"{folder.relative_to(ROOT)} has too many files to be read at a glance"


def functions_of(path: Path):
    tree = ast.parse(path.read_text())
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_functions_are_short_and_take_few_arguments(path):
    for function in functions_of(path):
        lines, a = (function.end_lineno or 0) - function.lineno + 1, function.args
        names = [x.arg for x in (*a.posonlyargs, *a.args, *a.kwonlyargs) if x.arg not in ("self", "cls")]
        assert lines <= 60, f"{path.name}:{function.name} has {lines} lines"
        command = any(isinstance(d, ast.Call) and ast.unparse(d.func).endswith(".command") for d in function.decorator_list)
        assert len(names) <= 6 or command, f"{path.name}:{function.name} takes {len(names)} arguments"


def test_the_reader_of_imports_sees_all_forms():
    """The test's own tool, on a file with every way to import."""
    text = "import a.b\ndef f():\n    from c import d\n    from . import e\n    from .g import h\n    from ..i import j\n"
    assert {"a.b", "c.d", "rrr_oc.effects.e", "rrr_oc.effects.g", "rrr_oc.i"} <= imported(text, ("rrr_oc", "effects"))

"""The house as docs/architecture.md describes it: its folders, and imports that go one way between them."""

import ast
import re
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "rrr_oc"
MAP = ROOT / "docs" / "architecture.md"
# Where the command line and `import rrr_oc` begin, and what they hand over to
START = {"cli": {"commands"}, "__main__": {"cli"}, "__init__": {"python"}}
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


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def imports_of(path: Path) -> set[str]:
    return imported(path.read_text(), ("rrr_oc", *path.relative_to(PACKAGE).parts[:-1]))


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def test_the_map_shows_the_folders_that_there_are():
    there = {p.name for p in PACKAGE.iterdir() if p.is_dir() and any(p.glob("*.py"))}
    assert set(folders_of_the_map()) == there


def test_the_map_goes_from_the_ground_up():
    below: set[str] = set()
    for folder, allowed in folders_of_the_map().items():
        assert allowed <= below, f"{folder} may import {', '.join(allowed - below)}, which stand further down in the map"
        below.add(folder)


def test_imports_go_one_way():
    map_, wrong = folders_of_the_map(), {}
    for path in MODULES:
        own = folder_of(path)
        places = {name.split(".")[1] for name in imports_of(path) if name.startswith("rrr_oc.")} - {"__version__"}
        may = set(ROOT_MODULES) | (map_[own] | {own} if own in map_ else START.get(own, set()))
        if not places <= may:
            wrong[name_of(path)] = sorted(places - may)
    assert wrong == {}, "modules, and folders that they must not import from"


def test_no_file_needs_itself():
    """Through whatever others, also where only types are imported. `rrr_oc` itself hands out what is below it, and its version."""
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in MODULES}
    names.pop("rrr_oc")
    needs = {name: imports_of(path) & names.keys() - {name} for name, path in names.items()}
    assert len(list(TopologicalSorter(needs).static_order())) == len(names)  # in a circle there is no order


def test_the_package_does_not_know_studies_validation_and_tests():
    others = {"studies", "validation", "tests", *(path.stem for path in (ROOT / "tests").rglob("*.py"))}
    found = {name_of(path): {name.split(".")[0] for name in imports_of(path)} & others for path in MODULES}
    assert {path: names for path, names in found.items() if names} == {}


def test_validation_does_not_know_studies():
    """Which may import what they share with it."""
    others = {"studies", *(path.stem for path in (ROOT / "studies").glob("*.py"))}
    found = {path: {name.split(".")[0] for name in imported(path.read_text())} for path in (ROOT / "validation").rglob("*.py")}
    assert [name_of(path) for path, names in found.items() if names & others] == []


def test_plots_and_printing_live_away_from_numbers():
    wrong = {}
    for path in (p for p in MODULES if folder_of(p) not in VISIBLE):
        found = {name.split(".")[0] for name in imports_of(path)} & {"matplotlib", "rich", "typer"}
        calls = [node.func for node in ast.walk(parsed(path)) if isinstance(node, ast.Call)]
        found |= {f"print in line {f.lineno}" for f in calls if isinstance(f, ast.Name) and f.id == "print"}
        if found:
            wrong[name_of(path)] = sorted(found)
    assert wrong == {}


def test_every_folder_says_what_lives_in_it_and_is_read_at_a_glance():
    folders = sorted({p.parent for p in MODULES} - {PACKAGE})
    assert [name_of(f) for f in folders if not ast.get_docstring(parsed(f / "__init__.py"))] == [], "no docstring"
    counts = {name_of(f): len(list(f.glob("*.py"))) for f in folders}
    assert {folder: count for folder, count in counts.items() if count > 14} == {}, "too many files"


def test_a_class_has_a_name_of_its_own():
    """But for the results that `rrr_oc/python` hands to people, which are named as what they hold."""
    where: dict[str, list[str]] = {}
    for path in (p for p in MODULES if folder_of(p) != "python"):
        for node in parsed(path).body:
            if isinstance(node, ast.ClassDef):
                where.setdefault(node.name, []).append(name_of(path))
    assert {name: files for name, files in where.items() if len(files) > 1} == {}


def test_functions_are_short_and_take_few_arguments():
    wrong = []
    for path in MODULES:
        for function in ast.walk(parsed(path)):
            if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            lines, a = (function.end_lineno or 0) - function.lineno + 1, function.args
            names = [x.arg for x in (*a.posonlyargs, *a.args, *a.kwonlyargs) if x.arg not in ("self", "cls")]
            command = any(isinstance(d, ast.Call) and ast.unparse(d.func).endswith(".command") for d in function.decorator_list)
            if lines > 60:
                wrong.append(f"{name_of(path)}: {function.name} has {lines} lines")
            if len(names) > 6 and not command:
                wrong.append(f"{name_of(path)}: {function.name} takes {len(names)} arguments")
    assert wrong == []


def test_the_reader_of_imports_sees_all_forms():
    """The test's own tool, on a file with every way to import."""
    text = "import a.b\ndef f():\n    from c import d\n    from . import e\n    from .g import h\n    from ..i import j\n"
    assert {"a.b", "c.d", "rrr_oc.effects.e", "rrr_oc.effects.g", "rrr_oc.i"} <= imported(text, ("rrr_oc", "effects"))

"""The ladder of imports, read from the source: every module imports from rungs below its own only."""

import ast
from fnmatch import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "rrr_oc"

# From the ground up. A module imports from rungs below its own; of the side branches "control", "recordings" and "simulation"
# none imports from another. Names are below `rrr_oc`; to the folders `effects.*` and `importers.*` files may be added freely.
LADDER = (
    ("trunk", ("errors",)),
    ("trunk", ("smooth", "savitzky_golay", "akima", "oscillator", "_rigid_body", "_along")),
    ("trunk", ("files", "parallel", "parameters", "csv_table", "metrics", "nrmse", "c_library", "ranking")),
    ("trunk", ("robot", "runs", "effects.effect")),
    ("trunk", ("rigid_body", "effects.*")),
    ("trunk", ("effects", "inertial")),
    ("trunk", ("model",)),
    ("control", ("actuator", "task", "problem")),
    ("control", ("collocation",)),
    ("control", ("solve",)),
    ("control", ("optimality", "codesign")),
    ("control", ("search", "candidates")),
    ("control", ("catalogue", "certificate", "parametrised", "fixed_motion")),
    ("recordings", ("recording_header", "plausibility")),
    ("recordings", ("recordings",)),
    ("recordings", ("importers.*", "physics")),
    ("recordings", ("importers", "calibrated", "sweeps")),
    ("recordings", ("regression",)),
    ("recordings", ("inference", "excitation", "signatures")),
    ("recordings", ("widths",)),
    ("recordings", ("calibrate", "evidence")),
    ("recordings", ("fitting",)),
    ("recordings", ("diagnose",)),
    ("recordings", ("contest", "reversals")),
    ("recordings", ("locate", "suggest")),
    ("recordings", ("diagnosis",)),
    ("recordings", ("diagnosis_file",)),
    ("simulation", ("native",)),
    ("simulation", ("twin",)),
    ("simulation", ("simulate",)),
    ("results", ("outcome", "replay", "rollouts", "figures")),
    ("results", ("report", "evaluate", "calibrate_simulated", "transfer", "evolution")),
    ("results", ("before_after", "experiments")),
    ("results", ("diagnosis_report", "comparison")),
    ("results", ("cli",)),
)
BRANCHES = {"control", "recordings", "simulation"}
VISIBLE = {"report", "figures", "diagnosis_report", "cli"}  # the only modules that plot or print


def modules() -> dict[str, Path]:
    """The package's modules by their name below `rrr_oc`; the compiled one by its source."""
    found = {}
    for path in [*PACKAGE.rglob("*.py"), *PACKAGE.glob("*.cpp")]:
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        if name and not (path.name == "__init__.py" and not path.read_text().strip("\n").count("import")):
            found[name] = path
    return found


MODULES = modules()


def rung(module: str) -> int:
    """Where a module stands, an exact name before a pattern; -1 where it is not in the table."""
    exact = [i for i, (_, names) in enumerate(LADDER) if module in names]
    return (exact + [i for i, (_, names) in enumerate(LADDER) if any(fnmatch(module, n) for n in names)] + [-1])[0]


def imported(path: Path, package: tuple[str, ...] = ()) -> set[str]:
    """Full names of everything that a file imports, anywhere in it; `from a import b` counts as a and as a.b."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = (
                [*package[: len(package) - node.level + 1], *([node.module] if node.module else [])]
                if node.level
                else [node.module]
            )
            names |= {".".join(base), *(".".join([*base, alias.name]) for alias in node.names)}
    return names


def own_imports(module: str) -> set[str]:
    """The modules of this package that a module imports."""
    path = MODULES[module]
    if path.suffix == ".cpp":
        return set()
    package = ("rrr_oc", *path.relative_to(PACKAGE).parts[:-1])
    inside = {n.removeprefix("rrr_oc.") for n in imported(path, package) if n.startswith("rrr_oc.")}
    found = inside & set(MODULES)
    return {m for m in found if not any(other.startswith(f"{m}.") for other in found)} - {module}


@pytest.mark.parametrize("module", sorted(MODULES))
def test_every_module_stands_on_the_ladder(module):
    assert rung(module) >= 0, f"rrr_oc/{module.replace('.', '/')} is new: give it its rung in LADDER of tests/test_ladder.py"


def test_the_ladder_names_no_module_that_is_gone():
    gone = [n for _, names in LADDER for n in names if not any(fnmatch(m, n) for m in MODULES)]
    assert not gone, f"LADDER of tests/test_ladder.py still has {', '.join(gone)}"


@pytest.mark.parametrize("module", sorted(MODULES))
def test_imports_go_down_only(module):
    here = rung(module)
    for other in own_imports(module):
        assert rung(other) < here, f"{module} (rung {here}) imports {other} (rung {rung(other)}): imports go one way, downwards"
        branches = {LADDER[here][0], LADDER[rung(other)][0]}
        assert len(branches & BRANCHES) < 2, (
            f"{module} imports {other}: the branches {' and '.join(branches)} do not know each other"
        )


@pytest.mark.parametrize("module", sorted(MODULES))
def test_the_package_does_not_know_studies_validation_and_tests(module):
    if MODULES[module].suffix == ".py":
        tops = {n.split(".")[0] for n in imported(MODULES[module]) if n}
        assert not tops & {"studies", "validation", "tests", "chains", "conftest"}


@pytest.mark.parametrize("module", sorted(set(MODULES) - VISIBLE))
def test_plots_and_printing_live_away_from_numbers(module):
    path = MODULES[module]
    if path.suffix == ".py":
        assert not {n.split(".")[0] for n in imported(path) if n} & {"matplotlib", "rich", "typer"}
        calls = [node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
        assert not [f for f in calls if isinstance(f, ast.Name) and f.id == "print"], f"{module} prints"


def test_the_reader_of_imports_sees_all_forms(tmp_path):
    """The test's own tool, on a file with every way to import."""
    path = tmp_path / "x.py"
    path.write_text(
        "import a.b\ndef f():\n    from c import d\n    from . import e\n    from .g import h\n    from ..i import j\n"
    )
    found = imported(path, ("rrr_oc", "effects"))
    assert {"a.b", "c.d", "rrr_oc.effects.e", "rrr_oc.effects.g", "rrr_oc.i"} <= found

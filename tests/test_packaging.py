"""The package's metadata against the repository and what is installed: constraints and licences of dependencies, the cited version,
the hooks and `make lint`."""

import hashlib
import importlib.util
import re
import subprocess
import sys
import tomllib
from email.message import Message
from pathlib import Path
from typing import Any, cast

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import rrr_oc
from docs import dependencies
from rrr_oc.errors import UserError
from rrr_oc.report.pages.page import PLOTLY

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
FOR_USERS = [
    Requirement(line)
    for line in (*PROJECT["dependencies"], *(line for k, lines in EXTRAS.items() if k != "test" for line in lines))
]
FOR_TESTS = [Requirement(line) for line in EXTRAS["test"] if not line.startswith("rrr_oc[")]
COMPILED_AGAINST = ("casadi", "pin")
TEMPLATES = Path(rrr_oc.__file__).parent / "report" / "templates"


def pins(name: str) -> dict[str, str]:
    """Package to version, of a constraints file."""
    lines = [line for line in (ROOT / "constraints" / name).read_text().splitlines() if line and not line.startswith("#")]
    return dict(line.split("==") for line in lines)


def test_exact_versions_lie_in_their_ranges():
    exact = pins("ci.txt")
    assert {str(r): exact[r.name] for r in (*FOR_USERS, *FOR_TESTS) if not r.specifier.contains(exact[r.name])} == {}


def test_lowest_versions_are_the_lower_bounds():
    lowest, wrong = pins("lowest.txt"), {}
    for requirement in FOR_USERS:
        pinned, bounds = lowest[requirement.name], [s.version for s in requirement.specifier if s.operator == ">="]
        of_bound = {f"{bound}{zeros}" for bound in bounds for zeros in ("", ".0", ".0.0")}
        if len(bounds) != 1 or pinned not in of_bound or not requirement.specifier.contains(pinned):
            wrong[str(requirement)] = pinned
    assert wrong == {}


def test_only_what_the_extension_is_compiled_against_has_an_upper_end():
    """A library that asks for an exact version, or for an old one, cannot be installed beside others."""
    operators = {r.name: {s.operator for s in r.specifier} for r in FOR_USERS}
    assert operators == {r.name: {">=", "<"} if r.name in COMPILED_AGAINST else {">="} for r in FOR_USERS}


def test_the_extension_is_built_with_exact_versions_with_which_it_also_runs():
    build = {r.name: r.specifier for r in dependencies.requirements()[dependencies.BUILD]}
    assert {name: str(exact) for name, exact in build.items()} == {name: f"=={dependencies.pinned()[name]}" for name in build}
    run = {r.name: r.specifier for r in FOR_USERS}
    assert all(run[name].contains(dependencies.pinned()[name]) for name in COMPILED_AGAINST)


@pytest.mark.parametrize(
    "module", ["robot._rigid_body", "numerics._along", "numerics._stepping", "calibration.estimator._evidence"]
)
def test_a_compiled_extension_does_not_name_the_folder_where_it_was_compiled(module):
    """Else its bytes, and the wheel's, are others in every build; see docs/supply_chain.md."""
    found = importlib.util.find_spec(f"rrr_oc.{module}")
    assert found is not None
    named = re.findall(rb"/[\w./-]*(?:site-packages|cmeel\.prefix|include)/[\w./-]+", Path(found.origin or "").read_bytes())
    assert [path for path in named if not path.startswith(b"/cmeel.prefix")] == []


def test_the_citation_names_this_version():
    text = (ROOT / "CITATION.cff").read_text()
    assert re.search(r"^version: (\S+)$", text, re.M)[1] == rrr_oc.__version__  # type: ignore[index]
    assert re.search(r"^license: (\S+)$", text, re.M)[1] == PROJECT["license"]  # type: ignore[index]


def test_hooks_are_the_checks_of_make_lint():
    commands = re.search(r"^lint:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.M)
    assert commands is not None
    lint = set(
        re.findall(r"\$\(VENV\)/bin/(\w+ ?(?:check|format)?)", commands[1].replace("--pythonpath $(VENV)/bin/python", ""))
    )
    hooks = set(re.findall(r"entry: \.venv/bin/(\w+ ?(?:check|format)?)", (ROOT / ".pre-commit-config.yaml").read_text()))
    assert {name.strip() for name in lint} == {name.strip() for name in hooks}


def test_types_are_packaged():
    assert (ROOT / "rrr_oc" / "py.typed").exists()
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert "py.typed" in setuptools["package-data"]["rrr_oc"]


def test_advice_on_missing_packages_names_those_of_an_extra():
    """This package is on no index, so that pip cannot install its extras by name."""
    texts = [path.read_text() for path in (*(ROOT / "rrr_oc").rglob("*.py"), *(ROOT / "docs").glob("*.md"))]
    advice = [
        found
        for text in texts
        for found in re.findall(r"pip install ('?[a-z][\w\[\], -]*?)(?= brings|[`\"',;]| installs)", text)
    ]
    extras = [{Requirement(line).name for line in lines} for lines in EXTRAS.values()]
    assert len(advice) >= 5
    assert [one for one in advice if not one.startswith(("rrr_oc", "pre-commit")) and set(one.split()) not in extras] == []
    assert not any("pip install 'rrr_oc[" in text for text in texts)


REACHED = dependencies.reached()


def test_all_that_is_installed_is_pinned_in_the_version_that_is_installed():
    pinned = dependencies.pinned()
    installed = {name: one.version for name, (one, _) in REACHED.items() if one is not None}
    assert {name: (version, pinned.get(name)) for name, version in installed.items() if version != pinned.get(name)} == {}
    assert {name for name, (one, parts) in REACHED.items() if one is None and parts != {dependencies.BUILD}} == set()


def test_nothing_else_is_pinned():
    assert set(dependencies.pinned()) == set(REACHED)


def test_what_is_installed_fits_together():
    done = subprocess.run([sys.executable, "-m", "pip", "check"], capture_output=True, text=True)
    named = [line for line in done.stdout.splitlines() if canonicalize_name(line.split()[0]) in REACHED]
    assert done.returncode == 0 or not named, done.stdout


def test_the_page_of_licences_is_that_of_what_is_installed():
    assert dependencies.PAGE.read_text() == dependencies.page(), "python docs/dependencies.py writes it anew"


@pytest.mark.parametrize(
    ("script", "licence"), [(TEMPLATES / PLOTLY, "plotly-basic.LICENSE"), (ROOT / "docs/katex/katex.min.js", "LICENSE")]
)
def test_the_scripts_of_pages_are_those_that_are_documented(script, licence):
    shipped = hashlib.sha256(script.read_bytes()).hexdigest()
    assert f"`{shipped}`" in (ROOT / "docs" / "supply_chain.md").read_text()
    assert "MIT License" in (script.parent / licence).read_text()


def test_an_unknown_licence_is_refused():
    class Made:
        metadata = Message()

    Made.metadata["License-Expression"] = "MIT AND GPL-3.0-only"
    with pytest.raises(UserError, match=r"made: its licence is 'MIT AND GPL-3.0-only'; docs/dependencies\.py knows 0BSD"):
        dependencies.licence("made", cast(Any, Made))


def test_files_that_begin_first_are_there():
    names = re.findall(r'^    "(\w+/\w+\.py)",$', (ROOT / "tests" / "conftest.py").read_text(), re.M)
    assert names
    assert [name for name in names if not (ROOT / "tests" / name).is_file()] == []

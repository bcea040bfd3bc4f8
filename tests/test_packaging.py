"""The package's metadata against the repository: constraints for each dependency, the cited version, the hooks and `make lint`."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import rrr_oc

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
FOR_USERS = [
    Requirement(line)
    for line in (*PROJECT["dependencies"], *(line for k, lines in EXTRAS.items() if k != "test" for line in lines))
]
FOR_TESTS = [Requirement(line) for line in EXTRAS["test"] if not line.startswith("rrr_oc[")]
COMPILED_AGAINST = ("casadi", "pin")


def pins(name: str) -> dict[str, str]:
    """Package to version, of a constraints file."""
    lines = [line for line in (ROOT / "constraints" / name).read_text().splitlines() if line and not line.startswith("#")]
    return dict(line.split("==") for line in lines)


@pytest.mark.parametrize("requirement", [*FOR_USERS, *FOR_TESTS], ids=str)
def test_the_exact_version_lies_in_the_range(requirement):
    assert requirement.specifier.contains(pins("ci.txt")[requirement.name])


@pytest.mark.parametrize("requirement", FOR_USERS, ids=str)
def test_the_lowest_version_is_the_lower_bound(requirement):
    lowest = pins("lowest.txt")[requirement.name]
    assert requirement.specifier.contains(lowest)
    bounds = [s.version for s in requirement.specifier if s.operator in (">=", "==")]
    assert len(bounds) == 1
    assert lowest in (bounds[0], f"{bounds[0]}.0", f"{bounds[0]}.0.0")


@pytest.mark.parametrize("requirement", FOR_USERS, ids=str)
def test_only_what_the_extension_is_compiled_against_is_exact(requirement):
    """An exact version in a library cannot be installed beside anything else."""
    exact = any(s.operator == "==" for s in requirement.specifier)
    assert exact == (requirement.name in COMPILED_AGAINST)


def test_the_extension_is_built_with_the_versions_that_it_runs_with():
    build = {
        r.name: str(r.specifier)
        for r in map(Requirement, tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"])
    }
    run = {r.name: str(r.specifier) for r in FOR_USERS}
    assert {name: build[name] for name in COMPILED_AGAINST} == {name: run[name] for name in COMPILED_AGAINST}


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

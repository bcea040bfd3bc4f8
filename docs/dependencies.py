"""What an installation of this package brings along, with versions and licences; run as a program, it writes docs/licences.md.

    .venv/bin/python docs/dependencies.py

Requirements are read from pyproject.toml and, for everything below, from what is installed; so it needs an environment with all
extras in the versions of constraints/ci.txt, which `make test` makes.
"""

import re
import tomllib
from collections.abc import Iterator
from importlib.metadata import Distribution, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from rrr_oc.errors import UserError
from rrr_oc.report.tables import markdown
from rrr_oc.storage import write_text

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "licences.md"
RUN, BUILD = "run", "build"  # the parts beside extras
TOPIC = re.compile(r"(?!License )[A-Z][A-Za-z ]+ :: ")  # of a classifier that is not about licences
# What metadata of distributions say in place of an SPDX expression.
SPELLED = {
    "2-clause BSD": "BSD-2-Clause",
    "Apache 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "BSD License": "BSD",  # with two clauses or three; there is no identifier for "either"
    "GNU Lesser General Public License v3 or later (LGPLv3+)": "LGPL-3.0-or-later",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
}
# Where metadata say nothing or too little; of what only the build needs.
READ_IN_FILES = {"apsw": "Zlib", "cmeel-eigen": "MPL-2.0", "cmeel-qhull": "Qhull", "partd": "BSD-3-Clause", "setuptools": "MIT"}
PERMISSIVE = "0BSD Apache-2.0 BSD BSD-2-Clause BSD-3-Clause BSL-1.0 CC0-1.0 ISC MIT MIT-CMU PSF-2.0 Qhull Zlib"
PERMITS = dict.fromkeys(PERMISSIVE.split(), "permissive") | {
    "LGPL-3.0-or-later": "weak copyleft",
    "MPL-2.0": "weak copyleft",
}
HEAD = """\
# Licences of dependencies

`.venv/bin/python docs/dependencies.py` writes this page from the metadata of what is installed, in the versions of
`constraints/ci.txt`; a test compares the two. It is no legal advice.

This package is MIT licensed. pip installs each of the distributions below under its own licence; none is part of this package's wheel.

- **Permissive** licences (MIT, BSD, Apache-2.0, ISC, PSF, Zlib, BSL and the like) ask that their text be kept. They are compatible with
  MIT.
- **Weak copyleft** licences (LGPL, MPL, EPL) permit use by a program of any licence, so they are compatible with MIT, too. Whoever
  changes their files and passes them on must publish the changes under the same licence.
- **Strong copyleft** licences (GPL) would extend to a program that is made with them. No distribution is under one; a program that one
  of them carries is (see `imageio-ffmpeg`).

## Copyleft

"""
INSIDE = """\
Wheels carry programs and libraries of others that their metadata do not name. Those with a copyleft, as far as the licences that
lie in the wheels of these versions say:

- `casadi` (run) carries CasADi itself (LGPL-3.0), IPOPT, METIS's interface, CBC, CLP, Bonmin and other COIN-OR solvers (EPL-2.0 and
  EPL-1.0), MUMPS (CeCILL-C), qpOASES (LGPL-2.1), alpaqa and SLEQP (LGPL-3.0). All are libraries that are loaded at run time and can be
  replaced. Of these this package uses CasADi, and IPOPT with MUMPS.
- `imageio-ffmpeg` (video) is BSD-2-Clause, and carries the program `ffmpeg` under the **GPL-3.0**. `rrr-oc animate` runs it as a
  separate process to write MP4 files. Nothing else needs it; without the extra `video` it is not installed.
- `numpy`, `scipy` and `scikit-learn` carry `libgfortran`, `libquadmath` and `libgomp` of GCC: GPL-3.0 with the runtime library exception,
  and LGPL-2.1, which permit use by programs of any licence.
- `mujoco` (run) carries Eigen (MPL-2.0).

## What the wheel of this package contains

Its Python files and data are this project's, but for `rrr_oc/report/templates/plotly-basic.min.js`: that is plotly.js in its part with
lines and markers (MIT), as npm has it in `plotly.js-basic-dist-min` 4.1.1, unchanged, with its licence beside it; every page of a report
contains it. Its extensions `_rigid_body` and `_along` are compiled with headers of Pinocchio
(BSD-3-Clause), Boost (BSL-1.0), Eigen (MPL-2.0, unchanged; `EIGEN_MPL2_ONLY` leaves out its parts under the LGPL) and CasADi (LGPL-3.0,
unchanged); templates and inline functions of these are in the compiled files. Whoever passes the wheel on keeps their notices: the
headers, which have them, are in the distributions `libpinocchio`, `cmeel-boost`, `cmeel-eigen` and `casadi` of the versions below. The
extensions link `libcasadi` dynamically, and can be compiled anew against another version.

## All

"""


def requirements() -> dict[str, list[Requirement]]:
    """Those of pyproject.toml by part: to run, each extra, and to build."""
    content = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    project = content["project"]
    lines = {RUN: project["dependencies"], **project["optional-dependencies"], BUILD: content["build-system"]["requires"]}
    return {part: [r for r in map(Requirement, some) if r.name != project["name"]] for part, some in lines.items()}


def reached() -> dict[str, tuple[Distribution | None, set[str]]]:
    """Every distribution that a requirement leads to, here, and the parts that need it, by canonical name; None where it is not
    installed, as what only the build needs, and gets in an environment of its own."""
    found: dict[str, tuple[Distribution | None, set[str]]] = {}
    for part, some in requirements().items():
        todo, seen = list(some), set()
        while todo:
            one = todo.pop()
            name = canonicalize_name(one.name)
            if (name, frozenset(one.extras)) in seen:
                continue
            seen.add((name, frozenset(one.extras)))
            installed = _installed(name)
            found.setdefault(name, (installed, set()))[1].add(part)
            if installed is not None:
                todo += _below(installed, one.extras)
    return {name: (None if needed == {BUILD} else one, needed) for name, (one, needed) in sorted(found.items())}


def _installed(name: str) -> Distribution | None:
    try:
        return distribution(name)
    except ModuleNotFoundError:
        return None


def _below(installed: Distribution, extras: set[str]) -> Iterator[Requirement]:
    for one in map(Requirement, installed.requires or ()):
        if one.marker is None or any(one.marker.evaluate({"extra": extra}) for extra in (extras or {""})):
            yield one


def pinned() -> dict[str, str]:
    """Versions of constraints/ci.txt by canonical name."""
    lines = (ROOT / "constraints" / "ci.txt").read_text(encoding="utf-8").splitlines()
    return {
        canonicalize_name(name): version for name, version in (line.split("==") for line in lines if line[:1] not in ("", "#"))
    }


def licence(name: str, installed: Distribution | None) -> str:
    """The SPDX expression of a distribution's licence; raises `UserError` where it is unknown, or not known to permit use here."""
    keys = ("License-Expression", "License", "Classifier")
    said = [] if installed is None else [one for key in keys for one in installed.metadata.get_all(key) or ()]
    said = [one.removeprefix("License :: ").removeprefix("OSI Approved :: ") for one in said if TOPIC.match(one) is None]
    for one in [READ_IN_FILES[name]] if name in READ_IN_FILES else said:
        expression = SPELLED.get(one, one)
        if all(part in PERMITS for part in parts(expression)):
            return expression
    raise UserError(f"{name}: its licence is {' / '.join(said)[:200]!r}; docs/dependencies.py knows {', '.join(PERMITS)}")


def parts(expression: str) -> list[str]:
    """The identifiers of an SPDX expression."""
    return re.split(r" AND | OR ", expression)


def page() -> str:
    """docs/licences.md; raises `UserError` where something is not installed or has an unknown licence."""
    rows, copyleft = [], []
    for name, (installed, needed) in reached().items():
        version = installed.version if installed is not None else pinned().get(name)
        if version is None or (installed is None and name not in READ_IN_FILES):
            raise UserError(f"{name} is not installed; `make test` makes an environment with all extras")
        expression = licence(name, installed)
        kind = " and ".join(sorted({PERMITS[part] for part in parts(expression)}))
        needing = [RUN] if RUN in needed else [part for part in requirements() if part in needed]
        rows.append([f"`{name}`", version, expression, kind, ", ".join(needing)])
        if kind != "permissive":
            copyleft.append(f"- `{name}`: {expression}, for {', '.join(needing)}")
    header = ["distribution", "version", "licence", "kind", "needed by"]
    note = "`run` is what `pip install rrr_oc` installs; other words are extras, `build` what the wheel is built with.\n\n"
    return HEAD + "\n".join(copyleft) + "\n\n" + INSIDE + note + markdown(header, rows)


if __name__ == "__main__":
    write_text(PAGE, page())

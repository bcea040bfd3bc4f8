"""Profiles of Hypothesis, which must be known before it reads `--hypothesis-profile`, what tests side by side need, and a browser."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# One thread of linear algebra for each process of the tests: more would compete for the cores. It is read when numpy is imported.
if "PYTEST_XDIST_WORKER" in os.environ:
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(variable, "1")

import pytest
from hypothesis import settings

HERE = Path(__file__).parent
# Files that take more than half a minute of processor time, longest first: they begin first, so that none is left at the end.
LONGEST = (
    "whole/test_documented_commands.py",
    "whole/test_readme.py",
    "codesign/test_task_sets.py",
    "diagnosis/test_links_and_payloads.py",
    "diagnosis/test_some_recordings.py",
    "whole/test_study.py",
    "diagnosis/test_dry_friction.py",
    "diagnosis/test_laws_named.py",
    "whole/test_real_arms_study.py",
    "diagnosis/test_concealed_effects.py",
    "codesign/test_springs_of_designs.py",
    "diagnosis/test_stages.py",
)

settings.register_profile("long", max_examples=int(os.environ.get("RRR_OC_EXAMPLES", "20000")))


def pytest_collection_modifyitems(items):
    order = {HERE / name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path, len(order)))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A Chromium without a window; skips where there is none."""
    driver = pytest.importorskip("playwright.sync_api", reason="needs playwright, of the extra `test`")
    names = ("chromium", "google-chrome", "chrome-headless-shell")
    found = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, names)), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(names)} is on the path, and CHROMIUM names none")
    with driver.sync_playwright() as started:
        opened = started.chromium.launch(executable_path=found, args=["--no-sandbox"])  # which root in a container needs
        yield opened
        opened.close()

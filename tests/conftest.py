"""Profiles of Hypothesis, which must be known before it reads `--hypothesis-profile`, and what tests side by side need."""

import os
from pathlib import Path

# One thread of linear algebra for each process of the tests: more would compete for the cores. It is read when numpy is imported.
if "PYTEST_XDIST_WORKER" in os.environ:
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(variable, "1")

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

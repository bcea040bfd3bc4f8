"""Profiles of Hypothesis, which must be known before it reads `--hypothesis-profile`, and tests side by side in several processes."""

import os

# One thread of linear algebra for each process of the tests: more would compete for the cores. It is read when numpy is imported.
if "PYTEST_XDIST_WORKER" in os.environ:
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")

from hypothesis import settings

settings.register_profile("long", max_examples=int(os.environ.get("RRR_OC_EXAMPLES", "20000")))

"""Profiles of Hypothesis, which must be known before it reads `--hypothesis-profile`."""

import os

from hypothesis import settings

settings.register_profile("long", max_examples=int(os.environ.get("RRR_OC_EXAMPLES", "20000")))

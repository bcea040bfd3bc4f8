"""Profiles of Hypothesis, which must be known before it reads `--hypothesis-profile`."""

from hypothesis import settings

settings.register_profile("long", max_examples=20_000)

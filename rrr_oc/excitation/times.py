"""When a planned recording is sampled."""

import numpy as np

from rrr_oc.errors import UserError

STEP = 0.01  # default sampling of a planned recording [s]
MOST = 1_000_000  # samples of a motion; doubled, a file of seven joints has 800 MB


def times(duration: float, step: float) -> np.ndarray:
    """Sampling times from 0 to the duration [s]; raises `UserError` for a step that is not within it, or more than `MOST` of them."""
    if not 0 < step <= duration:
        raise UserError(f"the sampling step must be above 0 and at most the duration, {duration:g} s, got {step:g} s")
    if duration / step >= MOST:
        raise UserError(
            f"a motion of {duration:g} s has more than {MOST} samples of {step:g} s; at most {MOST * step:g} s are allowed"
        )
    return np.linspace(0, duration, round(duration / step) + 1)

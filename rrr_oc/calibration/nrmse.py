"""How far a prediction lies from a recording: the root mean square of the error over the recorded signal's spread."""

from collections.abc import Sequence

import numpy as np

from rrr_oc.numerics.savitzky_golay import WINDOW, smooth

DROPPED = 0.1  # [s] left out at the start and at the end


def error(
    t: np.ndarray,
    recorded: np.ndarray,
    predicted: np.ndarray,
    segments: Sequence[slice],
    window: float = WINDOW,
    dropped: float = DROPPED,
) -> dict[str, np.ndarray]:
    """NRMSE [1] and RMSE [unit of the signal] of each row, both smoothed over `window` [s] (order 3), the ends dropped.

    Args:
        t: Times [s], shape (K,).
        recorded, predicted: Signals (n, K).
        segments: Slices of the samples that no filter may cross.
        dropped: Time left out at both ends [s].

    Returns:
        `{"nrmse": (n,), "rmse": (n,)}`: RMSE over the standard deviation of the recorded signal, NaN where that is 0 or
        nothing is left.
    """
    kept = (t >= t[0] + dropped) & (t <= t[-1] - dropped)
    if not kept.any():
        return {"nrmse": np.full(len(recorded), np.nan), "rmse": np.full(len(recorded), np.nan)}
    recorded, predicted = (smooth(t, x, segments, window)[:, kept] for x in (recorded, predicted))
    rmse, spread = np.sqrt(np.mean((predicted - recorded) ** 2, axis=1)), np.std(recorded, axis=1)
    still = spread <= 1e-12 * np.max(np.abs(recorded), axis=1)  # rounding
    return {"nrmse": np.where(still, np.nan, rmse / np.where(still, 1.0, spread)), "rmse": rmse}

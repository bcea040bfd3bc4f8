"""Savitzky–Golay filtering of samples that need not be uniform in time, within segments that gaps separate."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.signal import savgol_filter

GAP = 5.0  # longest step within a segment, in median steps
WINDOW = 0.15  # default length of the window [s]
LEAST_ROWS = 5  # fewest samples of a segment from which a derivative is taken
CHUNK = 100_000  # samples worked on at once: what they need stays in the processor's cache


def split(t: np.ndarray) -> tuple[slice, ...]:
    """Segments of `t` (K,) [s], strictly increasing: a step longer than `GAP` median steps ends one."""
    steps = np.diff(t)
    ends = [0, *(np.flatnonzero(steps > GAP * np.median(steps)) + 1).tolist(), len(t)] if len(t) > 1 else [0, len(t)]
    return tuple(slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True))


def differentiate(t: np.ndarray, x: np.ndarray, segments: Sequence[slice], derivative: int = 1) -> np.ndarray:
    """Derivative of x (n, K) [1/s, 1/s²], from polynomials two orders above it over `WINDOW` or 7 samples.

    So the bias is of order window⁴. A segment shorter than the window gets the polynomial of lowest order, because there
    noise is worse than bias; one below `LEAST_ROWS` samples gets NaN.
    """
    count = window_samples(t, WINDOW, least=derivative + 5)
    result = np.full(x.shape, np.nan)
    for s in segments:
        size = s.stop - s.start
        if size >= count:
            result[:, s] = local_polynomial(t[s], x[:, s], derivative, derivative + 2, count)
        elif size >= LEAST_ROWS:
            result[:, s] = local_polynomial(t[s], x[:, s], derivative, derivative, size - 1 + size % 2)
    return result


def smooth(t: np.ndarray, x: np.ndarray, segments: Sequence[slice], window: float = WINDOW, order: int = 3) -> np.ndarray:
    """x (n, K) filtered over `window` [s], never more than a tenth of a segment; a segment too short for that is kept."""
    result = np.array(x, float)
    for s in segments:
        count = min(window_samples(t[s], window), (s.stop - s.start) // 10)
        count -= 1 - count % 2
        if count > order:
            result[:, s] = local_polynomial(t[s], x[:, s], 0, order, count)
    return result


def window_samples(t: np.ndarray, window: float, least: int = 1) -> int:
    """Odd number of samples, `least` or more, that spans `window` [s] at the median step of `t`."""
    if len(t) < 2:
        return least + 1 - least % 2
    half = min(window / np.median(np.diff(t)) / 2, len(t))  # before rounding: a ratio of floats may be infinite
    return 2 * max(round(half), least // 2) + 1


def local_polynomial(t: np.ndarray, x: np.ndarray, derivative: int, order: int, count: int) -> np.ndarray:
    """Derivative at each t (K,) of the least-squares polynomial of `order` over the `count` nearest samples of x (n, K).

    The polynomials are fitted to the samples at their own times: to interpolate first, onto uniform times, would mix
    neighbours before the fit and bias it by the jitter. At both ends the window stays inside and the point moves in it.
    Where steps are equal to 0.1 % this is the Savitzky–Golay filter. NaN where the times decide no polynomial.
    """
    if x.size == 0:
        return np.empty(x.shape)
    step = (t[-1] - t[0]) / (len(t) - 1)
    with np.errstate(all="ignore"):  # absurd numbers become inf or NaN, which the caller looks for
        if np.all(np.abs(np.diff(t) - step) < 1e-3 * step):
            return savgol_filter(x, count, order, deriv=derivative, delta=step, axis=-1, mode="interp")
        return _moving_fits(t, x, derivative, order, count)


def _moving_fits(t: np.ndarray, x: np.ndarray, derivative: int, order: int, count: int) -> np.ndarray:
    """`local_polynomial` for any t, at a cost that does not grow with the window.

    Windows that start next to one another form a block; over its samples, centred and scaled to -1 … 1, the normal equations
    of every window are differences of cumulative sums of powers.
    """
    windows, half = len(t) - count + 1, count // 2
    size = min(count, windows)  # windows of a block
    starts = np.append(np.arange(0, windows - size, size), windows - size)
    result = np.empty(x.shape)
    for chunk in np.array_split(starts, 1 + len(starts) * size * count // CHUNK):
        samples = chunk[:, None] + np.arange(size + count - 1)  # (blocks, samples)
        centre, scale = t[samples[:, samples.shape[1] // 2]], (t[samples[:, -1]] - t[samples[:, 0]]) / 2
        base = x[:, samples[:, :1]]  # (n, blocks, 1)
        coefficients = _block_fits((t[samples] - centre[:, None]) / scale[:, None], x[:, samples] - base, order, count)

        def value(at: np.ndarray, c: np.ndarray, block: slice | int, centre=centre, scale=scale, base=base) -> np.ndarray:
            u = (t[at] - centre[block, None]) / scale[block, None]
            polynomial = sum(math.perm(k, derivative) * c[..., k] * u ** (k - derivative) for k in range(derivative, order + 1))
            return polynomial / scale[block, None] ** derivative + (base[:, block] if derivative == 0 else 0.0)

        result[:, chunk[:, None] + np.arange(size) + half] = value(samples[:, half : half + size], coefficients, slice(None))
        if chunk[0] == 0:  # rows before the first window's centre, and after the last one's
            result[:, :half] = value(np.arange(half), coefficients[:, 0, :1], 0)
        if chunk[-1] == starts[-1]:
            result[:, windows + half :] = value(np.arange(windows + half, len(t)), coefficients[:, -1, -1:], -1)
    return result


def _block_fits(u: np.ndarray, x: np.ndarray, order: int, count: int) -> np.ndarray:
    """Coefficients (n, blocks, windows, order + 1) of polynomials in u (blocks, samples) fitted to x (n, blocks, samples)."""

    def window_sums(values: np.ndarray) -> np.ndarray:
        sums = np.cumsum(np.concatenate([np.zeros((*values.shape[:-1], 1)), values], axis=-1), axis=-1)
        return sums[..., count:] - sums[..., :-count]

    powers = [np.ones_like(u)]
    for _ in range(2 * order):
        powers.append(powers[-1] * u)
    moments = [window_sums(power) for power in powers]
    matrix = np.stack([np.stack(moments[k : k + order + 1], axis=-1) for k in range(order + 1)], axis=-1)
    right = np.stack([window_sums(x * power) for power in powers[: order + 1]], axis=-1)  # (n, blocks, windows, order + 1)
    try:
        return np.moveaxis(np.linalg.solve(matrix, np.moveaxis(right, 0, -1)), -1, 0)
    except np.linalg.LinAlgError:
        return np.full(right.shape, np.nan)

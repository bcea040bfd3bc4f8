"""Savitzky–Golay filtering of samples that need not be uniform in time, within segments that gaps separate."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

GAP = 5.0  # longest step within a segment, in median steps (file contract); doubled, filters reach across gaps twice as long
WINDOW = 0.15  # [s], default window (file contract); doubled, derivatives have half the noise and 16 times the bias
LEAST_ROWS = 5  # fewest samples of a segment from which a derivative is taken; doubled, more short segments are dropped
CHUNK = 100_000  # samples in one block of arrays, which then fit into the processor's cache; results do not depend on it


def split(t: np.ndarray) -> tuple[slice, ...]:
    """Segments of `t` (K,) [s], strictly increasing: a step longer than `GAP` median steps ends one."""
    steps = np.diff(t)
    ends = [0, *(np.flatnonzero(steps > GAP * np.median(steps)) + 1).tolist(), len(t)] if len(t) > 1 else [0, len(t)]
    return tuple(slice(a, b) for a, b in itertools.pairwise(ends))


def differentiate(t: np.ndarray, x: np.ndarray, segments: Sequence[slice], derivative: int = 1) -> np.ndarray:
    """Derivative of x (n, K) [1/s, 1/s²], from polynomials two orders above it over `WINDOW` or 7 samples.

    The bias is of order window⁴. In a segment shorter than the window the polynomial has the lowest order, because noise
    is then worse than bias; in one of fewer than `LEAST_ROWS` samples the result is NaN.
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
        count = _smoothing_samples(t, s, window)
        if count > order:
            result[:, s] = local_polynomial(t[s], x[:, s], 0, order, count)
    return result


def _smoothing_samples(t: np.ndarray, segment: slice, window: float, part: int = 10) -> int:
    count = min(window_samples(t[segment], window), (segment.stop - segment.start) // part)
    return count - 1 + count % 2


def window_samples(t: np.ndarray, window: float, least: int = 1) -> int:
    """Odd number of samples, `least` or more, that spans `window` [s] at the median step of `t`."""
    if len(t) < 2:
        return least + 1 - least % 2
    half = min(window / np.median(np.diff(t)) / 2, len(t))  # before rounding: a ratio of floats may be infinite
    return 2 * max(round(half), least // 2) + 1


def local_polynomial(t: np.ndarray, x: np.ndarray, derivative: int, order: int, count: int) -> np.ndarray:
    """Derivative at each t (K,) of the least-squares polynomial of `order` over the `count` nearest samples of x (n, K).

    On uniform times this is the Savitzky–Golay filter. The polynomials are fitted to the samples at their own times:
    interpolation onto uniform times would bias the fit by the jitter. At both ends the window stays inside the data and the
    point moves within it. NaN where the normal equations are singular.

    The cost does not grow with the window: over a block of neighbouring windows, with time centred and scaled to -1 … 1, the
    normal equations of every window are differences of cumulative sums of powers.
    """
    windows, half = len(t) - count + 1, count // 2
    size = min(count, windows)  # windows of a block
    starts = np.append(np.arange(0, windows - size, size), windows - size)
    result = np.empty(x.shape)
    with np.errstate(all="ignore"):  # absurd numbers become inf or NaN, which the caller looks for
        for chunk in np.array_split(starts, min(len(starts), 1 + windows // CHUNK)):
            samples = chunk[:, None] + np.arange(size + count - 1)  # (blocks, samples)
            polynomials = _Polynomials.fit(t[samples], x[:, samples], order, count)
            centres = samples[:, half : half + size]
            result[:, centres] = polynomials.value(t[centres], derivative)
            if chunk[0] == 0:  # rows before the first window's centre
                result[:, :half] = polynomials.one(0).value(t[None, :half], derivative)[:, 0]
            if chunk[-1] == starts[-1]:  # rows after the last one's
                result[:, windows + half :] = polynomials.one(-1).value(t[None, windows + half :], derivative)[:, 0]
    return result


def as_matrix(t: np.ndarray, segments: Sequence[slice], window: float = WINDOW, order: int = 3) -> "csr_matrix":
    """The filter as a sparse matrix (K, K), for many signals and short windows; the window is at most a third of a segment."""
    from scipy.sparse import csr_matrix

    rows, columns, values = [], [], []
    for s in segments:
        size, count = s.stop - s.start, _smoothing_samples(t, s, window, 3)
        if count <= order:
            rows.append(np.arange(s.start, s.stop))
            columns.append(rows[-1])
            values.append(np.ones(size))
            continue
        for rows_ in np.array_split(np.arange(size), 1 + size // CHUNK):
            samples = s.start + np.clip(rows_ - count // 2, 0, size - count)[:, None] + np.arange(count)
            at = s.start + rows_
            scale = (t[samples[:, -1]] - t[samples[:, 0]])[:, None] / 2
            powers = ((t[samples] - t[at][:, None]) / scale)[:, :, None] ** np.arange(order + 1)
            pick = np.zeros((len(at), order + 1, 1))
            pick[:, 0] = 1.0
            solved = np.linalg.solve(np.einsum("kwa,kwb->kab", powers, powers), pick)[:, :, 0]
            values.append(np.einsum("kwa,ka->kw", powers, solved).ravel())
            rows.append(np.repeat(at, count))
            columns.append(samples.ravel())
    if not values:
        return csr_matrix((len(t), len(t)))
    return csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(len(t), len(t)))


@dataclass(frozen=True)
class _Polynomials:
    """Polynomials in (t − centre) / scale of n signals, one a window.

    Attributes:
        centre, scale: Of time in each block [s], shape (blocks, 1).
        offset: Subtracted from each signal for numerical accuracy, shape (n, blocks, 1).
        coefficients: Shape (n, blocks, windows, order + 1).
    """

    centre: np.ndarray
    scale: np.ndarray
    offset: np.ndarray
    coefficients: np.ndarray

    @classmethod
    def fit(cls, t: np.ndarray, x: np.ndarray, order: int, count: int) -> "_Polynomials":
        """Fits over every `count` neighbours of the samples t (blocks, samples), x (n, blocks, samples)."""
        centre, scale, offset = t[:, t.shape[1] // 2, None], (t[:, -1:] - t[:, :1]) / 2, x[..., :1]
        powers = [np.ones_like(t)]
        for _ in range(2 * order):
            powers.append(powers[-1] * ((t - centre) / scale))
        moments = [_window_sums(power, count) for power in powers]
        matrix = np.stack([np.stack(moments[k : k + order + 1], axis=-1) for k in range(order + 1)], axis=-1)
        right = np.stack([_window_sums((x - offset) * power, count) for power in powers[: order + 1]], axis=-1)
        try:
            coefficients = np.moveaxis(np.linalg.solve(matrix, np.moveaxis(right, 0, -1)), -1, 0)
        except np.linalg.LinAlgError:
            coefficients = np.full(right.shape, np.nan)
        return cls(centre, scale, offset, coefficients)

    def one(self, end: int) -> "_Polynomials":
        """The first (0) or last (-1) polynomial of each signal."""
        coefficients = self.coefficients[:, end, end][:, None, None]
        return _Polynomials(self.centre[end, None], self.scale[end, None], self.offset[:, end, None], coefficients)

    def value(self, t: np.ndarray, derivative: int) -> np.ndarray:
        """Derivatives (n, blocks, times) at t (blocks, times): at one time each, or of one polynomial at many."""
        u, result = (t - self.centre) / self.scale, 0.0
        for k in reversed(range(derivative, self.coefficients.shape[-1])):  # Horner's scheme
            result = result * u + math.perm(k, derivative) * self.coefficients[..., k]
        return result / self.scale**derivative + (self.offset if derivative == 0 else 0.0)


def _window_sums(values: np.ndarray, count: int) -> np.ndarray:
    """Sums over every `count` neighbours along the last axis."""
    sums = np.cumsum(np.concatenate([np.zeros((*values.shape[:-1], 1)), values], axis=-1), axis=-1)
    return sums[..., count:] - sums[..., :-count]

"""Errors on data that a fit leaves out: recordings are cut into blocks of some seconds, a quarter of which is predicted from the others.

Blocks lie in every recording, so that no law has to predict where it was never seen.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.stats import t as student

from rrr_oc.calibration.estimator.data import EVERY
from rrr_oc.calibration.estimator.evidence import Gram, Posterior, Spectrum, estimated, root_of_covariance
from rrr_oc.calibration.samples import STRIDE

BLOCK, LEAST_BLOCKS, LEAST_ROWS = 5.0, 4, 8  # length [s] of a block, number of a recording that shortens them, least rows
PARTS = 4  # of the blocks, each predicted once
QUANTILE = 0.975  # of the upper end of an interval


@dataclass(frozen=True)
class Fall:
    """By how much a change of a model lowers the held-out rms of a joint, as a share of what it is without, and its 95 % interval.

    `before` is the rms without it over the standard deviation of the joint's torque; NaN where it is not asked for.
    """

    joint: int
    share: float
    low: float
    high: float
    before: float = np.nan

    @property
    def of_torque(self) -> float:
        """The fall over the joint's torque, by which effects of different joints are compared."""
        return self.share * self.before

    @property
    def explained(self) -> float:
        """Rms of what the change explains over the joint's torque."""
        return self.before * float(np.sqrt(max(1 - (1 - self.share) ** 2, 0.0)))


def block_edges(edges: np.ndarray) -> np.ndarray:
    """First row of each block, and the number of rows, from those of the recordings."""
    inner = []
    for a, b in pairwise(edges.tolist()):
        number = max(round((b - a) * STRIDE * EVERY / BLOCK), min(LEAST_BLOCKS, (b - a) // LEAST_ROWS), 1)
        inner.append(np.linspace(a, b, number + 1)[:-1].astype(int))
    return np.append(np.concatenate(inner), edges[-1])


def fall_of(joint: int, after: np.ndarray, before: np.ndarray) -> Fall:
    """From squared errors of a joint in each block, (B,) each: a ratio of sums with its interval (Cochran 1977, section 6.4)."""
    total, count = float(before.sum()), int(np.count_nonzero(before))
    if count < 2:
        return Fall(joint, 0.0, -np.inf, np.inf)
    ratio = float(after.sum()) / total
    std = np.sqrt(count / (count - 1) * np.sum((after - ratio * before) ** 2)) / total
    half = float(student.ppf(QUANTILE, count - 1) * std)
    share, low, high = (float(1 - np.sqrt(max(r, 0.0))) for r in (ratio, ratio + half, ratio - half))
    return Fall(joint, share, low, high)


def surest_fall(post: Posterior, other: Posterior) -> Fall | None:
    """By how much a fit lowers the error on data left out against another of the same rows, on the joint where it is surest."""
    after, before = squares_left_out(post), squares_left_out(other)
    every = [fall_of(j, after[:, j], before[:, j]) for j in range(after.shape[1]) if before[:, j].any()]
    return max(every, key=lambda f: f.low, default=None)


def squares_left_out(post: Posterior) -> np.ndarray:
    """Squared errors of each block and joint, predicted from the other parts in the linear problem of a fit without discrepancy, (B, n)."""
    edges, left = block_edges(post.data.edges), np.zeros_like(post.residual)
    block = np.repeat(np.arange(len(edges) - 1), np.diff(edges))
    white = [(one.white @ x, one.white @ y) for one, x, y in zip(post.joints, post.columns, post.residual, strict=True)]
    spectra = [Spectrum(np.zeros(0), one.log_det, one.count) for one in post.joints]
    for part in range(min(PARTS, len(edges) - 1)):
        held = block % PARTS == part
        step = estimated([_gram(x[~held], y[~held]) for x, y in white], spectra, post.hyper, post.base, True).step
        left[:, held] = post.residual[:, held] - post.columns[:, held] @ step
    return np.add.reduceat(left**2, edges[:-1], axis=1).T


def std_by_blocks(post: Posterior) -> tuple[np.ndarray, int]:
    """Standard errors of the parameters (p,) from how the slopes of the likelihood differ between blocks of the recordings, and the number
    of blocks; 0 with one block.

    They hold where the model or its noise is not exact (White 1982, the sandwich), which the posterior does not know; from few blocks
    they are not exact themselves.
    """
    edges = block_edges(post.data.edges)
    number, slopes = len(edges) - 1, 0.0
    for one, x, y, sigma in zip(post.joints, post.columns, post.residual, post.hyper.sigma, strict=True):
        each = (one.white @ x) * (one.white @ y)[:, None] / sigma**2
        slopes = slopes + np.add.reduceat(each, edges[:-1], axis=0)
    if number < 2:
        return np.zeros(len(post.step)), 2
    root = root_of_covariance(post.matrix)
    moved = (slopes - np.mean(slopes, axis=0)) @ root @ root.T
    return np.sqrt(number / (number - 1) * np.sum(moved**2, axis=0)), number


def _gram(x: np.ndarray, y: np.ndarray) -> Gram:
    """Products of whitened columns (M, p) and a residual (M,), without a discrepancy."""
    live = np.flatnonzero(np.any(x != 0, axis=0))
    x = x[:, live]
    return Gram(x.T @ x, x.T @ y, float(y @ y), np.zeros((0, len(live))), np.zeros(0), live)

"""Covariance and intervals of estimates, robust where residuals are autocorrelated.

The estimator is ours: the usual HAC covariances (Newey–West) weigh lags by a kernel, know no gaps between recordings and no
Student distribution for short ones, and would give other intervals.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from rrr_oc.calibration.regression import Rows
from rrr_oc.calibration.samples import CORRELATION

LEVEL = 0.95  # of confidence intervals
MOST_LOST = 10.0  # largest factor by which a variance is corrected for the fit; doubled, wider intervals of few-row parameters
FASTEST = 1.0  # [Hz], of the cosines that measure the scores' spectrum at zero frequency; doubled, more of them, and more bias


@dataclass(frozen=True)
class Covariance:
    """Covariance of estimates, and the degrees of freedom of each one's Student distribution, (p, p) and (p,)."""

    matrix: np.ndarray
    freedom: np.ndarray

    @property
    def std(self) -> np.ndarray:
        """Standard errors (p,)."""
        return np.sqrt(np.maximum(np.diag(self.matrix), 0.0))

    @property
    def half_width(self) -> np.ndarray:
        """Half of the confidence intervals of `LEVEL`, (p,)."""
        return student.ppf((1 + LEVEL) / 2, self.freedom) * self.std

    @property
    def correlation(self) -> np.ndarray:
        """Correlation coefficients (p, p)."""
        scale = np.where(self.std > 0, self.std, 1.0)
        return self.matrix / np.outer(scale, scale)


def covariance(rows: Rows, weights: np.ndarray, bread: np.ndarray, fitted: np.ndarray) -> Covariance:
    """Covariance of bread @ (sum of scores), robust to autocorrelation and heteroscedasticity (a sandwich estimator).

    The long-run variance of the scores s_k = Σ_j w_j J_jkᵀ r_jk is estimated for each stretch from their first B cosine
    transforms with equal weights (EWC of Lazarus, Lewis, Stock and Watson 2018), so that an estimate over its standard error
    follows Student's t with B degrees of freedom; over several stretches, with Satterthwaite's. B = 0.4 T^(2/3), where T is the
    duration over the correlation time of filtered noise. A fit makes residuals smaller than the noise in the directions of its
    regressors; each variance is divided by the share that would be left of white noise (Bell & McCaffrey's idea).

    Args:
        bread: (q, p): the inverse of the normal matrix, or that times a linear map of the parameters.
        fitted: (p, p): the map of the fit from scores to parameters: the inverse of the normal matrix of the fitted parameters.
    """
    size = bread.shape[0]
    total, target, left = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    parts, dof = [], []
    for stretch, duration in zip(rows.stretches, rows.durations, strict=True):
        jacobian, weighted = rows.jacobian[:, stretch], rows.jacobian[:, stretch] * weights[:, None, None]
        scores = np.einsum("jkp,jk->kp", weighted, rows.residual[:, stretch])
        cosines = _cosines(len(scores), duration)
        z = (cosines @ scores) @ bread.T  # (B, q)
        total += z.T @ z / len(z)
        parts.append(np.mean(z**2, axis=0))
        dof.append(len(z))
        for cosine in cosines:
            once = bread @ sum((j * cosine[:, None]).T @ w for j, w in zip(jacobian, weighted, strict=True))
            twice = bread @ sum((j * cosine[:, None] ** 2).T @ w for j, w in zip(jacobian, weighted, strict=True))
            whole = np.einsum("qp,qp->q", twice, bread)
            target += whole / len(cosines)
            left += (whole - np.einsum("qp,pr,qr->q", once, fitted, once)) / len(cosines)
    if not parts:
        return Covariance(np.full((size, size), np.nan), np.ones(size))
    each, summed = np.array(parts), np.sum(parts, axis=0)  # (stretches, q), (q,)
    freedom = np.where(summed > 0, summed**2 / np.maximum(np.sum(each**2 / np.array(dof)[:, None], axis=0), 1e-300), sum(dof))
    lost = np.sqrt(np.divide(target, np.maximum(left, target / MOST_LOST), out=np.ones(size), where=target > 0))
    return Covariance(total * np.outer(lost, lost), np.maximum(freedom, 1.0))


def covariance_of_some(rows: Rows, weights: np.ndarray, matrix: np.ndarray, which: np.ndarray) -> Covariance:
    """As `covariance`, with the parameters outside `which` (p,) fixed, and zeros there; `matrix`: normal matrix (p, p)."""
    bread = np.zeros_like(matrix)
    if which.any():
        bread[np.ix_(which, which)] = np.linalg.inv(matrix[np.ix_(which, which)])
    return covariance(rows, weights, bread, bread)


def _cosines(count: int, duration: float) -> np.ndarray:
    """Orthogonal cosines without the constant, scaled so that a flat spectrum gives the variance of the sum, (B, count)."""
    number = int(0.4 * (duration / CORRELATION) ** (2 / 3))
    number = max(1, min(number, int(2 * FASTEST * duration), count - 1))
    k = np.arange(1, number + 1)[:, None]
    return np.sqrt(2) * np.cos(np.pi * k * (np.arange(count) + 0.5) / count)


def intervals(value: np.ndarray, half_width: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> Sequence[tuple[float, float]]:
    """Confidence intervals cut at the bounds."""
    low, high = np.clip(value - half_width, lower, upper), np.clip(value + half_width, lower, upper)
    return [(float(a), float(b)) for a, b in zip(low, high, strict=True)]

"""Bounded least squares, and standard errors that hold up where residuals are autocorrelated."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear
from scipy.stats import t as student

from rrr_oc.calibration.regression import Rows
from rrr_oc.calibration.samples import CORRELATION

LEVEL = 0.95
NULL = 1e-10  # eigenvalue of the scaled normal matrix, over the largest, below which nothing is known of a direction
MOST_LOST = 10.0  # largest factor by which a variance is corrected for what the fit takes
FASTEST = 1.0  # [Hz], of the cosines that measure the scores' spectrum at zero frequency


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


def normal_equations(rows: Rows, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """H = Σ_j w_j J_jᵀ J_j (p, p) and g = Σ_j w_j J_jᵀ r_j (p,), for weights of the joints (n,)."""
    weighted = rows.jacobian * weights[:, None, None]
    matrix = sum(w.T @ j for w, j in zip(weighted, rows.jacobian, strict=True))
    right = sum(w.T @ r for w, r in zip(weighted, rows.residual, strict=True))
    return np.asarray(matrix), np.asarray(right)


def box_step(matrix: np.ndarray, right: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """argmin dᵀ H d / 2 − gᵀ d within bounds; of all such, about the one nearest to 0 where H is singular."""
    scale = scales(matrix)
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    known = np.maximum(values, NULL * max(values.max(initial=0.0), 1e-300))
    target = vectors.T @ (right / scale)
    step, low, high = vectors @ (target / known), lower * scale, upper * scale
    if np.any(step < low) or np.any(step > high):
        free = low < high
        root = np.sqrt(known)[:, None] * vectors.T[:, free]
        step = np.zeros_like(step)
        step[free] = lsq_linear(root, target / np.sqrt(known), (low[free], high[free]), method="bvls").x
    return step / scale


def scales(matrix: np.ndarray) -> np.ndarray:
    """Norms of the columns that a normal matrix is made of; 1 for a column of zeros."""
    norms = np.sqrt(np.diag(matrix))
    return np.where(norms > 0, norms, 1.0)


def condition(matrix: np.ndarray) -> float:
    """Condition number of the Jacobian with columns scaled to length 1, from its normal matrix; infinite if singular."""
    scale = scales(matrix)
    values = np.linalg.eigvalsh(matrix / np.outer(scale, scale))
    return float(np.sqrt(values[-1] / values[0])) if len(values) and values[0] > 1e-15 * values[-1] else float("inf")


def undetermined(matrix: np.ndarray) -> np.ndarray:
    """Which parameters the data do not decide (p,): those that take part in a null direction of the normal matrix."""
    scale = scales(matrix)
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    null = vectors[:, values <= NULL * max(values.max(initial=0.0), 1e-300)]
    return np.any(np.abs(null) > 1e-3, axis=1) | (np.diag(matrix) <= 0)


def covariance(rows: Rows, weights: np.ndarray, bread: np.ndarray, fitted: np.ndarray) -> Covariance:
    """Covariance of bread @ (Σ of scores), robust to autocorrelation and to unequal variance (a sandwich).

    The long-run variance of the scores s_k = Σ_j w_j J_jkᵀ r_jk is measured stretch by stretch from their first B cosine
    transforms with equal weights (Lazarus, Lewis, Stock and Watson 2018, EWC): what they measure at frequency 0 follows
    Student's t with B degrees of freedom; over several stretches Satterthwaite's. B = 0.4 T^(2/3), where T counts the times over
    which filtered noise is correlated. Residuals are smaller than the noise where the regressors live, since they were fitted
    there: each variance is divided by what that leaves of it where noise is white (Bell & McCaffrey's idea).

    Args:
        bread: (q, p): the inverse of the normal matrix, or what maps it onto other quantities.
        fitted: (p, p): what the fit maps scores to parameters by: the inverse of the normal matrix of the parameters fitted.
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


def _cosines(count: int, duration: float) -> np.ndarray:
    """Orthonormal cosines but for the constant, scaled so that a constant spectrum gives the variance of the sum, (B, count)."""
    number = int(0.4 * (duration / CORRELATION) ** (2 / 3))
    number = max(1, min(number, int(2 * FASTEST * duration), count - 1))
    k = np.arange(1, number + 1)[:, None]
    return np.sqrt(2) * np.cos(np.pi * k * (np.arange(count) + 0.5) / count)


def intervals(value: np.ndarray, half_width: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> Sequence[tuple[float, float]]:
    """Confidence intervals cut at the bounds."""
    low, high = np.clip(value - half_width, lower, upper), np.clip(value + half_width, lower, upper)
    return [(float(a), float(b)) for a, b in zip(low, high, strict=True)]

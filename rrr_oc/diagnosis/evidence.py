"""The evidence for a model: its likelihood, integrated over parameters, discrepancy and errors of the links.

At a model, the residual of joint j is y_j = A_j d + F_j c_j + e_j for a change d of the parameters: F_j c_j is a discrepancy, c_j ~
N(0, s_j²), and e_j the noise, which the matrix W_j of an autoregressive process makes white, W_j e_j ~ N(0, σ_j²). Priors of d are
normal. So all integrals are in closed form; the sizes σ_j, s_j and that of the links' errors maximise the evidence (MacKay 1992).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigh
from scipy.sparse import diags
from scipy.stats import t as student

from rrr_oc.calibration.least_squares import box_step
from rrr_oc.diagnosis.data import Data, Noise

LEAST = 1e-5  # of a size over its unit, against a singular precision
FREEDOMS = (np.inf, 30.0, 10.0, 5.0, 3.0)  # degrees of freedom of Student's distribution that are tried for the noise
TAIL_STEPS, TAILED = 10, 3.0  # steps to its scale, and nats by which a heavy tail must raise the likelihood
ROUNDS = 5  # most estimates of the noise
UPDATES = 12  # most of the sizes for one noise
SMALL_GAIN = 0.2  # nats by which another noise must raise the evidence
SETTLED = 0.05  # nats: change of log σ times rows below which updates of the sizes end


@dataclass(frozen=True)
class Prior:
    """Normal prior of the changes of p parameters.

    Attributes:
        mean, precision: (p,) each.
        proper: Whose width counts in the evidence; the others are in every model, (p,).
        links: Which are errors of the links, whose common size is estimated, (p,).
        lower, upper: Bounds of the changes, (p,).
        flat: Precision that only bounds the volume of a parameter and does not draw it, (p,).
    """

    mean: np.ndarray
    precision: np.ndarray
    proper: np.ndarray
    links: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    flat: np.ndarray


def joined(base: Prior, scales: np.ndarray) -> Prior:
    """A prior with further parameters about 0, of standard deviations (m,)."""
    m, inf = len(scales), np.full(len(scales), np.inf)
    return Prior(
        np.append(base.mean, np.zeros(m)),
        np.append(base.precision, scales**-2.0),
        np.append(base.proper, np.ones(m, bool)),
        np.append(base.links, np.zeros(m, bool)),
        np.append(base.lower, -inf),
        np.append(base.upper, inf),
        np.append(base.flat, np.zeros(m)),
    )


@dataclass(frozen=True)
class Sizes:
    """What is estimated beside the parameters: noise by joint, σ (n,), discrepancy (n,) over the declared one, size of the links' errors."""

    noise: tuple[Noise, ...]
    sigma: np.ndarray
    discrepancy: np.ndarray
    links: float


@dataclass(frozen=True)
class Joint:
    """One joint, whitened and with its discrepancy diagonalised.

    Attributes:
        white: W, (M, M).
        turn: From whitened features to orthogonal ones, (F, F).
        values: Squared lengths of these, (F,).
        features: The whitened features, (M, F).
        log_det: Of W.
        count: Rows that count.
    """

    noise: Noise
    white: Any
    turn: np.ndarray
    values: np.ndarray
    features: np.ndarray
    log_det: float
    count: int

    @classmethod
    def of(cls, data: Data, j: int, noise: Noise) -> "Joint":
        """A joint with normal noise."""
        white, log_det = noise.whitening(data.place[j], data.turning[j])
        none = np.zeros((0, 0))
        return cls(noise, white, none, np.zeros(0), none, log_det, int(data.counted[j].sum())).with_features(data.features[j])

    @classmethod
    def estimated(cls, data: Data, j: int, left: np.ndarray) -> tuple["Joint", float]:
        """The noise of a residual (M,), without features yet, and its σ."""
        place, turning = data.place[j], data.turning[j]
        noise = Noise.of(left, place, turning)
        white, log_det = noise.whitening(place, turning)
        error = (white @ left)[place >= 0]
        tails = [_tail(error, freedom) for freedom in FREEDOMS]
        log, sigma, weights = max(tails, key=lambda t: t[0])
        count = len(error)
        scale = np.ones(len(place))
        scale[place >= 0] = np.sqrt(weights)
        log_det += log + count * np.log(sigma) + 0.5 * float(np.sum(weights * error**2)) / sigma**2
        none = np.zeros((0, 0))
        return cls(noise, diags(scale) @ white, none, np.zeros(0), none, float(log_det), count), sigma

    @classmethod
    def weighted(cls, data: Data, j: int, noise: Noise, weights: np.ndarray, log_det: float) -> "Joint":
        """A joint whose rows have these weights (M,) in the noise, W with this logarithm of its determinant; see `weights`."""
        white, _ = noise.whitening(data.place[j], data.turning[j])
        none = np.zeros((0, 0))
        one = cls(noise, diags(weights) @ white, none, np.zeros(0), none, log_det, int(data.counted[j].sum()))
        return one.with_features(data.features[j])

    def weights(self, data: Data, j: int) -> np.ndarray:
        """By how much each row counts, beside the noise's own filters, (M,); 1 where the noise is normal."""
        own, plain = self.white.diagonal(), self.noise.whitening(data.place[j], data.turning[j])[0].diagonal()
        return np.divide(own, plain, out=np.ones_like(own), where=plain != 0)

    def with_features(self, features: np.ndarray) -> "Joint":
        """The joint with the features of its discrepancy (M, F)."""
        x = self.white @ features
        values, turn = eigh(x.T @ x)
        return replace(self, turn=turn, values=np.maximum(values, 0.0), features=x)

    def along(self, x: np.ndarray) -> np.ndarray:
        """Products of the orthogonal features with whitened columns, (F, …)."""
        return self.turn.T @ (self.features.T @ x)

    def beyond_discrepancy(self, x: np.ndarray, rho: float) -> np.ndarray:
        """Whitened columns (M, …) with the discrepancy integrated out, rho = (σ / its size)²: W⁻ᵀ P W⁻¹ x of `docs/discovery.md`."""
        return x - self.features @ (self.turn @ (self.along(x).T / (self.values + rho)).T)


def _tail(error: np.ndarray, freedom: float) -> tuple[float, float, np.ndarray]:
    """Logarithm of Student's likelihood of white errors, up to a constant, with its scale and the weight of each error."""
    sigma = max(float(np.sqrt(np.mean(error**2))) if len(error) else 1.0, 1e-9)
    weights = np.ones(len(error))
    if not np.isfinite(freedom) or not len(error):
        return -len(error) * np.log(sigma) - 0.5 * len(error), sigma, weights
    for _ in range(TAIL_STEPS):
        weights = (freedom + 1) / (freedom + (error / sigma) ** 2)
        sigma = max(float(np.sqrt(np.mean(weights * error**2))), 1e-9)
    log = np.sum(student.logpdf(error / sigma, freedom)) + 0.5 * len(error) * np.log(2 * np.pi) - len(error) * np.log(sigma)
    return float(log) - TAILED, sigma, (freedom + 1) / (freedom + (error / sigma) ** 2)


@dataclass(frozen=True)
class Posterior:
    """A linear problem solved.

    Attributes:
        log_evidence: Logarithm of the evidence, without the prior probability of the structure.
        step: Change of the parameters, (p,).
        matrix: Posterior precision, (p, p).
        likelihood: The part of it that the data add, (p, p).
        right: Weighted residual by parameters at the start, (p,).
        misfit: Weighted square of the residual at the start.
        sizes: Estimated sizes.
        joints: The joints whitened.
        data: The data.
        base: The prior, the links' errors of size 1.
    """

    log_evidence: float
    step: np.ndarray
    matrix: np.ndarray
    likelihood: np.ndarray
    right: np.ndarray
    misfit: float
    sizes: Sizes
    joints: tuple[Joint, ...]
    data: Data
    base: Prior
    residual: np.ndarray
    columns: np.ndarray

    @property
    def prior(self) -> Prior:
        """The prior at the estimated sizes."""
        return at_size(self.base, self.sizes.links)

    def cost(self, residual: np.ndarray) -> float:
        """Weighted square of another residual (n, M), under this noise."""
        total = 0.0
        for j, one in enumerate(self.joints):
            y = one.white @ residual[j]
            t = one.along(y)
            rho = (self.sizes.sigma[j] / self.sizes.discrepancy[j]) ** 2
            total += (y @ y - t @ (t / (one.values + rho))) / self.sizes.sigma[j] ** 2
        return float(total)

    def foreseen(self, step: np.ndarray) -> float:
        """Cost after a change of the parameters, as linearity has it."""
        return self.misfit - 2 * float(self.right @ step) + float(step @ self.likelihood @ step) + self.prior_cost(step)

    def prior_cost(self, step: np.ndarray) -> float:
        """Weighted square of a change of the parameters from the prior's mean."""
        off = step - self.prior.mean
        return float(off @ (self.prior.precision * off))


@dataclass(frozen=True)
class Start:
    """Where the estimates of a fit's noise and sizes begin if there is no posterior of a similar problem."""

    sizes: Sizes
    joints: tuple[Joint, ...]

    @classmethod
    def of(cls, data: Data, sizes: Sizes) -> "Start":
        """With these sizes."""
        return cls(sizes, tuple(Joint.of(data, j, noise) for j, noise in enumerate(sizes.noise)))


def solve(
    data: Data,
    residual: np.ndarray,
    columns: np.ndarray,
    prior: Prior,
    start: Posterior | Start | None = None,
    fixed: bool = False,
) -> Posterior:
    """The posterior of a linear problem.

    Args:
        residual: (n, M).
        columns: Derivatives of the prediction, (n, M, p).
        start: Whose sizes are the first ones: the posterior of a similar problem, as a rule.
        fixed: Whether these stay as they are.
    """
    start = start or Start.of(data, _first(data, residual))
    sizes, joints = start.sizes, start.joints
    grams = [_gram(one, residual[j], columns[j]) for j, one in enumerate(joints)]
    best = None
    for _ in range(ROUNDS):
        if not fixed:
            sizes = _converged(grams, joints, sizes, prior)
        found = _posterior(data, grams, joints, sizes, prior, (residual, columns))
        if fixed:
            return found
        if best is not None and found.log_evidence < best.log_evidence + SMALL_GAIN:
            break
        best = found
        renewed = [_renewed(data, found, j) for j in range(data.n)]
        if all(one is old for (one, _), old in zip(renewed, joints, strict=True)):
            break
        grams = [
            g if one is old else _gram(one, residual[j], columns[j])
            for j, (g, (one, _), old) in enumerate(zip(grams, renewed, joints, strict=True))
        ]
        joints = tuple(one for one, _ in renewed)
        sizes = Sizes(tuple(one.noise for one in joints), np.array([s for _, s in renewed]), sizes.discrepancy, sizes.links)
    assert best is not None
    return best


def _renewed(data: Data, found: Posterior, j: int) -> tuple[Joint, float]:
    """A joint with its noise estimated from the residual that is left, and σ; as it is where that changes the evidence little."""
    left, old, sigma = _left(data, found, j), found.joints[j], found.sizes.sigma[j]
    new, size = Joint.estimated(data, j, left)
    logs = [
        one.log_det - one.count * np.log(s) - 0.5 * np.sum((one.white @ left) ** 2) / s**2
        for one, s in ((old, sigma), (new, size))
    ]
    if logs[1] - logs[0] < SMALL_GAIN:
        return old, sigma
    return new.with_features(data.features[j]), size


def _converged(grams, joints, sizes: Sizes, prior: Prior) -> Sizes:
    """The sizes of the largest evidence for this noise."""
    for _ in range(UPDATES):
        step, matrix = _minimum(grams, joints, sizes, prior)
        before, sizes = sizes, _updated(grams, joints, sizes, prior, step, matrix)
        change = np.log(sizes.sigma / before.sigma) * [one.count for one in joints]
        if np.max(np.abs(change)) < SETTLED and abs(np.log(sizes.links / before.links)) < 0.1:
            break
    return sizes


@dataclass(frozen=True)
class Gram:
    """Products of one whitened joint: of its columns x, its residual y and its orthogonal features t; `live` are the columns not 0."""

    xx: np.ndarray
    xy: np.ndarray
    yy: float
    tx: np.ndarray
    ty: np.ndarray
    live: np.ndarray


def _gram(one: Joint, residual: np.ndarray, columns: np.ndarray) -> Gram:
    live = np.flatnonzero(np.any(columns != 0, axis=0))
    y, x = one.white @ residual, one.white @ columns[:, live]
    return Gram(x.T @ x, x.T @ y, float(y @ y), one.along(x), one.along(y), live)


def _reduced(g: Gram, one: Joint, sigma: float, discrepancy: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Normal equations of a joint with its discrepancy integrated out."""
    d = 1 / (one.values + (sigma / discrepancy) ** 2)
    scaled = g.tx * d[:, None]
    misfit = float(g.yy - g.ty @ (d * g.ty)) / sigma**2
    return (g.xx - g.tx.T @ scaled) / sigma**2, (g.xy - scaled.T @ g.ty) / sigma**2, misfit


def at_size(prior: Prior, links: float) -> Prior:
    """The prior with errors of the links of this size."""
    return replace(prior, precision=np.where(prior.links, prior.precision / links**2, prior.precision))


def _normal(grams, joints, sizes, prior):
    p = len(prior.mean)
    matrix, right, misfit = np.zeros((p, p)), np.zeros(p), 0.0
    for j, (g, one) in enumerate(zip(grams, joints, strict=True)):
        xx, xy, yy = _reduced(g, one, sizes.sigma[j], sizes.discrepancy[j])
        matrix[np.ix_(g.live, g.live)] += xx
        right[g.live] += xy
        misfit += yy
    return matrix, right, misfit


def _minimum(grams, joints, sizes, prior):
    likelihood, right, _ = _normal(grams, joints, sizes, prior)
    at = at_size(prior, sizes.links)
    matrix = likelihood + np.diag(at.precision)
    target = right + at.precision * at.mean
    step = _solved(matrix, target)
    if np.any(step < prior.lower) or np.any(step > prior.upper):
        step = box_step(matrix, target, prior.lower, prior.upper)
    return step, matrix


def _solved(matrix: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The solution of linear equations with a precision, scaled to a diagonal of 1; a matrix of targets gives one each."""
    scale = np.sqrt(np.diag(matrix))
    scale = np.where(scale > 0, scale, 1.0)
    factor = cho_factor(matrix / np.outer(scale, scale) + 1e-12 * np.eye(len(matrix)))
    return (cho_solve(factor, (target.T / scale).T).T / scale).T


def _updated(grams, joints, sizes: Sizes, prior: Prior, step: np.ndarray, matrix: np.ndarray) -> Sizes:
    """The sizes after one step towards those of the largest evidence (MacKay's fixed point)."""
    sigma, discrepancy = sizes.sigma.copy(), sizes.discrepancy.copy()
    inverse = _solved(matrix, np.eye(len(matrix)))
    for j, (g, one) in enumerate(zip(grams, joints, strict=True)):
        rho = (sigma[j] / discrepancy[j]) ** 2
        d, own = step[g.live], inverse[np.ix_(g.live, g.live)]
        t, weights = g.ty - g.tx @ d, 1 / (one.values + rho)
        c, through = weights * t, weights[:, None] * g.tx
        spread = float(np.sum((through @ own) * through)) / discrepancy[j] ** 2  # of c, as that of the parameters has it
        used = max(float(np.sum(one.values * weights)) - spread, 0.0)
        xx, _, _ = _reduced(g, one, sigma[j], discrepancy[j])
        taken = float(np.sum(xx * own))
        squares = g.yy - 2 * g.xy @ d + d @ g.xx @ d - 2 * c @ t + c @ (one.values * c)
        sigma[j] = np.sqrt(max(squares, 1e-18) / max(one.count - used - taken, one.count / 2, 1.0))
        discrepancy[j] = _size(float(c @ c), used, 1.0)
    links, which = sizes.links, prior.links
    if which.any():
        weights = prior.precision[which]
        known = np.count_nonzero(which) - float(np.sum(weights / links**2 * np.diag(inverse)[which]))
        links = _size(float(weights @ (step - prior.mean)[which] ** 2), max(known, 0.0), 1.0)
    return Sizes(sizes.noise, np.maximum(sigma, 1e-9), discrepancy, links)


def _size(squares: float, known: float, scale: float) -> float:
    """The size x that maximises −squares / 2 x² − known log x − x² / 2 scale²."""
    a = scale**2
    return max(float(np.sqrt(a * (np.sqrt(known**2 + 4 * squares / a) - known) / 2)), LEAST)


def _posterior(data, grams, joints, sizes: Sizes, prior: Prior, problem) -> Posterior:
    likelihood, right, misfit = _normal(grams, joints, sizes, prior)
    at = at_size(prior, sizes.links)
    step, matrix = _minimum(grams, joints, sizes, prior)
    off = step - at.mean
    cost = misfit - 2 * right @ step + step @ likelihood @ step + off @ (at.precision * off)
    volume = matrix + np.diag(at.flat)
    scale = np.sqrt(np.maximum(np.diag(volume), 1e-30))
    log_det = np.linalg.slogdet(volume / np.outer(scale, scale) + 1e-12 * np.eye(len(scale)))[1] + 2 * np.sum(np.log(scale))
    widths = (at.precision + at.flat)[at.proper]
    log = -0.5 * cost - 0.5 * log_det + 0.5 * np.sum(np.log(widths))
    for j, one in enumerate(joints):
        share = one.values * (sizes.discrepancy[j] / sizes.sigma[j]) ** 2
        log += one.log_det - one.count * np.log(sizes.sigma[j]) - 0.5 * np.sum(np.log1p(share))
        log -= 0.5 * sizes.discrepancy[j] ** 2
    if prior.links.any():
        log -= 0.5 * sizes.links**2
    return Posterior(float(log), step, matrix, likelihood, right, misfit, sizes, joints, data, prior, *problem)


def _left(data: Data, found: Posterior, j: int) -> np.ndarray:
    """Residual of a joint without parameters' step and discrepancy, (M,)."""
    one = found.joints[j]
    r = found.residual[j] - found.columns[j] @ found.step
    t = one.along(one.white @ r)
    c = t / (one.values + (found.sizes.sigma[j] / found.sizes.discrepancy[j]) ** 2)
    return (r - data.features[j] @ (one.turn @ c)) * (data.place[j] >= 0)


def _first(data: Data, residual: np.ndarray) -> Sizes:
    """Sizes to begin with: white noise of the residual's own size, a small discrepancy."""
    none = Noise((np.zeros(0),), np.ones(1), 1.0)
    count = np.maximum(data.counted.sum(axis=1), 1)
    sigma = np.sqrt(np.sum(residual**2, axis=1) / count)
    return Sizes((none,) * data.n, np.maximum(sigma, 1e-9), np.ones(data.n), 1.0)

"""The evidence for a model: its likelihood, integrated over parameters, discrepancy and errors of the links.

At a model, the residual of joint j is y_j = A_j d + F_j c_j + e_j for a change d of the parameters: F_j c_j is a discrepancy, c_j ~
N(0, s_j²), and e_j the noise, which the matrix W_j of an autoregressive process makes white, W_j e_j ~ N(0, σ_j²). Priors of d are
normal. So all integrals are in closed form; the hyperparameters σ_j, s_j and by how much errors of each link exceed the declared ones maximise
the evidence (MacKay 1992).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy.linalg import eigh
from scipy.sparse import diags
from scipy.special import gammaln

import rrr_oc.calibration.estimator._evidence as extension
from rrr_oc.calibration.estimator.data import Data, Noise
from rrr_oc.calibration.estimator.knobs import MEMORY, PAST, WANDER
from rrr_oc.numerics.rank import lengths

ROUNDING = 1e-12  # share of the largest squared length of a combination of features below which one is 0
ROUNDED = 1e-13  # added to the diagonal of a precision with a diagonal of 1
LARGEST = 1e100  # [Nm] of a residual, beyond which squares are not computed
FARTHEST = (
    100.0  # times the declared ones that errors of a link are expected at most: masses within a factor of some 20, as a rule
)
LEAST = 1e-5  # of a size over its unit, against a singular precision
FREEDOMS = (30.0, 10.0, 5.0, 3.0)  # degrees of freedom of Student's distribution that are tried for the noise
TAIL_STEPS, TAILED = 10, 3.0  # steps to its scale, and nats by which a heavy tail must raise the likelihood
ROUNDS = 5  # most estimates of the noise
UPDATES = 12  # most of the hyperparameters for one noise
SAME = 0.01  # share of a residual by which it may change and leave the same noise; doubled, no change
SMALL_GAIN = 0.2  # nats by which another noise must raise the evidence
CONVERGED = 0.002  # nats that an update of the hyperparameters gains, below which it is the last


@dataclass(frozen=True)
class ParameterPrior:
    """Normal prior of the changes of p parameters.

    Attributes:
        mean, precision: (p,) each.
        proper: Whose width counts in the evidence; the others are in every model, (p,).
        links: Number, from 1, of the link of a URDF whose error it is; 0 of others, (p,).
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

    def some(self, which: np.ndarray) -> "ParameterPrior":
        """Of these parameters, by their numbers."""
        return ParameterPrior(*(getattr(self, f.name)[which] for f in fields(self)))


def joined(base: ParameterPrior, scales: np.ndarray) -> ParameterPrior:
    """A prior with further parameters about 0, of standard deviations (m,)."""
    none, free = np.zeros(len(scales)), np.full(len(scales), np.inf)
    return extended(base, none, scales**-2.0, none, -free, free)


def extended(
    base: ParameterPrior, mean: np.ndarray, precision: np.ndarray, flat: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> ParameterPrior:
    """A prior with further proper parameters, (m,) each."""
    one = ParameterPrior(mean, precision, np.ones(len(mean), bool), np.zeros(len(mean), int), lower, upper, flat)
    return ParameterPrior(*(np.append(getattr(base, f.name), getattr(one, f.name)) for f in fields(base)))


@dataclass(frozen=True)
class Hyperparameters:
    """What is estimated beside the parameters.

    Attributes:
        noise, sigma: Of each joint, (n,).
        discrepancy: Of each joint, over the declared one, (n,).
        links: Errors of each link over the declared ones, (n,); at least 1 where they are estimated.
    """

    noise: tuple[Noise, ...]
    sigma: np.ndarray
    discrepancy: np.ndarray
    links: np.ndarray


@dataclass(frozen=True)
class Spectrum:
    """What the evidence needs of a whitened joint beside products of its columns.

    Attributes:
        values: Squared lengths of the orthogonal features of its discrepancy, (F,).
        log_det: Of W.
        count: Rows that count.
    """

    values: np.ndarray
    log_det: float
    count: int

    def square(self, y: np.ndarray, t: np.ndarray, sigma: float, discrepancy: float) -> float:
        """Weighted square yᵀ P y / σ² of a whitened residual (M,), whose products with the orthogonal features are t (F,)."""
        return float(y @ y - t @ (t / (self.values + (sigma / discrepancy) ** 2))) / sigma**2


@dataclass(frozen=True)
class Joint(Spectrum):
    """One joint, whitened and with its discrepancy diagonalised.

    Attributes:
        noise: The filters of W.
        freedom: Degrees of freedom of its Student distribution; infinite where it is normal.
        white: W, (M, M).
        turn: From whitened features to the orthogonal ones, (F, F').
        features: The whitened features, (M, F').
    """

    noise: Noise
    freedom: float
    white: Any
    turn: np.ndarray
    features: np.ndarray

    @classmethod
    def of(cls, data: Data, j: int, noise: Noise) -> "Joint":
        """A joint with normal noise."""
        white, log_det = noise.whitening(data.place[j], data.turning[j])
        none = np.zeros((0, 0))
        return cls(np.zeros(0), log_det, int(data.counted[j].sum()), noise, np.inf, white, none, none).with_features(
            data.features[j]
        )

    @classmethod
    def estimated(cls, data: Data, j: int, left: np.ndarray, taken: np.ndarray | None = None) -> tuple["Joint", float]:
        """The noise of a residual (M,), without features yet, and its σ; `taken` (M, r) is as in `Noise.of`."""
        place, turning = data.place[j], data.turning[j]
        wanders = np.sum(left**2) <= np.count_nonzero(place >= 0) * (WANDER * data.torque[j]) ** 2
        noise = Noise.of(left, place, turning, taken, MEMORY if wanders else PAST)
        white, log_det = noise.whitening(place, turning)
        error = (white @ left)[place >= 0]
        freedom, log, sigma, weights = _tail(error)
        count = len(error)
        scale = np.ones(len(place))
        scale[place >= 0] = np.sqrt(weights)
        log_det += log + count * np.log(sigma) + 0.5 * float(np.sum(weights * error**2)) / sigma**2
        none = np.zeros((0, 0))
        return cls(np.zeros(0), float(log_det), count, noise, freedom, diags(scale) @ white, none, none), sigma

    @classmethod
    def weighted(cls, data: Data, j: int, noise: Noise, freedom: float, weights: np.ndarray, log_det: float) -> "Joint":
        """A joint whose rows have these weights (M,) in the noise, W with this logarithm of its determinant; see `weights`."""
        white, _ = noise.whitening(data.place[j], data.turning[j])
        none = np.zeros((0, 0))
        one = cls(np.zeros(0), log_det, int(data.counted[j].sum()), noise, freedom, diags(weights) @ white, none, none)
        return one.with_features(data.features[j])

    def weights(self, data: Data, j: int) -> np.ndarray:
        """By how much each row counts, beside the noise's own filters, (M,); 1 where the noise is normal."""
        own, plain = self.white.diagonal(), self.noise.whitening(data.place[j], data.turning[j])[0].diagonal()
        return np.divide(own, plain, out=np.ones_like(own), where=plain != 0)

    def with_features(self, features: np.ndarray) -> "Joint":
        """The joint with the features of its discrepancy (M, F)."""
        x = self.white @ features
        values, turn = orthogonal(x.T @ x)
        return replace(self, turn=turn, values=values, features=x)

    def along(self, x: np.ndarray) -> np.ndarray:
        """Products of the orthogonal features with whitened columns, (F, …)."""
        return self.turn.T @ (self.features.T @ x)

    def explained(self, features: np.ndarray, residual: np.ndarray, rho: float) -> np.ndarray:
        """The mean of the discrepancy, of which these are the features before whitening (M, F), beside a residual (M,), (M,)."""
        return features @ (self.turn @ (self.along(self.white @ residual) / (self.values + rho)))

    def beyond_discrepancy(self, x: np.ndarray, rho: float) -> np.ndarray:
        """Whitened columns (M, …) with the discrepancy integrated out, rho = (σ / its size)²: W⁻ᵀ P W⁻¹ x of `docs/discovery.md`."""
        return x - self.features @ (self.turn @ (self.along(x).T / (self.values + rho)).T)


def orthogonal(products: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Squared lengths (F',) of orthogonal combinations of features with these products (F, F), and the combinations (F, F').

    Those that are 0 but for rounding are left out, as where rows are fewer than features.
    """
    values, turn = eigh(products, check_finite=False)
    some = values > ROUNDING * values.max(initial=0.0)
    return values[some], turn[:, some]


def _tail(error: np.ndarray) -> tuple[float, float, float, np.ndarray]:
    """Degrees of freedom of Student's distribution of white errors (M,), the logarithm of its likelihood, its scale, weights of the errors.

    The logarithm is up to a constant. Where the kurtosis is no larger than of the normal distribution, no heavy tail is likelier.
    """
    count, sigma = len(error), max(float(np.sqrt(np.mean(error**2))) if len(error) else 1.0, 1e-9)
    best = np.inf, -count * np.log(sigma) - 0.5 * count, sigma, np.ones(count)
    if not count or np.mean((error / sigma) ** 4) <= 3:
        return best
    freedom, scale = np.array(FREEDOMS), np.full(len(FREEDOMS), sigma)
    for _ in range(TAIL_STEPS):
        weights = (freedom[:, None] + 1) / (freedom[:, None] + (error / scale[:, None]) ** 2)
        scale = np.maximum(np.sqrt(np.mean(weights * error**2, axis=1)), 1e-9)
    # of Student's density, times √(2 π) as that of the normal distribution is
    constant = gammaln((freedom + 1) / 2) - gammaln(freedom / 2) + 0.5 * np.log(2 / freedom) - np.log(scale)
    squares = (error / scale[:, None]) ** 2
    logs = count * constant - 0.5 * (freedom + 1) * np.sum(np.log1p(squares / freedom[:, None]), axis=1) - TAILED
    k = int(np.argmax(logs))
    if logs[k] <= best[1]:
        return best
    return float(freedom[k]), float(logs[k]), float(scale[k]), (freedom[k] + 1) / (freedom[k] + squares[k])


@dataclass(frozen=True)
class LinearSolution:
    """A linear problem solved at its best hyperparameters.

    Attributes:
        log_evidence: Logarithm of the evidence, without the prior probability of the structure.
        step: Change of the parameters, (p,).
        matrix: Posterior precision, (p, p).
        likelihood: The part of it that the data add, (p, p).
        right: Weighted residual by parameters at the start, (p,).
        misfit: Weighted square of the residual at the start.
        hyper: Estimated hyperparameters.
        base: The prior, the links' errors as large as declared.
    """

    log_evidence: float
    step: np.ndarray
    matrix: np.ndarray
    likelihood: np.ndarray
    right: np.ndarray
    misfit: float
    hyper: Hyperparameters
    base: ParameterPrior

    @property
    def prior(self) -> ParameterPrior:
        """The prior at the estimated hyperparameters."""
        return at_size(self.base, self.hyper.links)

    def damped(self, damping: float) -> np.ndarray:
        """The step of Levenberg and Marquardt, with this share of the precision's diagonal added to it, (p,)."""
        if not damping:
            return self.step
        diagonal, prior = np.diag(self.matrix), self.prior
        target = self.right + prior.precision * prior.mean
        step = np.linalg.solve(self.matrix + np.diag(damping * np.maximum(diagonal, 1e-12)), target)
        return np.clip(step, prior.lower, prior.upper)

    def predicted(self, step: np.ndarray) -> float:
        """Cost after a change of the parameters, as linearity has it."""
        return self.misfit - 2 * float(self.right @ step) + float(step @ self.likelihood @ step) + self.prior_cost(step)

    def prior_cost(self, step: np.ndarray) -> float:
        """Weighted square of a change of the parameters from the prior's mean."""
        off = step - self.prior.mean
        return float(off @ (self.prior.precision * off))


@dataclass(frozen=True)
class Posterior(LinearSolution):
    """The posterior of the parameters of a model about its fit.

    Attributes:
        joints: The joints whitened.
        data: The data.
        residual: (n, M).
        columns: Derivatives of the prediction, (n, M, p).
        moving: Joints whose noise has not come to its end.
    """

    joints: tuple[Joint, ...]
    data: Data
    residual: np.ndarray
    columns: np.ndarray
    moving: Sequence[int] = ()

    def ratio(self, j: int) -> float:
        """ρ = (σ / size of the discrepancy)² of a joint."""
        return float(self.hyper.sigma[j] / self.hyper.discrepancy[j]) ** 2

    def missed(self, j: int, residual: np.ndarray) -> float:
        """By what share another residual (M,) of a joint is not as predicted after the step."""
        predicted = self.residual[j] - self.columns[j] @ self.step
        return float(np.linalg.norm(residual - predicted) / max(np.linalg.norm(predicted), 1e-300))

    def cost(self, residual: np.ndarray) -> float:
        """See `NoiseStart.cost`."""
        return NoiseStart(self.hyper, self.joints).cost(residual)


@dataclass(frozen=True)
class NoiseStart:
    """Where the estimates of a fit's noise and hyperparameters begin if there is no posterior of a similar problem."""

    hyper: Hyperparameters
    joints: tuple[Joint, ...]

    @classmethod
    def of(cls, data: Data, hyper: Hyperparameters) -> "NoiseStart":
        """With these hyperparameters."""
        return cls(hyper, tuple(Joint.of(data, j, noise) for j, noise in enumerate(hyper.noise)))

    def cost(self, residual: np.ndarray) -> float:
        """Weighted square of a residual (n, M), under this noise; infinite where squares would be."""
        if not np.max(np.abs(residual), initial=0.0) < LARGEST:
            return np.inf
        total = 0.0
        for j, one in enumerate(self.joints):
            y = one.white @ residual[j]
            total += one.square(y, one.along(y), self.hyper.sigma[j], self.hyper.discrepancy[j])
        return total


def solve(
    data: Data,
    residual: np.ndarray,
    columns: np.ndarray,
    prior: ParameterPrior,
    start: Posterior | NoiseStart | None = None,
    fixed: bool = False,
) -> Posterior:
    """The posterior of a linear problem.

    Args:
        residual: (n, M).
        columns: Derivatives of the prediction, (n, M, p).
        start: Whose hyperparameters are the first ones: the posterior of a similar problem, as a rule.
        fixed: Whether these stay as they are.
    """
    start = start or NoiseStart.of(data, _first(data, residual))
    hyper, joints = start.hyper, start.joints
    grams = [Gram.of(one, residual[j], columns[j]) for j, one in enumerate(joints)]
    # joints whose noise may still change: not where the residual is the one from which it was estimated
    moving = list(range(data.n))
    if isinstance(start, Posterior) and start.data is data:
        moving = [j for j in moving if j in start.moving or start.missed(j, residual[j]) > SAME]
    best = None
    for _ in range(ROUNDS):
        solution = estimated(grams, joints, hyper, prior, fixed)
        found = Posterior(**vars(solution), joints=joints, data=data, residual=residual, columns=columns)
        if fixed:
            return found
        if best is not None and found.log_evidence < best.log_evidence + SMALL_GAIN:
            break
        best = found
        root, sigma, before = root_of_covariance(found.matrix), found.hyper.sigma.copy(), joints
        for j in moving:
            one, sigma[j] = _renewed(data, found, j, root)
            joints = (*joints[:j], one, *joints[j + 1 :])
        moving = [j for j in moving if joints[j] is not before[j]]
        if not moving:
            break
        for j in moving:
            grams[j] = Gram.of(joints[j], residual[j], columns[j])
        noise = tuple(one.noise for one in joints)
        hyper = Hyperparameters(noise, sigma, found.hyper.discrepancy, found.hyper.links)
    else:
        best = best and replace(best, moving=moving)
    assert best is not None
    return best


def _renewed(data: Data, found: Posterior, j: int, root: np.ndarray) -> tuple[Joint, float]:
    """A joint with its noise estimated from the residual that is left, and σ; as it is where that changes the evidence little."""
    left, old, sigma = _left(data, found, j), found.joints[j], found.hyper.sigma[j]
    new, size = Joint.estimated(data, j, left, _taken(data, found, j, root))
    if _likelihood(new, size, left) - _likelihood(old, sigma, left) < SMALL_GAIN:
        return old, sigma
    return new.with_features(data.features[j]), size


def _likelihood(one: Joint, sigma: float, left: np.ndarray) -> float:
    """Logarithm of the likelihood of the noise (M,) of a joint, up to a constant."""
    return float(one.log_det - one.count * np.log(sigma) - 0.5 * np.sum((one.white @ left) ** 2) / sigma**2)


def gain_of_other_noise(data: Data, j: int, one: Joint, sigma: float, discrepancy: float, residual: np.ndarray) -> float:
    """By how much the log likelihood of a joint's residual (M,) rises, all else being estimated, if its noise is estimated anew."""
    left = _noise(data, j, one, (sigma / discrepancy) ** 2, residual)
    return max(_likelihood(*Joint.estimated(data, j, left), left) - _likelihood(one, sigma, left), 0.0)


@dataclass(frozen=True)
class Gram:
    """Products of one whitened joint: of its columns x, its residual y and its orthogonal features t; `live` are the columns not 0."""

    xx: np.ndarray
    xy: np.ndarray
    yy: float
    tx: np.ndarray
    ty: np.ndarray
    live: np.ndarray

    @classmethod
    def of(cls, one: Joint, residual: np.ndarray, columns: np.ndarray) -> "Gram":
        """Of a joint's residual (M,) and columns (M, p)."""
        live = np.flatnonzero(np.any(columns != 0, axis=0))
        y, x = one.white @ residual, one.white @ columns[:, live]
        return cls(x.T @ x, x.T @ y, float(y @ y), one.along(x), one.along(y), live)


def at_size(prior: ParameterPrior, links: np.ndarray) -> ParameterPrior:
    """The prior with errors of the links (n,) times as large as declared."""
    return replace(prior, precision=prior.precision / np.append(1.0, links)[prior.links] ** 2)


def estimated(
    grams: Sequence[Gram], joints: Sequence[Spectrum], hyper: Hyperparameters, prior: ParameterPrior, fixed: bool = False
) -> LinearSolution:
    """The posterior of a linear problem, from the products of its columns.

    Hyperparameters are those of the largest evidence for this noise, by MacKay's fixed point from `hyper` on, or these if `fixed`.
    """
    p, n = len(prior.mean), len(grams)
    arrays = [np.ascontiguousarray(getattr(prior, f.name), float) for f in fields(prior)]
    size = np.concatenate([hyper.sigma, hyper.discrepancy, hyper.links])
    step, matrix, likelihood, right = np.empty(p), np.empty((p, p)), np.empty((p, p)), np.empty(p)
    every = tuple(
        (
            len(g.live),
            len(one.values),
            *map(_contiguous, (g.xx, g.xy, g.tx, g.ty, one.values)),
            g.live,
            g.yy,
            one.log_det,
            one.count,
        )
        for g, one in zip(grams, joints, strict=True)
    )
    updates = 0 if fixed else UPDATES
    while True:
        log, misfit = extension.estimate(p, every, *arrays, size, updates, CONVERGED, LEAST, step, matrix, likelihood, right)
        if np.all(size[2 * n :] <= FARTHEST):
            break
        size[2 * n :], updates = np.minimum(size[2 * n :], FARTHEST), 0
    found = Hyperparameters(hyper.noise, size[:n], size[n : 2 * n], size[2 * n :])
    return LinearSolution(log, step, matrix, likelihood, right, misfit, found, prior)


def _contiguous(x: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(x, float)


def _left(data: Data, found: Posterior, j: int) -> np.ndarray:
    """Residual of a joint without parameters' step and discrepancy, (M,)."""
    return _noise(data, j, found.joints[j], found.ratio(j), found.residual[j] - found.columns[j] @ found.step)


def _noise(data: Data, j: int, one: Joint, rho: float, residual: np.ndarray) -> np.ndarray:
    """A joint's residual (M,) without the mean of its discrepancy; 0 at rows that do not count."""
    return (residual - one.explained(data.features[j], residual, rho)) * (data.place[j] >= 0)


def _taken(data: Data, found: Posterior, j: int, root: np.ndarray) -> np.ndarray:
    """Columns whose products are the covariance of what parameters and discrepancy explain of a joint, given the data, (M, r).

    Args:
        root: Of the covariance of the parameters, (p, p).
    """
    one, rho = found.joints[j], found.ratio(j)
    live = np.any(found.columns[j], axis=0)
    by_parameters = found.columns[j][:, live] @ root[live]
    features, weights = data.features[j] @ one.turn, 1 / (one.values + rho)
    by_parameters -= features @ (weights[:, None] * one.along(one.white @ by_parameters))
    both = np.column_stack([by_parameters, features * (found.hyper.sigma[j] * np.sqrt(weights))])
    return both * (data.place[j] >= 0)[:, None]


def root_of_covariance(matrix: np.ndarray) -> np.ndarray:
    """A matrix (p, p) whose product with its transpose is the inverse of a posterior precision."""
    scale = lengths(matrix)
    factor = np.linalg.cholesky(matrix / np.outer(scale, scale) + ROUNDED * np.eye(len(scale)))
    return np.linalg.inv(factor).T / scale[:, None]


def _first(data: Data, residual: np.ndarray) -> Hyperparameters:
    """Hyperparameters to begin with: white noise of the residual's own size, a small discrepancy."""
    none = Noise((np.zeros(0),), np.ones(1), 1.0)
    count = np.maximum(data.counted.sum(axis=1), 1)
    sigma = np.sqrt(np.sum(residual**2, axis=1) / count)
    return Hyperparameters((none,) * data.n, np.maximum(sigma, 1e-9), np.ones(data.n), np.ones(data.n))

"""The posterior of linear problems against dense normal distributions, and what follows from it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import lsq_linear, minimize
from scipy.stats import multivariate_normal
from test_data import INNOVATION, PLACE, dense, exact_noise, places

from rrr_oc.calibration.estimator.data import Noise
from rrr_oc.calibration.estimator.evidence import Gram, Hyperparameters, Joint, ParameterPrior, Spectrum, estimated, solve


class Problem:
    """Two joints, p parameters and a discrepancy of three functions on each, made up at random."""

    def __init__(self, seed: int, parameters: int = 4, place: np.ndarray = PLACE, features: int = 3):
        rng, m = np.random.default_rng(seed), len(place)
        counted = place >= 0
        self.features = tuple(rng.standard_normal((m, features)) * counted[:, None] for _ in range(2))
        self.residual = rng.standard_normal((2, m)) * counted
        self.columns = rng.standard_normal((2, m, parameters)) * counted[:, None]
        self.data = SimpleNamespace(
            torque=np.full(9, 1e3),  # of each joint, so large that all noise may wander
            n=2,
            place=np.array([place, place]),
            turning=np.zeros((2, m), bool),
            counted=np.array([counted, counted]),
            features=self.features,
        )
        self.prior = normal(rng.standard_normal(parameters), rng.uniform(0.5, 2.0, parameters))
        noises = (exact_noise(), Noise((np.zeros(0),), np.ones(1), 1.0))
        self.joints = tuple(Joint.of(self.data, j, noise) for j, noise in enumerate(noises))
        self.hyper = Hyperparameters(noises, np.array([0.4, 0.9]), np.array([0.7, 1.6]), np.array([1.3, 2.5]))

    def solved(self, prior: ParameterPrior, columns: np.ndarray, hyper: Hyperparameters | None = None):
        start = SimpleNamespace(hyper=hyper or self.hyper, joints=self.joints)
        return solve(self.data, self.residual, columns, prior, start, fixed=True)

    def covariance(self, prior: ParameterPrior, columns: np.ndarray) -> np.ndarray:
        """Of the rows that count, joint by joint, without the parameters' uncertainty if they have none."""
        counted, parts = self.data.counted[0], []
        alone = (dense(PLACE) / INNOVATION**2, np.eye(np.count_nonzero(counted)))
        for j, shape in enumerate(alone):
            f = self.features[j][counted]
            parts.append(self.hyper.sigma[j] ** 2 * shape + self.hyper.discrepancy[j] ** 2 * f @ f.T)
        a = columns[:, counted].reshape(-1, columns.shape[2])
        precision = prior.precision / np.append(1.0, self.hyper.links)[prior.links] ** 2
        return block_diag(*parts) + a @ np.diag(1 / precision) @ a.T

    def log_density(self, prior: ParameterPrior, columns: np.ndarray) -> float:
        """Of the residual, parameters and discrepancy integrated out."""
        counted = self.data.counted[0]
        mean = (columns[:, counted] @ prior.mean).ravel()
        y = self.residual[:, counted].ravel()
        return float(multivariate_normal(mean, self.covariance(prior, columns)).logpdf(y))


def with_rest_at(problem: Problem, j: int) -> Problem:
    """The problem with a joint of which no row counts."""
    problem.data.place[j], problem.data.counted[j] = -1, False
    problem.residual[j], problem.columns[j], problem.features[j][:] = 0, 0, 0
    return problem


def normal(mean: np.ndarray, std: np.ndarray, links: tuple[int, ...] = ()) -> ParameterPrior:
    """Proper normal priors; of `links`, the first half are errors of one link, the others of another."""
    p, half = len(mean), len(links) // 2
    which, inf = np.isin(np.arange(p), links[:half]) + 2 * np.isin(np.arange(p), links[half:]), np.full(p, np.inf)
    return ParameterPrior(np.asarray(mean), std**-2.0, np.ones(p, bool), which, -inf, inf, np.zeros(p))


@pytest.mark.parametrize("links", [(), (1, 2)])
def test_evidence_is_the_density_of_the_marginal_normal_distribution(links):
    """But for 2 π and the priors of the hyperparameters: of a discrepancy normal of scale 1, of links' sizes x above 1 the chance 1 / x."""
    problem = Problem(1)
    prior = replace(problem.prior, links=normal(np.zeros(4), np.ones(4), links).links)
    found = problem.solved(prior, problem.columns)
    count = 2 * np.count_nonzero(PLACE >= 0)
    expected = problem.log_density(prior, problem.columns) + 0.5 * count * np.log(2 * np.pi)
    expected -= 0.5 * np.sum(np.square(problem.hyper.discrepancy)) + np.sum(np.log(problem.hyper.links))
    assert found.log_evidence == pytest.approx(expected, abs=1e-7)


def test_the_posterior_is_that_of_dense_algebra():
    problem = Problem(2)
    found = problem.solved(problem.prior, problem.columns)
    counted = PLACE >= 0
    noise = problem.covariance(replace(problem.prior, precision=np.full(4, 1e30)), problem.columns)
    a, y = problem.columns[:, counted].reshape(-1, 4), problem.residual[:, counted].ravel()
    precision = a.T @ np.linalg.solve(noise, a) + np.diag(problem.prior.precision)
    right = a.T @ np.linalg.solve(noise, y) + problem.prior.precision * problem.prior.mean
    np.testing.assert_allclose(found.matrix, precision, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found.step, np.linalg.solve(precision, right), rtol=1e-7, atol=1e-9)
    other = np.random.default_rng(3).standard_normal(problem.residual.shape) * counted
    z = other[:, counted].ravel()
    assert found.cost(other) == pytest.approx(z @ np.linalg.solve(noise, z), rel=1e-9)


@pytest.mark.parametrize("seed", range(8))
def test_the_step_within_bounds_is_that_of_bounded_least_squares(seed):
    """By another method (Stark & Parker's BVLS, of scipy), of the same normal equations; parameters may be fixed."""
    problem, rng = Problem(20 + seed, 6), np.random.default_rng(seed)
    base = normal(rng.standard_normal(6), np.full(6, 3.0))
    free = problem.solved(base, problem.columns)
    lower, upper = free.step + rng.uniform(-0.3, 0.1, 6), free.step + rng.uniform(0.1, 0.3, 6)
    lower[5] = upper[5] = free.step[5] + 0.2
    found = problem.solved(replace(base, lower=lower, upper=upper), problem.columns)
    root = np.linalg.cholesky(free.matrix).T
    inside = lower < upper
    target = root @ free.step - root[:, ~inside] @ lower[~inside]
    expected = lower.copy()
    expected[inside] = lsq_linear(root[:, inside], target, (lower[inside], upper[inside]), method="bvls", tol=1e-14).x
    np.testing.assert_allclose(found.step, expected, rtol=1e-7, atol=1e-8)


def test_a_damped_step_is_shorter_and_lowers_the_cost():
    problem = Problem(12)
    found = problem.solved(problem.prior, problem.columns)
    steps = [found.damped(x) for x in (0.0, 0.1, 1.0, 100.0)]
    costs = [found.predicted(step) for step in steps]
    assert costs == sorted(costs)
    assert costs[-1] < found.predicted(np.zeros(4))
    np.testing.assert_array_equal(steps[0], found.step)


def test_structures_are_compared_whatever_the_prior_of_what_all_have():
    """A parameter that is in every model has a wide prior, whose width counts in none of them."""
    problem, wide = Problem(4), 1e3
    mean, std = np.array([0.0, 0.2, -0.3, 0.1]), np.array([wide, 1.0, 0.5, 2.0])
    whole = replace(normal(mean, std), proper=np.array([False, True, True, True]))
    less = replace(normal(mean[:2], std[:2]), proper=np.array([False, True]))
    found = problem.solved(whole, problem.columns).log_evidence - problem.solved(less, problem.columns[:, :, :2]).log_evidence
    expected = problem.log_density(whole, problem.columns) - problem.log_density(less, problem.columns[:, :, :2])
    assert found == pytest.approx(expected, abs=1e-5)  # of a condition of 1e6
    bare = problem.solved(less, problem.columns[:, :, :2]).log_evidence
    assert problem.solved(
        replace(less, precision=np.array([1e-10, 1.0])), problem.columns[:, :, :2]
    ).log_evidence == pytest.approx(bare, abs=1e-3)


def test_a_column_that_says_nothing_changes_no_evidence():
    problem = Problem(5)
    more = np.concatenate([problem.columns, np.zeros((2, len(PLACE), 1))], axis=2)
    prior = normal(np.append(problem.prior.mean, 0.0), np.append(problem.prior.precision**-0.5, 3.0))
    plain = problem.solved(problem.prior, problem.columns).log_evidence
    assert problem.solved(prior, more).log_evidence == pytest.approx(plain, abs=1e-9)


@pytest.mark.parametrize("like", [0.0, 1.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_sizes_that_are_found_maximise_the_evidence(seed, like):
    """Also where parameters act like the discrepancy, so that what is known of either depends on the other."""
    place, count = places(200, -3, 200), 8
    problem, rng = Problem(seed, count, place, 12), np.random.default_rng(100 + seed)
    alike = 0.5 * np.array(problem.features)[..., :count] + 0.005 * problem.columns
    problem.columns = like * alike + (1 - like) * problem.columns
    d, c = rng.standard_normal(count), 0.6 * rng.standard_normal((2, 12))
    for j in range(2):
        problem.residual[j] = 0.5 * problem.residual[j] + problem.columns[j] @ d + problem.features[j] @ c[j]
    prior = normal(np.zeros(count), np.ones(count), (3, 4, 5, 6, 7))
    found = solve(problem.data, problem.residual, problem.columns, prior)

    def loss(change: np.ndarray) -> float:
        factors, hyper = np.exp(change), found.hyper
        links = np.maximum(hyper.links * factors[4:], 1.0)
        hyper = Hyperparameters(hyper.noise, hyper.sigma * factors[:2], hyper.discrepancy * factors[2:4], links)
        start = replace(found, hyper=hyper)
        return (
            found.log_evidence - solve(problem.data, problem.residual, problem.columns, prior, start, fixed=True).log_evidence
        )

    assert loss(np.zeros(6)) == pytest.approx(0.0, abs=1e-9)
    best = minimize(loss, np.zeros(6), method="Nelder-Mead", options={"maxiter": 1500, "fatol": 1e-6, "xatol": 1e-4})
    assert best.fun > -0.01  # updates end where the hyperparameters hardly change
    assert all(loss(0.3 * step) > 0.01 for step in np.concatenate([np.eye(6)[:4], -np.eye(6)[:4]]))
    assert np.all(np.abs(found.hyper.sigma - 0.5) < 0.06)


def test_one_huge_error_hardly_moves_the_estimates():
    """The noise becomes Student's; least squares would be moved far."""
    place, truth = places(400), np.array([1.0, -2.0, 0.5, 0.0])
    problem = Problem(6, 4, place)
    prior = normal(np.zeros(4), np.full(4, 10.0))
    y = 0.1 * problem.residual + problem.columns @ truth
    wrong = y.copy()
    wrong[:, 123] += 50.0
    calm, hit = (solve(problem.data, r, problem.columns, prior) for r in (y, wrong))
    std = np.sqrt(np.diag(np.linalg.inv(calm.matrix)))
    squares = np.linalg.lstsq(problem.columns.reshape(-1, 4), wrong.ravel(), rcond=None)[0]
    assert np.max(np.abs(squares - truth) / std) > 20
    assert np.max(np.abs(hit.step - calm.step) / std) < 1
    np.testing.assert_allclose(calm.step, truth, atol=4 * np.max(std))
    assert np.all(hit.hyper.sigma < 1.3 * calm.hyper.sigma)


def test_a_joint_without_rows_that_count_says_nothing():
    """It rests in all recordings."""
    problem = Problem(7)
    still = with_rest_at(problem, 1)
    prior = normal(np.zeros(4), np.ones(4))
    found = solve(still.data, still.residual, still.columns, prior)
    alone = SimpleNamespace(**{**vars(still.data), "n": 1, "counted": still.data.counted[:1]})
    expected = solve(alone, still.residual[:1], still.columns[:1], prior)
    np.testing.assert_allclose(found.step, expected.step, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("count", [3, 40, 90])
def test_many_parameters_and_no_discrepancy(count):
    """Least squares with a normal prior, whatever the number of parameters."""
    rng = np.random.default_rng(count)
    x, y = rng.standard_normal((300, count)), rng.standard_normal(300)
    gram = Gram(x.T @ x, x.T @ y, float(y @ y), np.zeros((0, count)), np.zeros(0), np.arange(count))
    prior, none = normal(np.zeros(count), np.ones(count)), Noise((np.zeros(0),), np.ones(1), 1.0)
    hyper = Hyperparameters((none,), np.array([0.5]), np.array([1.0]), np.array([1.0]))
    for fixed in (True, False):
        found = estimated([gram], [Spectrum(np.zeros(0), 0.0, 300)], hyper, prior, fixed)
        weight = 1 / found.hyper.sigma[0] ** 2
        expected = np.linalg.solve(weight * gram.xx + np.diag(prior.precision), weight * gram.xy)
        np.testing.assert_allclose(found.step, expected, rtol=1e-6, atol=1e-9)

"""The least-squares core on a problem with a known answer, and the rank test against numpy's singular values."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import least_squares

from rrr_oc.calibration.least_squares import GaussNewton, Quadratic, gauss_newton, levenberg_marquardt
from rrr_oc.numerics.rank import Directions, condition, independent_columns, pseudo_inverse, undetermined

T = np.linspace(0, 2, 40)
TRUE = np.array([2.0, 1.3])


@dataclass(frozen=True)
class Decay:
    """y = a exp(−b t), whose cost is the sum of squared residuals."""

    measured: np.ndarray
    upper: np.ndarray

    def residual(self, at):
        return self.measured - at[0] * np.exp(-at[1] * T)

    def cost(self, at):
        return float(np.sum(self.residual(at) ** 2))

    def near(self, at):
        jacobian = np.stack([np.exp(-at[1] * T), -at[0] * T * np.exp(-at[1] * T)], axis=1)
        return Quadratic(self.cost(at), jacobian.T @ jacobian, jacobian.T @ self.residual(at), -at, self.upper - at)

    def tried(self, at, steps):
        return ((at + s, self.cost(at + s)) for s in steps)


METHODS = {
    "Gauss–Newton": lambda p, at: gauss_newton(at, p.near, p.tried, GaussNewton(50, promise=1e-14)),
    "Levenberg–Marquardt": lambda p, at: levenberg_marquardt(at, p.near, p.cost, 200, 1e-14),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("upper", [10.0, 1.0])
def test_the_minimum_within_bounds_is_scipys(method, upper):
    measured = TRUE[0] * np.exp(-TRUE[1] * T) + 0.01 * np.random.default_rng(0).standard_normal(T.size)
    problem = Decay(measured, np.array([10.0, upper]))
    expected = least_squares(problem.residual, [0.5, 0.5], bounds=([0, 0], problem.upper), xtol=1e-12, ftol=1e-14, gtol=1e-12).x
    found = METHODS[method](problem, np.array([0.5, 0.5]))
    np.testing.assert_allclose(found, expected, atol=2e-5)  # the cost is flat there


def test_a_step_is_shortened_until_the_cost_falls():
    problem = Decay(TRUE[0] * np.exp(-TRUE[1] * T), np.full(2, np.inf))
    far = np.array([0.5, 6.0])
    assert problem.cost(gauss_newton(far, problem.near, problem.tried, GaussNewton(1))) < problem.cost(far)


def test_the_rank_test_agrees_with_singular_values():
    a = np.random.default_rng(1).standard_normal((30, 5)) * [1e-3, 1.0, 1e3, 1.0, 1.0]
    np.testing.assert_allclose(condition(a.T @ a), np.linalg.cond(a / np.linalg.norm(a, axis=0)), rtol=1e-8)
    a[:, 4] = a[:, 1] - 2 * a[:, 3]
    matrix = a.T @ a
    found = Directions.of(matrix)
    assert found.determined.sum() == np.linalg.matrix_rank(a / np.linalg.norm(a, axis=0)) == 4
    np.testing.assert_array_equal(undetermined(matrix), [False, True, False, True, True])
    right = a.T @ a @ np.ones(5)
    np.testing.assert_allclose(matrix @ found.solve(right), right, rtol=1e-8)
    np.testing.assert_allclose(matrix @ pseudo_inverse(matrix) @ matrix, matrix, rtol=1e-7, atol=1e-7)
    np.testing.assert_array_equal(independent_columns(a), [0, 1, 2, 3])
    np.testing.assert_array_equal(independent_columns(a[:, ::-1]), [0, 1, 2, 4])

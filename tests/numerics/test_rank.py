"""The rank test against numpy's singular values."""

import numpy as np

from rrr_oc.numerics.rank import Directions, condition, independent_columns, pseudo_inverse, undetermined


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

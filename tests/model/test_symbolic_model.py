"""Functions at many instants against casadi's own evaluation of each."""

import casadi as ca
import numpy as np
import pytest

from rrr_oc.numerics.along import along


@pytest.fixture(scope="module")
def function() -> ca.Function:
    """All kinds of scalar operations, constants, sparse results, one without arguments."""
    x, matrix, c = ca.SX.sym("x", 3), ca.SX.sym("m", 2, 2), ca.SX.sym("c", 2)
    a, b, d = x[0], x[1], x[2]
    odd = ca.vertcat(
        ca.sin(a) * ca.cos(b) + ca.tan(d / 3),
        ca.tanh(a / c[0]) - ca.exp(-(b**2)) + ca.log(1 + d**2),
        ca.sqrt(ca.fabs(a)) / (2 + b) + a**3.5 / 7,
        ca.fmax(a, b) - ca.fmin(b, d) + ca.sign(a) + ca.floor(3 * b),
        ca.if_else(a > b, c[1], d) + ca.atan2(a, b) + ca.acos(b / 9) + ca.erf(d),
    )
    sparse = ca.SX(ca.Sparsity.lower(3), ca.vertcat(a, 2 * b, -d, a * b, a / d, c[1]))
    return ca.Function("kinds", [x, matrix, c], [odd, ca.mtimes(matrix, matrix).T, sparse, ca.SX([1.5, -2.0])])


@pytest.mark.parametrize("count", [1, 31, 32, 33, 2500])
def test_many_instants_equal_each_alone(function, count):
    rng = np.random.default_rng(count)
    x, m, c = rng.uniform(0.1, 3, (3, count)), rng.normal(size=(2, 2 * count)), np.array([0.4, -1.2])
    found = along(function, x, m, c)
    assert [f.shape for f in found] == [(5, count), (2, 2 * count), (3, 3 * count), (2, count)]
    for k in range(count):
        alone = function(x[:, k], m[:, 2 * k : 2 * k + 2], c)
        for whole, one in zip(found, alone, strict=True):
            width = one.shape[1]
            np.testing.assert_allclose(whole[:, k * width : (k + 1) * width], np.array(one), rtol=1e-14, atol=1e-15)


def test_arguments_that_do_not_fit_are_refused(function):
    x, m, c = np.ones((3, 7)), np.ones((2, 14)), np.ones(2)
    for wrong in ((x, m[:, :8], c), (x[:2], m, c), (x, m, np.ones(3))):
        with pytest.raises(ValueError, match="numbers"):
            along(function, *wrong)
    with pytest.raises(ValueError, match="arguments"):
        along(function, x, m)


def test_functions_that_are_not_of_scalars_are_refused():
    x = ca.MX.sym("x", 2)
    with pytest.raises(ValueError, match="scalar"):
        along(ca.Function("whole", [x], [2 * x]), np.ones((2, 4)))

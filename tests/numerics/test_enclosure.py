"""Interval arithmetic against values and differences at random points of boxes."""

import casadi as ca
import numpy as np
import pytest

from rrr_oc.numerics.enclosure import Enclosure, NotEnclosed, enclosed, enclosures, evaluated
from rrr_oc.numerics.smooth import ramp

T = np.linspace(-1.0, 1.0, 7)
FUNCTIONS = {
    "sum": lambda a, b: a + T - b - 0.5,
    "product": lambda a, b: (a * b + 2.0) * T,
    "power": lambda a, b: (T - a) ** 3 / 2.0 - b**2,
    "maximum": lambda a, b: np.maximum(a * T, b - T),
    "minimum": lambda a, b: np.minimum(a * T, 0.2) + b,
    "absolute": lambda a, b: np.absolute(a - T) * np.square(b),
    "exact ramp": lambda a, b: b * ramp(a + b * T, 0.0),
    "smooth ramp": lambda a, b: b * ramp(a + b * T, 0.3),
    "sine": lambda a, b: np.sin(2.0 * a + T) * np.cos(b),
    "of one parameter": lambda a, b: 3.0 - a * T,
}


@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS.keys())
def test_values_and_slopes_lie_within(function):
    """1000 points of 20 boxes; central differences where no kink is near, to the step's square."""
    rng = np.random.default_rng(0)
    lower = rng.uniform(-2, 2, (2, 20))
    upper = lower + rng.uniform(0, 1, lower.shape)
    found = function(*enclosures(lower, upper))
    for _ in range(50):
        point = (lower + (upper - lower) * rng.random(lower.shape))[:, :, None]
        value = function(*point)
        assert np.all(found.value[0] <= value + 1e-12)
        assert np.all(value <= found.value[1] + 1e-12)
        for k, step in enumerate(1e-6 * np.eye(2)[:, :, None, None]):
            # a difference over a kink lies between the slopes on its sides, which the enclosure has if the kink is in the box
            inside = (
                np.clip(point + step, lower[:, :, None], upper[:, :, None]),
                np.clip(point - step, lower[:, :, None], upper[:, :, None]),
            )
            slope = (function(*inside[0]) - function(*inside[1])) / (inside[0] - inside[1])[k]
            assert np.all(found.slopes[0][k] <= slope + 1e-6)
            assert np.all(slope <= found.slopes[1][k] + 1e-6)


def test_a_box_that_is_a_point_has_one_value():
    point = np.array([[0.4], [1.3]])
    for function in FUNCTIONS.values():
        found, value = function(*enclosures(point, point)), function(*point[:, :, None])
        np.testing.assert_allclose(found.value[0], value, atol=1e-14)
        np.testing.assert_allclose(found.value[1], value, atol=1e-14)


def test_a_total_counts_slopes_that_are_the_same_at_all_instants():
    """Σ_k w_k (T_k − a) over a box of a: the slope is −Σ w, and the values follow."""
    weights = np.linspace(-1.0, 2.0, T.size)
    found = (T - enclosures(np.array([[0.2]]), np.array([[0.5]]))[0]).total(weights)
    np.testing.assert_allclose(np.ravel(found.slopes), [-weights.sum()] * 2)
    ends = sorted(float(weights @ (T - a)) for a in (0.2, 0.5))
    assert found.value[0] <= ends[0] + 1e-12
    assert found.value[1] >= ends[1] - 1e-12


def test_a_total_of_signed_weights_lies_within():
    rng = np.random.default_rng(1)
    weights, lower, upper = rng.normal(size=T.size), np.array([[-1.0], [0.5]]), np.array([[-0.5], [0.9]])
    found = FUNCTIONS["exact ramp"](*enclosures(lower, upper)).total(weights)
    values = [FUNCTIONS["exact ramp"](*rng.uniform(lower, upper)) @ weights for _ in range(500)]
    assert found.value[0] <= min(values) < max(values) <= found.value[1]
    assert enclosed(T).total(weights).value == pytest.approx((T @ weights, T @ weights))
    assert enclosed(T).slopes is None


@pytest.mark.parametrize("function", [np.exp, lambda a: 1 / a, lambda a: a**0.5, lambda a: a**a, lambda a: np.add(a, 1, out=T)])
def test_what_has_no_rule_is_refused(function):
    with pytest.raises(NotEnclosed):
        function(Enclosure((np.zeros(1), np.ones(1))))


def test_a_casadi_function_is_enclosed():
    """As numpy's arithmetic is, with an entry that is a number and an output without entries."""
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p")
    expression = ca.vertcat(ca.sin(x[0]) * x[1] - p / 2, ca.fmax(x[0] ** 2, -x[1]) + 2 * ca.fabs(x[1]), p)
    function = ca.Function("f", [x, p], [expression, ca.SX(1, 1)])
    rng, lower = np.random.default_rng(0), np.array([[-1.0, 0.3], [0.2, -2.0]])
    upper = lower + 0.7
    (first, second, third), nothing = evaluated(function, [enclosures(lower, upper), [3.0]])
    assert (third, nothing) == (3.0, [])
    for _ in range(100):
        point = rng.uniform(lower, upper)
        value = np.array(function(point, 3.0)[0])
        for found, row in ((first, value[0]), (second, value[1])):
            assert np.all(found.value[0][:, 0] <= row)
            assert np.all(row <= found.value[1][:, 0])
    with pytest.raises(NotEnclosed):
        evaluated(ca.Function("f", [x], [ca.exp(x)]), [enclosures(lower, upper)])

"""Akima's path against scipy's, its derivatives against differences, its extremes against dense samples."""

import casadi as ca
import numpy as np
import pytest
from scipy.interpolate import Akima1DInterpolator

from studies.paper.akima import cubics, extremes, motion, slopes

RNG = np.random.default_rng(3)
S = np.linspace(0, 1, 401)


@pytest.mark.parametrize("points", [RNG.normal(size=7), RNG.normal(size=3), np.array([0, 0, 0, 1, 1, 1, 1.0]), np.arange(7.0)])
def test_the_path_is_scipys(points):
    """The width decides where Akima's weights vanish together, as on straight pieces; scipy takes the same mean there."""
    reference = Akima1DInterpolator(np.arange(len(points)), points)
    for i, cubic in enumerate(cubics(list(points), rest=False)):
        q, dq, ddq = motion(cubic, S, 1.0)
        np.testing.assert_allclose(q, reference(i + S), atol=1e-7)
        np.testing.assert_allclose(dq, reference(i + S, 1), atol=1e-6)
        np.testing.assert_allclose(ddq[:-1], reference(i + S[:-1], 2), atol=1e-5)  # at the last one scipy is on the next piece


def test_rest_changes_the_outer_slopes_only():
    points = list(RNG.normal(size=(7, 2)))
    free, rest = slopes(points, rest=False), slopes(points, rest=True)
    np.testing.assert_array_equal(rest[1:-1], free[1:-1])
    assert not np.any(rest[0])
    assert not np.any(rest[-1])
    assert np.all(np.abs(free[0]) > 1e-3)


def test_derivatives_in_time():
    """dq and ddq of an interval that lasts 0.4 s, against differences of q."""
    cubic, h, step = cubics(list(RNG.normal(size=7)), rest=True)[2], 0.4, 1e-4
    q = [motion(cubic, 0.3 + k * step / h, h)[0] for k in (-1, 0, 1)]
    _, dq, ddq = motion(cubic, 0.3, h)
    assert dq == pytest.approx((q[2] - q[0]) / (2 * step), rel=1e-5)
    assert ddq == pytest.approx((q[2] - 2 * q[1] + q[0]) / step**2, rel=1e-4)


def test_extremes_are_those_of_dense_samples():
    """Of 500 random intervals at once: exact, so never below a sample, and near the nearest one (400 samples: 1e-4 of the way)."""
    cubic = tuple(RNG.normal(size=(4, 500)))
    reach = extremes(cubic, 0.7)
    dense = motion(tuple(c[:, None] for c in cubic), S, 0.7)
    for found, samples in zip(reach, dense, strict=True):
        for exact, sampled in ((found.max(axis=0), samples.max(axis=1)), (-found.min(axis=0), -samples.min(axis=1))):
            assert np.all(exact >= sampled - 1e-12)
            np.testing.assert_allclose(exact, sampled, atol=1e-3)


def test_expressions_give_the_same_numbers():
    """The formula in casadi, with the smoothed weights' width; its slope by a point against a difference."""
    points, width = ca.SX.sym("p", 7), 0.05
    path = ca.Function(
        "path", [points], [ca.vertcat(*[motion(c, 0.4, 1.0)[0] for c in cubics(ca.vertsplit(points), True, width)])]
    )
    values = RNG.normal(size=7)
    numbers = [motion(c, 0.4, 1.0)[0] for c in cubics(list(values), True, width)]
    np.testing.assert_allclose(np.array(path(values)).ravel(), numbers, atol=1e-12)
    slope = ca.Function("slope", [points], [ca.jacobian(path(points), points)])
    away = values.copy()
    away[3] += 1e-6
    difference = (np.array(path(away)) - np.array(path(values))).ravel() / 1e-6
    np.testing.assert_allclose(np.array(slope(values))[:, 3], difference, atol=1e-5)

"""States of first order against the exact solution of each substep, and against an adaptive integrator."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rrr_oc.numerics.relaxation import relaxed


@pytest.mark.parametrize("parts", [1, 4])
@pytest.mark.parametrize("steep", [0.0, 1e-9, 3.0, 5e3])
def test_each_substep_is_exact(parts, steep):
    """x = −constant/slope + (x − that) exp(slope h), or constant h where nothing relaxes; uneven times, substeps without slope."""
    rng, count = np.random.default_rng(51), 50
    t, fine = np.cumsum(rng.uniform(0.5, 1.5, count)) / 100, parts * (count - 1) + 1
    constant, slope = rng.normal(size=fine), -steep * rng.uniform(0, 1, fine) * (rng.uniform(size=fine) > 0.3)
    x, exact = 0.7, [0.7]
    for k in range(fine - 1):
        h = (t[k // parts + 1] - t[k // parts]) / parts
        a, b = (constant[k] + constant[k + 1]) / 2, (slope[k] + slope[k + 1]) / 2
        x = x + a * h if b > -1e-6 else -a / b + (x + a / b) * np.exp(b * h)
        exact += [x] if (k + 1) % parts == 0 else []
    np.testing.assert_allclose(relaxed(t, constant, slope, 0.7), exact, atol=1e-9)  # a slope of 1e-6 for 0.5 s, of 1e-3


def test_a_driven_state_against_an_adaptive_integrator():
    t = np.arange(400) / 200
    fine = np.linspace(t[0], t[-1], 4 * (len(t) - 1) + 1)
    exact = solve_ivp(
        lambda at, x: 4 * np.cos(5 * at) - (2 + np.sin(3 * at)) * x, (t[0], t[-1]), [-0.4], t_eval=t, rtol=1e-10, atol=1e-12
    ).y[0]
    found = relaxed(t, 4 * np.cos(5 * fine), -(2 + np.sin(3 * fine)), -0.4)
    np.testing.assert_allclose(found, exact, atol=1e-5)  # 1e-6; with twice the step four times that


def test_one_sample_is_the_start_and_a_diverging_state_stays_finite():
    assert relaxed(np.array([1.0]), np.ones(1), np.ones(1), 0.3).tolist() == [0.3]
    assert np.all(np.isfinite(relaxed(np.arange(3.0), np.ones(9), np.full(9, 1e9), 1.0)))

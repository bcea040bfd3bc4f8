"""A mass between two ends: the compiled steps against the same steps written out in Python, and against an adaptive integrator."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rrr_oc.numerics.gap import PARTS, across_gap


def stepwise(t, load, stiffness, mass, half, damping):
    """The equation of motion by semi-implicit Euler, sample by sample."""
    result, steps = np.zeros((3, len(t))), np.append(np.diff(t), t[-1] - t[-2])
    x, v, rests = (-half if load[0] > 0 else half), 0.0, True
    for k, step in enumerate(steps):
        outward = -(load[k] + stiffness[k] * x) * np.sign(x)
        if rests and outward >= 0:
            result[0, k] = x
            continue
        start, rests = (x, v), False
        for _ in range(PARTS):
            v = (v - (load[k] + stiffness[k] * x) / mass[k] * step / PARTS) / (1 + damping / mass[k] * step / PARTS)
            x += v * step / PARTS
            if abs(x) >= half:
                x, v = half * np.sign(x), 0.0
        result[:, k] = *start, (v - start[1]) / step
        rests = abs(x) == half
    return result


@pytest.mark.parametrize("half", [0.001, 0.01, 0.1])
@pytest.mark.parametrize("damping", [0.0, 0.1, 5.0])
def test_the_compiled_steps_are_those_written_out(half, damping):
    """Under random loads, at uneven times; the mass rests at both ends, leaves them and crosses."""
    rng, ends, inside = np.random.default_rng(31), set(), 0
    for count in (2, 3, *rng.integers(4, 800, 12).tolist()):
        t = np.cumsum(rng.uniform(0.5, 1.5, count)) / 100
        load = rng.normal(0, 3, (5, 1)) * np.sin(rng.uniform(0.1, 20, (5, 1)) * t + rng.uniform(0, 6, (5, 1)))
        stiffness, mass = rng.normal(0, 10) + 5 * np.cos(t), rng.uniform(0.2, 1) + 0.1 * np.sin(t)
        given = t, load.sum(axis=0), stiffness, mass, half, damping
        found = across_gap(*given)
        np.testing.assert_allclose(found, stepwise(*given), rtol=1e-9, atol=1e-12)  # rounding
        ends |= set(found[0][np.abs(found[0]) == half])
        inside += np.count_nonzero(np.abs(found[0]) < half)
    assert ends == {-half, half}
    assert inside > 100


def test_a_crossing_against_an_adaptive_integrator():
    """From the end that the load leaves, until the other end is reached, sampled so finely that Euler's steps hardly count."""
    t, half, damping = np.arange(4000) / 4000, 0.05, 0.8

    def given(at):
        return 6 * np.sin(9 * at - 1.5), 4 + 3 * np.cos(at), 0.4 + 0.2 * at

    def slope(at, y):
        load, stiffness, mass = given(at)
        return [y[1], -(load + stiffness * y[0] + damping * y[1]) / mass]

    found = across_gap(t, *given(t), half, damping)
    leaves = int(np.flatnonzero(np.abs(found[0]) < half)[0]) - 1
    hits = leaves + int(np.flatnonzero(np.abs(found[0, leaves + 1 :]) == half)[0])
    exact = solve_ivp(slope, (t[leaves], t[hits]), [half, 0.0], t_eval=t[leaves : hits + 1], rtol=1e-10, atol=1e-12).y
    assert hits - leaves > 500
    np.testing.assert_allclose(
        found[:2, leaves : hits + 1], exact, atol=2e-3 * np.abs(exact).max()
    )  # 1.0e-3; with twice the step twice that


def test_arrays_of_another_length_are_refused():
    t = np.arange(10) / 10
    with pytest.raises(ValueError, match="expected 10 numbers"):
        across_gap(t, t[1:], t, t + 1, 0.1, 0.0)

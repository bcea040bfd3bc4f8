"""Oscillators against the matrix exponential of the same system."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.linalg import expm

from rrr_oc.numerics.oscillator import Oscillator


@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.999999, 1.0, 1.5, 4.0])
@pytest.mark.parametrize("rested", [True, False])
def test_motions_are_those_of_the_matrix_exponential(ratio, rested):
    """With inertia, stiffness and steps that change, from light to heavy damping: x, v and the signal's polynomial as one state."""
    rng, count = np.random.default_rng(42), 60
    t = np.cumsum(rng.uniform(0.002, 0.02, count))
    mass, total = rng.uniform(0.5, 1.5, count - 1), rng.uniform(200, 800, count - 1)
    if ratio == 1.0:  # critically damped in every step
        mass, total = np.full((2, count - 1), [[1.0], [400.0]])
    damping, signal = 2 * ratio * 20.0, np.sin(9 * t) + 0.2 * rng.normal(size=count)
    oscillator, powers = Oscillator(t, mass, total, damping), CubicSpline(t, signal).c[::-1]
    found = oscillator.driven(signal, rested)
    state = found[:2, 0]
    if rested:
        np.testing.assert_allclose(state, [signal[0] / total[0], 0.0])
    whole = [state]
    for k in range(count - 1):
        system = np.zeros((6, 6))  # of x, x' and the signal with its three derivatives
        system[0, 1] = system[2, 3] = system[3, 4] = system[4, 5] = 1.0
        system[1, :3] = -total[k] / mass[k], -damping / mass[k], 1 / mass[k]
        there = expm(system * (t[k + 1] - t[k])) @ [*whole[-1], *(powers[:, k] * [1, 1, 2, 6])]
        whole.append(there[:2])
    x, v = np.transpose(whole)
    scale = np.abs(x).max(), np.abs(v).max()
    np.testing.assert_allclose(found[0], x, atol=1e-9 * scale[0])  # rounding
    np.testing.assert_allclose(found[1], v, atol=1e-9 * scale[1])
    force = np.append(mass, mass[-1]) * found[2] + damping * found[1] + np.append(total, total[-1]) * found[0]
    np.testing.assert_allclose(force, signal, atol=1e-8 * np.abs(signal).max())  # rounding, in derivatives over short steps


def test_free_motions_are_differences_of_driven_ones():
    t = np.arange(200) / 100
    mass, total = 0.5 + 0.1 * np.sin(t[1:]), 90 + 5 * np.cos(t[1:])
    free = Oscillator(t, mass, total, 1.7).free()
    np.testing.assert_allclose(free[:, :2, 0], np.eye(2))
    for motion in free:
        force = np.append(mass, mass[-1]) * motion[2] + 1.7 * motion[1] + np.append(total, total[-1]) * motion[0]
        np.testing.assert_allclose(force, 0, atol=1e-9 * 95)
        np.testing.assert_allclose(
            np.diff(motion[0]), np.diff(t) * (motion[1, 1:] + motion[1, :-1]) / 2, atol=2e-4
        )  # h³ x''' / 12

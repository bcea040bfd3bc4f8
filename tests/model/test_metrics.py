"""Metrics against integrals in closed form."""

import numpy as np
import pytest

from rrr_oc.errors import UserError
from rrr_oc.model import metrics


@pytest.fixture
def sines():
    """3 sin(2 t) over half a turn and a constant 2, then 1 and −4 for 0.5 s: E1 = 9 π/4 + 0.5 and 4 π/2 + 8."""
    t, s = np.linspace(1, 1 + np.pi / 2, 2001), np.linspace(0, 0.5, 11)
    first = np.array([3 * np.sin(2 * (t - 1)), np.full_like(t, 2)])
    return [(t, first), (s, np.array([np.full_like(s, 1), np.full_like(s, -4)]))]


def test_figures_of_a_task(sines):
    found = metrics.measure(sines)
    E1 = np.array([9 * np.pi / 4 + 0.5, 2 * np.pi + 8])
    T = np.pi / 2 + 0.5
    # the trapezoid rule is exact to rounding for a full period of a sine squared and for constants
    np.testing.assert_allclose(found.E1, E1, rtol=1e-12)
    np.testing.assert_allclose(found.rms, np.sqrt(E1 / T), rtol=1e-12)
    assert found.duration == pytest.approx(T, rel=1e-12)
    assert found.E1_total == pytest.approx(E1.sum(), rel=1e-12)
    np.testing.assert_allclose(found.peak, [3, 4], rtol=1e-6)  # the samples miss the crest by at most h² of it


def test_nothing_is_integrated_between_phases():
    """Two phases with a jump of torque between them, on clocks of their own."""
    t = np.array([0.0, 1.0])
    assert metrics.measure([(t, np.array([[1.0, 1.0]])), (t + 5, np.array([[3.0, 3.0]]))]).E1_total == pytest.approx(
        10.0, rel=1e-14
    )


def test_decrease():
    np.testing.assert_allclose(metrics.decrease([1.0, 5.0], [4.0, 4.0]), [0.75, -0.25], rtol=1e-15)  # exact in binary


@pytest.mark.parametrize(
    ("phases", "message"),
    [
        ([], "at least one"),
        ([(np.arange(3.0), np.zeros((2, 4)))], "shapes"),
        ([(np.arange(3.0), np.zeros((2, 3))), (np.arange(3.0), np.zeros((1, 3)))], "phase 1: shapes"),
        ([(np.array([0.0, 1.0, 1.0]), np.zeros((2, 3)))], "increase"),
        ([(np.arange(2.0), np.array([[0.0, np.nan]]))], "finite"),
    ],
)
def test_unusable_phases(phases, message):
    with pytest.raises(UserError, match=message):
        metrics.measure(phases)

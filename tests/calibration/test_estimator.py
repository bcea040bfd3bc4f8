"""The estimator where a law is missing, and where its steps have to be short."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import Plant, as_set, multisine, record
from scipy.signal import lfilter

from rrr_oc.calibration.calibrate import data_of
from rrr_oc.calibration.calibrated_model import Estimate, Term
from rrr_oc.calibration.estimator.data import low_frequency, share_of_low_frequency
from rrr_oc.calibration.estimator.fitting import PlainFitter, bent
from rrr_oc.calibration.estimator.intervals import canonical
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.samples import prepare
from rrr_oc.effects.friction.position_dependent_friction import PositionDependentFriction
from rrr_oc.effects.transmission.torque_ripple import TorqueRipple


def fitter_of(recordings) -> tuple[PlainFitter, object]:
    """Of the plain model of recordings, about its nominal values; and these."""
    nominal = plain_model(recordings)
    return PlainFitter.of(data_of(recordings, prepare(recordings), nominal, nominal)), nominal


def test_what_is_reported_predicts_better_than_what_is_likeliest_where_a_law_is_missing():
    """A detent that the discrepancy takes up, with part of the friction."""
    plant, rng = Plant("rrr", *np.array([[5.0] * 3, [15.0] * 3, [0.2] * 3])), np.random.default_rng(3)
    made = []
    for i in range(3):
        motion = multisine(3, np.arange(1200) / 100, rng)
        r = record(plant, f"{i}.csv", rng, 12.0, motion=motion)
        made.append(replace(r, tau=r.tau + 4.0 * np.tanh(20 * motion[1]) * np.exp(-((motion[1] / 0.3) ** 2))))
    fitter, nominal = fitter_of(as_set(plant, made))
    likeliest = fitter.begin(nominal)
    closest = fitter.closest(likeliest)
    left = [np.sum(f.residual**2, axis=1) for f in (likeliest, closest)]
    assert np.all(left[1] < 0.95 * left[0])


def test_links_of_which_nothing_is_known_are_fitted_to_the_minimum():
    """In a curved valley, where a full step raises the cost: at the end a full step has next to nothing to gain."""
    plant, rng = Plant("rrr", *np.array([[5.0] * 3, [15.0] * 3, [0.2] * 3])), np.random.default_rng(4)
    recordings = as_set(plant, [record(plant, f"{i}.csv", rng, 12.0) for i in range(3)], "identify")
    fitter, nominal = fitter_of(recordings)
    post = fitter.least_squares(fitter.begin(nominal)).posterior
    before = post.misfit + post.prior_cost(0 * post.step)
    assert before - post.predicted(post.step) < 1.0  # of a likelihood in nats, doubled


def test_the_strength_of_noise_at_frequency_0_is_that_of_its_process():
    """y_k = 0.6 y_k−1 + e_k has the strength of e / (1 − 0.6) there; a filter of order 6 finds it to 5 % from 20,000 rows."""
    rng, count = np.random.default_rng(5), 20000
    drive, y = rng.standard_normal(count), np.zeros(count)
    for k in range(1, count):
        y[k] = 0.6 * y[k - 1] + drive[k]
    still = np.zeros(count, bool)
    assert abs(low_frequency(y, np.arange(count), still) * 0.4 - 1) < 0.05
    x = np.cos(0.01 * np.arange(count)) / np.sqrt(count / 2)
    left = y - x * (x @ y)
    assert low_frequency(left, np.arange(count), still, 2.5 * x[:, None]) > low_frequency(left, np.arange(count), still)


def test_noise_along_a_sine_is_that_of_its_frequency():
    """The spectrum of y_k = 0.6 y_k−1 + e_k at ω over that at 0 is 0.16 / |1 − 0.6 exp(−i ω)|²; rows that do not count are left out."""
    rng, count, omega = np.random.default_rng(6), 20000, np.array([0.01, 0.5, 2.0])
    y, still = lfilter([1.0], [1.0, -0.6], rng.standard_normal(count)), np.zeros(count, bool)
    place = np.where(np.arange(count) < 100, -1, np.arange(count) - 100)
    share = share_of_low_frequency(np.sin(omega * np.arange(count)[:, None]), y, place, still)
    assert share == pytest.approx(0.16 / np.abs(1 - 0.6 * np.exp(-1j * omega)) ** 2, rel=0.05)


def test_a_discrepancy_bends_parameters_as_least_squares_of_drawn_ones_are_bent():
    """Discrepancies of a known size are drawn, and fitted by least squares of noise and prior, as if there were none."""
    plant, rng = Plant("rrr", *np.array([[5.0] * 3, [15.0] * 3, [0.2] * 3])), np.random.default_rng(6)
    fitter, nominal = fitter_of(as_set(plant, [record(plant, f"{i}.csv", rng, 12.0) for i in range(2)]))
    post = fitter.least_squares(fitter.begin(nominal)).posterior
    size, draws = np.array([0.2, 0.5, 1.0]), 600
    places, sigma = [place >= 0 for place in post.data.place], post.hyper.sigma
    design = [x[at] / s for x, at, s in zip(post.columns, places, sigma, strict=True)]
    design = np.vstack([*design, np.diag(np.sqrt(post.prior.precision))])
    drawn = [
        (features[at] @ rng.normal(0.0, s, (features.shape[1], draws))) / noise
        for features, at, s, noise in zip(post.data.features, places, size, sigma, strict=True)
    ]
    scale = np.linalg.norm(design, axis=0)
    steps = np.linalg.lstsq(design / scale, np.vstack([*drawn, np.zeros((len(scale), draws))]), rcond=1e-12)[0] / scale[:, None]
    expected = np.linalg.norm(bent(post, size), axis=1)
    np.testing.assert_allclose(np.sqrt(np.mean(steps**2, axis=1)), expected, rtol=0.15, atol=1e-12)


@pytest.mark.parametrize("effect", [TorqueRipple((0,)), PositionDependentFriction((0,))])
def test_the_interval_of_what_has_no_sign_ends_at_0(effect):
    """A wave of a negative amplitude is one of the opposite phase."""
    term = Term(effect, (Estimate(-0.1, 0.1, (-0.3, 0.1)), Estimate(2.0), Estimate(0.3)), effect.width)
    amplitude, _, phase = canonical(term).estimates
    assert (amplitude.value, *amplitude.interval) == pytest.approx((0.1, 0.0, 0.3))
    assert phase.value == pytest.approx(0.3 - np.pi)

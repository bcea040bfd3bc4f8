"""A calibration is a diagnosis with an empty catalogue."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import as_set, record
from scipy.signal import lfilter

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.calibrated_model import Estimate, Term
from rrr_oc.calibration.estimator.intervals import described
from rrr_oc.diagnosis.procedure import diagnose, ready
from rrr_oc.effects.priors import Priors
from rrr_oc.effects.transmission.torque_ripple import TorqueRipple


@pytest.mark.parametrize("inertial", ["nominal", "identify"])
def test_a_calibration_is_the_plain_model_of_a_diagnosis(planar, inertial):
    plant, rng = planar(1), np.random.default_rng(8)
    recordings = as_set(plant, [record(plant, f"{i}.csv", rng, 8.0, 0.01) for i in range(2)], inertial)
    calibrated, plain = calibrate(recordings), diagnose(recordings).plain
    assert calibrated.terms == plain.terms
    np.testing.assert_array_equal(calibrated.robot.inertial, plain.robot.inertial)
    np.testing.assert_array_equal(calibrated.nrmse, plain.nrmse)
    np.testing.assert_array_equal(calibrated.noise, plain.noise)


def test_the_width_of_a_prior_stays_where_least_squares_shrink_an_effect(planar):
    """Least squares take noise for as strong as in slow motion. An effect that shrinks a little would get a narrower prior and shrink more."""
    plant, rng = planar(1), np.random.default_rng(8)
    _, fitter, _, _ = ready(as_set(plant, [record(plant, "0.csv", rng, 8.0, 0.01)]), Priors())
    small, large = (Term(TorqueRipple((0,)), tuple(map(Estimate, (size, 20.0, 0.3)))) for size in (0.001, 0.5))
    number = [p.name for p in small.effect.parameters].index("amplitude")
    (one,), (wide,) = fitter.widths_of_priors([small]), fitter.widths_of_priors([large])
    assert wide > one
    declared, kept = (f.of_effects([small])[1][number] for f in (fitter, replace(fitter, wide=(wide,))))
    assert kept == pytest.approx(declared * (one / wide) ** 2)


def test_a_fast_law_under_a_slow_disturbance_keeps_its_size(planar):
    """A ripple beside a slow wander of the torque that is four times as large: its interval is that of the noise at its own frequency."""
    plant, rng, made = planar(1), np.random.default_rng(7), []
    for k in range(3):
        r = record(plant, f"{k}.csv", rng, 20.0, 0.005)
        wander = lfilter([1.0], [1.0, -0.999], rng.standard_normal(len(r.t)))
        made.append(replace(r, tau=r.tau + 0.2 * np.sin(12 * r.q + 0.4) + 0.8 * wander / wander.std()))
    _, fitter, _, plain = ready(as_set(plant, made), Priors())
    law = Term(TorqueRipple((0,)), (Estimate(0.2), Estimate(12.0), Estimate(0.4)), None, "all", ())
    fit = fitter.fit(replace(plain, terms=(*plain.terms, law)), fitter.data.links.none)
    amplitude = described(fitter.closest(fit)).terms[-1].estimates[0]
    assert amplitude.value == pytest.approx(0.2, abs=0.04)
    assert amplitude.interval[0] > 0.1
    assert amplitude.interval[0] < 0.2 < amplitude.interval[1]

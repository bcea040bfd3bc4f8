"""A calibration is a diagnosis with an empty catalogue."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import as_set, record

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.calibrated_model import Estimate, Term
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

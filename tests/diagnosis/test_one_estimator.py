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


def test_effects_are_believed_less_where_noise_counts_as_stronger(planar):
    """Least squares take noise for as strong as in slow motion; a fast law whose prior stayed would shrink beside it."""
    plant, rng = planar(1), np.random.default_rng(8)
    _, fitter, _, _ = ready(as_set(plant, [record(plant, "0.csv", rng, 8.0, 0.01)]), Priors())
    ripple = Term(TorqueRipple((0,)), tuple(map(Estimate, (0.04, 20.0, 0.3))))
    names = [p.name for p in ripple.effect.parameters]
    declared, looser = fitter.of_effects([ripple])[1], replace(fitter, looser=np.array([3.0])).of_effects([ripple])[1]
    assert looser[names.index("amplitude")] == pytest.approx(declared[names.index("amplitude")] / 9)

"""A calibration is a diagnosis with an empty catalogue."""

import numpy as np
import pytest
from recorded import as_set, record

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.diagnosis.procedure import diagnose


@pytest.mark.parametrize("inertial", ["nominal", "identify"])
def test_a_calibration_is_the_plain_model_of_a_diagnosis(planar, inertial):
    plant, rng = planar(1), np.random.default_rng(8)
    recordings = as_set(plant, [record(plant, f"{i}.csv", rng, 8.0, 0.01) for i in range(2)], inertial)
    calibrated, plain = calibrate(recordings), diagnose(recordings).plain
    assert calibrated.terms == plain.terms
    np.testing.assert_array_equal(calibrated.robot.inertial, plain.robot.inertial)
    np.testing.assert_array_equal(calibrated.nrmse, plain.nrmse)
    np.testing.assert_array_equal(calibrated.noise, plain.noise)

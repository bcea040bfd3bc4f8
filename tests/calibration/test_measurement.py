"""The chain of measurement: torques that are late, and speeds that are, in calibrations."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import Plant, as_set, multisine, record

from rrr_oc.calibration.calibrate import calibrate, data_of
from rrr_oc.calibration.estimator.fitting import PlainFitter
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.measurement import common_delay, measurement
from rrr_oc.calibration.samples import prepare

TRUTH = np.array([[2.0, 3.0, 1.5], [3.0, 4.0, 2.0], [0.2, 0.3, 0.1]])


def late(*delays: float):
    """Recordings of the paper's arm whose torques are late by these times [s], and their set."""
    plant, rng = Plant("rrr", *TRUTH), np.random.default_rng(81)
    made = []
    for i in range(3):
        fine = np.arange(12000) / 1000
        motion = multisine(3, fine, rng)
        torque = plant.torque(*motion)
        moved = np.array([np.interp(fine - d, fine, x) for d, x in zip(delays, torque, strict=True)])[:, ::10]
        r = record(plant, f"{i}.csv", rng, 12.0, motion=tuple(x[:, ::10] for x in motion))
        made.append(replace(r, tau=moved + 0.01 * moved.std(axis=1, keepdims=True) * rng.standard_normal(moved.shape)))
    return as_set(plant, made)


@pytest.mark.parametrize("delays", [(0.012, 0.012, 0.012), (0.0, -0.003, 0.02)], ids=["alike", "each its own"])
def test_torques_that_are_late_bias_nothing(delays):
    recordings = late(*delays)
    model = calibrate(recordings)
    found = measurement(recordings, model)
    for joint, delay in zip(model.joints, delays, strict=True):
        assert found[joint]["torque_late_s"] == pytest.approx(delay, abs=4e-4)
        low, high = found[joint]["interval"]
        assert low - 3e-4 < delay < high + 3e-4  # torques are linear between samples of 10 ms
        assert found[joint]["used"] == "q"
    values = np.array([t.values[0] for t in model.prompt_terms]).reshape(3, 3).T
    np.testing.assert_allclose(values[:2], TRUTH[:2], rtol=0.02)
    np.testing.assert_allclose(values[2], TRUTH[2], rtol=0.05)  # of which links take a part
    assert np.all(model.nrmse < 0.015)


def test_a_delay_is_told_if_all_torques_have_it():
    def told(*delays: float):
        recordings = late(*delays)
        start = plain_model(recordings)
        fitter = PlainFitter.of(data_of(recordings, prepare(recordings), start, start))
        return common_delay(fitter, fitter.closest(fitter.begin(start)))

    found = told(0.012, 0.012, 0.012)
    assert found is not None
    term, fall, p_value = found
    assert (term.effect.name, term.effect.joints) == ("time_delay", ())
    assert term.values[0] == pytest.approx(0.012, abs=5e-4)
    assert fall.low > 0.3
    assert p_value < 1e-6
    assert told(0.0, 0.0, 0.02) is None
    assert told(0.001, 0.001, 0.001) is None

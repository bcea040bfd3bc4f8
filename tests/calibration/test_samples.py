"""Motion made ready for regression: the window of the speed, and samples that do not count."""

import numpy as np
import pytest
from swung import columns, without, written

from rrr_oc.calibration.samples import prepare
from rrr_oc.recordings.reader import load_recordings


def prepared(folder, **files):
    return prepare(load_recordings(written(folder, **files)))


@pytest.mark.parametrize(("bits", "most"), [(0, 1e-5), (16, 4e-4), (12, 4e-3)])
def test_speeds_of_coarse_encoders_are_smoothed_longer(tmp_path, bits, most):
    """Errors of the speed [rad/s]; the shortest window would make errors of 0.015 rad/s of 12 bit at 100 Hz, 0.0009 of 16."""
    right = columns(20.0)
    step = 2 * np.pi / 2**bits if bits else 0.0
    coarse = {
        name: np.round(x / step) * step if step and name[:2] == "q_" else x for name, x in without(("dq", "ddq"), right).items()
    }
    (found,) = prepared(tmp_path, a=coarse)
    speeds = np.array([right[name] for name in right if name.startswith("dq_")])
    inside = slice(50, -50)
    error = np.sqrt(np.mean((found.recording.dq - speeds)[:, inside] ** 2, axis=1))
    assert np.all(error < most)


def test_samples_at_which_the_torque_is_cut_off_do_not_count(tmp_path):
    right = without(("dq", "ddq"), columns(20.0))
    limit = 0.7 * np.max(np.abs(right["tau_joint2"]))
    (whole,) = prepared(tmp_path / "whole", a=right)
    (found,) = prepared(tmp_path / "cut", a=right | {"tau_joint2": np.clip(right["tau_joint2"], -limit, limit)})
    beyond = np.abs(right["tau_joint2"]) >= limit
    np.testing.assert_array_equal(found.moving[1], whole.moving[1] & ~beyond)
    np.testing.assert_array_equal(found.moving[[0, 2]], whole.moving[[0, 2]])

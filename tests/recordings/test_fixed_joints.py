# pyright: reportAttributeAccessIssue=false
# (pinocchio has no stubs)
"""Angles of joints that are not recorded: the recorded ones feel the arm as it stands, and every file keeps it so."""

import json

import numpy as np
import pinocchio as pin
import pytest
from chains import random_chain

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.errors import UserError
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.writer import save_recordings
from rrr_oc.robot.robot import load_robot
from rrr_oc.simulation.export import urdf
from rrr_oc.storage import write_csv

JOINTS, KEPT = ("j2", "j3", "j5"), [1, 2, 4]
FIXED = {"j1": 40.0, "j4": -65.0}  # [°]


@pytest.fixture
def folder(tmp_path):
    """Two joints of five stand still at `FIXED`; torques by Pinocchio from the whole chain."""
    text = random_chain(5, 5)
    (tmp_path / "arm.urdf").write_text(text)
    model = pin.buildModelFromXML(text)
    data, t = model.createData(), np.arange(600) / 100
    q, dq, ddq = np.zeros((3, 5, len(t)))
    q[0], q[3] = np.radians(FIXED["j1"]), np.radians(FIXED["j4"])
    for j in KEPT:
        w = 1.0 + 0.7 * j
        q[j], dq[j], ddq[j] = np.sin(w * t), w * np.cos(w * t), -w * w * np.sin(w * t)
    tau = np.array([pin.rnea(model, data, *x) for x in zip(q.T, dq.T, ddq.T, strict=True)]).T
    columns = {"t": t}
    for name, j in zip(JOINTS, KEPT, strict=True):
        columns |= {f"q_{name}": q[j], f"dq_{name}": dq[j], f"ddq_{name}": ddq[j], f"tau_{name}": tau[j]}
    write_csv(tmp_path / "a.csv", columns)
    say(tmp_path, fixed_deg=FIXED)
    return tmp_path


def say(folder, **more):
    entry = {"format": "rrr_oc-recordings/1", "robot": "arm.urdf", "joints": list(JOINTS), "recordings": [{"file": "a.csv"}]}
    (folder / "recordings.json").write_text(json.dumps(entry | more))


def test_the_arm_is_the_one_that_was_recorded(folder):
    assert np.max(calibrate(load_recordings(folder)).nrmse) < 1e-2  # what smoothing leaves of exact torques
    say(folder)
    assert np.max(calibrate(load_recordings(folder)).nrmse) > 0.1  # the same arm, stretched out


def test_every_file_keeps_the_angles(folder):
    recordings = load_recordings(folder)
    placements = recordings.robot.placements
    save_recordings(recordings, folder / "again")
    np.testing.assert_allclose(load_recordings(folder / "again").robot.placements, placements, atol=1e-15)
    model = calibrate(recordings)
    save_model(model, folder / "model.json")
    again = load_model(folder / "model.json")
    np.testing.assert_allclose(again.robot.placements, placements, atol=1e-15)
    (folder / "exported.urdf").write_text(urdf((folder / "arm.urdf").read_text(), recordings.robot))
    exported = load_robot(folder / "exported.urdf")
    assert exported.joints == JOINTS
    np.testing.assert_allclose(exported.placements, placements, atol=1e-15)


@pytest.mark.parametrize(
    ("fixed", "said"),
    [
        ({"j1": 200.0}, r"recordings\.json: robot 'arm': fixed_deg\.j1: found 200; its range is -114\.59° … 114\.59°"),
        ({"j2": 0.0}, r"fixed_deg: unknown locked joint that turns 'j2'; allowed are j1, j4"),
        ({"j1": "up"}, r"recordings\.json: fixed_deg\.j1"),
    ],
)
def test_angles_that_cannot_be(folder, fixed, said):
    say(folder, fixed_deg=fixed)
    with pytest.raises(UserError, match=said):
        load_recordings(folder)

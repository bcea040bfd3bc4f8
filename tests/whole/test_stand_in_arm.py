"""The arm of the worked path records what numeric Pinocchio says, and hides what it is asked to hide."""

import numpy as np
import pytest
import stand_in_arm as study
from recorded import URDF, Plant, multisine

from rrr_oc.errors import UserError
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.storage import write_csv

JOINTS = ("joint1", "joint2", "joint3")


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    t = np.arange(400) / 100
    q = multisine(3, t, np.random.default_rng(0))[0]
    path = tmp_path_factory.mktemp("motion") / "motion.csv"
    write_csv(path, {"t": t, **{f"q_{j}": row for j, row in zip(JOINTS, q, strict=True)}})
    return path


def test_torques_are_those_of_the_urdf_with_friction(motion):
    arm = study.Plant(URDF / "rrr.urdf", 0.0, "", 0.0, 0)
    curve = study.read_motion(motion, arm.joints)
    arm.fit_to(curve)
    made = arm.run(curve, 0.8)
    q, tau = (np.array([made[f"{kind}_{j}"] for j in JOINTS]) for kind in ("q", "tau"))
    dq, ddq = (0.8**k * curve(0.8 * made["t"], k).T for k in (1, 2))
    expected = Plant("rrr", arm.dry, arm.viscous, arm.model.dof_armature, study.CROSSING).torque(q, dq, ddq)
    settled = slice(100, None)  # it starts at rest beside a motion that does not
    assert np.std((tau - expected)[:, settled]) < 0.03 * np.std(expected)  # the reference's motion, not the arm's own


def test_what_is_hidden_is_in_the_recordings(motion, tmp_path):
    for name, mass in (("without", 0.0), ("with", 1.0)):
        study.main(URDF / "rrr.urdf", [motion], tmp_path / name, mass, "joint2", 0.1, "1,0.5")
    plain, loaded = (load_recordings(tmp_path / name).recordings for name in ("without", "with"))
    assert len(plain) == len(loaded) == 2
    assert np.abs(loaded[0].tau[1] - plain[0].tau[1]).mean() > 1.0  # a kilogram at the end of an arm of half a metre


@pytest.mark.parametrize("speeds", ["", "fast", "1,0"])
def test_unusable_speeds_are_refused(motion, tmp_path, speeds):
    with pytest.raises(UserError, match="--speeds"):
        study.main(URDF / "rrr.urdf", [motion], tmp_path / "o", speeds=speeds)

"""Joints that never move: what is left there is said, and decides the verdict, but is no effect."""

import numpy as np
import pytest
from recorded import as_set, multisine, record

from rrr_oc.diagnosis.files.diagnosis_file import to_json
from rrr_oc.diagnosis.procedure import diagnose


@pytest.mark.parametrize(("held", "verdict"), [(2.0, "cannot_tell"), (0.0, "nothing_missing")])
def test_a_torque_on_a_joint_at_rest_is_said(planar, held, verdict):
    plant, rng, made = planar(2), np.random.default_rng(3), []
    for i in range(3):
        motion = multisine(2, np.arange(800) / 100, rng)
        for part in motion:
            part[1] = 0.0
        r = record(plant, f"{i}.csv", rng, 8.0, 0.01, motion)
        r.tau[1] += held
        made.append(r)
    found = diagnose(as_set(plant, made))
    (one,) = to_json(found)["idle"]
    assert one["joint"] == plant.model.names[2]
    assert one["torque"] == pytest.approx(held, abs=0.02)
    assert not found.findings
    assert found.verdict == verdict


def test_a_joint_that_moves_is_not_idle(planar):
    plant, rng = planar(1), np.random.default_rng(3)
    assert diagnose(as_set(plant, [record(plant, f"{i}.csv", rng, 6.0) for i in range(2)])).idle == ()

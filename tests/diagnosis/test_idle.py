"""Joints that never move: what is left there is said, and decides the verdict, but is no effect."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import as_set, multisine, record

from rrr_oc.calibration.samples import prepare
from rrr_oc.diagnosis.diagnosis_file import to_json
from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.errors import UserError


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


def test_torques_that_tell_nothing_are_one_sentence(planar):
    """A torque that was not recorded has no scale to which errors could be compared."""
    plant, rng, one = planar(2), np.random.default_rng(3), np.array([[1.0], [0.0]])
    made = [record(plant, f"{i}.csv", rng, 2.0) for i in range(2)]
    assert len(prepare(as_set(plant, made))) == 2
    off = [replace(r, tau=r.tau * one) for r in made]
    with pytest.raises(UserError, match=r"the torque of j2 is 0 Nm in every sample while the joint moves, .* was it recorded"):
        prepare(as_set(plant, off))
    still = [replace(r, q=r.q * one, dq=r.dq * one, ddq=r.ddq * one) for r in off]
    assert len(prepare(as_set(plant, still))) == 2

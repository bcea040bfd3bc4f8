"""Diagnosis where links, the payload or gravity are not what is stated, and what is suggested to record of an arm."""

from dataclasses import replace

import chains
import numpy as np
import pytest
from recorded import Plant, as_set, multisine, record

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.calibrated_model import Estimate, Term
from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.calibration.regression import rows
from rrr_oc.calibration.samples import prepare
from rrr_oc.diagnosis.procedure import diagnose, ready
from rrr_oc.diagnosis.result import Finding
from rrr_oc.diagnosis.signatures import view
from rrr_oc.diagnosis.suggestion import suggest
from rrr_oc.effects.priors import Priors
from rrr_oc.effects.sensor.torque_offset import TorqueOffset
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.robot import ToolPoint, load_robot

TOOL = (0.3, 0.0, 0.0)  # of the last link [m]


def test_a_tilt_is_found_where_one_of_its_angles_does_nothing(planar):
    """Arms that move in a plane hardly feel a tilt about an axis in it; what is fitted to it is beyond all bounds."""
    plant, rng = planar(2), np.random.default_rng(3)
    plant.model.gravity.linear = 9.81 * np.array([np.sin(0.15), 0.0, -np.cos(0.15)])
    found = diagnose(as_set(plant, [record(plant, f"{i}.csv", rng, 6.0) for i in range(4)]))
    (finding,) = found.findings
    equal = {"gravity_tilt", "encoder_offset", "backlash"}  # all turn the first link
    assert finding.term.effect.name in equal
    assert equal <= {finding.term.effect.name, *(name for name, _ in finding.rivals)}


def test_what_few_recordings_leave_open_of_links_stays_near_what_is_believed(planar):
    """Inertial parameters fitted to a slow motion predict a fast one where what is believed beside it counts."""
    plant, rng = planar(3), np.random.default_rng(12)
    motions = [multisine(3, np.arange(400) / 100, rng, fastest) for fastest in (0.15, 1.5)]
    recordings = as_set(
        plant,
        [record(plant, f"{k}.csv", rng, 4.0, motion=m) for k, m in enumerate(motions)],
        "identify",
        robot=load_robot(plant.urdf),
    )
    _, fitter, _, plain = ready(recordings, Priors())
    wrong, left = 0.3 * rng.standard_normal(len(fitter.data.links.none)), []
    for wide in (100.0, 1.0):
        links = replace(fitter.data.links, std=wide * fitter.data.links.std)
        slow = replace(fitter, data=replace(fitter.data.part([0]), links=links))
        begin = replace(plain, robot=replace(plain.robot, inertial=links.at(wrong / wide)[0]))  # the same links for both
        left.append(np.linalg.norm(rows(fitter.data.part([1]).prepared, slow.fit(begin, wrong / wide).model).residual))
    assert left[1] < 0.8 * left[0], left


def test_a_payloads_centre_goes_before_a_links_inertial_parameters_that_fit_more_noise(tmp_path):
    """The last link's ten hold all that a payload's three do where all recordings carry it, and fit 15 of noise with this seed."""
    (tmp_path / "skew.urdf").write_text(chains.random_chain(1, 3))
    plant, rng = Plant(tmp_path / "skew.urdf", np.ones(3), np.ones(3), 0.1 * np.ones(3)), np.random.default_rng(4)
    off = np.add(TOOL, (0.02, 0.01, 0.0))
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.01, payload=2.0, tool=off) for i in range(4)]
    recordings = as_set(plant, made)
    recordings = replace(recordings, tool=recordings.robot.point(recordings.robot.links[-1], TOOL))
    found = diagnose(recordings).findings
    assert [f.term.effect.name for f in found] == ["payload_com"]


def test_recorded_load_torque_may_hold_what_no_law_explains(planar, tmp_path):
    """A detent: on the link's side, for no drive is in what was recorded."""
    plant, rng = planar(1), np.random.default_rng(4)
    made = [record(plant, f"{i}.csv", rng, 12.0, 0.01, load=True) for i in range(4)]
    made = [replace(r, tau=r.tau + 1.5 * np.exp(-((r.q / 0.25) ** 2))) for r in made]
    found = diagnose(as_set(plant, made, torque="load"))
    (term,) = (f.term for f in found.findings if f.term.effect.black_box)
    assert term.effect.side == "link"
    assert term.effect.depends_on == (("q", 0),)
    assert found.held_out[1][0] < 0.3 * found.held_out[0][0]
    save_model(found.model, tmp_path / "model.json")
    assert load_model(tmp_path / "model.json").terms == found.model.terms


def test_a_payload_that_errors_of_the_links_could_replace_is_claimed():
    """They predict held-out recordings as well, but only at many times the size that a URDF's errors have."""
    plant, rng = Plant("rrr", np.array([1.0, 2.0, 1.0]), np.full(3, 2.0), np.full(3, 0.3)), np.random.default_rng(0)
    tool = load_robot("rrr").tool.position
    made = [record(plant, f"{i}.csv", rng, 8.0, 0.003, payload=1.0, tool=tool) for i in range(4)]
    (found,) = diagnose(as_set(plant, [replace(r, payload=0 * r.t) for r in made])).findings
    assert found.term.effect.name == "payload_mass"
    assert found.term.values == pytest.approx([1.0], abs=found.term.estimates[0].std / 3)


@pytest.mark.parametrize("undecided", [False, True])
def test_a_suggested_motion_keeps_to_what_the_arm_can_do(planar, undecided):
    """Recorded with the joints in step: most motions within their ranges would need more torque and come lower than recorded."""
    plant, made = planar(2), []
    t = np.arange(1000) / 100
    for i, w in enumerate((0.6, 0.8, 1.0)):
        one = np.array([0.8 * np.sin(w * t), 0.8 * w * np.cos(w * t), -0.8 * w**2 * np.sin(w * t)])
        motion = tuple(np.array([[0.3], [-1.5]]) * (k == 0) + np.array([[1.0], [-2.0]]) * x for k, x in enumerate(one))
        made.append(record(plant, f"{i}.csv", np.random.default_rng(i), 10.0, motion=motion, payload=3.0, tool=(0.4, 0.0, 0.0)))
    recordings = replace(as_set(plant, made), tool=ToolPoint(1, np.array([0.4, 0.0, 0.0])))
    weak = replace(
        recordings.robot, effort=np.full(2, 1e-3), velocity=np.full(2, 1e-3)
    )  # below what was recorded, which counts
    recordings = replace(recordings, robot=weak)
    plain = calibrate(recordings)
    seen = view(prepare(recordings), plain)
    arm = Model(weak, recordings.tool)
    largest = np.max([np.abs(r.tau).max(axis=1) for r in made], axis=0)
    lowest = min(float(arm.tool_height(q)) for r in made for q in r.q.T)
    found = Finding(Term(TorqueOffset((1,)), (Estimate(0.5),)), 1.0, 50.0, 1e-9, (("coulomb_asymmetry", (1,)),))
    (suggestion,) = suggest(recordings, plain, [] if undecided else [found], undecided, seen)
    m = suggestion.motion
    assert np.all((seen.low <= m.q.T) & (seen.high >= m.q.T))
    assert np.all(np.abs(m.dq).max(axis=1) <= seen.speed)
    assert np.all(np.abs(plain.torques(m)[0]).max(axis=1) <= 1.01 * largest)  # planned with dry friction of a wider transition
    assert min(float(arm.tool_height(q)) for q in m.q.T) >= lowest
    np.testing.assert_allclose(m.dq[:, [0, -1]], 0, atol=1e-9)
    assert np.ptp(m.q, axis=1).min() > 0.05

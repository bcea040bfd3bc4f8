"""What recordings do not decide: effects, others in their place, and links that are not the URDF's."""

import json
from dataclasses import replace

import numpy as np
import pytest
from recorded import as_set, record

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile
from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.report.diagnosis_report import write_diagnosis
from rrr_oc.report.diagnosis_words import sentence
from rrr_oc.robot.robot import load_robot
from rrr_oc.schema import built

TOOL = (0.3, 0.0, 0.0)  # of the last link [m]


@pytest.fixture
def recordings(planar):
    """Of an arm of two joints, four of 10 s."""
    plant, rng = planar(2), np.random.default_rng(5)
    return plant, [record(plant, f"{i}.csv", rng, 10.0, 0.003) for i in range(4)]


def test_torques_in_a_wrong_unit_are_not_told_from_heavier_links(recordings, tmp_path):
    """Of an arm whose friction, armature and links all are not known beforehand, a common factor of all torques is none of one."""
    plant, made = recordings
    found = diagnose(as_set(plant, [replace(r, tau=2.0 * r.tau) for r in made]))
    assert found.findings == ()
    assert found.verdict == "cannot_tell"
    (one,) = found.undecided
    gain = next(t for t in one.terms if t.effect.name == "torque_gain" and not t.effect.joints)
    assert gain.values == pytest.approx([1.0], abs=0.1)
    assert found.links
    write_diagnosis(found, tmp_path)
    content = json.loads((tmp_path / "diagnosis.json").read_text())
    (entry,) = content["undecided"]
    assert {m["effect"] for m in entry["members"]} >= {"torque_gain", "link_errors"}
    assert "do not tell which is so" in sentence(built(content, DiagnosisFile))
    assert "do not tell which is so" in (tmp_path / "report.html").read_text()


def test_a_description_that_leaves_out_two_thirds_of_a_link_is_told(recordings):
    """By a calibration, too; nothing else is claimed in its place."""
    plant, made = recordings
    robot = load_robot(plant.urdf)
    light = replace(robot, inertial=robot.inertial * np.array([1.0, 1 / 3]))
    wrong = as_set(plant, made, robot=light)
    told = {f["link"]: f for f in calibrate(wrong).report["link_findings"]}[robot.links[1]]
    # of a motion in a plane only the product of mass and centre is known
    one = next(d for d in told["directions"] if (d["joint"], d["quantity"]) == (robot.joints[1], "first_moment"))
    assert one["urdf"] == pytest.approx(robot.inertial[1, 1] / 3)
    assert one["value"] == pytest.approx(robot.inertial[1, 1], rel=0.02)
    found = diagnose(wrong)
    assert not [f for f in found.findings if f.term.effect.side != "body"]


def test_a_payload_is_claimed_and_a_link_said_to_be_as_good(recordings):
    """Both say that the last link is heavier than described; one of them can be put down."""
    plant = recordings[0]
    rng = np.random.default_rng(6)
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.003, payload=2.0, tool=TOOL) for i in range(4)]
    whole = as_set(plant, [replace(r, payload=0 * r.t) for r in made])
    whole = replace(whole, tool=whole.robot.point(whole.robot.links[-1], TOOL))
    (found,) = diagnose(whole).findings
    assert found.term.effect.name == "payload_mass"
    assert ("link_errors", ()) in found.rivals
    assert found.fall is not None
    assert found.fall.low > 0.1

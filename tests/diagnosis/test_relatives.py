# pyright: reportAttributeAccessIssue=false
"""Relatives of laws that the catalogue had first: each is told as itself, with its size, and not as two others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from chains import joint, link, robot
from recorded import Plant, as_set, multisine, record

from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.diagnosis.diagnosis_file import ClaimEntry, to_json
from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.diagnosis.result import Diagnosis
from rrr_oc.effects.friction.load_dependent_friction import LoadDependentFriction
from rrr_oc.report.diagnosis_words import plain
from rrr_oc.schema import built

TIMES = np.arange(1200) / 100  # [s]


def told(plant: Plant, recordings) -> tuple[Diagnosis, dict[tuple, dict[str, float]]]:
    """A diagnosis, and what it claims: parameters by name and joints."""
    found = diagnose(as_set(plant, recordings))
    return found, {f.key: f.term.named for f in found.findings}


def upright(folder: Path, joints: int) -> Plant:
    """An arm with little friction whose first axis is vertical, the others horizontal."""
    names, axes = ["base", "l1", "l2"][: joints + 1], ["0 0 1", "0 -1 0"]
    parts = [link(name, mass) for name, mass in zip(names, (0.0, 1.0, 1.0), strict=False)]
    parts += [joint(f"j{i + 1}", names[i], names[i + 1], axis=axes[i]) for i in range(joints)]
    (folder / "upright.urdf").write_text(robot(*parts))
    return Plant(folder / "upright.urdf", *(np.full(joints, size) for size in (0.1, 0.05, 0.01)))


def test_a_spring_across_two_joints_that_pulls_both_ways(planar):
    plant, rng = planar(2), np.random.default_rng(31)
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.01) for i in range(3)]
    law = [6.0 * (r.q[0] - 0.8 * r.q[1] - 0.3) * np.array([[1.0], [-0.8]]) for r in made]
    found, claimed = told(plant, [replace(r, tau=r.tau + more) for r, more in zip(made, law, strict=True)])
    assert list(claimed) == [("two_sided_biarticular_spring", (0, 1))]
    assert claimed["two_sided_biarticular_spring", (0, 1)] == pytest.approx({"kappa": 6.0, "rho": -0.8, "phi": 0.3}, rel=0.02)
    assert np.all(found.held_out[1] < 0.1 * found.held_out[0])


@pytest.mark.parametrize("follows", ["motor", "motor without friction", "load"])
def test_friction_that_grows_with_the_torque_of_the_load_or_of_the_motor(planar, follows):
    """A rotor that takes as much as the load, and three laws: each is told with its mu, alone."""
    plant, rng = Plant(planar(1).urdf, np.array([0.3]), np.array([0.2]), np.array([0.3])), np.random.default_rng(34)
    recordings = []
    for i in range(4):
        motion = multisine(1, TIMES, rng)
        turn, load = np.tanh(motion[1] / plant.width), plant.load(*motion)
        rotor = load + 0.3 * motion[2]
        motor = rotor + 0.3 * turn + 0.2 * motion[1]
        motor = (motor + 0.1 * turn * np.abs(motor)) / (1 - 0.01 * turn**2) if follows == "motor" else motor
        felt = {"load": load, "motor": motor, "motor without friction": rotor}[follows]
        r = record(plant, f"{i}.csv", rng, 12.0, 0.005, motion)
        recordings.append(replace(r, tau=r.tau + 0.1 * np.abs(felt) * turn))
    found, claimed = told(plant, recordings)
    assert claimed == {("load_dependent_friction", (0,)): {"mu": pytest.approx(0.1, abs=0.005)}}
    (entry,) = to_json(found)["effects"]
    assert entry["follows"] == follows.split()[0]
    assert list(entry["parameters"]) == ["mu"]
    assert ("the torque of its motor" in plain(built(entry, ClaimEntry))) == (follows != "load")
    assert found.findings[0].term.effect == LoadDependentFriction((0,), follows)
    assert entry["equation"] == found.findings[0].term.effect.law


def test_one_gain_of_all_joints_in_one_set_up(planar):
    """The links are the same in all of them, so that they do not explain it; a gain of each joint would be two laws."""
    plant, rng = planar(2), np.random.default_rng(35)
    made = [replace(record(plant, f"{i}.csv", rng, 10.0, 0.01), group="ab"[i % 2]) for i in range(4)]
    made[1], made[3] = (replace(r, tau=1.2 * r.tau) for r in (made[1], made[3]))
    found, claimed = told(plant, made)
    assert claimed == {("torque_gain", ()): {"gain": pytest.approx(0.2, abs=0.01)}}
    (entry,) = to_json(found)["effects"]
    assert (entry["joint"], entry["recordings"]) == (None, ["1.csv", "3.csv"])


def test_a_harness_that_hardens_in_pieces_of_one_slow_sweep(tmp_path):
    """Each piece covers angles that the others lack; the law holds there too. Gravity does not turn the joint.

    What is left at the only reversals, which a lag of the torque may stand for, is told beside it or not.
    """
    plant, rng = upright(tmp_path, 1), np.random.default_rng(36)
    t, slow = np.arange(4000) / 100, np.pi / 40
    motion = 1.4 * np.cos(slow * t), -1.4 * slow * np.sin(slow * t), -1.4 * slow**2 * np.cos(slow * t)
    parts = [tuple(x[None, k : k + 1000] for x in motion) for k in range(0, 4000, 1000)]
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.01, part) for i, part in enumerate(parts)]
    found, claimed = told(plant, [replace(r, tau=r.tau + 2.0 * r.q + 1.5 * r.q**3) for r in made])
    assert next(iter(claimed)) == ("cable_harness", (0,))
    assert all(f.fall.of_torque < 0.01 for f in found.findings[1:])
    named = claimed["cable_harness", (0,)]
    assert named["hardening"] == pytest.approx(1.5, rel=0.1)
    assert named["stiffness"] == pytest.approx(2.0, abs=0.5)
    assert found.held_out[1][0] < 0.1 * found.held_out[0][0]


def test_an_arm_on_a_wall_is_turned_by_one_angle_about_one_axis(tmp_path):
    """By 90°, an angle that has no neighbour of less in a sum of turns about x and y; the recordings say that it stands level."""
    plant, rng = upright(tmp_path, 2), np.random.default_rng(37)
    wall = Plant(plant.urdf, plant.dry, plant.viscous, plant.armature)
    wall.model.gravity.linear = np.array([-9.81 * 0.8, 9.81 * 0.6, 0.0])
    found, claimed = told(plant, [record(wall, f"{i}.csv", rng, 10.0, 0.003) for i in range(3)])
    assert list(claimed) == [("gravity_tilt", ())]
    tilt = to_json(found)["effects"][0]["parameters"]
    low, high = tilt["angle"]["interval"]
    assert tilt["angle"]["value"] == pytest.approx(np.pi / 2, abs=0.003)
    assert low < tilt["angle"]["value"] < high < low + 0.02
    assert tilt["axis"]["value"] == pytest.approx([-0.6, -0.8, 0.0], abs=0.01)
    turn = tilt["angle"]["value"] * np.array(tilt["axis"]["value"])
    assert turn[:2] == pytest.approx([tilt["about_x"]["value"], tilt["about_y"]["value"]])
    np.testing.assert_allclose(pin.exp3(turn).T @ [0, 0, -9.81], wall.model.gravity.linear, atol=0.1)


@pytest.mark.parametrize("what", ["encoder_offset", "torque_offset"])
def test_a_zero_that_is_another_in_every_recording(planar, what, tmp_path):
    """One entry with a value for each; a model predicts a recording that it does not know with 0, and says so."""
    plant, rng, zeros = planar(1), np.random.default_rng(38), np.array([0.05, -0.03, 0.08, -0.04, 0.0])
    made = [record(plant, f"{i}.csv", rng, 12.0, 0.005) for i in range(5)]
    shifted = {
        "encoder_offset": [replace(r, q=r.q + zero) for r, zero in zip(made, zeros, strict=True)],
        "torque_offset": [replace(r, tau=r.tau + 10 * zero) for r, zero in zip(made, zeros, strict=True)],
    }[what]
    found, claimed = told(plant, shifted)
    assert list(claimed) == [(what, (0,))]
    (entry,) = to_json(found)["effects"]
    assert entry["recordings"] == "each"
    each = entry["parameters"]["offset"]["by_recording"]
    scale = 1.0 if what == "encoder_offset" else 10.0
    off = np.array([each[r.file]["value"] for r in made]) - scale * zeros
    assert np.abs(off - off.mean()).max() < 0.005 * scale  # of a common zero links and gravity may take a part
    assert np.abs(off.mean()) < (0.05 if what == "encoder_offset" else 0.2)  # an error of a link's centre turns gravity alike
    save_model(found.model, tmp_path / "model.json")
    model = load_model(tmp_path / "model.json")
    assert model.terms == found.model.terms
    other = as_set(plant, [replace(shifted[0], file="new.csv", group="new"), shifted[1]])
    assert model.without_values(other) == {f"{what} of j1": ["new.csv"]}
    bare = replace(model, terms=tuple(t for t in model.terms if t.effect.name != what))
    unknown, known = other.recordings
    np.testing.assert_array_equal(model.output_torque(unknown), bare.output_torque(unknown))
    assert np.abs(model.output_torque(known) - bare.output_torque(known)).max() > 0.02


def test_efforts_that_leave_out_gravity(tmp_path):
    """A half of it; the whole, which lighter links can almost equal, is a case of `validation/known_misses.py`."""
    plant, rng, share = upright(tmp_path, 2), np.random.default_rng(33), 0.5
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.003) for i in range(3)]
    still = np.zeros(made[0].q.shape)
    found, claimed = told(plant, [replace(r, tau=r.tau - share * plant.load(r.q, still, still)) for r in made])
    assert list(claimed) == [("missing_gravity", ())]
    assert claimed["missing_gravity", ()]["share"] == pytest.approx(share, abs=0.01)
    assert np.all(found.held_out[1] < found.held_out[0])


def test_viscous_friction_of_two_directions(planar):
    plant, rng = planar(1), np.random.default_rng(32)
    made = [record(plant, f"{i}.csv", rng, 12.0, 0.01) for i in range(4)]
    found, claimed = told(plant, [replace(r, tau=r.tau + 0.2 * np.abs(r.dq)) for r in made])
    assert list(claimed) == [("viscous_asymmetry", (0,))]
    assert claimed["viscous_asymmetry", (0,)]["asymmetry"] == pytest.approx(0.4, rel=0.1)
    assert found.held_out[1][0] < found.held_out[0][0]

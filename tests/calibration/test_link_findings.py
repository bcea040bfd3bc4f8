# pyright: reportAttributeAccessIssue=false
"""Links that are off against a plant whose bodies are known: what torques see of them, and that they stay bodies."""

from dataclasses import replace
from pathlib import Path

import chains
import mujoco
import numpy as np
import pinocchio as pin
import pytest
from recorded import Plant, as_set, record

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.inertial_parameters import about_centre, base_parameters, is_possible, pseudo_inertia, seen_quantities
from rrr_oc.robot.link_errors import HEAVIEST, OF_URDF, LinkErrors, most_of
from rrr_oc.robot.robot import Robot, load_robot
from rrr_oc.simulation.export import mjcf

SHAPE = np.array([0.03, 0.01, 0.01, 0.01, 0.05, 0.05, 0.05])  # standard deviations of a link's errors


def recordings(folder: Path, joints: int, seed: int):
    """Three recordings of 10 s of an arm of joints with parallel axes, and the robot of its URDF."""
    urdf, rng = folder / "arm.urdf", np.random.default_rng(seed)
    urdf.write_text(chains.arm(joints).replace('xyz="0.1 0 0"', 'xyz="0.25 0 0"'))  # centres of mass
    plant = Plant(urdf, np.ones(joints), np.ones(joints), 0.1 * np.ones(joints))
    return plant, [record(plant, f"{i}.csv", rng, 10.0, 0.003) for i in range(3)], load_robot(urdf)


def moved(robot: Robot, link: int, mass: float = 1.0, centre=(0.0, 0.0, 0.0)) -> Robot:
    """A robot with another mass, by a factor at the same shape, and another centre of a link."""
    inertial = robot.inertial.copy()
    at, inertia = about_centre(inertial[:, link])
    inertial[:, link] = pin.Inertia(mass * inertial[0, link], at + centre, mass * inertia).toDynamicParameters()
    return replace(robot, inertial=inertial)


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_told_of_links_as_described(seed, tmp_path):
    plant, made, _ = recordings(tmp_path, 2, seed)
    assert calibrate(as_set(plant, made)).report["link_findings"] == []


def test_a_pendulum_with_a_quarter_more_first_moment_is_told(tmp_path):
    """Its mass and its centre may each be as described, for all that torques tell."""
    plant, made, robot = recordings(tmp_path, 1, 1)
    wrong = moved(robot, 0, centre=-0.2 * about_centre(robot.inertial[:, 0])[0])
    (found,) = calibrate(as_set(plant, made, robot=wrong)).report["link_findings"]
    (one,) = (d for d in found["directions"] if d["quantity"] == "first_moment")
    assert (found["link"], one["joint"]) == (robot.links[0], robot.joints[0])
    low, high = one["interval"]
    assert low < np.linalg.norm(robot.inertial[1:4, 0]) < high
    assert high - low < 0.02 * one["value"]
    assert one["urdf"] == pytest.approx(0.8 * np.linalg.norm(robot.inertial[1:4, 0]))


def test_a_turned_last_link_has_a_first_moment_across_the_described_one(tmp_path):
    """As a zero of the last joint that is off has it."""
    plant, made, robot = recordings(tmp_path, 2, 2)
    off = [replace(r, q=r.q + np.array([[0.0], [0.25]])) for r in made]
    (found,) = calibrate(as_set(plant, off)).report["link_findings"]
    across = min(found["directions"], key=lambda d: abs(d["urdf"]))
    assert found["link"] == robot.links[1]
    assert abs(across["value"]) == pytest.approx(np.sin(0.25) * np.linalg.norm(robot.inertial[1:4, 1]), rel=0.05)


def test_a_link_that_is_made_far_too_light_is_named(tmp_path):
    plant, made, robot = recordings(tmp_path, 2, 3)
    found = calibrate(as_set(plant, made, robot=moved(robot, 1, 0.04)))
    directions = {(d["joint"], d["quantity"]): (f["link"], d) for f in found.report["link_findings"] for d in f["directions"]}
    moment = robot.inertial[1, 1]
    assert all(f["lowers_error"]["interval"][0] > 0.5 for f in found.report["link_findings"])
    link, one = directions[robot.joints[1], "first_moment"]
    assert link == robot.links[1]
    assert one["value"] == pytest.approx(moment, rel=1e-3)
    # in a plane, the mass of the last link is seen through the first moment about the joint before alone
    _, one = directions[robot.joints[0], "first_moment"]
    assert one["value"] == pytest.approx(robot.inertial[1, 0] + 0.3 * robot.inertial[0, 1], rel=1e-3)
    assert np.all(found.nrmse < 0.01)


def test_identified_links_are_proposed_where_no_error_of_a_file_explains_as_much(tmp_path):
    """A mass that is a hundredth of the true one is further off than a link of a file may be."""
    plant, made, robot = recordings(tmp_path, 1, 5)
    report = calibrate(as_set(plant, made, robot=moved(robot, 0, 0.01))).report
    (found,) = report["if_identified"]
    (one,) = (d for d in found["directions"] if d["quantity"] == "first_moment")
    assert one["value"] == pytest.approx(np.linalg.norm(robot.inertial[1:4, 0]), rel=0.01)
    assert found["lowers_error"]["interval"][0] > 0.3
    assert "if_identified" not in calibrate(as_set(plant, made)).report


def test_links_stay_bodies_where_a_spring_is_missing(tmp_path):
    """Gravity of a link stands for a spring in part; its file then needs the same torques."""
    plant, made, robot = recordings(tmp_path, 2, 4)
    sprung = [replace(r, tau=r.tau + np.array([[0.0], [30.0]]) * (r.q - 1.0)) for r in made]
    found = calibrate(as_set(plant, sprung)).robot
    for body, plain in zip(found.inertial.T, robot.inertial.T, strict=True):
        assert np.linalg.eigvalsh(pseudo_inertia(body))[0] > 0
        assert 1 / HEAVIEST < body[0] / plain[0] < HEAVIEST * max(1.0, robot.inertial[0].mean() / plain[0])
    text = mjcf(Model(found, found.tool), np.zeros(0)).text
    mj, rng = mujoco.MjModel.from_xml_string(text), np.random.default_rng(0)
    data, model = mujoco.MjData(mj), pin.buildModelFromUrdf(str(plant.urdf))
    for i, body in enumerate(found.inertial.T):
        model.inertias[i + 1] = pin.Inertia.FromDynamicParameters(body)
    for q, dq, ddq in rng.uniform(-1.5, 1.5, (5, 3, 2)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddq
        mujoco.mj_inverse(mj, data)
        needed = pin.rnea(model, model.createData(), q, dq, ddq)
        np.testing.assert_allclose(data.qfrc_inverse, needed, rtol=1e-2)


def test_what_torques_see_of_a_joint_is_what_turns_about_it():
    """First moment and inertia of the outer links as a whole, but for what base parameters leave to inner ones, against Pinocchio."""
    robot = load_robot("rrr")
    every = {(s.joint, s.quantity): [] for s in seen_quantities(robot)}
    for s in seen_quantities(robot):
        every[s.joint, s.quantity].append(float(s.row @ robot.inertial.T.ravel()))
    last = robot.inertial[:, 2]
    assert every[2, "first_moment"] == pytest.approx([np.linalg.norm(last[1:4]), 0.0], abs=1e-9)
    # of the plane of joints 2 and 3: the last link counts as a mass at joint 3
    length = robot.placements[2, 0, 3]
    second = robot.inertial[:, 1]
    assert every[1, "first_moment"] == pytest.approx([second[1] + length * last[0], 0.0], abs=1e-9)
    assert every[1, "inertia"] == pytest.approx([second[9 if abs(robot.axes[1, 2]) > 0.5 else 6] + length**2 * last[0]])
    base = base_parameters(robot)
    hidden = np.linalg.svd(base.projection)[2][len(base.independent) :]
    for s in seen_quantities(robot):  # nothing that no torque sees
        assert np.abs(hidden @ s.row).max() < 1e-6
        assert np.linalg.norm(s.along) == pytest.approx(1.0)


def test_errors_have_ends_that_no_body_reaches():
    """Of any size; those of usual size are hardly changed."""
    robot, rng = load_robot("rrr"), np.random.default_rng(1)
    ends = most_of(robot, OF_URDF)
    links = LinkErrors(robot.inertial, np.tile(SHAPE, 3), ends)
    free = LinkErrors(robot.inertial, np.tile(SHAPE, 3))
    for size in (1.0, 30.0, 1e4):
        errors = size * rng.standard_normal(21)
        bodies, slopes = links.at(errors)
        assert np.all(np.isfinite(slopes))
        for i, (body, plain) in enumerate(zip(bodies.T, robot.inertial.T, strict=True)):
            assert is_possible(body)
            assert 1 / HEAVIEST <= body[0] / plain[0] <= HEAVIEST * max(1.0, robot.inertial[0].mean() / plain[0]) * (1 + 1e-9)
            shift = np.abs(body[1:4] / body[0] - plain[1:4] / plain[0])
            assert np.all(shift <= ends[1][7 * i + 1 : 7 * i + 4] * (1 + 1e-9))
    small = rng.standard_normal(21)
    np.testing.assert_allclose(links.at(small)[0], free.at(small)[0], rtol=0.01, atol=1e-3)

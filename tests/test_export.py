"""Exported files, read again by the programs that they are for."""

from dataclasses import replace

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from rrr_oc.effects.elastic.biarticular_spring import BiarticularSpring
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.effects.friction.load_dependent_friction import LoadDependentFriction
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.robot import BUNDLED, load_robot, urdf_text
from rrr_oc.simulation.export import mjcf, urdf

STATES = np.random.default_rng(0).uniform(-1.5, 1.5, (20, 3, 3))  # q, dq, ddq of each


def torque(mj: mujoco.MjModel, q, dq, ddq) -> np.ndarray:
    """What plain MuJoCo needs for a motion, (n,) [Nm]."""
    data = mujoco.MjData(mj)
    data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddq
    mujoco.mj_inverse(mj, data)
    return data.qfrc_inverse.copy()


@pytest.mark.parametrize("name", BUNDLED)
def test_a_urdf_read_again_has_the_inertial_parameters(name, tmp_path):
    robot = load_robot(name)
    changed = robot.inertial * np.random.default_rng(1).uniform(0.9, 1.1, robot.inertial.shape[1])
    (tmp_path / "arm.urdf").write_text(urdf(urdf_text(name), replace(robot, inertial=changed)))
    np.testing.assert_allclose(load_robot(tmp_path / "arm.urdf").inertial, changed, rtol=1e-9, atol=1e-10)


def test_a_locked_joint_is_fixed_and_its_link_is_part_of_the_one_before(tmp_path):
    robot = load_robot("rrr", ["joint1", "joint2"])
    (tmp_path / "arm.urdf").write_text(urdf(urdf_text("rrr"), robot))
    again = load_robot(tmp_path / "arm.urdf")
    assert again.joints == ("joint1", "joint2")
    np.testing.assert_allclose(again.inertial, robot.inertial, rtol=1e-9, atol=1e-10)


def test_mjcf_needs_the_torques_of_pinocchio_and_of_the_springs_laws():
    robot = load_robot("rrr")
    pea, bpea = ParallelSpring((1,)), BiarticularSpring((1, 2))
    model = Model(robot, robot.tool, (pea, bpea))
    theta = model.theta(
        {
            model.label(pea): {"stiffness": 30.0, "equilibrium": 0.4},
            model.label(bpea): {"kappa": 20.0, "rho": 0.8, "phi": 0.3},
        }
    )
    made = mjcf(model, theta, payload=2.0)
    assert made.left_out == ()
    mj = mujoco.MjModel.from_xml_string(made.text)
    body = pin.buildModelFromXML(urdf_text("rrr"))
    body.appendBodyToJoint(3, pin.Inertia(2.0, np.zeros(3), np.zeros((3, 3))), pin.SE3(np.eye(3), robot.tool.position))
    data = body.createData()
    slack = []
    for share, dq, ddq in STATES:
        q = robot.lower + (robot.upper - robot.lower) * (0.5 + share / 3.2)  # limits push back beyond
        stretch = max(0.4 - q[1], 0.0), max(-q[1] - 0.8 * q[2] - 0.3, 0.0)
        slack.append([s == 0 for s in stretch])
        springs = np.array([0.0, 30.0 * stretch[0] + 20.0 * stretch[1], 0.8 * 20.0 * stretch[1]])
        np.testing.assert_allclose(torque(mj, q, dq, ddq), pin.rnea(body, data, q, dq, ddq) - springs, rtol=1e-7, atol=1e-7)
    assert 0 < np.mean(slack) < 1  # both sides of the springs are met
    np.testing.assert_allclose(mj.jnt_range, np.array([robot.lower, robot.upper]).T, rtol=1e-5)  # the digits that MuJoCo writes
    np.testing.assert_allclose(mj.actuator_ctrlrange[:, 1], robot.effort)


def test_what_mujoco_cannot_express_is_named():
    robot = load_robot("rrr")
    friction = LoadDependentFriction((1,))
    made = mjcf(Model(robot, robot.tool, (friction,)), [0.1])
    (one,) = made.left_out
    assert "load_dependent_friction" in one
    assert "load_dependent_friction" in made.text.split("-->")[0]
    mujoco.MjModel.from_xml_string(made.text)

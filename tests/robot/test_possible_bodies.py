"""Bodies that take the place of impossible ones: torques by Pinocchio from both."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from chains import random_chain

from rrr_oc.robot.inertial_parameters import base_parameters, is_physical
from rrr_oc.robot.possible_bodies import SameTorques
from rrr_oc.robot.robot import Robot, load_robot

OWN = slice(-10, None)  # numbers of the last link


def regressor(urdf: str, states: np.ndarray) -> np.ndarray:
    """Torques at states (K, 3, n) by the inertial parameters, (K n, 10 n), in Pinocchio's order of these numbers, which is ours."""
    model = pin.buildModelFromXML(urdf)
    data = model.createData()
    return np.array([pin.computeJointTorqueRegressor(model, data, *state) for state in states]).reshape(-1, 10 * model.nq)


def robot_of(folder, urdf: str) -> Robot:
    (folder / "arm.urdf").write_text(urdf)
    return load_robot(folder / "arm.urdf")


@pytest.mark.parametrize(("seed", "joints"), [(1, 1), (2, 2), (3, 3), (4, 5), (5, 7)])
def test_impossible_links_are_replaced_by_possible_ones_that_need_the_same_torques(seed, joints, tmp_path):
    """The links are changed along what no torque depends on until the last one is none."""
    urdf = random_chain(seed, joints)
    robot, rng = robot_of(tmp_path, urdf), np.random.default_rng(seed)
    unfelt = np.linalg.svd(base_parameters(robot).projection)[2][len(base_parameters(robot).independent) :]
    change, size = rng.standard_normal(len(unfelt)) @ unfelt, 1.0
    while all(is_physical(x) for x in (robot.inertial.T.ravel() + size * change).reshape(-1, 10)):
        size *= 2
    wrong = (robot.inertial.T.ravel() + 2 * size * change).reshape(-1, 10).T
    found = SameTorques.of(robot).bodies(wrong)
    assert found is not None
    assert all(is_physical(x) for x in found.T)
    torques = regressor(urdf, rng.uniform(-2, 2, (50, 3, joints)))
    wanted = torques @ robot.inertial.T.ravel()
    np.testing.assert_allclose(torques @ found.T.ravel(), wanted, rtol=0, atol=1e-8 * np.abs(wanted).max())


def test_possible_links_stay_as_they_are(tmp_path):
    robot = robot_of(tmp_path, random_chain(1, 3))
    lighter = robot.inertial * 0.9
    assert SameTorques.of(robot).bodies(lighter) is lighter


def test_there_are_none_for_torques_of_no_body(tmp_path):
    """The last link's moment of inertia about its joint is negative, and no other link can have a part of it."""
    robot = robot_of(tmp_path, random_chain(1, 3))
    wrong = robot.inertial.copy()
    wrong[4:, -1] *= -1
    assert SameTorques.of(robot).bodies(wrong) is None


def test_links_without_extent_are_near_possible_ones(tmp_path):
    """A URDF may have points of mass, whose pseudo-inertia has no root."""
    robot = robot_of(tmp_path, random_chain(1, 2))
    point = robot.inertial.copy()
    at = np.array([0.1, 0.0, 0.0])
    inertia = 2.0 * (at @ at * np.eye(3) - np.outer(at, at))
    point[:, 1] = [2.0, *(2.0 * at), *inertia[np.tril_indices(3)]]
    wrong = point.copy()
    wrong[0, 0] = -1.0
    found = SameTorques.of(replace(robot, inertial=point)).bodies(wrong)
    assert found is not None  # the first link's mass is felt by no joint
    assert found[0, 0] > 0

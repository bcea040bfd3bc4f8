# pyright: reportAttributeAccessIssue=false
# (pinocchio has no stubs)
"""The symbolic dynamics against Pinocchio's numeric algorithms on the URDF, and against what the equations themselves imply."""

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from chains import random_chain

from rrr_oc.robot.rigid_body import rigid_body, with_payload
from rrr_oc.robot.robot import Robot, load_robot

URDFS = Path(__file__).resolve().parents[2] / "rrr_oc" / "urdf"
TILTED = np.array([3.0, -4.0, -8.0])
ROUNDING = 1e-9  # of numbers up to some hundred, over some hundred operations


@pytest.fixture(scope="module", params=["rrr", "rrr_prototype", "chain6", "chain7"])
def arm(request, tmp_path_factory) -> tuple[Robot, pin.Model]:
    """A robot of ours, and Pinocchio's own reading of the same file."""
    name = request.param
    if name.startswith("rrr"):
        return load_robot(name), pin.buildModelFromUrdf(str(URDFS / f"{name}.urdf"))
    path = tmp_path_factory.mktemp("urdf") / f"{name}.urdf"
    path.write_text(random_chain(int(name[-1]), int(name[-1])))
    return load_robot(path), pin.buildModelFromUrdf(str(path))


def states(n: int, count: int = 20, seed: int = 3):
    """Angles [rad], speeds [rad/s] and accelerations [rad/s²]."""
    yield from np.random.default_rng(seed).normal(size=(count, 3, n)) * np.array([1.5, 2.0, 5.0])[:, None]


def value(function: ca.Function, *arguments) -> np.ndarray:
    """A Function's one output, a vector where it is a column."""
    output = np.array(function(*arguments))
    return output[:, 0] if output.shape[1] == 1 and output.shape[0] > 1 else output


def test_dynamics(arm):
    robot, model = arm
    body, data, g = rigid_body(robot), model.createData(), robot.gravity
    for q, dq, ddq in states(robot.n):
        inertial = robot.inertial
        M = pin.crba(model, data, q)
        M = np.triu(M) + np.triu(M, 1).T
        C, G = pin.computeCoriolisMatrix(model, data, q, dq), pin.computeGeneralizedGravity(model, data, q)
        tau = pin.rnea(model, data, q, dq, ddq)
        np.testing.assert_allclose(value(body.mass_matrix, q, inertial), M, atol=ROUNDING)
        np.testing.assert_allclose(value(body.coriolis_matrix, q, dq, inertial), C, atol=ROUNDING)
        np.testing.assert_allclose(value(body.gravity_torque, q, inertial, g), G, atol=ROUNDING)
        np.testing.assert_allclose(value(body.inverse_dynamics, q, dq, ddq, inertial, g), tau, atol=ROUNDING)
        np.testing.assert_allclose(M @ ddq + C @ dq + G, tau, atol=ROUNDING)
        scale = max(1.0, np.linalg.cond(M))  # forward dynamics divides by M
        acceleration = pin.aba(model, data, q, dq, 10 * ddq)
        np.testing.assert_allclose(
            value(body.forward_dynamics, q, dq, 10 * ddq, inertial, g), acceleration, rtol=ROUNDING, atol=ROUNDING * scale
        )
        np.testing.assert_allclose(value(body.forward_dynamics, q, dq, tau, inertial, g), ddq, atol=ROUNDING * scale)


def test_kinematics(arm):
    robot, model = arm
    body, model, tip = rigid_body(robot), model.copy(), np.array([0.1, -0.2, 0.3])
    point = model.addFrame(pin.Frame("point", robot.n, pin.SE3(np.eye(3), tip), pin.FrameType.OP_FRAME))
    data = model.createData()
    for q, _, _ in states(robot.n):
        pin.framesForwardKinematics(model, data, q)
        frames = value(body.joint_frames, q)
        for i in range(robot.n):
            np.testing.assert_allclose(frames[:9, i].reshape(3, 3, order="F"), data.oMi[i + 1].rotation, atol=ROUNDING)
            np.testing.assert_allclose(frames[9:, i], data.oMi[i + 1].translation, atol=ROUNDING)
        np.testing.assert_allclose(value(body.tool_position, q, tip), data.oMf[point].translation, atol=ROUNDING)
        tool = data.oMf[model.getFrameId("tool")].translation
        np.testing.assert_allclose(value(body.tool_position, q, robot.tool.position), tool, atol=ROUNDING)
        jacobian = pin.computeFrameJacobian(model, data, q, point, pin.LOCAL_WORLD_ALIGNED)
        np.testing.assert_allclose(value(body.tool_jacobian, q, tip), jacobian[:3], atol=ROUNDING)


def test_mass_matrix_is_symmetric_and_positive(arm):
    robot, _ = arm
    body = rigid_body(robot)
    for q, _, _ in states(robot.n):
        M = value(body.mass_matrix, q, robot.inertial)
        np.testing.assert_array_equal(M, M.T)
        assert np.linalg.eigvalsh(M)[0] > 0


def test_the_rate_of_M_less_twice_C_is_skew(arm):
    """dM/dt along the motion is the derivative of M in the direction dq, here casadi's own, and by differences."""
    robot, _ = arm
    body = rigid_body(robot)
    q, dq = ca.SX.sym("q", robot.n), ca.SX.sym("dq", robot.n)
    M = body.mass_matrix(q, robot.inertial)
    rate = ca.Function("rate", [q, dq], [ca.reshape(ca.jtimes(ca.vec(M), q, dq), robot.n, robot.n)])
    for at, speed, _ in states(robot.n):
        step = 1e-6
        ahead, behind = (value(body.mass_matrix, at + s * step * speed, robot.inertial) for s in (1, -1))
        slope = value(rate, at, speed)
        np.testing.assert_allclose((ahead - behind) / (2 * step), slope, rtol=1e-6, atol=1e-6)  # rounding over the step
        skew = slope - 2 * value(body.coriolis_matrix, at, speed, robot.inertial)
        np.testing.assert_allclose(skew, -skew.T, atol=ROUNDING)


def test_gravity_torque_is_the_slope_of_the_potential(arm):
    """For gravity tilted out of the vertical; U = −g·Σ (m o + R h) by the links' own frames."""
    robot, model = arm
    body, q = rigid_body(robot), ca.SX.sym("q", robot.n)
    frames, energy = body.joint_frames(q), ca.SX(0)
    for i in range(robot.n):
        energy -= ca.dot(
            ca.DM(TILTED), robot.inertial[0, i] * frames[9:, i] + ca.reshape(frames[:9, i], 3, 3) @ robot.inertial[1:4, i]
        )
    slope = ca.Function("slope", [q], [ca.gradient(energy, q)])
    tilted = model.copy()
    tilted.gravity.linear = TILTED
    data = tilted.createData()
    for at, dq, ddq in states(robot.n):
        found = value(body.gravity_torque, at, robot.inertial, TILTED)
        np.testing.assert_allclose(found, value(slope, at), atol=ROUNDING)
        np.testing.assert_allclose(found, pin.computeGeneralizedGravity(tilted, data, at), atol=ROUNDING)
        expected = pin.rnea(tilted, data, at, dq, ddq)
        np.testing.assert_allclose(value(body.inverse_dynamics, at, dq, ddq, robot.inertial, TILTED), expected, atol=ROUNDING)


def test_inertial_parameters_are_inputs(arm):
    """Other links' inertias, given to one Function, and written into Pinocchio's model."""
    robot, model = arm
    body, rng = rigid_body(robot), np.random.default_rng(4)
    changed, inertial = model.copy(), np.empty_like(robot.inertial)
    for i in range(robot.n):
        shape = rng.normal(size=(3, 3))
        inertia = pin.Inertia(
            rng.uniform(0.5, 5), rng.normal(size=3) / 5, np.trace(shape @ shape.T) * np.eye(3) - shape @ shape.T
        )
        changed.inertias[i + 1] = inertia
        inertial[:, i] = inertia.toDynamicParameters()
    data = changed.createData()
    for q, dq, ddq in states(robot.n):
        expected = pin.rnea(changed, data, q, dq, ddq)
        np.testing.assert_allclose(value(body.inverse_dynamics, q, dq, ddq, inertial, robot.gravity), expected, atol=ROUNDING)
        M = pin.crba(changed, data, q)
        np.testing.assert_allclose(np.triu(value(body.mass_matrix, q, inertial)), np.triu(M), atol=ROUNDING)


@pytest.mark.parametrize("symbolic", [False, True], ids=["numbers", "symbols"])
def test_payload_is_a_point_mass(arm, symbolic):
    """On the last link and on one before it, against an inertia that Pinocchio adds itself."""
    robot, model = arm
    body, point = rigid_body(robot), np.array([0.1, -0.25, 0.05])
    for at in (robot.n - 1, 1):
        loaded = model.copy()
        loaded.inertias[at + 1] = loaded.inertias[at + 1] + pin.Inertia(2.5, point, np.zeros((3, 3)))
        mass = ca.SX.sym("mass")
        inertial = with_payload(robot.inertial, at, mass if symbolic else 2.5, point)
        if symbolic:
            inertial = ca.Function("inertial", [mass], [inertial])(2.5)
        data = loaded.createData()
        np.testing.assert_allclose(np.array(ca.DM(inertial))[:, at], loaded.inertias[at + 1].toDynamicParameters(), atol=1e-12)
        for q, dq, ddq in states(robot.n, 5):
            expected = pin.rnea(loaded, data, q, dq, ddq)
            found = value(body.inverse_dynamics, q, dq, ddq, ca.DM(inertial), robot.gravity)
            np.testing.assert_allclose(found, expected, atol=ROUNDING)


def test_no_payload_changes_nothing(arm):
    robot, _ = arm
    np.testing.assert_array_equal(np.array(ca.DM(with_payload(robot.inertial, 0, 0.0, np.ones(3)))), robot.inertial)


def test_two_robots_of_one_size_do_not_share_functions(arm, tmp_path):
    robot, _ = arm
    path = tmp_path / "other.urdf"
    path.write_text(random_chain(99, robot.n))
    other = replace(load_robot(path), inertial=robot.inertial)
    q = np.full(robot.n, 0.3)
    one, two = (value(rigid_body(r).mass_matrix, q, robot.inertial) for r in (robot, other))
    assert np.abs(one - two).max() > 1e-3

"""Information against its definition, limits between grid points, and gains."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from chains import arm, random_chain

from rrr_oc.effects import CATALOGUE
from rrr_oc.errors import UserError
from rrr_oc.excitation import design as excitation
from rrr_oc.excitation.design import ExcitationSearch, excite
from rrr_oc.excitation.fourier_series import Series
from rrr_oc.excitation.information import INERTIAL, Information, Sensitivity, information, model_sensitivity
from rrr_oc.excitation.limits import MotionLimits, Rig, robot_limits, signals, stands
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.robot import Robot, load_robot, urdf_text
from studies.paper.sweeps import PROTOTYPE_SWEEP, sweep

FRICTION = ("viscous_friction", "dry_friction")
QUICK = ExcitationSearch(harmonics=5, starts=2, draws=8, iterations=60)


def friction_rig(robot: Robot, acceleration: float = 4.0, floor: float = -np.inf, torque: float | None = None) -> Rig:
    """An arm with viscous and dry friction in every joint, at their nominal values."""
    effects = tuple(CATALOGUE[name]((j,)) for name in FRICTION for j in range(robot.n))
    model = Model(robot, robot.tool, effects)
    limits = robot_limits(robot, acceleration, floor)
    if torque is not None:
        limits = replace(limits, torque=np.full(robot.n, torque))
    return Rig(model, limits, np.array([p.nominal for p in model.parameters]))


def everything(rig: Rig) -> Information:
    """On inertial and friction parameters of all joints."""
    return information(rig, [name for name in model_sensitivity(rig).names if name != "payload"])


@pytest.fixture(scope="module")
def rig() -> Rig:
    return friction_rig(load_robot("rrr_prototype"))


@pytest.fixture(scope="module")
def found(rig):
    return excite(everything(rig), QUICK)


# Sensitivity and information


def test_sensitivity_is_pinocchios_regressor(tmp_path):
    (tmp_path / "chain.urdf").write_text(random_chain(4, 4))
    robot = load_robot(tmp_path / "chain.urdf")
    model, rng = pin.buildModelFromUrdf(str(tmp_path / "chain.urdf")), np.random.default_rng(0)
    columns = model_sensitivity(friction_rig(robot))
    for q, dq, ddq in rng.normal(size=(10, 3, 4)):
        expected = pin.computeJointTorqueRegressor(model, model.createData(), q, dq, ddq)
        got = np.asarray(columns.function(q, dq, ddq))
        np.testing.assert_allclose(got[:, :40], expected, atol=1e-10)  # rounding
        np.testing.assert_allclose(got[:, 41:45], np.diag(dq), atol=1e-12)
        np.testing.assert_allclose(got[:, 45:], np.diag(np.tanh(dq / 0.1)), atol=1e-12)  # the width planned for
    assert columns.names[:11] == (*(f"l1.{name}" for name in INERTIAL), "l2.mass")


def test_sensitivity_of_springs_and_payload_by_differences():
    robot = load_robot("rrr")
    model = Model(robot, robot.tool, (CATALOGUE["parallel_spring"]((1,)), CATALOGUE["biarticular_spring"]((1, 2))))
    theta, widths, mass = np.array([8.0, 1.2, 20.0, 0.7, -0.3]), np.full(2, 0.1), 2.0
    columns, rng = model_sensitivity(Rig(model, robot_limits(robot), theta, mass)), np.random.default_rng(1)
    for q, dq, ddq in rng.normal(size=(20, 3, 3)):

        def torque(values, q=q, dq=dq, ddq=ddq):
            return np.asarray(model.inverse(q, dq, ddq, values[0], values[1:], widths)[0]).ravel()

        at, h = np.array([mass, *theta]), 1e-6
        differences = np.array([(torque(at + h * e) - torque(at - h * e)) / (2 * h) for e in np.eye(6)]).T
        # The ramp's third derivative is about 1/width²: times stiffness and h² it is below 1e-7.
        np.testing.assert_allclose(np.asarray(columns.function(q, dq, ddq))[:, 30:], differences, atol=1e-6)


def of_pendulum(*interest: str) -> Information:
    """Columns written by hand: gravity, inertia, two frictions, a copy of gravity, and nothing."""
    robot = load_robot("rrr_prototype", joints=["joint2"])
    rig = Rig(Model(robot, robot.tool), robot_limits(robot, 5.0))
    names = ("gravity", "inertia", "viscous", "dry", "copy", "nothing")

    q, dq, ddq = signals(1)
    columns = ca.horzcat(ca.cos(q), ddq, dq, ca.tanh(dq / 0.1), 3 * ca.cos(q), 0 * q)
    law = ca.Function("law", [q, dq, ddq], [columns])
    return information(rig, interest, 0.5, Sensitivity(names, law))


def test_information_is_the_mean_of_the_products_of_scaled_columns():
    asked = of_pendulum("dry", "inertia", "viscous", "gravity")
    assert (asked.interest, asked.inseparable) == (("dry", "inertia", "viscous", "gravity"), ())
    one = {key: getattr(PROTOTYPE_SWEEP, key)[1:2] for key in ("centre", "amplitude", "slow", "fast")}
    plan = sweep(replace(PROTOTYPE_SWEEP, **one), "rising")
    q, dq, ddq = plan.q[0], plan.dq[0], plan.ddq[0]
    columns = np.array([np.tanh(dq / 0.1), ddq, dq, np.cos(q)]) / 0.5 / asked.scale[:, None]
    S = columns @ columns.T / q.size
    np.testing.assert_allclose(asked.matrix(plan.q, plan.dq, plan.ddq), S, rtol=1e-9)
    assert asked.log_det(plan) == pytest.approx(np.log(np.linalg.det(S)))
    assert asked.condition(plan) == pytest.approx(np.linalg.cond(S))


def test_what_no_motion_can_tell():
    asked = of_pendulum("gravity", "viscous", "copy", "nothing")
    assert len(asked.inseparable) == 2
    assert "nothing" in asked.inseparable
    assert {"gravity", "copy"} & set(asked.inseparable)  # one of two that are told apart by nothing
    with pytest.raises(UserError, match="no motion within the limits distinguishes nothing from a torque of zero"):
        of_pendulum("nothing")
    rig = friction_rig(load_robot("rrr"))
    names = model_sensitivity(rig).names
    lost = [information(rig, some).inseparable for some in (names, [name for name in names if name != "payload"])]
    assert len(lost[0]) == len(lost[1]) + 1  # the last link's own mass explains the payload


def test_base_parameters_are_as_many_as_the_regressor_has(rig):
    """Of 30 inertial parameters this arm has 15 base parameters (Gautier & Khalil's rules; here the rank of Pinocchio's)."""
    robot, rng = rig.model.robot, np.random.default_rng(0)
    model = pin.buildModelFromXML(urdf_text("rrr_prototype"))
    stacked = np.vstack([pin.computeJointTorqueRegressor(model, model.createData(), *s) for s in rng.normal(size=(60, 3, 3))])
    known = model_sensitivity(rig)
    links = tuple(name for name in known.names if name.split(".")[0] in robot.links)
    assert len(information(rig, links).interest) == np.linalg.matrix_rank(stacked, 1e-8) == 15


# Motions


def test_series_is_at_rest_at_both_ends_and_derives_itself():
    series, h = Series(7.0, 6), 1e-5
    for t in (0.0, 7.0):
        np.testing.assert_allclose(np.vstack(series.basis(np.array([t]))[1:]), 0, atol=1e-12)
    t = np.linspace(0.1, 6.9, 50)
    before, here, after = (series.basis(t + s) for s in (-h, 0, h))
    for k in (0, 1):
        np.testing.assert_allclose((after[k] - before[k]) / (2 * h), here[k + 1], atol=1e-7)
    np.testing.assert_allclose(here[0] @ series.still, 1, atol=1e-12)


def test_limits_on_the_grid_hold_between_its_points():
    """Ehlich & Zeller's bound, on random polynomials; and it is nearly attained by the highest harmonic."""
    series, rng = Series(1.0, 4), np.random.default_rng(0)
    fine = np.linspace(0, 1, 4001)
    for x in rng.normal(size=(200, 7)):
        assert np.max(np.abs(series.basis(fine)[0] @ x)) <= np.max(np.abs(series.basis(series.grid)[0] @ x)) / series.margin


def test_exact_gradient(rig):
    problem = excitation._Problem(everything(rig), Series(QUICK.duration, QUICK.harmonics), QUICK)
    x = ca.SX.sym("x", problem.criterion.size1_in(0))
    gradient = ca.Function("gradient", [x], [ca.gradient(problem.criterion(x), x)])
    at, rng = problem.starts()[0][0].ravel("F"), np.random.default_rng(0)
    for direction in rng.normal(size=(3, at.size)):
        h = 1e-6
        difference = float(problem.criterion(at + h * direction) - problem.criterion(at - h * direction)) / (2 * h)
        assert float(gradient(at).T @ direction) == pytest.approx(difference, rel=1e-5, abs=1e-6)


def test_exact_jacobian():
    """What the solver is given, by the chain rule, against CasADi's own of the constraints, where all kinds of limits are there."""
    rig = friction_rig(load_robot("rrr"), floor=0.05, torque=10.0)
    problem = excitation._Problem(everything(rig), Series(QUICK.duration, QUICK.harmonics), QUICK)
    values, given = problem.constraints
    x = ca.MX.sym("x", values.size1_in(0))
    at = problem.starts()[0][0].ravel("F")
    stacked, jacobian = given(at, [])
    expected = np.asarray(ca.Function("expected", [x], [ca.jacobian(values(x), x)])(at))
    assert set(problem.path.names) == {"torque", "floor"}
    np.testing.assert_allclose(np.asarray(jacobian), expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(np.asarray(stacked), np.asarray(values(at)))


def test_criterion_is_the_information_on_the_grid(rig):
    asked = everything(rig)
    problem = excitation._Problem(asked, Series(QUICK.duration, QUICK.harmonics), QUICK)
    x = problem.starts()[0][0]
    S = asked.matrix(*problem.series.motion(x, rig.limits, problem.series.grid))
    got = float(problem.criterion(x.ravel("F")))
    assert got == pytest.approx(-np.linalg.slogdet(S)[1] / len(S), rel=1e-5)  # 1e-10 on F's diagonal


def test_found_motion_keeps_the_limits_everywhere(rig, found):
    fine = np.linspace(0, QUICK.duration, 50001)
    coefficients = np.linalg.lstsq(found_basis(found.motion.t), found.motion.q.T, rcond=None)[0]
    motion = Series(QUICK.duration, QUICK.harmonics).motion(coefficients, rig.limits, fine)
    assert max(rig.excess(*motion).values()) <= 1e-9  # what the fit of the coefficients leaves
    assert all(np.max(np.abs(v)) < 1e-9 for p in [found.motion] for v in (p.dq[:, [0, -1]], p.ddq[:, [0, -1]]))
    np.testing.assert_allclose(found.motion.q[:, 0], found.motion.q[:, -1], atol=1e-12)


def found_basis(t):
    return Series(QUICK.duration, QUICK.harmonics).basis(t)[0]


def test_found_motion_tells_more_than_sweep_and_random_motions(rig, found):
    asked = everything(rig)
    slow = replace(PROTOTYPE_SWEEP, duration=QUICK.duration)  # the same length; and as published, three times as long
    for motion in (slow, PROTOTYPE_SWEEP):
        for direction in ("rising", "falling"):
            plan = sweep(motion, direction)
            assert found.log_det > asked.log_det(plan) + 20
            assert asked.condition(found.motion) < asked.condition(plan) / 10
    assert found.solved.min() < found.drawn.min() - 0.3  # nat a parameter, against the best of 16 random motions
    assert found.log_det == pytest.approx(-found.solved.min() * len(asked.interest), abs=0.5)  # samples against the grid


def test_torque_limit_and_floor_hold_between_grid_points():
    """Where both bind: without them the same search breaks them."""
    robot = load_robot("rrr_prototype")
    free, bound = friction_rig(robot), friction_rig(robot, floor=0.05, torque=10.0)
    loose, tight = (excite(everything(r), replace(QUICK, starts=1)).motion for r in (free, bound))
    assert bound.excess(loose.q, loose.dq, loose.ddq)["torque"] > 0.1
    assert bound.excess(loose.q, loose.dq, loose.ddq)["floor"] > 0.1
    assert max(bound.excess(tight.q, tight.dq, tight.ddq).values()) <= 1e-6


def test_a_motion_for_one_effect():
    """A spring across two joints, on an arm with other springs and a payload that are known."""
    robot = load_robot("rrr")
    model = Model(robot, robot.tool, (CATALOGUE["parallel_spring"]((1,)), CATALOGUE["biarticular_spring"]((1, 2))))
    rig = Rig(model, replace(robot_limits(robot, 4.0), torque=np.full(3, np.inf)), np.array([8.0, 2.0, 20.0, 0.7, -0.3]), 5.0)
    known = model_sensitivity(rig)
    interest = tuple(name for name in known.names if name.startswith("biarticular"))
    asked = information(rig, interest)
    result = excite(asked, QUICK)
    assert asked.interest == interest
    assert set(result.motion.payload) == {5.0}
    assert result.solved.min() < result.drawn.min() - 0.1
    assert result.log_det > max(asked.log_det(sweep(PROTOTYPE_SWEEP, d)) for d in ("rising", "falling")) + 1


def test_joints_that_stand_still(rig):
    limits = replace(rig.limits, lower=np.array([0.3, -0.1, -2.0]), upper=np.array([0.3, 2.0, 2.0]))
    fixed = replace(rig, limits=limits)
    known = model_sensitivity(fixed)
    asked = information(fixed, [n for n in known.names if n.startswith(FRICTION)])
    result = excite(asked, replace(QUICK, starts=1))
    assert set(asked.inseparable) == {"viscous_friction[joint1].coefficient", "dry_friction[joint1].level"}
    np.testing.assert_array_equal(result.motion.q[0], 0.3)
    assert np.ptp(result.motion.q[1]) > 0.5


@pytest.mark.parametrize("joints", [1, 2, 6])
def test_any_number_of_joints(joints, tmp_path):
    (tmp_path / "chain.urdf").write_text(random_chain(joints, joints))
    rig = friction_rig(load_robot(tmp_path / "chain.urdf"), torque=np.inf)
    result = excite(everything(rig), replace(QUICK, starts=1, draws=4, iterations=15))
    assert result.solved.min() < result.drawn.min()
    assert max(rig.excess(result.motion.q, result.motion.dq, result.motion.ddq).values()) <= 0


def test_joints_without_a_range_move(tmp_path):
    """Files with the range 0 to 0 give none; taken at their word no joint would move."""
    (tmp_path / "arm.urdf").write_text(arm(2).replace('lower="-2" upper="2"', 'lower="0" upper="0"'))
    robot = load_robot(tmp_path / "arm.urdf")
    limits = robot_limits(robot, acceleration=5.0)
    assert limits.moving.tolist() == [0, 1]


def test_same_seed_same_motion(rig, found):
    again, other = (excite(everything(rig), replace(QUICK, seed=seed)) for seed in (0, 1))
    np.testing.assert_array_equal(again.motion.q, found.motion.q)
    assert again.log_det == found.log_det
    assert np.any(other.motion.q != found.motion.q)


# What users can mend


def test_unusable_input(rig):
    for interest in (("joint9",), ("payload", "payload"), ()):
        with pytest.raises(UserError, match=r"must be different ones of link1\.mass"):
            information(rig, interest)
    with pytest.raises(UserError, match="noise"):
        information(rig, ("link2.mx",), noise=0.0)
    with pytest.raises(UserError, match="ranges are crossed"):
        replace(rig.limits, lower=np.full(3, 4.0))
    with pytest.raises(UserError, match="at least one joint must move"):
        replace(rig.limits, lower=np.zeros(3), upper=np.zeros(3))
    with pytest.raises(UserError, match="speed limits must be above 0"):
        replace(rig.limits, speed=np.zeros(3))
    with pytest.raises(UserError, match="one shape"):
        MotionLimits(*[np.ones(k) for k in (3, 3, 2, 3, 3)])
    with pytest.raises(UserError, match="harmonics must be 3 or more"):
        ExcitationSearch(harmonics=2)
    with pytest.raises(UserError, match="6 parameters"):
        replace(rig, theta=np.zeros(2))


def test_limits_that_leave_no_motion(rig):
    torque, lower, upper = np.array([[10.0, 1e-3, 10.0], [-1, 0.0, -0.5], [1, 0.5, 0.5]])
    weak = replace(rig, limits=replace(rig.limits, torque=torque, lower=lower, upper=upper))
    with pytest.raises(UserError, match=r"no motion found that keeps the limits: at best the torque is broken by .* \[Nm\]"):
        excite(everything(weak), replace(QUICK, starts=1, iterations=20))


def test_limits_of_a_urdf_that_has_none():
    """A URDF says that it knows no limit by 0, or by an absurd number."""
    robot = replace(load_robot("rrr"), effort=np.array([0.0, 5.0, 1e30]), velocity=np.array([1.0, 0.0, np.inf]))
    limits = robot_limits(robot)
    assert limits.torque.tolist() == [np.inf, 5.0, np.inf]
    assert limits.speed.tolist() == [1.0, np.inf, np.inf]


def test_an_arm_stands_unless_it_hangs_from_its_base(tmp_path):
    """The bundled arm stands; the same arm under a ceiling, and a pendulum, hang."""
    assert stands(load_robot("rrr"))
    assert not stands(load_robot("rrr", gravity=(0.0, 0.0, 9.81)))
    (tmp_path / "arm.urdf").write_text(arm(2).replace('xyz="0.3 0 0"', 'xyz="0 0 -0.3"'))
    assert not stands(load_robot(tmp_path / "arm.urdf"))

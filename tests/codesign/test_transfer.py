"""Optima in a calibrated twin: without friction the engine gives the motion's own cost, with it all routes mean what they say."""

from dataclasses import replace

import casadi as ca
import designs
import numpy as np
import pytest
from recorded import Plant, as_set, record
from small_searches import smooth_motion

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term, nominal_term
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import SampledMotion, describe_motors
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.codesign.transfer import check_transfer, describe_transfer, motors_of, of_all_joints, reference_phases, repaired
from rrr_oc.effects import CATALOGUE
from rrr_oc.effects.black_box.empirical import Empirical
from rrr_oc.errors import UserError
from rrr_oc.report.design_report import transfer_table
from rrr_oc.robot.drives import MotorAndGear, actuators_of, load_actuators
from rrr_oc.robot.robot import load_robot, urdf_text


def calibrated(dry=0.0, viscous=0.0, armature=0.0):
    """A calibrated model of the paper's arm with these parameters in every joint."""
    plant = Plant("rrr", np.zeros(3), np.zeros(3), np.zeros(3))
    start = plain_model(as_set(plant, [record(plant, "a.csv", np.random.default_rng(0), 1.0)]))
    return replace(
        start,
        terms=tuple(
            t.with_values(np.array([v])) for t, v in zip(start.prompt_terms, (dry, viscous, armature) * 3, strict=True)
        ),
    )


@pytest.fixture(scope="module")
def moved() -> tuple[CoDesign, SampledMotion, np.ndarray]:
    return smooth_motion()


def test_without_friction_the_engine_gives_the_motions_own_cost(moved):
    design, motion, theta = moved
    found = describe_transfer(design, motion, theta, calibrated(), load_actuators(design.task.joints))
    expected = motion.metrics()
    # the engine's springs are exact, the motion's rounded over their width: 1e-3 of their torque
    assert found["engine"]["E1"] == pytest.approx(expected.E1_total, rel=3e-3)
    assert found["motor"]["E1"] == pytest.approx(expected.E1_total, rel=3e-3)
    assert found["tracking_error_rad"] < 1e-3
    assert not found["saturated"]


def test_what_the_motors_do_is_the_friction_rotors_and_gears_of_task_or_model(moved):
    """Squared torque and work of the motors, written out; from the motors of a task and from those of a calibrated model."""
    design, motion, _ = moved
    own = {"dry_Nm": 5.0, "viscous_Nm_s_per_rad": 10.0, "inertia_kg_m2": 0.2}
    task = dict.fromkeys(design.task.joints, MotorAndGear(**own))
    assert motors_of(calibrated(5.0, 10.0, 0.2), design.task) == task
    found = describe_motors(replace(design, actuators=actuators_of({j: one.drive for j, one in task.items()})), motion)
    assert found is not None
    sign = np.tanh(20 * motion.dq)
    torque = motion.tau_load + 5.0 * sign + 10.0 * motion.dq * sign**2
    torque += 0.2 * motion.ddq
    spans = [(motion.t[k], torque[:, k], motion.dq[:, k]) for k in motion.segments]
    assert found["E1"] == pytest.approx(sum(np.trapezoid((tau**2).sum(axis=0), t) for t, tau, _ in spans), rel=1e-6)
    assert found["work_J"] == pytest.approx(
        sum(np.trapezoid(np.maximum(tau * dq, 0).sum(axis=0), t) for t, tau, dq in spans), rel=1e-6
    )
    assert found["peak"] == pytest.approx(dict(zip(design.task.joints, np.abs(torque).max(axis=1), strict=True)))
    assert found["electrical_J"] is None
    assert describe_motors(design, motion) is None


def test_a_model_without_friction_and_rotors_has_no_motors(moved):
    bare = replace(calibrated(), terms=())
    with pytest.raises(UserError, match="the model has no friction and no rotor of joint2, joint3"):
        motors_of(bare, moved[0].task)


def test_friction_stands_in_the_motors_and_not_in_the_engines_load(moved):
    design, motion, theta = moved
    drives = load_actuators(design.task.joints)
    found = describe_transfer(design, motion, theta, calibrated(5.0, 10.0, 0.2), drives)
    assert found["engine"]["E1"] == pytest.approx(motion.metrics().E1_total, rel=0.02)  # the motion is the same
    drive = 5.0 * np.sign(motion.dq) + 10.0 * motion.dq + 0.2 * motion.ddq
    motor = motion.tau_load + drive
    expected = sum(np.trapezoid(np.sum(motor[:, k] ** 2, axis=0), motion.t[k]) for k in motion.phases())
    assert found["motor"]["E1"] == pytest.approx(expected, rel=0.02)
    by_eq10 = np.array(drives.load_from_motor(motion.dq, motion.ddq, motor)[0])
    expected = sum(np.trapezoid(np.sum(by_eq10[:, k] ** 2, axis=0), motion.t[k]) for k in motion.phases())
    assert found["eq10"]["E1"] == pytest.approx(expected, rel=0.05)  # Eq. 10 divides small differences


def test_eq_10_turns_motor_torque_back_into_load(moved):
    _, motion, _ = moved
    drives, symbols = load_actuators(("joint2", "joint3")), [ca.SX.sym(name, 2) for name in ("dq", "ddq", "load")]
    forth = ca.Function("forth", symbols, [drives.motor_torque(*symbols)])
    motor = np.array(forth(motion.dq, motion.ddq, motion.tau_load))
    load, slope = (np.array(x) for x in drives.load_from_motor(motion.dq, motion.ddq, motor))
    np.testing.assert_allclose(load, motion.tau_load, atol=0.02)  # |tau| is rounded over 0.05 Nm
    step = np.array(drives.load_from_motor(motion.dq, motion.ddq, motor + 1e-6)[0])
    np.testing.assert_allclose(slope, (step - load) / 1e-6, rtol=1e-6)


def test_models_that_cannot_serve_are_refused(moved):
    design = moved[0]
    model = calibrated()
    check_transfer(design, model)
    with pytest.raises(UserError, match=r'the model has the joints a, b, c.*"joints" of the task says which'):
        check_transfer(design, replace(model, robot=replace(model.robot, joints=("a", "b", "c"))))
    with pytest.raises(UserError, match="holds for single recordings only"):
        check_transfer(design, replace(model, terms=(replace(model.terms[0], recordings=("a.csv",)),)))


def test_the_table_has_a_row_per_transferred_optimum(moved):
    design, motion, theta = moved
    one = describe_transfer(design, motion, theta, calibrated(1.0), load_actuators(design.task.joints))
    half = {**one, "engine": {**one["engine"], "E1": one["engine"]["E1"] / 2}}
    found = {
        name: designs.with_motion(designs.design(1.0), calibrated=twin)
        for name, twin in (("SA", one), ("PEA", half), ("BPEA", None))
    }
    header, rows = transfer_table(found) or ([], [])
    assert [row[0] for row in rows] == ["SA", "PEA"]
    assert rows[1][header.index("decrease")] == "50.0 %"
    assert transfer_table({"BPEA": found["BPEA"]}) is None


def test_what_builds_up_on_the_way_is_fed_forward(moved):
    """Bristles have bent after the first moments: then the help is what the model predicts, and the arm keeps to its way."""
    design, motion, theta = moved
    start = calibrated()
    bristles = Term(CATALOGUE["presliding_hysteresis"]((1,)), (Estimate(600.0), Estimate(6.0)), 0.05)
    model = replace(start, terms=(*start.terms, bristles))
    bare, helped = (reference_phases(design, motion, theta, m) for m in (start, model))
    for one, other in zip(bare, helped, strict=True):
        middle = len(one.t) // 2
        assert abs(other.feed_forward[1, middle] - one.feed_forward[1, middle]) == pytest.approx(6.0, rel=0.01)
    assert describe_transfer(design, motion, theta, model, load_actuators(design.task.joints))["tracking_error_rad"] < 0.01


@pytest.mark.parametrize("name", ["SA", "PEA"])
def test_what_was_found_of_another_spring_does_not_come_along(moved, name):
    _, motion, theta = moved
    task = load_task("paper")
    design = CoDesign(task, spring_bounds(task, name))
    theta = theta if name == "PEA" else theta[:0]
    start = calibrated()
    scaled = replace(start, terms=(*start.terms, Term(CATALOGUE["spring_stiffness"]((1,)), (Estimate(1.4),))))
    check_transfer(design, scaled)
    for one, other in zip(*(reference_phases(design, motion, theta, m) for m in (start, scaled)), strict=True):
        np.testing.assert_array_equal(one.feed_forward, other.feed_forward)


def test_gravity_that_is_only_missing_in_the_records_is_carried(moved):
    design, motion, theta = moved
    start = calibrated()
    silent = replace(start, terms=(*start.terms, Term(CATALOGUE["missing_gravity"](()), (Estimate(0.9),))))
    for one, other in zip(*(reference_phases(design, motion, theta, m) for m in (start, silent)), strict=True):
        np.testing.assert_array_equal(one.feed_forward, other.feed_forward)
    assert repaired(design, silent, ("a", "b")).model.effects == repaired(design, start, ("a", "b")).model.effects


# a model of some of the joints


def of_some(task, names, terms=(), heavier=0.0):
    """A model of the paper's arm with only these joints, whose first link is heavier than the URDF's."""
    robot = load_robot("rrr", names)
    plain = tuple(
        nominal_term(kind((j,))).with_values(np.array([value]))
        for kind, value in ((CATALOGUE["dry_friction"], 2.0), (CATALOGUE["armature"], 0.1))
        for j in range(len(names))
    )
    inertial = robot.inertial.copy()
    inertial[0, 0] += heavier
    return CalibratedModel(
        replace(robot, inertial=inertial), "rrr", urdf_text("rrr"), robot.tool, "motor", (None,) * len(names), "nominal",
        (*plain, *terms), np.ones(len(names)), np.ones(len(names)),
    )  # fmt: skip


def test_a_model_of_some_joints_is_one_of_all_of_the_tasks(moved):
    design, motion, theta = moved
    task = design.task
    drift = nominal_term(Empirical((1,), (("q", 0),), (-1.0,), (1.0,), (1,)))
    whole = of_all_joints(task, of_some(task, ("joint2", "joint3"), (drift,), heavier=0.5))
    assert whole.joints == task.robot.joints
    np.testing.assert_allclose(whole.robot.inertial[0] - task.robot.inertial[0], [0, 0.5, 0], atol=1e-12)
    assert [t.effect.joints for t in whole.terms if t.effect.name == "dry_friction"] == [(1,), (2,)]
    (own,) = [t.effect for t in whole.terms if t.effect.name == "empirical"]
    assert isinstance(own, Empirical)
    assert (own.joints, own.variables) == ((2,), (("q", 1),))
    assert np.isnan(whole.noise[0])
    found = describe_transfer(design, motion, theta, whole, None)
    assert found["motor"]["E1"] != pytest.approx(found["engine"]["E1"], rel=0.01)  # friction and rotors of two joints
    assert found["tracking_error_rad"] < 1e-2
    assert of_all_joints(task, whole) is whole


def test_what_was_held_still_on_a_link_stays_on_it_once(moved):
    """Of an unchanged model of the first joint, whose link carries all others, nothing is added to the task's link."""
    task = moved[0].task
    whole = of_all_joints(task, of_some(task, ("joint1",)))
    np.testing.assert_allclose(whole.robot.inertial, task.robot.inertial, atol=1e-12)


def test_a_model_of_other_joints_is_refused(moved):
    task = moved[0].task
    other = of_some(task, ("joint2", "joint3"))
    elsewhere = replace(task, robot=load_robot("rrr", ("joint1", "joint2")))
    with pytest.raises(
        UserError, match="the model has the joints joint2, joint3, but the task's robot joint1, joint2; the model's must"
    ):
        of_all_joints(elsewhere, other)
    turned = replace(other, robot=replace(other.robot, axes=-other.robot.axes))
    with pytest.raises(UserError, match="joint joint2 of the model sits or turns otherwise"):
        of_all_joints(task, turned)
    light = of_some(task, ("joint2", "joint3"), heavier=-1000.0)
    with pytest.raises(UserError, match="would be no possible body"):
        of_all_joints(task, light)
    shifted = of_some(task, ("joint1", "joint2"), (nominal_term(CATALOGUE["payload_com"](())),))
    with pytest.raises(UserError, match="payload_com is of a payload on joint2; the task's is carried by joint3"):
        of_all_joints(task, shifted)


def test_a_stiff_arm_with_effects_starts_from_a_motion_with_these(moved):
    """The motion of a design whose springs do nothing is a start for the stiff arm, whose problem has the arm's own effects as parameters."""
    task, start = moved[0].task, calibrated()
    harness = Term(CATALOGUE["cable_harness"]((1,)), (Estimate(3.0), Estimate(0.5)))
    stiff = repaired(CoDesign(task, ()), replace(start, terms=(*start.terms, harness)), ("", ""))
    np.testing.assert_array_equal(stiff.known_parameters, [3.0, 0.5])
    assert len(stiff.known_parameters) == len(stiff.problem.parameters)
    assert len(CoDesign(task, ()).known_parameters) == 0

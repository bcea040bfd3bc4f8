"""What recordings leave open of a design: ranges of E1 against the same motion on arms that are changed by hand."""

import re
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from recorded import Plant, as_set, record

from rrr_oc.calibration.calibrated_model import Alternative, CalibratedModel, Estimate, Term
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import SAVED, SampledMotion, sample_motion
from rrr_oc.codesign.posterior.foreseen import foreseen
from rrr_oc.codesign.posterior.members import AS_CALIBRATED, drawn, members
from rrr_oc.codesign.posterior.scenarios import over_members
from rrr_oc.codesign.search.multistart import solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.study import Request
from rrr_oc.codesign.task import load_task
from rrr_oc.codesign.transfer import of_all_joints, repaired
from rrr_oc.effects import CATALOGUE
from rrr_oc.errors import UserError
from rrr_oc.model.metrics import measure
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.robot.drives import load_actuators
from rrr_oc.robot.robot import load_robot

LINK3_MASS = 20  # of the inertial parameters (30,), link by link


@pytest.fixture(scope="module")
def model() -> CalibratedModel:
    """A calibrated model of the paper's arm without friction, with nothing left open."""
    plant = Plant("rrr", np.zeros(3), np.zeros(3), np.zeros(3))
    start = plain_model(as_set(plant, [record(plant, "a.csv", np.random.default_rng(0), 1.0)]))
    terms = tuple(t.with_values(np.zeros(len(t.estimates))) for t in start.prompt_terms)
    return replace(start, terms=terms, noise=np.full(3, 0.1))


@pytest.fixture(scope="module")
def moved() -> tuple[CoDesign, SampledMotion, np.ndarray]:
    """The paper's task, polynomials from start to release and back, with parallel springs."""
    task = load_task("paper")
    design = CoDesign(task, spring_bounds(task, "PEA"))
    theta, (a, b) = np.array([8.0, 2.0, 0.7, 2.3]), (task.start[:, None], task.release[:, None])
    s, columns = np.linspace(0, 1, 200), []
    for i, (one, two) in enumerate(((a, b), (b, a))):
        q, dq = one + (two - one) * (10 * s**3 - 15 * s**4 + 6 * s**5), (two - one) * (30 * s**2 - 60 * s**3 + 30 * s**4) / 2
        ddq, payload = (two - one) * (60 * s - 180 * s**2 + 120 * s**3) / 4, task.payloads[i]
        tau, spring = (np.array(v) for v in design.torques(q, dq, ddq, payload, theta, design.model.widths))
        columns.append((2 * (s + i), q, dq, ddq, tau, spring, np.full(200, i), np.full(200, payload), np.zeros((3, *q.shape))))
    whole = [np.concatenate(c, axis=-1) for c in zip(*columns, strict=True)]
    return design, SampledMotion(**dict(zip(SAVED, whole, strict=True))), theta


def cost_of(design: CoDesign, motion: SampledMotion, theta: np.ndarray) -> float:
    """Of a motion, by the design's own torques: another route than the members', which go through the model of recordings."""
    torques = []
    for k, payload in zip(motion.phases(), design.task.payloads, strict=True):
        tau = design.torques(motion.q[:, k], motion.dq[:, k], motion.ddq[:, k], payload, theta, design.model.widths)[0]
        torques.append((motion.t[k], np.array(tau)))
    return measure(torques).E1_total


def spread(model: CalibratedModel, **rows: float) -> np.ndarray:
    """One direction that changes these inertial parameters, by their numbers."""
    result = np.zeros((len(model.values) + model.robot.inertial.size, 1))
    for number, std in rows.items():
        result[len(model.values) + int(number.lstrip("_"))] = std
    return result


def test_of_a_model_that_leaves_nothing_open_the_range_is_the_cost_itself(moved, model):
    design, motion, theta = moved
    found = foreseen(design, motion, theta, members(model), "PEA.npz")
    assert found is not None
    assert pytest.approx((cost_of(design, motion, theta),) * 2, rel=1e-9) == found.E1
    assert found.cost == pytest.approx(found.E1)
    assert [one.says for one in found.members] == [AS_CALIBRATED]
    assert found.narrowed_by is None


def test_the_range_is_that_of_arms_with_other_masses(moved, model):
    """A mass of link 3 with 0.2 kg of standard deviation, its centre held: E1 at the quantiles of the normal distribution."""
    design, motion, theta = moved
    lever = model.robot.inertial[1, 2] / model.robot.inertial[0, 2]
    unsure = replace(model, spread=spread(model, _20=0.2, _21=0.2 * lever))
    found = foreseen(design, motion, theta, members(unsure), "PEA.npz")
    assert found is not None
    ends = []
    for sign in (-1, 1):
        inertial = design.task.robot.inertial.copy()
        inertial[:2, 2] += sign * 1.96 * 0.2 * np.array([1.0, lever])
        heavier = replace(design, task=replace(design.task, robot=replace(design.task.robot, inertial=inertial)))
        ends.append(cost_of(heavier, motion, theta))
    low, high = found.E1
    # 64 draws of pairs know a quantile of 2.5 % to about a fifth of the distance from the middle
    middle = cost_of(design, motion, theta)
    assert low == pytest.approx(min(*ends, middle), abs=0.3 * (max(ends) - min(ends)))
    assert high == pytest.approx(max(ends), abs=0.3 * (max(ends) - min(ends)))
    assert low < middle < high


def harness(model: CalibratedModel, stiffness: float) -> CalibratedModel:
    """The model with a harness at joint 2 that rests at 1 rad."""
    term = Term(CATALOGUE["cable_harness"]((1,)), (Estimate(stiffness), Estimate(1.0)))
    return replace(model, terms=(*model.terms, term))


def test_a_model_that_is_as_good_widens_the_range_and_is_named(moved, model):
    design, motion, theta = moved
    other = Alternative(harness(model, 60.0), "cable_harness of joint2")
    found = foreseen(design, motion, theta, members(replace(model, alternatives=(other,))), "PEA.npz")
    assert found is not None
    stiffer = replace(design, springs=()).with_physics([(CATALOGUE["cable_harness"]((1,)), np.array([60.0, 1.0]))])
    own = replace(design, springs=(*design.springs, *stiffer.springs))
    expected = cost_of(own, motion, np.r_[theta, 60.0, 1.0])
    assert found.members[1].E1_itself == pytest.approx(expected, rel=1e-9)
    assert pytest.approx(tuple(sorted((expected, cost_of(design, motion, theta)))), rel=1e-9) == found.E1
    assert found.widened_by == "cable_harness of joint2"
    assert found.narrowed_by == "PEA.npz"  # the harness shows in the torques of the designed motion
    suggested = replace(other, decided_by="suggested_1.csv")
    again = foreseen(design, motion, theta, members(replace(model, alternatives=(suggested,))), "PEA.npz")
    assert again is not None
    assert again.narrowed_by == "suggested_1.csv"


def test_what_no_recording_tells_apart_has_none_that_narrows(moved, model):
    """An offset of the torque sensor in the place of a spring's pretension: equal torques are recorded, and the loads differ."""
    design, motion, theta = moved
    offset = Term(CATALOGUE["torque_offset"]((1,)), (Estimate(-20.0),))
    known = replace(harness(model, 20.0), terms=(*harness(model, 20.0).terms, offset))
    pretension = replace(model, terms=(*model.terms, Term(CATALOGUE["cable_harness"]((1,)), (Estimate(20.0), Estimate(2.0)))))
    other = Alternative(pretension, "cable_harness of joint2 with another equilibrium", ("cable_harness", "torque_offset"))
    found = foreseen(design, motion, theta, members(replace(known, alternatives=(other,))), "PEA.npz")
    assert found is not None
    assert found.E1[1] > 1.5 * found.E1[0]
    assert found.widened_by == other.says
    assert found.narrowed_by is None


def test_what_the_model_leaves_unexplained_may_act_on_the_links(moved, model):
    """Any torque of that rms, whatever its course: E1 of the most adverse and of the most helpful one, in proportion to the load."""
    design, motion, theta = moved
    left = replace(model, unexplained=np.array([9.0, 3.0, 4.0]))  # joint 1 does not move
    found = foreseen(design, motion, theta, members(left), "PEA.npz")
    assert found is not None
    usual, seconds = cost_of(design, motion, theta), 4.0
    share = 5.0 * np.sqrt(seconds / usual)  # of the load torque, by which one of that rms is as large
    assert tuple(found.E1) == pytest.approx((usual * (1 - share) ** 2, usual * (1 + share) ** 2), rel=1e-9)
    assert found.widened_by == "with the torques on its links that no effect explains"
    assert found.narrowed_by == "PEA.npz"


def test_the_other_costs_have_ranges(moved, model):
    design, motion, theta = moved
    motors = replace(design, cost="motor", actuators=load_actuators(design.task.joints))
    found = foreseen(motors, motion, theta, members(model), "PEA.npz")
    assert found is not None
    symbols = [ca.SX.sym(name, 2) for name in ("dq", "ddq", "load")]
    motor = ca.Function("motor", symbols, [load_actuators(design.task.joints).motor_torque(*symbols)])
    torque = np.array(motor(motion.dq, motion.ddq, motion.tau_load))
    expected = sum(np.trapezoid(np.sum(torque[:, k] ** 2, axis=0), motion.t[k]) for k in motion.phases())
    assert found.cost == pytest.approx((expected, expected), rel=1e-6)
    assert pytest.approx((cost_of(design, motion, theta),) * 2, rel=1e-9) == found.E1


def test_draws_have_the_covariance_that_the_model_says(model):
    rng = np.random.default_rng(1)
    root = np.zeros((len(model.values) + 30, 3))
    root[-30:] = 1e-3 * rng.standard_normal((30, 3))
    found = drawn(replace(model, spread=root), 4000, 0)
    changes = np.array([(one.robot.inertial - model.robot.inertial).T.ravel() for one in found])
    np.testing.assert_allclose(changes.mean(axis=0), 0, atol=1e-15)
    expected = root[-30:] @ root[-30:].T
    # of 2000 independent pairs a variance is known to 3 %
    np.testing.assert_allclose(changes.T @ changes / len(changes), expected, atol=0.15 * expected.max())


def test_parameters_stay_within_their_bounds(model):
    term = Term(CATALOGUE["parallel_spring"]((1,)), (Estimate(0.1), Estimate(0.0)))
    with_spring = replace(model, terms=(*model.terms, term))
    root = np.zeros((len(with_spring.values) + 30, 1))
    root[len(with_spring.values) - 2] = 5.0
    stiffness = [one.terms[-1].values[0] for one in drawn(replace(with_spring, spread=root), 16, 0)]
    assert min(stiffness) == 0.0
    assert max(stiffness) > 1.0


def test_a_model_of_some_joints_keeps_what_it_leaves_open(model):
    """Its links are those of the task's robot that it has."""
    task = load_task("paper")
    part = load_robot("rrr", joints=("joint2", "joint3"))
    few = replace(model, robot=part, terms=(), torque_constant=(None, None), noise=np.ones(2), nrmse=np.ones(2))
    root = np.arange(20.0)[:, None]
    few = replace(few, spread=root, alternatives=(Alternative(replace(few, spread=root), "another"),))
    whole = of_all_joints(task, few)
    for one in (whole, whole.alternatives[0].model):
        assert one.spread is not None
        np.testing.assert_array_equal(one.spread.ravel(), [*np.zeros(10), *np.arange(20.0)])


def unsure(model: CalibratedModel) -> CalibratedModel:
    """With a mass of link 3 that is not known, a harness at joint 2 and a tilted base that may be there, and a heavier payload."""
    rival = replace(harness(model, 5.0), spread=None)
    tilt = Term(CATALOGUE["gravity_tilt"](()), (Estimate(0.05), Estimate(0.02)))
    tilted = replace(model, terms=(*model.terms, tilt), spread=None)
    heavy = replace(model, terms=(*model.terms, Term(CATALOGUE["payload_mass"](()), (Estimate(0.5),))))
    others = tuple(Alternative(m, says) for m, says in ((rival, "harness"), (tilted, "tilt"), (heavy, "payload")))
    return replace(model, spread=spread(model, _20=0.2, _21=0.03), alternatives=others)


def test_each_member_is_a_scenario_of_the_search(moved, model):
    """At random motions the costs of the problem are the squared load torques of each arm, designed for alone."""
    design, _, theta = moved
    whole, every = over_members(design, members(unsure(model)), "worst"), members(unsure(model))
    said = [s.says for s in whole.scenarios]
    assert said[0] == AS_CALIBRATED
    assert set(said[1:4]) == {"harness", "tilt", "payload"}
    assert len(said) == 6  # the mass, to both sides
    rng, problem = np.random.default_rng(3), whole.problem
    known = np.concatenate([s.lower for s in whole.springs if s.known])
    parameters, data = np.r_[theta, known], whole.data(1e-3)
    mean = over_members(design, every, "mean").problem
    for phase in (0, 1):
        x, u = np.r_[design.task.start + rng.uniform(-0.3, 0.3, 2), rng.uniform(-1, 1, 2)], rng.uniform(-2, 2, 2)
        costs = np.array(problem.phases[phase].rates(x, u, parameters, data)[1]).ravel()
        expected = []
        for member in [m for says in said[:4] for m in every if m.says == says]:
            arm = repaired(design, member.model, ("", ""))
            own = np.r_[theta, *(s.lower for s in arm.springs if s.known)]
            tau = arm.torques(x[:2], x[2:], u, arm.task.payloads[phase], own, np.full(arm.model.widths.size, 1e-3))[0]
            expected.append(float(np.sum(np.array(tau) ** 2)))
        np.testing.assert_allclose(costs[:4], expected, rtol=1e-9)
        # of opposite changes of one mass, torques are as far from the calibrated one's
        assert np.ptp(costs[[0, 4, 5]]) > 1e-3 * costs[0]
        both = np.array(mean.phases[phase].rates(x, u, parameters, data)[1]).ravel()
        assert both.shape == (1,)
        assert both[0] == pytest.approx(costs.mean(), rel=0.01)  # the mass to both sides by less
    assert problem.groups == (0,) * 6
    assert mean.groups == (0,)


def test_the_worst_member_is_better_served_by_a_design_for_the_worst(model):
    """Springs and motion of a small search: the greatest cost over the members falls, that of the calibrated arm rises."""
    task = load_task("paper")
    design, every = CoDesign(task, spring_bounds(task, "PEA")), members(unsure(model))
    options = SearchOptions(starts=2, motions=0, coarse=6, fine=8, kept=1, refinement=Refinement(1e-2, rounds=0))
    found = {}
    for over in ("calibrated", "worst", "mean"):
        one = over_members(design, every, over)
        optimum = solve_multistart(one, options).whole().best
        motion = sample_motion(one, optimum.solution)
        left = foreseen(design, motion, optimum.solution.parameters[: len(design.problem.parameters)], every, "PEA.npz")
        assert left is not None
        itself = [m.E1_itself for m in left.members]
        found[over] = {"cost": optimum.cost, "worst": max(itself), "first": itself[0]}
    assert found["worst"]["worst"] < found["calibrated"]["worst"]
    assert found["worst"]["first"] > found["calibrated"]["first"]
    assert found["calibrated"]["cost"] < found["mean"]["cost"] < found["worst"]["cost"]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"over": "best"}, "--over is 'best'; allowed are calibrated, mean, worst"),
        ({"over": "mean"}, "--over mean needs --model and --repaired"),
        ({"over": "mean", "repaired": True, "model": Path("m"), "price": 2.0}, "--over is mean and --price is 2"),
    ],
)
def test_what_does_not_go_with_the_members_is_refused(more, said):
    with pytest.raises(UserError, match=re.escape(said)):
        Request("paper", Path("out"), **more)

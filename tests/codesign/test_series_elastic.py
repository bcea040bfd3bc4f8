# pyright: reportAttributeAccessIssue=false
"""Series elastic actuation in co-designs: against Pinocchio, differences, MuJoCo with two coordinates a joint, and its stiff limit."""

import json
from dataclasses import replace
from importlib import resources

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import embedded, idle_springs, resimulate, rotors, sample_motion
from rrr_oc.codesign.search.proposals import dimensions, proposed_guess
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.codesign.task_sets.task_set import SetDesign, load_task_set
from rrr_oc.errors import UserError
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.refinement import Refinement, refine
from rrr_oc.optimal_control.scheme import scheme, uniform_mesh
from rrr_oc.optimal_control.solver import Options, Solution, Solver
from rrr_oc.optimal_control.transcription import Transcription
from rrr_oc.robot.drives import load_actuators

URDF = resources.files("rrr_oc.urdf").joinpath("rrr.urdf").read_text()
TASK = load_task("series_springs")
DRIVES = load_actuators(TASK.joints)


def design_of(configuration: str, task=TASK, **changes) -> CoDesign:
    return CoDesign(task, spring_bounds(task, configuration), **{"cost": "motor", "actuators": DRIVES, **changes})


def replaced(entry: dict) -> dict:
    return {**entry, "compliance_mrad_per_Nm": [5.0, 10.0]} if entry["effect"] == "series_spring" else entry


def transcribed(design: CoDesign, intervals: int) -> Transcription:
    return Transcription(design.problem, scheme("gauss", 3), uniform_mesh(design.problem, intervals))


@pytest.fixture(scope="module")
def optimum() -> tuple[CoDesign, Solution]:
    """A local optimum with springs that are soft enough for a coarse mesh."""
    entries = (replaced(entry) for entry in TASK.springs)
    design = design_of("SEA", replace(TASK, springs=tuple(entries)))
    solver = Solver(transcribed(design, 40), Options(tolerance=1e-7))
    coarse = solver.solve(proposed_guess(design, np.full(dimensions(design, 2), 0.5), 2), design.data())
    return design, refine(coarse, Refinement(1e-3))[0]


def test_links_obey_the_torque_of_their_springs():
    """Pinocchio's mass matrix and nonlinear effects, with the payload, at random states; joint 1 is locked."""
    design, rng = design_of("SEA"), np.random.default_rng(0)
    for phase, payload in enumerate(TASK.payloads):
        model = pin.buildModelFromXML(URDF)
        model.inertias[3] += pin.Inertia(payload, np.array([0.3, 0, 0]), np.zeros((3, 3)))
        for _ in range(10):
            q, dq, torque, drive = rng.uniform(-1, 1, 2), rng.uniform(-1, 1, 2), rng.uniform(-20, 20, 2), rng.uniform(-9, 9, 2)
            own = design.problem.phases[phase]
            c = np.array([0.004, 0.002])
            found = np.array(own.rates(np.r_[q, dq, torque, drive], [3.0, -4.0], c, design.data())[0]).ravel()
            mass = pin.crba(model, model.createData(), np.r_[0.0, q])
            bias = pin.nle(model, model.createData(), np.r_[0.0, q], np.r_[0.0, dq])
            expected = np.linalg.solve(mass[1:, 1:], torque - bias[1:])
            np.testing.assert_allclose(found, [*dq, *expected, *(drive - dq) / c, 3.0, -4.0], rtol=1e-9, atol=1e-9)


def test_derivatives_of_the_program_against_differences():
    """Gradient, Jacobian and Hessian of the Lagrangian along random directions, springs that hold the arm still at the ends included."""
    design, rng = design_of("PEA+SEA"), np.random.default_rng(1)
    program = transcribed(design, 3)
    w = program.pack(proposed_guess(design, rng.uniform(size=dimensions(design, 2)), 2))
    w, data, step = w + 0.02 * rng.standard_normal(w.size), design.data(0.3), 1e-6
    multipliers = rng.standard_normal(program.row_bounds[0].size)

    def slopes(at):
        cost, jacobian = program.functions["grad_f"](at, data)[1], program.functions["jac_g"](at, data)[1]
        return np.array(cost).ravel(), np.array(ca.densify(jacobian))

    triu = np.array(ca.densify(program.functions["hess_lag"](w, data, 1.0, multipliers)))
    hessian = triu + np.triu(triu, 1).T
    for _ in range(3):
        d = rng.standard_normal(w.size)
        ends = [program.functions["nlp"](w + s * step * d, data) for s in (1, -1)]
        cost, rows = ((np.array(a) - np.array(b)).ravel() / 2 / step for a, b in zip(*ends, strict=True))
        gradient, jacobian = slopes(w)
        assert float(cost[0]) == pytest.approx(gradient @ d, rel=1e-6)
        np.testing.assert_allclose(jacobian @ d, rows, rtol=1e-5, atol=1e-6 * np.abs(rows).max())
        one, other = (g + j.T @ multipliers for g, j in map(slopes, (w + step * d, w - step * d)))
        np.testing.assert_allclose(hessian @ d, (one - other) / 2 / step, atol=1e-5 * np.abs(hessian @ d).max())


def test_springs_of_a_set_hold_the_payload_of_each_task(tmp_path):
    """The conditions at the ends of the phases, the last rows, are those of each task alone, on the same motions."""
    content = {"format": "rrr_oc-tasks/1", "base": "series_springs", "tasks": [{"name": "a"}, {"name": "b", "payload_kg": 2.0}]}
    (tmp_path / "set.json").write_text(json.dumps(content))
    tasks = load_task_set(str(tmp_path / "set.json"))
    of_set = SetDesign(tasks, tuple(design_of("SEA", task) for task in tasks.tasks))
    guesses = [proposed_guess(one, np.full(dimensions(one, 2), 0.4), 2) for one in of_set.designs]
    whole = transcribed(of_set, 4)
    found = np.array(whole.functions["nlp"](whole.pack(of_set.guess(guesses, guesses[0].parameters)), of_set.data())[1]).ravel()
    expected = []
    for one, guess in zip(of_set.designs, guesses, strict=True):
        program = transcribed(one, 4)
        expected.append(np.array(program.functions["nlp"](program.pack(guess), one.data())[1]).ravel()[-8:])
    np.testing.assert_allclose(found[-16:], np.concatenate(expected), atol=1e-9)


def test_the_engine_agrees_and_motors_do_what_is_planned(optimum):
    """MuJoCo with a drive and a twist for every joint: E1 of the load, and of the motors from its actuators, to 0.1 %."""
    design, solution = optimum
    motion = sample_motion(design, solution)
    tracked, rows = resimulate(design, solution, motion), list(TASK.moving)
    assert tracked.metrics.E1_total == pytest.approx(motion.metrics().E1_total, rel=1e-3)
    inertia, signals = rotors(design), [ca.SX.sym(name, 2) for name in ("dq", "ddq", "tau")]
    motor = ca.Function("motor", signals, [DRIVES.motor_torque(*signals)])
    np.testing.assert_allclose(inertia[rows], DRIVES.inertia / DRIVES.c_1)
    total = 0.0
    for phase in tracked.phases:
        twist = phase.twist[0][rows]
        compliance = np.array([[solution.parameters[i]] for i in design.series.compliances])
        torque = phase.tau_motor[rows] - inertia[rows, None] * (phase.ddq - phase.twist[2])[rows]
        np.testing.assert_allclose(twist, -compliance * torque, atol=2e-3 * np.abs(twist).max())
        drives = (phase.dq - phase.twist[1])[rows], (phase.ddq - phase.twist[2])[rows]
        total += np.trapezoid(np.sum(np.array(motor(*drives, phase.tau_load[rows])) ** 2, axis=0), phase.t)
    assert total == pytest.approx(solution.cost, rel=1e-3)


def test_springs_hold_the_arm_still_at_the_ends_and_limits_are_the_drives(optimum):
    _, solution = optimum
    for phase in range(2):
        _, x, _, u = solution.sample(phase, np.linspace(0, 1, 5))
        dx = solution.rates(phase, x, u)[0]
        x, dx, u = (v.reshape(len(v), -1) for v in (x, dx, u))
        for end in (0, -1):
            np.testing.assert_allclose(dx[2:4, end], 0.0, atol=1e-5)  # accelerations of the links
            np.testing.assert_allclose(x[6:, end], 0.0, atol=1e-5)
        speeds = solution.values[solution.transcription.blocks[phase].nodes][6:]
        assert np.all(np.abs(speeds) <= TASK.speed[:, None] + 1e-6)
        assert np.all(np.abs(solution.controls(phase)) <= TASK.acceleration[:, None, None] + 1e-6)


def test_a_stiff_spring_costs_what_a_stiff_drive_does():
    """The same motion: with less compliance the cost tends to that without springs in series."""
    stiff, elastic = design_of("SA"), design_of("SEA")
    guess = proposed_guess(stiff, np.full(dimensions(stiff, 2), 0.5), 2)

    def cost(design: CoDesign, guess: Guess) -> float:
        program = transcribed(design, 64)
        return float(program.functions["nlp"](program.pack(guess), design.data())[0]) * design.problem.cost_scale

    soft, firm, hard = (cost(elastic, elastic.lifted(replace(guess, parameters=np.full(2, c)))) for c in (1e-3, 1e-4, 1e-6))
    assert abs(firm / hard - 1) < 0.15 * abs(soft / hard - 1)
    assert hard == pytest.approx(cost(stiff, guess), rel=1e-2)  # of the spline through the load torque


def test_series_springs_are_never_idle_and_are_in_no_design_without_them(optimum):
    design, solution = optimum
    assert not [
        label for label in idle_springs(design, sample_motion(design, solution), solution.parameters) if "series" in label
    ]
    assert embedded(solution, design, design_of("PEA+SEA")) is not None
    assert embedded(solution, design, design_of("PEA")) is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cost": "load"}, "series_spring changes what the motors do, not the load torque; the costs motor and energy show it"),
        ({"task": replace(TASK, speeds=("moving", "moving"))}, "series_spring needs an arm that is at rest between the phases"),
    ],
)
def test_problems_that_are_turned_away(changes, message):
    with pytest.raises(UserError, match=message):
        design_of("SEA", **changes)


def test_a_spring_without_compliance_is_turned_away():
    entries = ({**TASK.springs[-1], "compliance_mrad_per_Nm": [0.0, 3.0]},)
    with pytest.raises(UserError, match=r"compliance_mrad_per_Nm must be 0\.01 or more, got 0"):
        spring_bounds(replace(TASK, springs=entries), "SEA")

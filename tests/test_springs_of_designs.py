"""Springs that only a co-design uses: their laws, their twins in MuJoCo, and designs with them; a diagnosis does not look for them."""

from dataclasses import replace

import casadi as ca
import mujoco
import numpy as np
import pytest
from recorded import Plant, as_set, record

from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.samples import prepare
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import describe_simulation, sample_motion
from rrr_oc.codesign.search.multistart import SearchResult, solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import configurations, offered, spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.diagnosis.signatures import trials, view
from rrr_oc.effects import CATALOGUE, Signals
from rrr_oc.effects.elastic.two_sided_spring import TwoSidedSpring
from rrr_oc.effects.priors import load_priors
from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.robot.robot import load_robot
from rrr_oc.simulation.engine_model import Settings, twin

DESIGN_ONLY = [name for name, kind in CATALOGUE.items() if kind.role == "design"]
PAPER = load_task("paper")
PEA = PAPER.springs[:2]  # of joint2 and joint3
TPEA = tuple({**entry, "effect": "two_sided_spring"} for entry in PEA)
TPEA = tuple({key: value for key, value in entry.items() if key != "active"} for entry in TPEA)
QUICK = SearchOptions(starts=2, motions=0, refinement=Refinement(1e-3))
THETA = {TwoSidedSpring: {"stiffness": 7.0, "equilibrium": 0.4}}
each_spring = pytest.mark.parametrize("spring", [TwoSidedSpring((1,))], ids=lambda s: f"{s.name}-{getattr(s, 'active', '')}")


def searched(name: str, springs) -> SearchResult:
    task = replace(PAPER, springs=tuple(springs))
    return solve_multistart(CoDesign(task, spring_bounds(task, name)), QUICK).whole()


@pytest.fixture(scope="module")
def pea() -> SearchResult:
    return searched("PEA", PEA)


@each_spring
def test_the_torque_is_the_slope_of_the_energy(spring):
    """By CasADi's gradient and by central differences of the energy in numpy."""
    theta, q = THETA[type(spring)], ca.SX.sym("q", 3)
    gradient = ca.Function("gradient", [q], [ca.gradient(spring.energy(Signals(q), theta, 0.2), q)])
    for at in np.random.default_rng(0).uniform(-3, 3, (40, 3)):
        (torque,) = spring.torque(Signals(at), theta, 0.2)
        np.testing.assert_allclose(np.array(gradient(at)).ravel(), [0, -torque, 0], atol=1e-10)
        ends = [float(spring.energy(Signals([*at, 0, step, 0]), theta, 0.2)) for step in (1e-5, -1e-5)]
        assert (ends[0] - ends[1]) / 2e-5 == pytest.approx(-torque, abs=1e-6)  # the step's square


@each_spring
def test_torque_by_parameters_against_differences(spring):
    values, at, width = np.array([*THETA[type(spring)].values()]), np.array([0.1, -0.7, 0.3]), 0.1

    def torque(theta):
        return spring.torque(Signals(at), dict(zip(THETA[type(spring)], theta, strict=True)), width)[0]

    theta = ca.SX.sym("theta", values.size)
    found = ca.Function("slopes", [theta], [ca.jacobian(torque([theta[i] for i in range(values.size)]), theta)])(values)
    for i, step in enumerate(1e-5 * np.abs(values)):
        moved = np.eye(values.size)[i] * step
        expected = (torque(values + moved) - torque(values - moved)) / (2 * step)
        assert float(found[i]) == pytest.approx(expected, rel=1e-6, abs=1e-8)


@each_spring
@pytest.mark.parametrize("form", ["native", "generated"])
def test_mujoco_has_the_same_torque(spring, form):
    robot, theta = load_robot("rrr"), THETA[type(spring)]
    width = 0.0 if form == "native" else None if spring.width is None else spring.width.nominal
    engine, seen = twin(Model(robot, robot.tool, (spring,)), [*theta.values()], settings=Settings(form)), 0.0
    d = mujoco.MjData(engine.mj)
    for q in np.random.default_rng(1).uniform(-1.5, 1.5, (20, 3)):
        d.qpos[:] = q
        with engine.effects():
            mujoco.mj_forward(engine.mj, d)
        (expected,) = spring.torque(Signals(q), theta, width)
        np.testing.assert_allclose(d.qfrc_passive, [0, expected, 0], atol=1e-9)  # rounding
        seen += abs(float(expected))
    assert seen > 1


def test_a_two_sided_spring_pulls_both_ways():
    for q in np.linspace(-2, 2, 9):
        assert TwoSidedSpring((0,)).torque(Signals([q]), {"stiffness": 3.0, "equilibrium": 0.5}, None)[0] == -3.0 * (q - 0.5)


def test_a_design_with_two_sided_springs(pea):
    """No worse than the parallel springs, which stay on their own side on the best motion; MuJoCo agrees to 0.1 %."""
    found = searched("TPEA", TPEA)
    assert found.best.cost <= pea.best.cost * (1 + 1e-3)  # both within the mesh tolerance
    solution = found.best.solution
    error = describe_simulation(found.design, solution, sample_motion(found.design, solution))
    assert abs(error["E1_relative_error"]) < 1e-3
    assert abs(error["exact_springs"]["E1_relative_error"]) < 1e-3


def test_a_task_says_what_it_offers():
    """The paper's four configurations, and more where the task has more springs."""
    assert offered(PAPER) == ("SA", "PEA", "BPEA", "PEA+BPEA")
    assert offered(replace(PAPER, springs=())) == ("SA",)
    assert offered(replace(PAPER, springs=(*PEA, *TPEA))) == ("SA", "PEA", "TPEA", "PEA+TPEA")
    assert set(offered(PAPER)) < set(configurations())


@pytest.mark.parametrize(
    ("name", "springs", "message"),
    [
        ("TPEA", [{**TPEA[0], "stiffness_Nm_per_rad": [-1, 3]}], "stiffness_Nm_per_rad must be 0 or more, got -1 … 3"),
        ("TPEA", [{**TPEA[0], "active": "below"}], "active"),
        ("TPEA", [{**TPEA[0], "joint": "joint1"}], "joint1 does not move in this task"),
        ("TPEA", PEA, "offers no two_sided_spring, which configuration TPEA needs"),
        ("BPEA+PEA", PEA, r"unknown configuration 'BPEA\+PEA'; it is SA, .* in this order and joined by '\+'"),
    ],
)
def test_tasks_that_are_turned_away(name, springs, message):
    with pytest.raises(UserError, match=message):
        spring_bounds(replace(PAPER, springs=tuple(springs)), name)


def test_a_diagnosis_does_not_look_for_them(tmp_path):
    """They are among no trials, and a file of priors that names one is turned away."""
    plant = Plant("rrr", *np.ones((3, 3)))
    recordings = as_set(plant, [record(plant, "a.csv", np.random.default_rng(2), 4.0)])
    seen = view(prepare(recordings), plain_model(recordings))
    names = {trial.effect.name for torque in ("motor", "load") for trial in trials(seen, torque)}
    assert "parallel_spring" in names
    assert DESIGN_ONLY
    assert not names & set(DESIGN_ONLY)
    for name in DESIGN_ONLY:
        (tmp_path / "priors.toml").write_text(f"[{name}]\nprobability = 0.5\n")
        with pytest.raises(UserError, match=name):
            load_priors(tmp_path / "priors.toml")

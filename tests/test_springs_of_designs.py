"""Springs that only a co-design uses: their laws, their twins in MuJoCo, and designs with them; a diagnosis does not look for them."""

import json
from dataclasses import replace

import casadi as ca
import mujoco
import numpy as np
import pytest
from commands import rrr_oc
from recorded import Plant, as_set, record

from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.samples import prepare
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import describe_simulation, profiles, sample_motion
from rrr_oc.codesign.search.multistart import SearchResult, solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import configurations, offered, spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.diagnosis.signatures import trials, view
from rrr_oc.effects import CATALOGUE, Signals
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.effects.elastic.pulley_spring import RADII, PulleySpring
from rrr_oc.effects.elastic.two_sided_spring import TwoSidedSpring
from rrr_oc.effects.priors import load_priors
from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.numerics.enclosure import enclosures
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.robot.robot import load_robot
from rrr_oc.simulation.engine_model import Settings, twin

DESIGN_ONLY = [name for name, kind in CATALOGUE.items() if kind.role == "design"]
PAPER = load_task("paper")
PEA = PAPER.springs[:2]  # of joint2 and joint3
TPEA = tuple({**entry, "effect": "two_sided_spring"} for entry in PEA)
TPEA = tuple({key: value for key, value in entry.items() if key != "active"} for entry in TPEA)
QUICK = SearchOptions(starts=2, motions=0, refinement=Refinement(1e-3))
VPEA = load_task("more_springs").springs[-2:]
UNEVEN = dict(zip(RADII, (0.02, 0.035, 0.01, 0.03, 0.025), strict=True))
THETA = {
    TwoSidedSpring: {"stiffness": 7.0, "equilibrium": 0.4},
    PulleySpring: {"stiffness": 9000.0, "equilibrium": 0.4, **UNEVEN},
}
SPRINGS = [TwoSidedSpring((1,)), PulleySpring((1,)), PulleySpring((1,), "above")]
each_spring = pytest.mark.parametrize("spring", SPRINGS, ids=lambda s: f"{s.name}-{getattr(s, 'active', '')}")


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
        ends = [float(spring.energy(Signals(at + step * np.array([0, 1, 0])), theta, 0.2)) for step in (1e-5, -1e-5)]
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


@pytest.mark.parametrize("active", ["below", "above"])
def test_a_round_pulley_is_a_parallel_spring(active):
    """Of stiffness k r², at every width."""
    theta = {"stiffness": 5000.0, "equilibrium": 0.3} | dict.fromkeys(RADII, 0.04)
    for width in (0.0, 0.3):
        for q in np.linspace(-4, 4, 33):
            (found,) = PulleySpring((0,), active).torque(Signals([q]), theta, width)
            (expected,) = ParallelSpring((0,), active).torque(Signals([q]), {"stiffness": 8.0, "equilibrium": 0.3}, width)
            assert found == pytest.approx(expected, abs=1e-12)


def test_the_pulley_can_be_made():
    """Lever and radius of curvature lie between the least and the greatest radius, the outline is closed, and the cable fits it.

    The outline is that of the table by which the pulley is made; its arc and curvature are taken by differences of its points.
    """
    spring, theta = PulleySpring((0,)), THETA[PulleySpring]
    q = np.linspace(-np.pi, np.pi, 7201)
    table = spring.profile(q, theta)
    least, greatest = min(UNEVEN.values()), max(UNEVEN.values())
    r, outline = 1e-3 * table["radius_mm"], 1e-3 * np.array([table["outline_x_mm"], table["outline_y_mm"]])
    assert np.all((least <= r) & (r <= greatest))
    np.testing.assert_allclose(outline[:, 0], outline[:, -1], atol=1e-12)
    arc, step = np.linalg.norm(np.diff(outline), axis=0), q[1] - q[0]
    curvature = arc / step  # the outline turns by as much as the joint
    assert least * (1 - 1e-6) <= curvature.min() < curvature.max() <= greatest * (1 + 1e-6)
    normal = np.array([np.cos(q), -np.sin(q)])
    np.testing.assert_allclose(np.sum(outline * normal, axis=0), r, rtol=1e-12)  # the cable's distance from the axis
    turned = np.diff(outline)
    assert np.all(turned[0, 1:] * turned[1, :-1] - turned[1, 1:] * turned[0, :-1] > 0)  # convex
    np.testing.assert_allclose(-np.diff(table["cable_mm"]) / step, 1e3 * (r[1:] + r[:-1]) / 2, rtol=1e-6)  # dl = r dq
    assert arc.sum() == pytest.approx(2 * np.pi * np.mean([*UNEVEN.values()]), rel=1e-6)
    tension = 9000.0 * np.maximum(1e-3 * table["cable_mm"], 0)
    np.testing.assert_allclose(table["torque_Nm"], tension * r, atol=1e-12)


def test_the_pulley_spring_is_enclosed():
    """By intervals in all its parameters but the stiffness, so that designs with it have a lower bound."""
    rng, spring, q = np.random.default_rng(3), PulleySpring((0,)), np.linspace(-1, 1, 9)
    lower = np.column_stack([[0.2, *5 * [0.01]]])
    upper = np.column_stack([[0.6, *5 * [0.015]]])
    names = ("equilibrium", *RADII)
    (found,) = spring.torque(Signals([q]), {"stiffness": 1.0} | dict(zip(names, enclosures(lower, upper), strict=True)), 0.0)
    for _ in range(100):
        theta = {"stiffness": 1.0} | dict(zip(names, rng.uniform(lower, upper).ravel(), strict=True))
        (torque,) = spring.torque(Signals([q]), theta, 0.0)
        assert np.all(found.value[0] <= torque + 1e-15)
        assert np.all(torque <= found.value[1] + 1e-15)


def check_engine(found) -> None:
    """MuJoCo has the E1 of a search's best design, with smooth and with exact springs."""
    solution = found.best.solution
    error = describe_simulation(found.design, solution, sample_motion(found.design, solution))
    assert abs(error["E1_relative_error"]) < 1e-3
    assert abs(error["exact_springs"]["E1_relative_error"]) < 1e-3


def test_a_design_with_pulley_springs(pea):
    """No worse than the parallel springs, which round pulleys of the greatest radius are; MuJoCo agrees to 0.1 %."""
    found = searched("VPEA", VPEA)
    assert found.best.cost <= pea.best.cost * (1 - 5e-3)
    check_engine(found)
    solution = found.best.solution
    values = found.design.model.values(solution.parameters)
    springs = [(s.effect, values[found.design.model.label(s.effect)]) for s in found.design.springs]
    tables = profiles(found.design.task, springs)
    assert list(tables) == ["pulley_spring[joint2]", "pulley_spring[joint3]"]
    hardware = found.design.hardware(solution.parameters)
    for number, table in zip((2, 3), tables.values(), strict=True):
        radii = [1e3 * hardware[f"r{i}_v{number}"] for i in range(1, 6)]
        assert 10 - 1e-6 <= min(radii) <= max(radii) <= 30 + 1e-6
        assert np.all((min(radii) - 1e-9 <= table["radius_mm"]) & (table["radius_mm"] <= max(radii) + 1e-9))
        assert len({len(column) for column in table.values()}) == 1


def test_the_command_writes_the_profile(monkeypatch, tmp_path):
    options = ["--configurations", "VPEA", "--starts", "1", "--motions", "0", "--tolerance", "1e-2", "--jobs", "1", "--quiet"]
    assert rrr_oc(monkeypatch, "design", "more_springs", *options, "--out", str(tmp_path / "out")) == 0
    table = np.genfromtxt(tmp_path / "out" / "VPEA_pulley_spring_joint3.csv", delimiter=",", names=True)
    assert table.dtype.names == ("angle_deg", "radius_mm", "cable_mm", "torque_Nm", "outline_x_mm", "outline_y_mm")
    np.testing.assert_allclose(table["angle_deg"], np.arange(-180, 181))
    saved = json.loads((tmp_path / "out" / "summary.json").read_text())["configurations"]["VPEA"]["parameters"]
    theta = saved["pulley_spring[joint3]"]
    (torque,) = PulleySpring((0,)).torque(Signals([np.radians(table["angle_deg"])]), theta, 0.0)
    np.testing.assert_allclose(table["torque_Nm"], torque, atol=1e-9)
    assert torque.max() > 0.5


def test_a_design_with_two_sided_springs(pea):
    """Better than parallel springs of the same bounds on this task; MuJoCo agrees to 0.1 %."""
    found = searched("TPEA", TPEA)
    assert found.best.cost <= pea.best.cost * (1 - 5e-3)
    check_engine(found)


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
        ("VPEA", [{**VPEA[0], "radius_mm": [0, 30]}], "radius_mm must be 1 or more, got 0 … 30"),
        ("VPEA", [{**VPEA[0], "stiffness_N_per_m": [-1, 30]}], "stiffness_N_per_m must be 0 or more, got -1 … 30"),
        ("VPEA", [{**VPEA[0], "active": "left"}], "active"),
        ("BPEA+PEA", PEA, r"unknown configuration 'BPEA\+PEA'; it is SA, .* in this order and joined by '\+'"),
    ],
)
def test_tasks_that_are_turned_away(name, springs, message):
    with pytest.raises(UserError, match=message):
        spring_bounds(replace(PAPER, springs=tuple(springs)), name)


def test_a_side_that_is_none_is_turned_away():
    with pytest.raises(UserError, match="'below' or 'above' its equilibrium, got 'left'"):
        PulleySpring((0,), "left")  # pyright: ignore[reportArgumentType]


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

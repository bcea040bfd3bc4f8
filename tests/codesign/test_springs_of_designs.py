"""Springs that only a co-design uses: their laws, their twins in MuJoCo, and designs with them; a diagnosis does not look for them."""

import json
from dataclasses import replace
from importlib import resources

import casadi as ca
import designs
import msgspec
import mujoco
import numpy as np
import pytest
from commands import rrr_oc
from recorded import Plant, as_set, record
from scipy.interpolate import CubicSpline

from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.samples import prepare
from rrr_oc.codesign.bounds.on_motion import bound_on_motion, needed_by
from rrr_oc.codesign.bounds.over_motions import task_bound
from rrr_oc.codesign.design_file import DesignFile
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import beyond_known, describe_simulation, idle_springs, profiles, sample_motion
from rrr_oc.codesign.search.multistart import SearchResult, solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import arrangements, configurations, holding, offered, spring_bounds
from rrr_oc.codesign.study import Request, prepared
from rrr_oc.codesign.task import load_task
from rrr_oc.commands.moving.sources import designed
from rrr_oc.commands.output import Output
from rrr_oc.diagnosis.signatures import trials, view
from rrr_oc.effects import CATALOGUE, Clutched, Signals
from rrr_oc.effects.elastic.biarticular_spring import BiarticularSpring
from rrr_oc.effects.elastic.clutched_biarticular_spring import ClutchedBiarticularSpring
from rrr_oc.effects.elastic.clutched_spring import ClutchedSpring
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.effects.elastic.pulley_spring import RADII, PulleySpring
from rrr_oc.effects.elastic.table_spring import TableSpring
from rrr_oc.effects.elastic.two_sided_spring import TwoSidedSpring
from rrr_oc.effects.priors import load_priors
from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.numerics.cubic_spline import natural_spline
from rrr_oc.numerics.enclosure import enclosures
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.report.design_report import report
from rrr_oc.report.design_words import cautions, verdict
from rrr_oc.robot.robot import load_robot
from rrr_oc.schema import read_json
from rrr_oc.simulation.engine_model import Settings, twin

DESIGN_ONLY = [name for name, kind in CATALOGUE.items() if kind.role == "design"]
PAPER = load_task("paper")
PEA = PAPER.springs[:2]  # of joint2 and joint3
TPEA = tuple({**entry, "effect": "two_sided_spring"} for entry in PEA)
TPEA = tuple({key: value for key, value in entry.items() if key != "active"} for entry in TPEA)
QUICK = SearchOptions(starts=2, motions=0, refinement=Refinement(1e-3))
VPEA = load_task("more_springs").springs[-2:]
FURTHER = load_task("further_springs").springs
NPEA, CPEA, CBPEA = (
    tuple(e for e in FURTHER if e["effect"] == kind.name) for kind in (TableSpring, ClutchedSpring, ClutchedBiarticularSpring)
)
GO = [{**entry, "phase": "go"} for entry in CBPEA]
ROWS = ((-120.0, -3.5), (-50.0, -0.8), (-10.0, -0.3), (0.0, 0.0), (25.0, 0.2), (60.0, 2.0), (100.0, 2.5))
UNEVEN = dict(zip(RADII, (0.02, 0.035, 0.01, 0.03, 0.025), strict=True))
THETA = {
    TwoSidedSpring: {"stiffness": 7.0, "equilibrium": 0.4},
    PulleySpring: {"stiffness": 9000.0, "equilibrium": 0.4, **UNEVEN},
    TableSpring: {"number": 1.7, "equilibrium": 0.4},
    ClutchedSpring: {"stiffness": 7.0, "equilibrium": 0.4},
}
SPRINGS = [
    TwoSidedSpring((1,)), PulleySpring((1,)), PulleySpring((1,), "above"), ClutchedSpring((1,)),
    *(TableSpring((1,), mounting, ROWS) for mounting in ("as listed", "mirrored")),
]  # fmt: skip
each_spring = pytest.mark.parametrize("spring", SPRINGS, ids=lambda s: f"{s.name}-{[*map(s.__getattribute__, s.options)]}")


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


def test_the_spline_is_that_of_scipy():
    """Value, integral, slope and curvature; beyond the ends a straight line."""
    rng = np.random.default_rng(4)
    x, y = np.sort(rng.uniform(-2, 2, 9)), rng.normal(size=9)
    spline, expected = natural_spline(tuple(zip(x.tolist(), y.tolist(), strict=True))), CubicSpline(x, y, bc_type="natural")
    inside = np.linspace(x[0], x[-1], 200)
    np.testing.assert_allclose(spline.value(x), y, atol=1e-12)
    np.testing.assert_allclose(spline.value(inside), expected(inside), atol=1e-11)
    whole = [expected.integrate(x[0], at) for at in inside]
    np.testing.assert_allclose(spline.integral(inside), whole, atol=1e-11)
    u = ca.SX.sym("u")
    value = spline.value(u)
    derivatives = ca.Function(
        "derivatives", [u], [ca.jacobian(value, u), ca.hessian(value, u)[0], ca.jacobian(spline.integral(u), u) - value]
    )
    for at in inside[1:-1]:
        slope, curvature, rest = (float(v) for v in derivatives(at))
        assert slope == pytest.approx(float(expected(at, 1)), abs=1e-9)
        assert curvature == pytest.approx(float(expected(at, 2)), abs=1e-8)
        assert rest == pytest.approx(0, abs=1e-9)
    for end, side in ((0, -1), (-1, 1)):
        beyond = x[end] + side * 0.7
        assert float(spline.value(beyond)) == pytest.approx(y[end] + side * 0.7 * float(expected(x[end], 1)), abs=1e-11)
        assert float(derivatives(x[end] + side * 1e-9)[1]) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("mounting", ["as listed", "mirrored"])
def test_a_table_of_a_straight_line_is_a_two_sided_spring(mounting):
    """Within the table and beyond; the number is a factor."""
    spring = TableSpring((0,), mounting, tuple((angle, 3.0 * np.radians(angle)) for angle in (-90.0, -20.0, 0.0, 70.0)))
    q = np.linspace(-4, 4, 33)
    found, expected = ({"number": 2.0, "equilibrium": 0.5}, {"stiffness": 6.0, "equilibrium": 0.5})
    for law in ("torque", "energy"):
        one, other = (
            getattr(spring, law)(Signals([q]), found, None),
            getattr(TwoSidedSpring((0,)), law)(Signals([q]), expected, None),
        )
        np.testing.assert_allclose(one, other, atol=1e-12)


def test_the_torque_of_a_table_is_that_of_its_rows():
    """The torque that holds the spring is listed; it pulls back. Mirrored, it pulls so at the opposite angles."""
    theta = {"number": 2.0, "equilibrium": 0.3}
    for mounting, side in (("as listed", 1), ("mirrored", -1)):
        for angle, torque in ROWS:
            q = 0.3 + side * np.radians(angle)
            (found,) = TableSpring((0,), mounting, ROWS).torque(Signals([q]), theta, None)
            assert float(found) == pytest.approx(-side * 2 * torque, abs=1e-12)
    assert np.degrees(TableSpring((0,), "mirrored", ROWS).known_range(theta)) == pytest.approx(
        np.degrees(0.3) + np.array([-100, 120])
    )


def test_the_table_spring_is_enclosed():
    """By intervals in its equilibrium, in torque and slope."""
    rng, spring, q = np.random.default_rng(3), TableSpring((0,), "as listed", ROWS), np.linspace(-2, 2, 41)
    lower, upper = np.array([[-1.0, -0.2, 0.4]]), np.array([[-0.4, 0.3, 1.2]])
    (found,) = spring.torque(Signals([q]), {"number": 1.0, "equilibrium": enclosures(lower, upper)[0]}, None)
    low, high, least, most = (
        np.broadcast_to(end, (3, q.size)) for end in (*found.value, found.slopes[0][0], found.slopes[1][0])
    )
    for _ in range(50):
        at = rng.uniform(lower, upper).reshape(3, 1)
        torque, moved = (spring.torque(Signals([q]), {"number": 1.0, "equilibrium": at + step}, None)[0] for step in (0, 1e-6))
        assert np.all((low <= torque + 1e-12) & (torque <= high + 1e-12))
        assert np.all(
            (least - 1e-4 <= (moved - torque) / 1e-6) & ((moved - torque) / 1e-6 <= most + 1e-4)
        )  # a difference's error


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
    lines = (tmp_path / "out" / "VPEA_pulley_spring_joint3.dxf").read_text().splitlines()
    drawn = [
        [float(value) for code, value in zip(lines[::2], lines[1::2], strict=True) if code == axis] for axis in ("10", "20")
    ]
    np.testing.assert_allclose(drawn, [table["outline_x_mm"][:-1], table["outline_y_mm"][:-1]], atol=1e-6)  # the file's digits
    assert lines[-2:] == ["0", "EOF"]
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


def test_a_design_with_a_table_is_that_with_the_spring_it_lists():
    """A straight table of the greatest stiffness, 0 to 1 times; the motion goes beyond a short table, which is told."""
    expected = searched("TPEA", TPEA)
    rows = [[[angle, k * float(np.radians(angle))] for angle in (-40.0, 0.0, 40.0)] for k in (13.7052, 1.32)]
    plain = [{k: v for k, v in entry.items() if k != "stiffness_Nm_per_rad"} for entry in TPEA]
    made = [{**e, "effect": "table_spring", "number": [0.0, 1.0], "table_deg_Nm": r} for e, r in zip(plain, rows, strict=True)]
    found = searched("NPEA", made)
    assert found.best.cost == pytest.approx(expected.best.cost, rel=2e-3)  # the tolerance of the mesh and the flat optimum
    check_engine(found)
    solution = found.best.solution
    said = beyond_known(found.design, sample_motion(found.design, solution), solution.parameters)
    assert set(said) == {"table_spring[joint2]", "table_spring[joint3]"}
    middle = np.degrees(found.design.hardware(solution.parameters)["q_n2"])
    assert f"from {middle - 40:.1f}° to {middle + 40:.1f}°" in said["table_spring[joint2]"]


def test_a_table_may_stand_in_a_file(tmp_path):
    """Beside the task's, with the same springs as rows in the task itself."""
    content = json.loads(resources.files("rrr_oc.data").joinpath("further_springs.json").read_text())
    rows = next(e["table_deg_Nm"] for e in content["springs"] if e["effect"] == "table_spring")
    for entry in content["springs"]:
        if entry["effect"] == "table_spring":
            entry["table_deg_Nm"] = "spring.csv"
    path, table = tmp_path / "task.json", tmp_path / "spring.csv"
    path.write_text(json.dumps(content))
    table.write_text("angle_deg,torque_Nm\n" + "\n".join(f"{a},{t}" for a, t in rows))
    task = load_task(path)
    assert [e["table_deg_Nm"] for e in task.springs if e["effect"] == "table_spring"] == [rows, rows]
    assert table in task.files
    assert [s.effect for s in spring_bounds(task, "NPEA")] == [
        s.effect for s in spring_bounds(load_task("further_springs"), "NPEA")
    ]
    table.write_text("torque_Nm,angle_deg\n0,0\n")
    with pytest.raises(
        UserError,
        match=r"springs\[3\].table_deg_Nm: found the columns torque_Nm, angle_deg in .*; angle_deg, torque_Nm are req",
    ):
        load_task(path)
    table.unlink()
    with pytest.raises(UserError, match=r"spring\.csv"):
        load_task(path)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([[0, 0], [10, 1]], "table_deg_Nm has 2 rows; 3 to 200 are required"),
        ([[-10, -1], [0, 0], [0, 1]], "row 3 has the angle 0° after 0°; angles must ascend"),
        ([[-10, -1], [10, 1], [0, 0]], "row 3 has the angle 0° after 10°; angles must ascend"),
        ([[-10, -1], [0, 0.1], [10, 1]], r"no row \[0, 0\]"),
        ([[-10, -1], [0, 0], [10, float("nan")]], "row 3 has no finite numbers"),
        ([[-10, -1], [0, 0], [10]], "table_deg_Nm"),
        ("spring.csv", "table_deg_Nm"),
    ],
)
def test_tables_that_are_turned_away(rows, message):
    with pytest.raises(UserError, match=message):
        spring_bounds(replace(PAPER, springs=({**NPEA[0], "table_deg_Nm": rows},)), "NPEA")


def test_a_clutched_spring_across_two_joints_has_the_law_without_the_clutch():
    """In numpy and in MuJoCo, in generated C and as a tendon."""
    robot, theta = load_robot("rrr"), {"kappa": 9.0, "rho": 0.5, "phi": -0.3}
    clutched, plain = ClutchedBiarticularSpring((1, 2), (1, -1)), BiarticularSpring((1, 2), (1, -1))
    for form in ("native", "generated"):
        engine, seen = twin(Model(robot, robot.tool, (clutched,)), [*theta.values()], settings=Settings(form)), 0.0
        d = mujoco.MjData(engine.mj)
        for q in np.random.default_rng(1).uniform(-1.5, 1.5, (20, 3)):
            d.qpos[:] = q
            with engine.effects():
                mujoco.mj_forward(engine.mj, d)
            expected = plain.torque(Signals(q), theta, 0.0 if form == "native" else 1e-3)
            np.testing.assert_allclose(d.qfrc_passive, [0, *map(float, expected)], atol=1e-9)
            seen += abs(float(expected[0]))
        assert seen > 1


@pytest.mark.parametrize(("name", "springs"), [("CPEA", CPEA), ("CBPEA", CBPEA)])
def test_a_clutched_spring_leaves_its_phase_with_the_energy_with_which_it_enters(name, springs):
    """For all parameters that its bounds leave; while the clutch is open, the lock keeps it."""
    rng, ends = np.random.default_rng(5), [PAPER.full(q) for q in (PAPER.start, PAPER.release)]
    for spring in spring_bounds(replace(PAPER, springs=springs), name):
        for _ in range(20):
            values = rng.uniform(np.maximum(spring.lower, -9), np.minimum(spring.upper, 9))
            theta = {p.name: value for p, value in zip(spring.effect.parameters, values, strict=True)}
            first, last = (float(spring.effect.energy(Signals(q), theta, 1e-3)) for q in ends)
            assert first == pytest.approx(last, rel=1e-9, abs=1e-12)
            assert first > 0 or name == "CBPEA"  # a cable may be slack at both ends


def test_only_windings_that_keep_the_energy_are_tried():
    """Joint 3 moves against joint 2 and twice as far, so both windings have the same sign and the lever is half."""
    ways = arrangements(replace(PAPER, springs=({k: v for k, v in CBPEA[0].items() if k != "winding"},)), "CBPEA")
    assert {(way[0].effect.winding, way[0].effect.phase) for way in ways} == {
        (winding, phase) for winding in ((1, 1), (-1, -1)) for phase in ("go", "return")
    }
    assert all(way[0].lower[1] == way[0].upper[1] == pytest.approx(0.5) for way in ways)


@pytest.fixture(scope="module")
def clutched() -> SearchResult:
    return searched("PEA+CBPEA", (*PEA, *GO))


def test_a_design_with_a_clutched_spring(clutched, pea):
    """Less than no springs without a clutch can reach on any motion; MuJoCo agrees to 0.1 %."""
    every = replace(PAPER, springs=(*PEA, *PAPER.springs[2:]))
    least = task_bound(CoDesign(every, spring_bounds(every, "PEA+BPEA")))
    assert least is not None
    assert clutched.best.cost < least < pea.best.cost
    check_engine(clutched)


def test_a_clutched_spring_acts_in_its_phase_only(clutched):
    """E1 of the load torque by hand: rigid body less parallel springs, less the clutched spring in the go phase alone."""
    design, solution = clutched.design, clutched.best.solution
    motion, values = sample_motion(design, solution), design.model.values(solution.parameters)
    bare, total, seen = PAPER.model(), 0.0, 0.0
    for phase, k in enumerate(motion.phases()):
        q, dq, ddq = (
            x(v[:, k]) for x, v in ((PAPER.full, motion.q), (PAPER.full_rates, motion.dq), (PAPER.full_rates, motion.ddq))
        )
        tau = np.array(bare.inverse(q, dq, ddq, PAPER.payloads[phase], [], [])[0])
        for effect in (s.effect for s in design.springs):
            for j, torque in zip(
                effect.joints, effect.torque(Signals(q), values[design.model.label(effect)], 0.003), strict=True
            ):
                acting = not isinstance(effect, Clutched) or phase == 0
                tau[j] -= torque * acting
                seen += np.abs(torque).max() * (not acting)
        total += np.trapezoid(np.sum(tau[1:] ** 2, axis=0), motion.t[k])
    assert total == pytest.approx(solution.cost, rel=1e-3)  # the trapezoid rule, and the mesh
    assert seen > 1  # it would pull in the return phase
    assert not idle_springs(design, motion, solution.parameters)


def test_the_bound_on_the_motion_knows_where_a_clutched_spring_acts(clutched):
    """No drawn springs cost less than the bound, which the design's own cost nearly reaches; with a spring that acts in both phases, E1
    of these springs would be another."""
    design, solution = clutched.design, clutched.best.solution
    needed, own = needed_by(solution, design)
    bound = bound_on_motion(design.springs, needed, own)
    assert own == pytest.approx(solution.cost, rel=5e-3)  # exact springs
    assert bound.lower <= own <= 1.1 * bound.lower
    rng, acting, best = np.random.default_rng(6), needed.phase == "go", np.inf
    assert 0 < acting.mean() < 1
    for size in np.geomspace(1e-3, 0.3, 300):
        tau, at = needed.tau.copy(), 0
        for spring in design.springs:
            centre = solution.parameters[at : at + len(spring.lower)]
            at += len(spring.lower)
            drawn = np.clip(centre * (1 + size * rng.normal(size=centre.size)), spring.lower, spring.upper)
            theta = {p.name: value for p, value in zip(spring.effect.parameters, drawn, strict=True)}
            for j, torque in zip(spring.effect.joints, spring.effect.torque(Signals(needed.q), theta, 0.0), strict=True):
                tau[needed.moving.index(j)] -= torque * (acting if isinstance(spring.effect, Clutched) else 1)
        best = min(best, needed.product(tau, tau))
    assert bound.lower <= best <= 1.1 * own


def test_no_bound_over_all_motions_where_a_clutched_spring_acts():
    """The torque of a posture may differ between the phases there: such joints are left out, and without any other there is no bound."""
    task = replace(PAPER, springs=(*PEA, *CPEA, *CBPEA))
    bounds = {name: spring_bounds(task, name) for name in ("PEA", "CPEA", "CBPEA")}
    least = task_bound(CoDesign(task, bounds["PEA"]))
    with_one = task_bound(CoDesign(task, (*bounds["PEA"], *(s for s in bounds["CPEA"] if s.effect.joints == (2,)))))
    assert least is not None
    assert with_one is not None
    assert 0 < with_one < least
    assert task_bound(CoDesign(task, bounds["CBPEA"])) is None
    assert task_bound(CoDesign(task, bounds["CPEA"])) is None


def test_a_clutch_needs_an_arm_at_rest():
    springs = spring_bounds(replace(PAPER, springs=CPEA), "CPEA")
    with pytest.raises(UserError, match="clutched_spring needs an arm that is at rest between the phases"):
        CoDesign(replace(PAPER, speeds=("rest", "moving")), springs)


def test_both_springs_across_two_joints_have_names_of_their_own():
    """With and without a clutch, and are held by these."""
    task = replace(PAPER, springs=(PAPER.springs[2], *GO))
    design = CoDesign(task, spring_bounds(task, "BPEA+CBPEA"))
    theta = np.array([3.0, 0.9, -0.2, 5.0, 0.5, 0.1])
    hardware = design.hardware(theta)
    assert set(hardware) == {"k_b", "q_0", "r_1", "r_2", "r_3", "k_bc", "q_0c", "r_1c", "r_2c", "r_3c"}
    held = design.with_fixed(hardware)
    np.testing.assert_allclose(held.problem.p_lower, theta, rtol=1e-9)
    np.testing.assert_allclose(held.problem.p_upper, theta, rtol=1e-9)
    assert held.hardware(theta) == pytest.approx(hardware)
    free = design.with_fixed(hardware, keep_free=("q_0c",)).problem
    assert np.flatnonzero(free.p_upper - free.p_lower).tolist() == [5]


def test_clutched_springs_of_a_set_need_the_same_ways(tmp_path):
    """Other payloads do, another release does not."""

    def read(changes):
        path = tmp_path / "set.json"
        content = {
            "format": "rrr_oc-tasks/1",
            "base": "further_springs",
            "tasks": [{"name": "first"}, {"name": "other", **changes}],
        }
        path.write_text(json.dumps(content))
        return prepared(Request(str(path), tmp_path / "out", ("PEA+CBPEA",), QUICK), None, Output(True, False))

    assert len(read({"payload_kg": 2.0}).designs["PEA+CBPEA"]) == 2
    with pytest.raises(UserError, match="no spring with a clutch keeps its energy both in task 'first' and in 'other'"):
        read({"release": {"position_m": [0.40, 0.0, 0.08]}})


def test_what_knows_no_phases_says_so(monkeypatch, tmp_path):
    """An exported arm is without the spring; an animation shows it slack in the return phase; figures and pages have its name."""
    options = ["--configurations", "CBPEA", "--starts", "1", "--motions", "0", "--tolerance", "1e-2", "--jobs", "1", "--quiet"]
    out = tmp_path / "out"
    assert rrr_oc(monkeypatch, "design", "further_springs", *options, "--out", str(out)) == 0
    task, label = load_task("further_springs"), "clutched_biarticular_spring[joint2,joint3]"
    study = read_json(out / "summary.json", DesignFile)
    saved = study.configurations["CBPEA"]
    assert saved.mounted[label]["phase"] == "go"
    assert saved.first.certificate.least is None
    scene, file = designed(out / "CBPEA.npz", "further_springs"), np.load(out / "CBPEA.npz")
    (spring,) = scene.springs
    assert np.all(spring.tension[file["phase"] == 1] == 0)
    assert spring.tension.max() > 1
    assert "that a clutch connects in one phase" in (out / "report.html").read_text()
    assert "the clutched biarticular spring of joint2 and joint3 acts in the phase “go” only" in verdict(study)
    beyond = {"table_spring[joint2]": "known from 0.0° to 9.0° of its joint"}
    changed = msgspec.structs.replace(study, configurations={"CBPEA": designs.with_motion(saved, beyond=beyond)})
    assert any("the law of the table spring of joint2 is known from 0.0° to 9.0° of its" in said for said in cautions(changed))
    assert "the law of the table spring of joint2 is known from 0.0° to 9.0°" in report(changed)
    asked = ["--design", str(out / "summary.json"), "--configuration", "CBPEA", "--task", "further_springs"]
    assert rrr_oc(monkeypatch, "export", "--out", str(tmp_path / "arm"), *asked) == 0
    assert "tendon" not in (tmp_path / "arm" / "arm.xml").read_text()
    assert [e.effect.name for e in spring_bounds(task, "CBPEA")] == ["clutched_biarticular_spring"]


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
        (
            "CPEA",
            [{**CPEA[0], "equilibrium_deg": [-10, 60]}],
            r"clutched_spring\[joint2\]: equilibrium_deg: found -10 … 60; it must allow 61.86",
        ),
        ("CPEA", [{**CPEA[0], "phase": "pick"}], "phase"),
        (
            "CBPEA",
            [{**CBPEA[0], "winding": [1, -1]}],
            r"only with r_3/r_2 = -0.5, and the windings and radii allow 0.3889 … 2.053",
        ),
        (
            "CBPEA",
            [{**CBPEA[0], "r_3_mm": [30, 39]}],
            r"only with r_3/r_2 = 0.5, and the windings and radii allow 0.8333 … 2.053",
        ),
        ("NPEA", [{**NPEA[0], "number": [-1, 3]}], "number must be 0 or more, got -1 … 3"),
        ("NPEA", [{k: v for k, v in NPEA[0].items() if k != "table_deg_Nm"}], "table_deg_Nm"),
        ("BPEA+PEA", PEA, r"unknown configuration 'BPEA\+PEA'; it is SA, .* in this order and joined by '\+'"),
    ],
)
def test_tasks_that_are_turned_away(name, springs, message):
    with pytest.raises(UserError, match=message):
        spring_bounds(replace(PAPER, springs=tuple(springs)), name)


def test_a_side_that_is_none_is_turned_away():
    with pytest.raises(UserError, match="active is 'below' or 'above', got 'left'"):
        PulleySpring((0,), "left")  # pyright: ignore[reportArgumentType]
    with pytest.raises(UserError, match="mounting is 'as listed' or 'mirrored', got 'left'"):
        TableSpring((0,), "left")  # pyright: ignore[reportArgumentType]
    with pytest.raises(UserError, match="phase is 'go' or 'return', got 'pick'"):
        ClutchedSpring((0,), "pick")  # pyright: ignore[reportArgumentType]


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


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"effect": {}}, "a spring's effect is parallel_spring or .*, got {}"),
        ({"effect": ["parallel_spring"]}, "a spring's effect is parallel_spring or "),
        ({"joint": 5}, r"springs\[0\].joint: found 5"),
        ({"joint": None}, r"springs\[0\].joint: found null"),
    ],
)
def test_a_spring_that_is_no_entry_is_refused_wherever_it_is_read_first(wrong, said):
    """Which configurations are offered, and which of them hold the arm, is asked before springs are made of the entries."""
    task = replace(PAPER, springs=({**PEA[0], **wrong}, PEA[1]))
    weak = replace(task, torque=np.full(task.torque.shape, 1.0))  # no joint holds the arm, so that springs are asked for
    for ask in (lambda: offered(task), lambda: holding(weak, None, ("SA", "PEA"), Output(quiet=True))):
        with pytest.raises(UserError, match=said):
            ask()

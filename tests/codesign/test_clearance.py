"""What an arm keeps away from: distances against a brute force, links covered by points, and motions that keep their distance."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_design_problem import TASK, design_of
from test_task import task_file

from rrr_oc.codesign.certificate import certify
from rrr_oc.codesign.clearance import FLOOR, SHARPNESS, TOOL, Box, Capsule, KeepOut, Surroundings
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import sample_motion
from rrr_oc.codesign.search.local_optima import Optimum
from rrr_oc.codesign.search.proposals import motion_guess
from rrr_oc.codesign.search.swings import with_other_swings
from rrr_oc.codesign.task import Task, load_task
from rrr_oc.errors import UserError
from rrr_oc.optimal_control.refinement import Refinement, refine
from rrr_oc.optimal_control.scheme import scheme, uniform_mesh
from rrr_oc.optimal_control.solver import Solution, Solver
from rrr_oc.optimal_control.transcription import Transcription

RNG = np.random.default_rng(1)
POST = Capsule((0.1, -0.2, 0.0), (0.3, 0.1, 0.4), 0.05)
SHELF = Box((0.2, 0.1, 0.3), (0.3, 0.1, 0.5), (20.0, -30.0, 70.0))
JERK = np.radians([1200.0, 900.0])


def of_function(keep_out: KeepOut, points: np.ndarray) -> np.ndarray:
    """Distances of points (K, 3) by the symbolic expression."""
    p = ca.SX.sym("p", 3)
    return np.array(ca.Function("d", [p], [keep_out.distance(p)]).map(len(points))(points.T)).ravel()


def from_line(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Least distances of points (K, 3) from a line between two others, by trying many of its points."""
    line = a + np.linspace(0, 1, 2001)[:, None] * (b - a)
    return np.array([np.linalg.norm(line - p, axis=1).min() for p in points])


def test_distance_from_a_capsule():
    points = RNG.uniform(-0.6, 0.8, (400, 3))
    exact = from_line(points, np.array(POST.from_m), np.array(POST.to_m)) - POST.radius_m
    found = of_function(KeepOut("post", capsule=POST), points)
    np.testing.assert_allclose(found, exact, atol=2e-4)
    ball = ball_at(POST.from_m)
    np.testing.assert_allclose(
        of_function(ball, points), np.linalg.norm(points - np.array(POST.from_m), axis=1) - POST.radius_m, atol=1e-4
    )


def ball_at(end: tuple[float, float, float]) -> KeepOut:
    return KeepOut("ball", capsule=Capsule(end, end, POST.radius_m))


def test_distance_from_a_turned_box_is_never_too_great():
    points = RNG.uniform(-0.6, 0.9, (2000, 3))
    inside = Rotation.from_euler("xyz", SHELF.rpy_deg, degrees=True).inv().apply(points - np.array(SHELF.center_m))
    over = np.abs(inside) - np.array(SHELF.size_m) / 2
    exact = np.linalg.norm(np.maximum(over, 0), axis=1) + np.minimum(over.max(axis=1), 0)
    found = of_function(KeepOut("shelf", box=SHELF), points)
    assert np.all(found <= exact + 1e-12)
    assert np.any(exact < 0)
    np.testing.assert_allclose(found, over.max(axis=1), atol=3 * 0.28 / SHARPNESS)
    before_a_side = (np.sort(over, axis=1)[:, :2] < -0.05).all(axis=1) & (over.max(axis=1) > 0)
    assert before_a_side.sum() > 10
    np.testing.assert_allclose(found[before_a_side], exact[before_a_side], atol=1e-3)


def test_points_along_the_links_cover_them():
    """Wherever all points keep their distance from a ball, the links as capsules do, by the geometry of two links in a plane; the last
    stretch before the tool, which has no radius, is left out."""
    radius, ball = 0.03, np.array([0.25, 0.0, 0.2])
    task = around(Surroundings(-np.inf, (KeepOut("ball", capsule=Capsule(tuple(ball), tuple(ball), 0.06)),), radius))
    free, near = 0, 0
    for q in RNG.uniform(task.lower, task.upper, (300, 2)):
        shoulder = np.array([0.0, 0.0, 0.07])
        elbow = shoulder + 0.3 * np.array([np.cos(q[0]), 0.0, np.sin(q[0])])
        tool = elbow + 0.3 * np.array([np.cos(q.sum()), 0.0, np.sin(q.sum())])
        kept = task.kept(task.full(q))
        if all(float(one.value) >= one.least for one in kept):
            free += 1
            last = elbow + (1 - 0.05 / 0.3) * (tool - elbow)
            clear = min(from_line(ball[None], a, b)[0] for a, b in ((shoulder, elbow), (elbow, last))) - 0.06
            assert clear >= radius - 1e-4
            near += clear < 2 * radius
    assert free > 50
    assert near > 5


def around(surroundings: Surroundings) -> Task:
    return replace(TASK, around=surroundings)


def test_only_what_moves_is_kept_above_a_floor():
    """The shoulder of the arm does not; elbow and tool do, of which the tool has no radius."""
    task = around(Surroundings(-0.1, (), 0.04))
    q = np.array([0.4, -0.9])
    elbow = 0.07 + 0.3 * np.sin(0.4)
    found = [(one.name, one.of, float(one.value), one.least) for one in task.kept(task.full(q))]
    assert found == [
        (FLOOR, "the link of joint2", pytest.approx(elbow), pytest.approx(-0.06)),
        (FLOOR, TOOL, pytest.approx(elbow + 0.3 * np.sin(0.4 - 0.9)), -0.1),
    ]
    assert TASK.kept(TASK.full(q)) == []
    np.testing.assert_allclose(TASK.heights(q[:, None]).ravel(), [elbow, elbow + 0.3 * np.sin(0.4 - 0.9)])


def optimum(task: Task, tolerance: float = 1e-2) -> tuple[CoDesign, Solution, list[dict]]:
    """The stiff arm's optimum near a straight way, on refined meshes."""
    design = design_of("SA", task)
    transcription = Transcription(design.problem, scheme("lobatto", 4), uniform_mesh(design.problem, 12))
    first = Solver(transcription).solve(motion_guess(design, np.zeros(0), (1.6, 1.6)))
    return design, *refine(first, Refinement(tolerance))


def test_a_motion_keeps_out_of_what_is_in_its_way():
    """The straight way of the tool from 0.15 to 0.40 m, 0.07 m high, leads through it; above it there is room."""
    low = KeepOut("sill", capsule=Capsule((0.28, -0.3, 0.06), (0.28, 0.3, 0.06), 0.03))
    free, kept = optimum(TASK), optimum(around(Surroundings(-np.inf, (low,), 0.02)))

    def clearance(design: CoDesign, solution: Solution) -> float:
        q = ca.SX.sym("q", 3)
        over = ca.vertcat(*[one.value - one.least for one in around(Surroundings(-np.inf, (low,), 0.02)).kept(q)])
        moved = design.task.full(sample_motion(design, solution).q)
        return float(np.array(ca.Function("over", [q], [over]).map(moved.shape[1])(moved)).min())

    assert clearance(*free[:2]) < -0.01
    assert clearance(*kept[:2]) > -1e-3  # between the nodes, too
    assert kept[2][-1]["converged"]
    assert kept[1].cost > free[1].cost
    certificate = certify(kept[0], Optimum(kept[1], kept[2]))
    (bound,) = [one for one in certificate.active if one.name == "the surface of the keep-out sill"]
    assert (bound.unit, bound.saving > 0) == ("mm", True)


def test_limits_of_torque_hold_between_the_nodes():
    design, solution, rows = optimum(replace(TASK, torque=np.array([28.5, np.inf])))
    peak = float(np.abs(sample_motion(design, solution).tau_load[0]).max())
    assert 28.4 < peak < 28.5 * 1.0011
    assert rows[-1]["converged"]


def test_with_a_limit_of_jerk_accelerations_do_not_jump():
    design, solution, rows = optimum(replace(TASK, jerk=JERK))
    motion = sample_motion(design, solution)
    assert rows[-1]["converged"]
    for k in motion.segments:
        t, ddq = motion.t[k], motion.ddq[:, k]
        np.testing.assert_allclose(ddq[:, [0, -1]], 0, atol=1e-9)
        assert np.all(np.abs(np.diff(ddq) / np.diff(t)) <= JERK[:, None] * (1 + 1e-6))
        speed = np.cumsum((ddq[:, 1:] + ddq[:, :-1]) / 2 * np.diff(t), axis=1)
        np.testing.assert_allclose(motion.dq[:, k][:, 1:], speed, atol=5e-4)  # of the trapezoid rule over switches of the jerk
    assert np.abs(motion.ddq).max() < TASK.acceleration[0] * 1.0011
    free = optimum(TASK)[1]
    assert solution.cost > free.cost * 1.05
    names = [one.name for one in certify(design, Optimum(solution, rows)).active]
    assert "the jerk limit of joint3" in names
    assert "the acceleration limit of joint3" in names


def test_a_motion_with_jerks_runs_through_faster_and_swings_once_more():
    """Speeds grow with the rate, accelerations with its square, jerks with its cube; derivatives of each other stay so."""
    design = design_of("SA", replace(TASK, jerk=JERK))
    phase, s = (
        motion_guess(design, np.zeros(0), (3.0, 3.0), np.full((2, 2, 1), [[1.6], [-2.0]])).phases[0],
        np.linspace(0, 1, 4001),
    )
    assert phase.states(s).shape == (6, s.size)
    for one in [phase, *with_other_swings(phase, design.orders, (0.5, 2.0))]:
        x, u, h = one.states(s), one.controls(s), one.duration / (s.size - 1)
        for rate, of in ((x[2:4], x[:2]), (x[4:], x[2:4])):
            np.testing.assert_allclose(
                np.diff(of), (rate[:, 1:] + rate[:, :-1]) / 2 * h, atol=5e-2 * np.abs(rate).max() * h + 1e-3
            )
        assert u.shape == (2, s.size)


WRONG = {
    "both": ({"name": "a", "box": SHELF, "capsule": POST}, 'either "capsule" or "box"'),
    "none": ({"name": "a"}, 'either "capsule" or "box"'),
}


@pytest.mark.parametrize(("keys", "message"), WRONG.values(), ids=WRONG.keys())
def test_a_keep_out_is_a_capsule_or_a_box(keys, message):
    with pytest.raises(ValueError, match=message):
        KeepOut(**keys)
    with pytest.raises(ValueError, match=r"size_m: found \[1.0, 0.0, 1.0\]; edges above 0"):
        Box((0.0, 0.0, 0.0), (1.0, 0.0, 1.0))


def test_an_end_in_a_keep_out_is_refused(tmp_path):
    box = {"name": "table", "box": {"center_m": [0.15, 0.0, 0.0], "size_m": [0.2, 0.2, 0.16]}}
    with pytest.raises(UserError, match=r"at the start the tool is -0\.0100 m from the keep-out table; 0\.0000 m or more"):
        load_task(task_file(tmp_path, keep_outs=[box]))
    with pytest.raises(UserError, match=r"the link of joint2 stands .* below floor_m = 0.1 m|the tool stands 0\.0700 m high"):
        load_task(task_file(tmp_path, floor_m=0.1))
    file = task_file(tmp_path, floor_m=0.0)
    assert load_task(file).around.floor == 0.0
    file.write_text(file.read_text().replace('"floor_m": 0.0', '"floor_m": null'))
    assert not np.isfinite(load_task(file).around.floor)

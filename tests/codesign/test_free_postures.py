"""Tasks whose ends are places of the tool, on an arm that reaches them in many postures."""

from pathlib import Path

import numpy as np
import pytest
from own_arm import own_task

from rrr_oc.codesign.bounds.over_motions import task_bound
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.local_optima import follow_to_fine_mesh
from rrr_oc.codesign.search.proposals import SearchOptions, motion_guess
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import Task, load_task
from rrr_oc.codesign.task_sets.task_set import load_tasks
from rrr_oc.errors import UserError

QUICK = SearchOptions(fine=12, widths=(0.03,))
JOINTS = ("j1", "j2", "j3")
LENGTHS, MASS, CENTRE, PAYLOAD = (
    (0.3, 0.3, 0.2),
    1.0,
    0.1,
    1.0,
)  # of tests/helpers/chains.arm: links, their centre of mass [m], [kg]
START, RELEASE = (0.7, 0.0, 0.2), (0.6, 0.0, -0.3)


def planar(folder: Path, start: dict | None = None, release: dict | None = None, **changes) -> Task:
    """Three joints about −y, 0.3 m apart from 0.3 m in front of the base, the tool 0.2 m behind the last one."""
    free = {"range_deg": [-170, 170], "speed_deg_per_s": 90, "acceleration_deg_per_s2": 180, "torque_Nm": "none"}
    ends = {"start": {"position_m": START, **(start or {})}, "release": {"position_m": RELEASE, **(release or {})}}
    return load_task(own_task(folder, moving=JOINTS, limits=dict.fromkeys(JOINTS, free), **ends, **changes))


def holding_cost(q: np.ndarray) -> float:
    """Torque² of the three joints that holds the arm still, with the payload and without [N²m²]: moments of the weights by hand."""
    turned = np.cumsum(q)
    x = np.r_[0, np.cumsum(np.array(LENGTHS) * np.cos(turned))]  # of the joints and of the tool, from the first joint
    centres = x[:3] + CENTRE * np.cos(turned)
    total = 0.0
    for payload in (PAYLOAD, 0.0):
        tau = [9.81 * (MASS * (centres[j:] - x[j]).sum() + payload * (x[3] - x[j])) for j in range(3)]
        total += float(np.square(tau).sum())
    return total


def least_cost(place: tuple[float, float, float]) -> float:
    """The least of `holding_cost` with the tool at a place, over all directions of the last link and both elbows."""
    best = np.inf
    for angle in np.linspace(-np.pi, np.pi, 20001):
        wrist = np.array([place[0] - 0.3, place[2]]) - LENGTHS[2] * np.array([np.cos(angle), np.sin(angle)])
        reach = np.linalg.norm(wrist) / (2 * LENGTHS[0])
        if reach < 1:
            for side in (1, -1):
                first = np.arctan2(wrist[1], wrist[0]) + side * np.arccos(reach)
                second = -2 * side * np.arccos(reach)
                q = np.array([first, second, angle - first - second])
                q = (q + np.pi) % (2 * np.pi) - np.pi
                if np.abs(q).max() <= np.radians(170):
                    best = min(best, holding_cost(q))
    return best


@pytest.mark.parametrize("posture", ["free", "held"])
def test_a_search_begins_in_the_posture_of_least_torque(tmp_path, posture):
    task = planar(tmp_path, {"posture": posture}, {"posture": posture})
    for q, place in ((task.start, START), (task.release, RELEASE)):
        tool = task.model().body.tool_position(task.full(q), task.tool.position)
        np.testing.assert_allclose(np.array(tool).ravel(), place, atol=1e-6)
        assert holding_cost(q) == pytest.approx(least_cost(place), rel=1e-5)  # of a grid of 20,001 directions
    assert [goal is not None for goal in task.goals] == [posture == "free"] * 2
    assert [len(goal.rows) for goal in task.goals if goal] == [2, 2] * (posture == "free")  # no joint moves the tool along y


def test_no_posture_is_free_where_the_joints_reach_a_place_in_few(tmp_path):
    assert load_task("paper").goals == (None, None)
    down = {"direction": {"axis": (1, 0, 0), "towards": (0, 0, -2)}}
    task = planar(tmp_path, down, down)
    assert task.goals == (None, None)
    for q in (task.start, task.release):
        assert np.sin(q.sum()) == pytest.approx(-1, abs=1e-6)  # the last link points down


def optimum(task: Task):
    design = CoDesign(task, spring_bounds(task, "SA"))
    found = follow_to_fine_mesh(design, QUICK, motion_guess(design, np.zeros(0), [2.0, 2.0]))
    assert found is not None
    return found


def test_a_free_posture_costs_no_more_and_holds_the_tool(tmp_path):
    held = optimum(planar(tmp_path, {"posture": "held"}, {"posture": "held"}))
    task = planar(tmp_path)
    free = optimum(task)
    assert free.cost < 0.9 * held.cost
    s, body = np.array([0.0, 1.0]), task.model().body
    go, back = (free.solution.at(i, s)[0] for i in range(2))
    np.testing.assert_allclose(go[:3], back[:3, ::-1], atol=1e-8)
    np.testing.assert_allclose(go[3:], 0, atol=1e-9)
    for q, place in zip(go[:3].T, (START, RELEASE), strict=True):
        tool = np.array(body.tool_position(task.full(q), task.tool.position)).ravel()
        np.testing.assert_allclose(tool, place, atol=1e-7)
    assert task_bound(CoDesign(task, ())) is None


def test_one_end_may_be_held(tmp_path):
    """And a direction of the tool at the other, of a joint more than it needs."""
    task = planar(tmp_path, {"posture": "held"})
    found = optimum(task)
    np.testing.assert_allclose(found.solution.at(0, np.zeros(1))[0][:3, 0], task.start, atol=1e-8)
    assert task.goals[0] is None
    assert task.goals[1] is not None


def test_places_tell_tasks_apart(tmp_path):
    file = tmp_path / "task.json"
    planar(tmp_path)
    first = load_tasks(file).contents
    planar(tmp_path, {"posture": "held"}, {"posture": "held"})
    assert load_tasks(file).contents != first


def test_wrong_ends_are_told(tmp_path):
    with pytest.raises(UserError, match=r"out of reach .* comes no nearer than 0\.4000 m"):
        planar(tmp_path, {"position_m": (1.5, 0, 0)})
    up = {"direction": {"axis": (0, 1, 0), "towards": (0, 0, 1)}}
    with pytest.raises(UserError, match=r"out of reach .* from the direction"):
        planar(tmp_path, up)
    with pytest.raises(UserError, match="a length above 0 is required"):
        planar(tmp_path, {"direction": {"axis": (0, 0, 0), "towards": (0, 0, 1)}})
    clutched = {"effect": "clutched_spring", "joint": "j2", "stiffness_Nm_per_rad": [0, 20], "equilibrium_deg": [-90, 90]}
    task = planar(tmp_path, springs=[clutched])
    with pytest.raises(UserError, match="its clutch needs postures that are known"):
        spring_bounds(task, "CPEA")

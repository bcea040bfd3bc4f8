"""Points that an arm passes on its ways: read, met on every mesh, and against kinematics written out here."""

import copy
import importlib.resources
import json
import re
from pathlib import Path

import numpy as np
import pytest

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.proposals import decode, dimensions, motion_guess
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import Task, load_task
from rrr_oc.codesign.task_sets.task_set import load_tasks
from rrr_oc.errors import UserError
from rrr_oc.optimal_control.refinement import Refinement, refine
from rrr_oc.optimal_control.scheme import scheme, uniform_mesh
from rrr_oc.optimal_control.solver import Solution, Solver
from rrr_oc.optimal_control.transcription import Transcription

PAPER = json.loads(importlib.resources.files("rrr_oc.data").joinpath("paper.json").read_text())
HIGH = {"phase": "go", "position_m": [0.2, 0.0, 0.45], "time_share": 0.3}
BENT = {"phase": "return", "angles_deg": [80.0, -100.0]}


def passing(folder: Path, *via: dict) -> Task:
    """The paper's task, passing some points."""
    (folder / "task.json").write_text(json.dumps(copy.deepcopy(PAPER) | {"via": list(via)}))
    return load_task(folder / "task.json")


def tool(q: np.ndarray) -> np.ndarray:
    """x and z of the tool [m] at angles (2, K): two links of 0.3 m from 0.07 m above the base."""
    first, second = q[0], q[0] + q[1]
    return 0.3 * np.array([np.cos(first) + np.cos(second), np.sin(first) + np.sin(second)]) + np.array([[0.0], [0.07]])


def solved(task: Task) -> Solution:
    design = CoDesign(task, spring_bounds(task, "PEA"))
    solver = Solver(Transcription(design.problem, scheme("lobatto", 4), uniform_mesh(design.problem, 8)))
    middle = decode(design, np.full(dimensions(design, 2), 0.5), 2)[:2]
    return solver.solve(motion_guess(design, *middle), design.data(0.1))


def test_an_optimal_motion_passes_its_points_on_every_mesh(tmp_path):
    """A position in any posture after 0.3 of the way there, angles after half of the way back. Both cost something."""
    solution = solved(passing(tmp_path, HIGH, BENT))
    finer = refine(solution, Refinement(tolerance=1e-3, rounds=1))[0]
    assert sum(map(len, finer.transcription.mesh)) > sum(map(len, solution.transcription.mesh))
    for one in (solution, finer):
        np.testing.assert_allclose(tool(one.at(0, np.array([0.3]))[0][:2])[:, 0], [0.2, 0.45], atol=1e-6)
        np.testing.assert_allclose(np.degrees(one.at(1, np.array([0.5]))[0][:2, 0]), [80, -100], atol=1e-4)
    assert solution.cost > 1.02 * solved(load_task("paper")).cost


def test_proposed_motions_pass_the_points(tmp_path):
    """Near a point of the task a proposed one gives way, so that the path does not turn sharply."""
    task = passing(tmp_path, HIGH, BENT)
    design = CoDesign(task, spring_bounds(task, "PEA"))
    for share in (0.1, 0.9):
        guess = motion_guess(design, *decode(design, np.full(dimensions(design, 2), share), 2))
        np.testing.assert_allclose(tool(guess.phases[0].states(np.array([0.3]))[:2])[:, 0], [0.2, 0.45], atol=1e-6)
        np.testing.assert_allclose(np.degrees(guess.phases[1].states(np.array([0.5]))[:2, 0]), [80, -100], atol=1e-6)
        np.testing.assert_allclose(guess.phases[0].states(np.array([0.0, 1.0]))[:2].T, [task.start, task.release], atol=1e-9)


def test_points_without_shares_divide_the_time_of_their_phase(tmp_path):
    first, second = ({"phase": "go", "angles_deg": angles} for angles in ([70.0, -120.0], [60.0, -110.0]))
    task = passing(tmp_path, first, BENT, second)
    assert [(one.phase, one.share) for one in task.via] == [(0, pytest.approx(1 / 3)), (1, 0.5), (0, pytest.approx(2 / 3))]


def test_two_sets_with_different_points_are_told_apart(tmp_path):
    """As plain data, by which an interrupted study knows its own results."""
    found = []
    for via in ([], [HIGH], [HIGH, BENT]):
        passing(tmp_path, *via)
        found.append(json.dumps(load_tasks(tmp_path / "task.json").contents))
    assert len(set(found)) == 3


@pytest.mark.parametrize(
    ("via", "says"),
    [
        ([{"phase": "go"}], 'via[0]: give either "angles_deg" or "position_m"'),
        ([HIGH | {"angles_deg": [1.0, 2.0]}], 'via[0]: give either "angles_deg" or "position_m"'),
        ([BENT | {"direction": {"axis": [1, 0, 0], "towards": [0, 0, 1]}}], "a direction needs a position_m"),
        ([HIGH | {"phase": "there"}], "via[0].phase: found 'there'"),
        ([HIGH | {"time_share": 1.0}], "time_share: found 1; a share between 0 and 1 is required"),
        ([HIGH, {**HIGH, "time_share": 0.2}], 'via: of "go" all or none need a time_share, each greater than the one before'),
        ([HIGH, {"phase": "go", "angles_deg": [80.0, -100.0]}], 'via: of "go" all or none need a time_share'),
        ([HIGH | {"position_m": [0.7, 0.0, 0.07]}], "via[0] at [0.7, 0.0, 0.07] m is out of reach within the joint ranges"),
        ([BENT | {"angles_deg": [80.0]}], "via[0].angles_deg: found [80.0]; one number per moving joint is required"),
        ([BENT | {"angles_deg": [80.0, 100.0]}], "via[0]: joint3 would stand at 100.00°, outside its range -180.00° … 0.00°"),
    ],
)
def test_wrong_points_are_told(tmp_path, via, says):
    with pytest.raises(UserError, match=re.escape(says)):
        passing(tmp_path, *via)


def test_a_point_below_the_floor_is_told(tmp_path):
    content = copy.deepcopy(PAPER) | {"floor_m": 0.0, "via": [HIGH | {"position_m": [0.4, 0.0, -0.1]}]}
    (tmp_path / "task.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"via\[0\]: the tool is -0\.1000 m from the floor; 0\.0000 m or more is required"):
        load_task(tmp_path / "task.json")

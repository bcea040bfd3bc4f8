"""A price on springs: which are chosen for a set of tasks, against what is known of free, dear and few springs."""

import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import rrr_oc

from rrr_oc.codesign import study as steps
from rrr_oc.codesign.design_file import DesignFile
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.multistart import solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import saved_springs, ways_to_mount
from rrr_oc.codesign.task import load_task
from rrr_oc.codesign.task_sets.spring_choice import GAIN, _Search, chosen, spring_front
from rrr_oc.codesign.task_sets.task_set import SetDesign, load_task_set
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.schema import read_json

OPTIONS = SearchOptions(
    starts=1, coarse=6, fine=10, widths=(0.01,), refinement=Refinement(1e-2, rounds=1), kept=1, within=0.0, motions=0
)


def set_file(folder: Path, **changes) -> str:
    content = {"format": "rrr_oc-tasks/1", "base": "paper", "tasks": [{"name": "a"}, {"name": "b", "payload_kg": 2.0}]}
    (folder / "set.json").write_text(json.dumps(content | changes))
    return str(folder / "set.json")


@pytest.fixture(scope="module")
def design(tmp_path_factory) -> SetDesign:
    """Two tasks, with every way to mount a spring in each place."""
    tasks = load_task_set(set_file(tmp_path_factory.mktemp("two")))
    springs = tuple(way for ways in ways_to_mount(tasks.tasks[0], "PEA") for way in ways)
    return SetDesign(tasks, tuple(CoDesign(task, springs) for task in tasks.tasks))


@pytest.fixture(scope="module")
def front(design):
    bare = design.with_springs(())
    stiff = [solve_multistart(one, OPTIONS).best for one in bare.designs]
    return spring_front(design, stiff, OPTIONS), stiff


def test_the_front_begins_at_the_stiff_arm_and_falls_with_every_spring(design, front):
    points, stiff = front[0].points, front[1]
    assert points[0].springs == ()
    assert points[0].total == pytest.approx(design.total([o.cost for o in stiff]), rel=1e-2)  # on two meshes
    assert len(points) > 1
    assert all(few.total > more.total for few, more in itertools.pairwise(points))
    assert all(len(few.springs) < len(more.springs) for few, more in itertools.pairwise(points))


def test_free_springs_are_used_and_dear_ones_are_not(front):
    points = front[0].points
    assert front[0].at(0.0) is points[-1]
    assert points[-1].total < 0.3 * points[0].total  # springs carry most of the load of this arm
    assert front[0].at(1e6) is points[0]
    between = 0.5 * (points[0].total - points[1].total)
    assert front[0].at(between).springs


def test_one_place_has_one_spring_and_springs_left_out_give_no_torque(design, front):
    for point in front[0].points:
        places = [design.springs[i].effect.joints for i in point.springs]
        assert len(places) == len(set(places))
        reduced, start = chosen(design, OPTIONS, point)
        assert [s.effect for s in reduced.springs] == [design.springs[i].effect for i in point.springs]
        assert np.all(point.parameters[::2][[i not in point.springs for i in range(len(design.springs))]] == 0)
        packed = [one.data() for one in reduced.designs]
        assert len(start.parameters) == 2 * len(point.springs)
        assert len(packed) == len(point.motions)


def test_a_spring_that_does_nothing_is_taken_away_without_a_joint_problem(design, front):
    """Beside one spring that helps; without that one, a joint problem is solved."""
    search, point = _Search(design, OPTIONS), next(p for p in front[0].points if len(p.springs) == 1)
    (helps,) = point.springs
    idle = next(i for i in range(len(design.springs)) if i not in search.places[design.springs[helps].place])
    both = replace(point, springs=tuple(sorted((helps, idle))), parameters=search.cleared(point.parameters, [helps]))
    left = search.without_one(both)
    assert (left.springs, search.solved) == ((helps,), 0)
    assert left.total <= point.total * (1 + GAIN)
    search.without_one(left)
    assert search.solved > 0


def test_the_objective_on_held_motions_has_its_gradient(design, front):
    """By central differences, and its value is the point's own."""
    point = front[0].points[-1]
    held = _Search(design, OPTIONS).held(point.parameters, point.motions)
    assert held(point.parameters)[0] == pytest.approx(point.total, rel=1e-6)
    p = 0.5 * point.parameters + 0.2
    slope, step = held(p)[1], 1e-5
    differences = [(held(p + step * e)[0] - held(p - step * e)[0]) / (2 * step) for e in np.eye(p.size)]
    np.testing.assert_allclose(slope, differences, rtol=1e-4, atol=1e-3)


def test_a_price_is_reported_and_its_design_simulated(monkeypatch, tmp_path):
    out, given = tmp_path / "out", ["--configurations", "SA,PEA", "--starts", "1", "--motions", "0", "--tolerance", "1e-2"]
    given += ["--intervals", "10", "--jobs", "1", "--price", "200"]
    assert rrr_oc(monkeypatch, "design", set_file(tmp_path), *given, "--out", str(out)) == 0
    c = json.loads((out / "summary.json").read_text())["configurations"]["PEA"]
    points, best = c["choice"]["points"], c["choice"]["chosen"]
    assert points[best]["priced"] == min(p["priced"] for p in points)
    assert [p["priced"] - p["cost"] for p in points] == pytest.approx([200 * p["count"] for p in points])
    assert c["mounted"] == points[best]["mounted"]
    assert c["cost"] == pytest.approx(points[best]["cost"], rel=0.05)  # on refined meshes
    for task in c["tasks"].values():
        assert task["mujoco"]["E1"] == pytest.approx(task["E1"], rel=1e-2)
    saved = saved_springs(out / "summary.json", "PEA", load_task("paper"))
    assert len(saved.mounted) == points[best]["count"]
    for report in ("report.md", "report.html"):
        assert f"At a price of 200 N²m²s a spring, {points[best]['count']} of 2 springs are best" in (out / report).read_text()
    assert (out / "choice.png").stat().st_size > 5000


def test_a_task_alone_may_have_a_price(monkeypatch, tmp_path):
    """So dear that one spring of two is left, as the points at the price say; the report says where it comes from."""
    out, given = tmp_path / "out", ["--configurations", "PEA", "--starts", "1", "--motions", "0", "--tolerance", "1e-2"]
    assert (
        rrr_oc(monkeypatch, "design", "paper", *given, "--intervals", "8", "--jobs", "1", "--price", "60", "--out", str(out))
        == 0
    )
    study = read_json(out / "summary.json", DesignFile)
    c, (asked,) = study.configurations["PEA"], study.tasks
    assert c.choice is not None
    best = c.choice.points[c.choice.chosen]
    assert best.priced == min(p.priced for p in c.choice.points)
    assert c.mounted == best.mounted
    moved = c.tasks[asked.name]
    assert pytest.approx(moved.E1, rel=1e-2) == moved.mujoco.E1  # on a coarse mesh
    assert c.published_springs is None or c.published_springs > 0
    with np.load(out / "PEA.npz") as m:
        parts = [np.trapezoid(m["tau_load"][:, k] ** 2, m["t"][k]).sum() for k in (m["phase"] == 0, m["phase"] == 1)]
    assert sum(parts) == pytest.approx(moved.E1, rel=1e-3)
    assert "Found from the choice of springs by their price." in (out / "report.md").read_text()


BAD = {
    "below 0": (lambda f: [set_file(f), "--price", "-1"], "--price is -1; a finite number of 0 or more is required"),
    "infinite": (lambda f: [set_file(f), "--price", "inf"], "--price is inf; a finite number of 0 or more is required"),
    "with a catalogue": (
        lambda f: ["paper", "--price", "2", "--catalogue", "prototype"],
        "--price is 2 and --catalogue is 'prototype'; only one of them is allowed",
    ),
    "of the worst": (
        lambda f: [set_file(f, objective="worst"), "--price", "2"],
        "--price needs a set whose objective is 'sum', without 'uncertain'; 'set' has the objective 'worst'",
    ),
    "uncertain": (
        lambda f: [set_file(f, uncertain={"payload": 0.1}), "--price", "2"],
        "'set' has something uncertain",
    ),
}


@pytest.mark.parametrize(("arguments", "message"), BAD.values(), ids=BAD.keys())
def test_a_bad_price_is_one_sentence_before_the_first_solve(monkeypatch, capsys, tmp_path, arguments, message):
    monkeypatch.setattr(steps, "solve_multistart", lambda *a: pytest.fail("it began to solve"))
    assert rrr_oc(monkeypatch, "design", *arguments(tmp_path), "--out", str(tmp_path / "out")) == 2
    told = capsys.readouterr().err.strip()
    assert told.startswith("Error: ")
    assert message in told
    assert len(told.splitlines()) == 1
    assert not (tmp_path / "out").exists()

"""Sets of tasks: one set of springs for all of them, against the tasks alone, another way to solve, and MuJoCo."""

import json
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from commands import rrr_oc
from own_arm import OWN, own_task

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.codesign import study as steps
from rrr_oc.codesign.design_file import DesignFile
from rrr_oc.codesign.design_problem import CoDesign, Scenario
from rrr_oc.codesign.optimum import sample_motion
from rrr_oc.codesign.search.multistart import solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions, motion_guess
from rrr_oc.codesign.springs import saved_springs, spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.codesign.task_sets.set_search import held_motions, solve_set
from rrr_oc.codesign.task_sets.task_set import SetDesign, TaskSet, load_task_set, with_uncertainty
from rrr_oc.codesign.transfer import repaired
from rrr_oc.effects import CATALOGUE
from rrr_oc.errors import UserError
from rrr_oc.optimal_control.problem import Link
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.optimal_control.scheme import scheme, uniform_mesh
from rrr_oc.optimal_control.transcription import Transcription
from rrr_oc.robot.robot import load_robot
from rrr_oc.schema import read_json
from validation import task_sets as other_way

OPTIONS = SearchOptions(
    starts=2, coarse=8, fine=12, widths=(0.01,), refinement=Refinement(1e-3, rounds=3), kept=2, within=0.0, motions=0
)
PAPER = load_task("paper")
TWELVE = load_task_set("twelve_tasks")


def set_of(*tasks, objective="sum", weights=None, payload=0.0, configuration="PEA") -> SetDesign:
    together = TaskSet("set", tasks, np.ones(len(tasks)) if weights is None else np.array(weights), objective, payload)
    springs = spring_bounds(tasks[0], configuration)
    return SetDesign(together, tuple(with_uncertainty(CoDesign(task, springs), together, None) for task in tasks))


def alone(design: SetDesign):
    return [solve_multistart(one, OPTIONS).best for one in design.designs]


THREE = (PAPER, replace(PAPER, name="light", payload=2.0), TWELVE.tasks[5])


@pytest.fixture(scope="module")
def three():
    """Three tasks with a search's result for the sum of their costs."""
    design = set_of(*THREE)
    return solve_set(design, alone(design), OPTIONS)


def test_a_set_of_one_task_is_the_task(three):
    design = set_of(PAPER)
    found = solve_set(design, [three.alone[0]], OPTIONS)
    assert found.total == pytest.approx(three.alone[0].cost, rel=1e-3)  # each on meshes of its own, with errors up to 1e-3
    np.testing.assert_allclose(found.parameters, three.alone[0].solution.parameters, atol=0.02 * design.problem.p_scale.min())
    assert found.total == pytest.approx(found.first[0].cost, rel=1e-3)


def test_two_equal_tasks_have_the_springs_of_one_and_twice_its_cost(three):
    design = set_of(PAPER, replace(PAPER, name="again"))
    found = solve_set(design, [three.alone[0]] * 2, OPTIONS)
    assert found.total == pytest.approx(2 * three.alone[0].cost, rel=1e-3)
    assert found.motions[0].cost == pytest.approx(found.motions[1].cost, rel=1e-3)
    np.testing.assert_allclose(found.parameters, three.alone[0].solution.parameters, atol=0.02 * design.problem.p_scale.min())


def test_sharing_costs_something_and_beats_the_springs_of_any_task(three):
    """Not below the sum of the optima alone, not above what the springs of any one task reach with the best motions for them."""
    design = three.design
    assert three.total >= design.total([o.cost for o in three.alone]) * (1 - 1e-3)
    assert three.total > design.total([o.cost for o in three.alone]) + 1  # the tasks differ, and so do their springs
    for optimum in three.alone:
        starts = [
            [own.solution.guess(), shared.solution.guess()] for own, shared in zip(three.alone, three.motions, strict=True)
        ]
        others = held_motions(design, optimum.solution.parameters, starts, OPTIONS)
        assert three.total <= design.total([o.cost for o in others]) * (1 + 1e-3)
    assert three.total <= design.total([o.cost for o in three.first]) * (1 + 1e-6)


def test_the_worst_case_has_a_lower_worst_than_the_sum(three):
    """With weights by which each of three tasks counts about the same."""
    weights = [1 / o.cost for o in three.alone]
    design = set_of(*THREE, objective="worst", weights=weights)
    found = solve_set(design, three.alone, OPTIONS)
    of_sum = max(w * o.cost for w, o in zip(weights, three.motions, strict=True))
    assert found.total < of_sum * (1 - 1e-3)
    assert found.total == pytest.approx(max(w * o.cost for w, o in zip(weights, found.motions, strict=True)), rel=1e-9)
    assert found.total >= 1 - 1e-3  # no task is better than alone


def test_a_heavier_weight_draws_the_springs_to_its_task(three):
    design = set_of(*THREE, weights=[1.0, 1.0, 50.0])
    found = solve_set(design, three.alone, OPTIONS)
    assert found.motions[2].cost < three.motions[2].cost
    assert sum(o.cost for o in found.motions) > sum(o.cost for o in three.motions)


@pytest.mark.parametrize(("objective", "payload"), [("sum", 0.0), ("sum", 0.2), ("worst", 0.0), ("worst", 0.2)])
def test_derivatives_of_the_joint_problem_are_exact(objective, payload):
    """By central differences at a random point, both kinds of springs, of tasks with unequal weights."""
    design = set_of(*THREE[:2], objective=objective, payload=payload, weights=[1.0, 3.0], configuration="PEA+BPEA")
    t = Transcription(design.problem, scheme("lobatto", 3), uniform_mesh(design.problem, 2))
    f, d, rng = t.functions, design.data(0.1), np.random.default_rng(0)
    w = rng.uniform(0.3, 0.7, t.size)
    lam, step = rng.normal(size=t.row_bounds[0].size), 1e-6

    def central(function):
        return np.array([(function(w + step * e) - function(w - step * e)) / (2 * step) for e in np.eye(t.size)]).T

    def lagrangian_gradient(v):
        return np.array(2.0 * f["grad_f"](v, d)[1]).ravel() + np.array(f["jac_g"](v, d)[1]).T @ lam

    close = {"rtol": 1e-6, "atol": 1e-5}  # of differences over 1e-6
    gradient, jacobian = (np.array(ca.DM(f[name](w, d)[1])) for name in ("grad_f", "jac_g"))
    np.testing.assert_allclose(gradient.ravel(), central(lambda v: float(f["nlp"](v, d)[0])), **close)
    np.testing.assert_allclose(jacobian, central(lambda v: np.array(f["nlp"](v, d)[1]).ravel()), **close)
    hessian = np.array(ca.triu2symm(ca.DM(f["hess_lag"](w, d, 2.0, lam))))
    np.testing.assert_allclose(hessian, central(lagrangian_gradient), **close)


def test_a_task_of_a_set_may_be_a_cycle():
    """Its own two phases are linked, and no others."""
    cycle = replace(PAPER, name="cycle", speeds=("moving", "moving"))
    design = set_of(PAPER, cycle)
    assert design.problem.links == (Link(3, 2, (2, 3)), Link(2, 3, (2, 3)))
    assert design.problem.chains == ((0,), (1,), (2, 3))


def test_the_objective_of_the_joint_problem_is_that_of_the_set():
    """From the costs of the tasks alone at the same motion and springs; "sum" and "worst", with and without scenarios."""
    for objective in ("sum", "worst"):
        for payload in (0.0, 0.2):
            design = set_of(*THREE, objective=objective, payload=payload, weights=[1.0, 2.0, 0.5])
            guess = [motion_guess(one, 0.5 * (one.problem.p_lower + one.problem.p_upper), (2.0, 3.0)) for one in design.designs]
            costs = [_cost(one, g) for one, g in zip(design.designs, guess, strict=True)]
            assert _cost(design, design.guess(guess, guess[0].parameters)) == pytest.approx(design.total(costs), rel=1e-12)


def _cost(design, guess) -> float:
    t = Transcription(design.problem, scheme("lobatto", 3), uniform_mesh(design.problem, 3))
    return float(t.functions["nlp"](t.pack(guess), design.problem.data)[0]) * design.problem.cost_scale


def test_a_decomposition_finds_no_better_springs(three):
    """A descent in the springs alone, the best motion for them inside, from the springs of the joint search."""
    design, springs = three.design, three.parameters
    solve = other_way.HeldSprings(design)
    held = solve(springs, [o.solution.guess() for o in three.motions])
    before = design.total([one.solution.cost for one in held])
    after, _ = other_way.descend(design, springs, held, solve)
    assert after == pytest.approx(before, rel=1e-3)  # the two stand on other meshes


def test_the_derivatives_of_the_decomposition_are_exact(three):
    """Of the cost of the best motion by the springs: gradient and curvature along one direction by central differences."""
    design = set_of(PAPER)
    solve, scale = other_way.HeldSprings(design), design.problem.p_scale
    springs = three.parameters + 0.1 * (0.5 * (design.problem.p_lower + design.problem.p_upper) - three.parameters)
    (held,) = solve(springs, [replace(three.motions[0].solution.guess(), parameters=springs)])
    step = 1e-3 * np.array([1.0, -0.5, 0.1, 0.3]) * (design.problem.p_upper - design.problem.p_lower) / scale
    up, down = (solve(springs + sign * step * scale, [held])[0].solution.cost for sign in (1, -1))
    assert (up - down) / 2 == pytest.approx(held.gradient @ step, rel=1e-3)
    assert up - 2 * held.solution.cost + down == pytest.approx(step @ held.hessian @ step, rel=0.05)


def test_the_worst_payload_is_at_an_end_of_its_interval(three):
    """Along one motion E1 is a convex quadratic of the payload; the robust design is the best in the worst case, not nominally."""
    design = set_of(PAPER, payload=0.2)
    found = solve_set(design, alone(design), OPTIONS)
    (held,), solution = design.held(found.parameters), found.motions[0].solution
    assert [s.payload for s in held.scenarios] == [0.8, 1.2]

    def cost_at(factor: float, of=solution) -> float:
        case = replace(held, task=replace(PAPER, payload=factor * PAPER.payload), scenarios=(Scenario(),))
        return steps._in_scenario(case, of, sample_motion(held, of), 0)["E1"]

    costs = [cost_at(f) for f in np.linspace(0.8, 1.2, 9)]
    assert max(costs) == pytest.approx(max(costs[0], costs[-1]))
    assert max(costs) == pytest.approx(found.total, rel=1e-4)  # trapezoids
    assert np.all(np.diff(costs, 2) > 0)
    nominal = [cost_at(f, three.alone[0].solution) for f in (0.8, 1.0, 1.2)]
    assert found.total < max(nominal)
    assert cost_at(1.0) > nominal[1]


def model_with(effect, *estimates) -> CalibratedModel:
    robot = load_robot("rrr")
    zero = np.zeros(robot.n)
    terms = (Term(effect, estimates),)
    return CalibratedModel(robot, "rrr", "", PAPER.tool, "load", (None,) * robot.n, "nominal", terms, zero, zero)


def test_parameters_of_a_model_lie_anywhere_in_their_intervals():
    kind = CATALOGUE["gravity_tilt"]
    effect = kind(())
    estimates = tuple(Estimate(0.01, 0.002, (0.006, 0.014)) for _ in effect.parameters)
    model = model_with(effect, *estimates)
    base = repaired(CoDesign(PAPER, spring_bounds(PAPER, "PEA")), model, ("", ""))
    label = f"{base.model.label(effect)}.{effect.parameters[0].name}"
    together = TaskSet("set", (PAPER,), np.ones(1), payload=0.1, model=(label,))
    design = with_uncertainty(base, together, model)
    at = design.problem.parameters.index(f"known {label}")
    assert {(s.payload, s.theta) for s in design.scenarios} == {
        (factor, ((at, end),)) for factor in (0.9, 1.1) for end in (0.006, 0.014)
    }
    assert design.problem.groups == (0,) * 4
    with pytest.raises(UserError, match=r"uncertain.model: unknown parameter 'gone'; allowed are gravity_tilt.*about_x"):
        with_uncertainty(base, replace(together, model=("gone",)), model)
    with pytest.raises(UserError, match="needs --model and --repaired"):
        with_uncertainty(base, together, None)


def test_the_bundled_set_is_what_it_says():
    assert len(TWELVE.tasks) == 12
    assert TWELVE.tasks[0].payload == PAPER.payload
    np.testing.assert_array_equal(TWELVE.tasks[0].release, PAPER.release)
    assert {task.payload for task in TWELVE.tasks} >= {2.0, 8.0}
    assert len({task.name for task in TWELVE.tasks}) == 12


BASE = {"format": "rrr_oc-tasks/1", "base": "paper", "tasks": [{"name": "a"}, {"name": "b", "payload_kg": 3.0}]}


def set_file(folder: Path, **changes) -> str:
    (folder / "set.json").write_text(json.dumps(BASE | changes))
    return str(folder / "set.json")


def other_task(folder: Path, **changes) -> str:
    content = json.loads((Path(steps.__file__).parents[1] / "data" / "paper.json").read_text()) | changes
    (folder / "other.json").write_text(json.dumps(content))
    return "other.json"


def with_other(folder: Path, **changes) -> str:
    return set_file(folder, tasks=[{"name": "a"}, {"task": other_task(folder, **changes)}])


SPRING = {"effect": "parallel_spring", "joint": "joint2", "stiffness_Nm_per_rad": [0, 1], "equilibrium_deg": [0, 90]}


def other_shop(folder: Path) -> str:
    content = {"format": "rrr_oc-catalogue/1", "parallel_springs_Nm_per_rad": {"joint2": [5.0]}}
    (folder / "shop.json").write_text(json.dumps(content))
    return str(folder / "shop.json")


BAD = {
    "no tasks": (lambda f: [set_file(f, tasks=[])], "tasks: found []; a list with at least one entry is required"),
    "unknown key": (lambda f: [set_file(f, weights=[1])], "unknown key 'weights'; allowed are format, tasks, base, name"),
    "weight": (lambda f: [set_file(f, tasks=[{"weight": 0}])], "tasks[0].weight: found 0; a finite number above 0 is required"),
    "objective": (lambda f: [set_file(f, objective="mean")], "objective: found 'mean'; allowed are 'sum', 'worst'"),
    "share": (lambda f: [set_file(f, uncertain={"payload": 1.2})], "uncertain.payload: found 1.2"),
    "same name": (lambda f: [set_file(f, tasks=[{"name": "a"}, {"name": "a"}])], "tasks[1].name: 'a' stands twice"),
    "no base": (
        lambda f: [set_file(f, base=None)],
        "tasks[0]: key 'task' is missing; it is required where the set has no 'base'",
    ),
    "gone": (lambda f: [set_file(f, tasks=[{"task": "gone.json"}])], "tasks[0]: no task at"),
    "durations": (lambda f: [set_file(f, tasks=[{"duration_s": [2, 1]}])], "tasks[0].duration_s: bounds are crossed: 2 … 1"),
    "too short": (
        lambda f: [set_file(f, tasks=[{"duration_s": [0.2, 0.5]}])],
        "tasks[0]: the task cannot be done: joint2 needs",
    ),
    "reach": (
        lambda f: [set_file(f, tasks=[{"release": {"position_m": [0.7, 0, 0.07]}}])],
        "tasks[0]: release at [0.7, 0.0, 0.07] m is out of reach",
    ),
    "joints": (
        lambda f: [
            with_other(f, moving=["joint2"], limits={}, springs=[], start={"angles_deg": [60]}, release={"angles_deg": [50]})
        ],
        "tasks[1]: found joint2 in the place of joint2, joint3; the moving joints must be those of the first task",
    ),
    "springs": (lambda f: [with_other(f, springs=[SPRING])], "tasks[1]: the springs must be those of the first task"),
    "too uncertain": (
        lambda f: [set_file(f, uncertain={"model": list("abcde")})],
        "uncertain: found 5 quantities; at most 4 are",
    ),
    "model": (lambda f: [set_file(f, uncertain={"model": ["x"]})], "uncertain.model: x needs --model and --repaired"),
    "format": (lambda f: [set_file(f, format="rrr_oc-tasks/2")], "format: found 'rrr_oc-tasks/2'; allowed is 'rrr_oc-tasks/1'"),
    "catalogue": (lambda f: [set_file(f), "--catalogue", "gone.json"], "no catalogue at 'gone.json'"),
    "catalogue without springs of these joints": (
        lambda f: [set_file(f), "--configurations", "PEA", "--catalogue", other_shop(f)],
        "has no parallel spring for joint3",
    ),
    "front of a task": (lambda f: ["paper", "--front", "2"], "--front is 2; it needs a set of tasks, and paper is a task"),
    "front of the worst": (
        lambda f: [set_file(f, objective="worst"), "--front", "2"],
        "--front needs a set whose objective is 'sum'",
    ),
}


@pytest.mark.parametrize(("arguments", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_one_sentence_before_the_first_solve(monkeypatch, capsys, tmp_path, arguments, message):
    monkeypatch.setattr(steps, "solve_multistart", lambda *a: pytest.fail("it began to solve"))
    out = tmp_path / "out"
    assert rrr_oc(monkeypatch, "design", *arguments(tmp_path), "--out", str(out)) == 2
    told = capsys.readouterr().err.strip()
    assert told.startswith("Error: ")
    assert message in told
    assert len(told.splitlines()) == 1
    assert not out.exists()


TINY = ["--configurations", "PEA", "--starts", "1", "--motions", "0", "--tolerance", "1e-2", "--jobs", "1", "--front", "1"]


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    """The folder of a small set, whose first run was interrupted after the tasks alone."""
    folder = tmp_path_factory.mktemp("sets")
    command = ["design", set_file(folder, uncertain={"payload": 0.1}), *TINY, "--out", str(folder / "out")]

    def interrupted(*_):
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(steps, "solve_set", interrupted)
        assert rrr_oc(patch, *command) == 130
    before = {path.name: path.stat().st_mtime_ns for path in (folder / "out").glob(".PEA alone *")}
    assert len(before) == 4
    assert not (folder / "out" / "summary.json").exists()
    with pytest.MonkeyPatch.context() as patch:
        assert rrr_oc(patch, *command) == 0
    assert before == {path.name: path.stat().st_mtime_ns for path in (folder / "out").glob(".PEA alone *")}
    return folder / "out"


def test_a_summary_says_what_was_asked_and_found(out):
    summary = json.loads((out / "summary.json").read_text())
    assert [t["name"] for t in summary["tasks"]] == ["a", "b"]
    assert summary["uncertain"] == {"payload": 0.1, "model": [], "over": "calibrated"}
    assert summary["objective"] == "sum"
    for name, c in summary["configurations"].items():
        assert c["cost"] == pytest.approx(sum(t["cost"] for t in c["tasks"].values()))
        assert c["cost"] >= c["alone"] * (1 - 1e-2)
        for i, task in enumerate(c["tasks"].values(), 1):
            with np.load(out / f"{name}_{i}.npz") as m:
                parts = [np.trapezoid(m["tau_load"][:, k] ** 2, m["t"][k]).sum() for k in (m["phase"] == 0, m["phase"] == 1)]
            assert sum(parts) == pytest.approx(task["E1"], rel=1e-6)
            assert task["mujoco"]["E1"] == pytest.approx(task["E1"], rel=1e-2)  # steps of 1 to 2 ms
            assert task["cost"] == pytest.approx(max(s["E1"] for s in task["scenarios"]), rel=2e-3)
            for s in task["scenarios"]:
                assert s["mujoco"] == pytest.approx(s["E1"], rel=1e-2)


def test_the_front_goes_from_the_set_to_its_first_task(out):
    c = json.loads((out / "summary.json").read_text())["configurations"]["PEA"]
    shares, first, total = zip(*((p["share"], p["first"], p["total"]) for p in c["front"]), strict=True)
    assert shares == (0.0, 0.5, 1.0)
    assert total[0] == pytest.approx(c["cost"])
    assert total[0] <= total[1] * (1 + 1e-2)
    assert first[1] <= first[0] * (1 + 1e-2)  # meshes of their own, to 1e-2
    assert first[2] == c["tasks"]["a"]["with_first"]


def test_report_page_and_figures_are_there(out):
    text, page = (out / "report.md").read_text(), (out / "report.html").read_text()
    for words in (
        "One set of springs for 2 tasks",
        "payloads within ±10 %",
        "Scenarios of PEA",
        "Between the set and its first task",
    ):
        assert words in text
    assert "springs of the first task" in page
    assert {path.name for path in out.glob("*.png")} == {"tasks.png", "front.png"}


def test_a_repeated_command_solves_nothing(out, monkeypatch, capsys):
    before = json.loads((out / "summary.json").read_text())
    monkeypatch.setattr(steps, "solve_set", lambda *a: pytest.fail("it solved again"))
    assert rrr_oc(monkeypatch, "design", str(out.parent / "set.json"), *TINY, "--out", str(out), "--json") == 0
    assert json.loads(capsys.readouterr().out)["configurations"] == before["configurations"]


def test_the_springs_of_a_set_are_read_again(out):
    springs = saved_springs(out / "summary.json", "PEA", PAPER)
    found = json.loads((out / "summary.json").read_text())["configurations"]["PEA"]["parameters"]
    assert {PAPER.model().label(effect): theta for effect, theta in springs.mounted} == found


def test_springs_for_a_set_can_be_bought(monkeypatch, tmp_path):
    """An arm with one spring and two tasks: the starred design has a spring of the catalogue, and is compared with what is made."""
    own_task(tmp_path)
    content = {"format": "rrr_oc-tasks/1", "base": "task.json", "tasks": [{"name": "a"}, {"name": "b", "payload_kg": 0.5}]}
    (tmp_path / "set.json").write_text(json.dumps(content))
    shop = {"format": "rrr_oc-catalogue/1", "parallel_springs_Nm_per_rad": {"j2": [5.0, 8.0]}}
    (tmp_path / "shop.json").write_text(json.dumps(shop))
    out, given = tmp_path / "out", [*OWN, "--configurations", "PEA", "--catalogue", str(tmp_path / "shop.json")]
    assert rrr_oc(monkeypatch, "design", str(tmp_path / "set.json"), *given, "--out", str(out)) == 0
    found = read_json(out / "summary.json", DesignFile).configurations
    made, bought = found["PEA"], found["PEA*"]
    assert bought.springs["k_p2"] in (5.0, 8.0)
    assert bought.catalogue is not None
    assert (bought.catalogue.combinations, bought.catalogue.left) == (2, 0)
    assert bought.catalogue.gap == pytest.approx(bought.cost / made.cost - 1)
    assert bought.cost >= made.cost * (1 - 1e-2)  # the meshes' tolerance
    assert bought.cost == pytest.approx(sum(m.cost for m in bought.tasks.values()))
    for task, moved in bought.tasks.items():
        assert moved.alone == made.tasks[task].alone
        assert pytest.approx(moved.E1, rel=1e-2) == moved.mujoco.E1
    assert "To buy for PEA*: a spring of" in (out / "report.html").read_text()

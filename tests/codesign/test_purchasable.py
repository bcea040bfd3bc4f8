"""The catalogue search against brute force by separate searches, all choices of the bundled one, and bad input."""

import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rrr_oc.codesign import purchasable
from rrr_oc.codesign.catalogue import Catalogue, choices_of, load_catalogue
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.purchasable import CatalogueResult, search_catalogue
from rrr_oc.codesign.search.multistart import SearchResult, continue_from, solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.codesign.task_sets.set_search import joint_optimum
from rrr_oc.codesign.task_sets.task_set import SetDesign, TaskSet
from rrr_oc.errors import UserError
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.optimal_control.solver import SolverFailure

TASK = load_task("paper")
OPTIONS = SearchOptions(
    starts=2, coarse=10, fine=12, widths=(0.01,), refinement=Refinement(1e-2, rounds=0), kept=2, within=0.0, motions=0
)
PARALLEL = {"joint2": (5.0, 13.0), "joint3": (0.3, 1.1)}
# k_b and r_1² both times four is the same to the arm: four combinations, three distinct ones
BIARTICULAR = {"k_b": (3.0, 12.0), "r_1": (0.014, 0.028), "r_2": (0.036,), "r_3": (0.014,)}


def continuous(configuration: str) -> SearchResult:
    return solve_multistart(CoDesign(TASK, spring_bounds(TASK, configuration)), OPTIONS)


def shop(result: SearchResult, parallel=None, biarticular=None, **options) -> CatalogueResult:
    catalogue, settings = (
        Catalogue("tiny", {"PEA": parallel or {}, "BPEA": biarticular or {}}),
        options.pop("settings", OPTIONS),
    )
    return search_catalogue(SetDesign.of_one(result.design), result.best.solution, catalogue, settings, **options)


@pytest.fixture(scope="module")
def pea() -> SearchResult:
    return continuous("PEA")


@pytest.fixture(scope="module")
def bpea() -> SearchResult:
    return continuous("BPEA")


@pytest.fixture(scope="module")
def counted() -> list[int]:
    """What `progress` was told."""
    return []


@pytest.fixture(scope="module")
def bought_pea(pea, counted) -> CatalogueResult:
    return shop(pea, PARALLEL, progress=counted.append)


@pytest.fixture(scope="module")
def bought_bpea(bpea) -> CatalogueResult:
    return shop(bpea, biarticular=BIARTICULAR)


def brute_force(result: SearchResult, names: list[str], lists: list[tuple[float, ...]], free: tuple[str, ...]):
    """(cost, hardware), best first: every combination held in turn and searched for itself, from starts of its own."""
    found = []
    for values in itertools.product(*lists):
        hardware = dict(zip(names, values, strict=True))
        held = result.design.with_fixed(hardware, free)
        found.append((solve_multistart(held, OPTIONS).best.solution.cost, hardware))
    return sorted(found, key=lambda row: row[0])


def test_parallel_springs_against_brute_force(pea, bought_pea):
    """On 12 intervals two optima 0.9 % apart compete for the motion; from other starts either may come out."""
    table = brute_force(pea, ["k_p2", "k_p3"], list(PARALLEL.values()), ("q_eq2", "q_eq3"))
    for (cost, hardware), found in zip(table[:2], bought_pea.runners_up, strict=False):
        assert {k: found[k] for k in hardware} == pytest.approx(hardware)
        assert found["cost"] == pytest.approx(cost, rel=1e-2)  # neighbouring optima in the duration of go
    assert bought_pea.optimum.solution.cost == bought_pea.runners_up[0]["cost"]
    assert {k: bought_pea.hardware[k] for k in table[0][1]} == pytest.approx(table[0][1])
    held = dict(zip(bought_pea.design.problem.parameters, bought_pea.design.problem.p_lower, strict=True))
    assert [v for k, v in held.items() if k.endswith("stiffness")] == pytest.approx(list(table[0][1].values()))


def test_biarticular_spring_against_brute_force(bpea, bought_bpea):
    cost, hardware = brute_force(bpea, list(BIARTICULAR), list(BIARTICULAR.values()), ("q_0",))[0]
    assert {k: bought_bpea.hardware[k] for k in hardware} == pytest.approx(hardware)
    assert bought_bpea.optimum.solution.cost == pytest.approx(cost, rel=1e-2)  # the flat valley's optima, on 12 intervals
    assert -np.pi <= bought_bpea.hardware["q_0"] <= np.pi


def test_buying_costs_more_than_making(pea, bought_pea):
    assert bought_pea.optimum.solution.cost > pea.best.solution.cost


def test_coverage_adds_up(bought_pea, bought_bpea, counted):
    """Fewer choices than are to be found: each is solved, and the parts that held them."""
    for cover, combinations, distinct in ((bought_pea.coverage, 4, 4), (bought_bpea.coverage, 4, 3)):
        assert (cover.combinations, cover.distinct, cover.single) == (combinations, distinct, distinct)
        assert (cover.excluded, cover.failed, cover.left, cover.margin) == (0, 0, 0, None)
        assert cover.solved == 2 * distinct - 1  # the nodes of a binary tree with so many leaves
    assert counted == sorted(counted)
    assert counted[-1] == bought_pea.coverage.solved


def test_equal_kappa_and_rho_are_one_choice(bought_bpea):
    """Of two that the arm cannot tell apart, the larger r_1 leaves phi = r_1 q_0 / r_2 more room."""
    kappas = sorted(r["k_b"] * (r["r_2"] / r["r_1"]) ** 2 for r in bought_bpea.runners_up)
    assert kappas == pytest.approx([3 * (36 / 28) ** 2, 3 * (36 / 14) ** 2, 12 * (36 / 14) ** 2], rel=1e-6)
    twin = next(r for r in bought_bpea.runners_up if r["k_b"] * (r["r_2"] / r["r_1"]) ** 2 == pytest.approx(kappas[1]))
    assert (twin["k_b"], twin["r_1"]) == (12.0, 0.028)
    (held,) = bought_bpea.design.springs
    assert held.fixed["k_b"] == bought_bpea.hardware["k_b"]


def test_values_outside_the_tasks_bounds_are_left_out(pea):
    bought = shop(pea, {"joint2": (9.0, 40.0), "joint3": (0.3,)})
    assert bought.coverage.combinations == 1
    assert bought.hardware["k_p2"] == pytest.approx(9.0)


def test_no_excluded_choice_is_better(pea):
    """All shoulder springs of the bundled catalogue with one for the elbow, each solved for itself from the continuous optimum."""
    lists = {"joint2": load_catalogue().lists["PEA"]["joint2"], "joint3": (0.8755,)}
    bought = shop(pea, lists)
    cover = bought.coverage
    assert (cover.distinct, cover.failed, cover.left) == (17, 0, 0)
    assert cover.excluded == 17 - cover.single > 0
    held = [pea.design.with_fixed({"k_p2": k, "k_p3": 0.8755}, ("q_eq2", "q_eq3")) for k in lists["joint2"]]
    guess = pea.best.solution.guess()
    starts = [replace(guess, parameters=np.clip(guess.parameters, d.problem.p_lower, d.problem.p_upper)) for d in held]
    every = sorted(o.cost for _, o in continue_from(list(zip(held, starts, strict=True)), OPTIONS))
    assert len(every) == 17
    np.testing.assert_allclose([r["cost"] for r in bought.runners_up[:4]], every[:4], rtol=1e-4)  # the next have two optima
    assert every[cover.single] >= bought.optimum.cost * (1 + cover.margin) * (1 - 1e-4)  # bounds and costs are IPOPT's to 1e-8


def test_a_search_that_is_not_let_finish_says_what_is_left(pea, monkeypatch):
    monkeypatch.setattr(purchasable, "MOST", 5)
    monkeypatch.setattr(purchasable, "BATCH", 1)
    cover = search_catalogue(SetDesign.of_one(pea.design), pea.best.solution, load_catalogue(), OPTIONS).coverage
    assert cover.solved == 5
    assert cover.left == 51 - cover.single > 0
    assert cover.excluded == 0


def test_a_search_without_a_solution_fails(pea, monkeypatch):
    monkeypatch.setattr(purchasable, "ACCEPTED", ())
    with pytest.raises(SolverFailure, match="no choice of the catalogue could be solved"):
        shop(pea, {"joint2": (5.0,), "joint3": (0.3,)})


def test_halves_share_nothing_and_lose_nothing(bpea):
    """Down to single choices, whatever the optimum; with a parameter between two sizes, they end up on different sides."""
    choices, rng = choices_of(SetDesign.of_one(bpea.design), load_catalogue()), np.random.default_rng(0)
    parts, seen = [choices.every], []
    while parts and len(seen) < 200:
        (kinds,) = parts.pop()
        if kinds.size == 1:
            seen.append(int(kinds[0]))
            continue
        lower, upper = choices.between((kinds,))
        below, above = choices.halves((kinds,), rng.uniform(lower, upper))
        assert sorted([*below[0], *above[0]]) == sorted(kinds)
        assert below[0].size > 0
        assert above[0].size > 0
        parts += [below, above]
    assert len(set(seen)) == 200
    kappa = 85.0
    below, above = choices.halves(choices.every, np.array([kappa, choices.bounds[0][0][0, 1], 0.0]))
    sizes = choices.bounds[0][0][:, 0]
    assert sizes[below[0]].max() < kappa < sizes[above[0]].min()


@pytest.mark.parametrize(
    "lists",
    [
        {"k_b": (9.0, 13.0), "r_1": (0.014,), "r_2": (0.036,), "r_3": (0.014,)},
        {"k_b": (13.0,), "r_1": (0.014,), "r_2": (0.036,), "r_3": (0.014,)},
    ],
    ids=["one rho", "one of each"],
)
def test_a_short_list(bpea, lists):
    """A shop with one pulley is still a shop."""
    best = shop(bpea, biarticular=lists)
    assert best.hardware["k_b"] == 13.0  # the stiffest: the continuous optimum is at k_b's upper bound
    assert best.hardware["r_3"] == 0.014
    assert best.coverage.single == len(lists["k_b"])


def test_a_catalogue_without_anything_that_fits_is_explained(pea, bpea):
    with pytest.raises(UserError, match=r"'tiny' has no parallel spring for joint3 within the task's bounds"):
        shop(pea, {"joint2": (9.0,)})
    with pytest.raises(UserError, match=r"no parallel spring for joint3"):
        shop(pea, {"joint2": (9.0,), "joint3": (70.0,)})
    with pytest.raises(UserError, match="'tiny' has no biarticular spring for joint2 and joint3"):
        shop(bpea, PARALLEL)


@pytest.mark.parametrize("name", ["k_b", "r_1", "r_2", "r_3"])
def test_pulleys_outside_the_bounds_are_explained(bpea, name):
    with pytest.raises(UserError, match=name):
        shop(bpea, biarticular=BIARTICULAR | {name: (99.0,)})


def test_the_prototypes_catalogue():
    """facts.md: springs i·2.057 + j·3.4263 with i ≤ 5, j ≤ 4 up to 13.7052, and each pulley with 1 mm of cable."""
    catalogue = load_catalogue()
    values = {round(i * 2.057 + j * 3.4263, 4) for i in range(6) for j in range(5)} - {0.0}
    assert set(catalogue.lists["PEA"]["joint2"]) == {v for v in values if v <= 13.7052 + 1e-9}
    assert catalogue.lists["PEA"]["joint3"] == (0.6589, 0.8755, 1.318)
    pulleys = [d + 1 for d in (13, 13.5, 14, 18, 18.5, 19, 20.5, 21, 22, 28, 28.5, 38)]
    assert catalogue.lists["BPEA"]["r_1"] == catalogue.lists["BPEA"]["r_3"] == pytest.approx(tuple(d / 1000 for d in pulleys))
    assert catalogue.lists["BPEA"]["r_2"] == pytest.approx(tuple((d + 1) / 1000 for d in (18, 21, 22, 22.5, 25, 26, 27, 35)))


GOOD = {
    "format": "rrr_oc-catalogue/1",
    "parallel_springs_Nm_per_rad": {"joint2": [2, 1]},
    "biarticular_spring": {"k_b_Nm_per_rad": [1], "r_1_mm": [14], "r_2_mm": [20], "r_3_mm": [20]},
}


def written(folder: Path, **changes) -> Path:
    file = folder / "shop.json"
    file.write_text(json.dumps(GOOD | changes))
    return file


def test_a_catalogue_file(tmp_path):
    catalogue = load_catalogue(written(tmp_path, name="corner shop"))
    assert catalogue == Catalogue(
        "corner shop",
        {"PEA": {"joint2": (1.0, 2.0)}, "BPEA": {"k_b": (1.0,), "r_1": (0.014,), "r_2": (0.02,), "r_3": (0.02,)}},
    )


WRONG = {
    "unknown key": ({"colour": 1}, "unknown key 'colour'"),
    "other format": ({"format": "x"}, "rrr_oc-catalogue/1"),
    "no list": ({"parallel_springs_Nm_per_rad": {"joint2": 3}}, "joint2: found 3; a list with at least one entry"),
    "empty list": ({"parallel_springs_Nm_per_rad": {"joint2": []}}, r"joint2: found \[\]; a list with at least one entry"),
    "negative": ({"parallel_springs_Nm_per_rad": {"joint2": [-3]}}, r"joint2\[0\]: found -3; a finite number above 0"),
    "unknown pulley": ({"biarticular_spring": {"r_9_mm": [1]}}, "unknown key 'r_9_mm'"),
    "list of springs": ({"parallel_springs_Nm_per_rad": [1, 2]}, "parallel_springs_Nm_per_rad"),
    "pulleys missing": ({"biarticular_spring": {"k_b_Nm_per_rad": [1]}}, "r_1_mm"),
}


@pytest.mark.parametrize(("changes", "message"), WRONG.values(), ids=WRONG.keys())
def test_a_wrong_catalogue_is_explained(tmp_path, changes, message):
    with pytest.raises(UserError, match=message):
        load_catalogue(written(tmp_path, **changes))


def test_a_wrong_catalogue_file_is_explained(tmp_path):
    with pytest.raises(
        UserError, match="no catalogue at 'nowhere'; give the path of a JSON file or the name of a bundled one: prototype"
    ):
        load_catalogue("nowhere")
    file = tmp_path / "shop.json"
    for content in (b"{", b"[]", b"\xff\xfe"):
        file.write_bytes(content)
        with pytest.raises(UserError):
            load_catalogue(file)


def test_the_best_of_a_catalogue_for_two_tasks_is_that_of_all_joint_problems():
    """Each choice held in turn; the catalogue's choice for both tasks is not that for either alone by accident of the search."""
    tasks = TaskSet("two", (TASK, replace(TASK, name="light", payload=1.0)), np.ones(2))
    design = SetDesign(tasks, tuple(CoDesign(task, spring_bounds(task, "PEA")) for task in tasks.tasks))
    motions = [solve_multistart(one, OPTIONS).best.solution for one in design.designs]
    guess = design.guess([s.guess() for s in motions], motions[0].parameters)
    start = joint_optimum(design, guess, OPTIONS)
    assert start is not None
    lists, names, free = ((4.0, 9.0, 13.0), (0.3, 1.1)), ("k_p2", "k_p3"), ("q_eq2", "q_eq3")
    bought = search_catalogue(
        design, start.solution, Catalogue("tiny", {"PEA": dict(zip(("joint2", "joint3"), lists, strict=True))}), OPTIONS
    )
    costs = {}
    for values in itertools.product(*lists):
        held = design.with_fixed(dict(zip(names, values, strict=True)), free)
        found = joint_optimum(held, start.solution.guess(), OPTIONS)
        assert found is not None
        costs[values] = found.cost
    best = min(costs, key=lambda values: costs[values])
    assert tuple(bought.hardware[name] for name in names) == best
    assert bought.optimum.cost == pytest.approx(costs[best], rel=1e-4)  # IPOPT's barrier on the same mesh
    assert bought.optimum.cost >= start.cost * (1 - 1e-6)

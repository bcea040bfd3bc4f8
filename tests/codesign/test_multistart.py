"""The multistart on coarse meshes: reproducible, honest about what it found, and clear about what it did not."""

import gc
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from small_searches import OPTIONS, PEA, TASK, design_of

from rrr_oc.codesign.certificate import certify
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import embedded
from rrr_oc.codesign.search import coarse, multistart
from rrr_oc.codesign.search.coarse import SEVERAL, Springs, alike, coarse_search
from rrr_oc.codesign.search.local_optima import follow_to_fine_mesh, moving_apart, same_optimum
from rrr_oc.codesign.search.motions import Covered, MotionSearch
from rrr_oc.codesign.search.multistart import SHARES, SearchResult, solve_multistart
from rrr_oc.codesign.search.proposals import decode, dimensions, motion_guess
from rrr_oc.codesign.search.starts import Polisher, Start, layers, polish
from rrr_oc.codesign.springs import arrangements
from rrr_oc.codesign.task import load_task
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.optimal_control.solver import SolverFailure
from rrr_oc.optimal_control.transcription import Transcription
from rrr_oc.parallel import KEPT, once_per_process, workers
from rrr_oc.progress import Progress


@pytest.fixture(scope="module")
def found() -> SearchResult:
    return solve_multistart(PEA, OPTIONS)


def fingerprint(result: SearchResult) -> list[tuple[str, float]]:
    return sorted((s.layer, s.polished) for s in result.starts)


def test_the_best_is_the_known_optimum(found):
    """66.75 converged (facts.md); a mesh tolerance of 1e-3 and 12 to 48 intervals read up to 0.5 % lower."""
    assert found.best.solution.cost == pytest.approx(66.75, rel=5e-3)
    assert not found.interrupted


def test_every_start_is_polished_and_both_layers_take_part(found):
    """Half of the starts a layer; no polished cost is above its own proposal's feasible neighbour, all are finite here."""
    assert [s.layer for s in found.starts].count("sobol") == 3
    assert [s.layer for s in found.starts].count("cma-es") == 3
    assert all(np.isfinite(s.polished) and s.w.size for s in found.starts)
    assert {s.message for s in found.starts} == {"Solve_Succeeded"}


def test_layers_count_what_the_starts_say(found):
    rows = layers(found.starts)
    for layer, row in rows.items():
        starts = [s for s in found.starts if s.layer == layer]
        costs = sorted(s.polished for s in starts)
        assert (row["starts"], row["failed"], row["best"]) == (3, 0, costs[0])
        assert row["median"] == costs[1]
        assert row["best_proposal"] == min(s.proposed for s in starts)
    lost = Start("sobol", 1.0, float("inf"), "Infeasible_Problem_Detected", 0.1, np.empty(0))
    rows = layers((lost, *found.starts))
    assert (rows["sobol"]["starts"], rows["sobol"]["failed"]) == (4, 1)
    assert layers((lost,))["sobol"]["best"] == float("inf")


def test_odd_starts_go_to_sobol_and_one_start_is_enough():
    result = solve_multistart(PEA, replace(OPTIONS, starts=1, within=0.0))
    assert [s.layer for s in result.starts] == ["sobol"]
    assert list(layers(result.starts)) == ["sobol"]


def test_optima_are_distinct_and_sorted(found):
    """Any two differ visibly in cost, durations, springs or path, by the thresholds that `same_optimum` states."""
    costs = [o.solution.cost for o in found.optima]
    assert costs == sorted(costs)
    assert sum(o.reached for o in found.optima) <= [s.layer for s in found.starts].count("sobol")
    for i, a in enumerate(found.optima):
        for b in found.optima[:i]:
            apart = abs(a.solution.cost - b.solution.cost) > 2e-3 * abs(b.solution.cost)
            apart |= bool(np.abs(a.solution.durations - b.solution.durations).max() > 0.03)
            apart |= bool(np.any(np.abs(a.solution.parameters - b.solution.parameters) > 0.01 * PEA.problem.p_scale))
            s = np.linspace(0, 1, 200)
            paths = [np.abs(a.solution.at(k, s)[0][:2] - b.solution.at(k, s)[0][:2]).max() > 0.029 for k in (0, 1)]
            assert apart or any(paths)
    assert all(same_optimum(o.solution, o.solution) for o in found.optima)


def test_the_result_depends_on_the_seed_alone(found):
    """Neither on the run nor on the number of processes."""
    again = solve_multistart(PEA, OPTIONS)
    assert fingerprint(again) == fingerprint(found)
    assert again.best.solution.cost == found.best.solution.cost
    other = solve_multistart(PEA, replace(OPTIONS, seed=1, starts=2))
    assert fingerprint(other) != fingerprint(found)[:2]


def test_the_result_does_not_depend_on_the_number_of_processes(found):
    with workers(2):
        parallel = solve_multistart(PEA, OPTIONS)
    assert fingerprint(parallel) == fingerprint(found)
    assert parallel.best.solution.cost == found.best.solution.cost
    np.testing.assert_array_equal(parallel.best.solution.w, found.best.solution.w)


@pytest.mark.parametrize("change", [{"coarse": 6}, {"width": 0.4}, {"scheme": "hermite-simpson"}], ids=lambda c: next(iter(c)))
def test_options_are_heeded_when_the_same_design_is_searched_again(change):
    """What a process keeps from an earlier search must not leak into the next."""
    design, few = design_of("PEA"), replace(OPTIONS, starts=1, within=0.0)
    solve_multistart(design, few)
    other, fresh = solve_multistart(design, replace(few, **change)), solve_multistart(design_of("PEA"), replace(few, **change))
    assert fingerprint(other) == fingerprint(fresh)


def test_a_design_at_a_recycled_address_is_not_taken_for_the_old_one():
    """Worker processes outlive a search, and Python hands the `id` of a design that is gone to a new one."""
    few = replace(OPTIONS, starts=4, within=0.0)
    loaded, empty = design_of("SA"), replace(TASK, payload=0.0)
    address = id(loaded)
    with workers(2):
        assert min(s.polished for s in solve_multistart(loaded, few).starts) > 500  # facts.md: 563
    del loaded
    gc.collect()
    others: list[CoDesign] = []
    while id(others[-1] if others else None) != address and len(others) < 20_000:
        others.append(CoDesign(empty, ()))
    with workers(2):
        assert max(s.polished for s in solve_multistart(others[-1], few).starts) < 100  # 72 without payload


def test_the_best_motions_never_lose():
    """Neither the whole search, nor each phase alone with the springs of an optimum."""
    without, with_them = (solve_multistart(PEA, replace(OPTIONS, starts=1, within=0.0, motions=n)) for n in (0, 8))
    assert with_them.best.cost <= without.best.cost * (1 + 1e-3)  # refined on other meshes, each to 1e-3
    assert without.covered == Covered()
    assert with_them.covered.springs >= 2
    assert (
        with_them.covered.motions >= 2 * 8 + with_them.covered.swings
    )  # eight proposed ones for each phase, and what they led to
    springs = with_them.best.solution.parameters
    motions = MotionSearch(PEA, replace(OPTIONS, motions=8)).best(springs, skip=0)
    assert sum(some[0].cost for some in motions) <= with_them.best.cost * (1 + 0.02)  # on the fine mesh of 12 intervals
    for phase, some in enumerate(motions):
        costs = [o.cost for o in some]
        assert costs == sorted(costs)
        np.testing.assert_array_equal(some[0].solution.parameters, springs)
        ends = some[0].solution.at(0, np.array([0.0, 1.0]))[0][:2].T
        np.testing.assert_allclose(ends, TASK.ends(phase), atol=1e-9)


def test_the_best_optimum_is_one_that_was_refined(monkeypatch):
    """A finer mesh may make the best one worse than another, which was too far away to be refined until then."""
    finer = {1.0: 1.05, 1.02: 1.03, 1.2: 1.1}

    def refined(calls):
        return [SimpleNamespace(cost=finer[o.cost], meshes=[{}, {"converged": True}]) for _, _, o in calls]

    monkeypatch.setattr(multistart, "refined", refined)
    monkeypatch.setattr(multistart, "distinct", lambda optima: sorted(optima, key=lambda o: o.cost))
    optima = [SimpleNamespace(cost=cost, meshes=[{}]) for cost in finer]
    found = multistart._refined_close(PEA, OPTIONS, optima, 12, 1e-3)
    assert [(o.cost, len(o.meshes)) for o in found] == [(1.03, 2), (1.05, 2), (1.2, 1)]


def test_the_motion_of_a_cycle_is_searched_as_a_whole():
    """Its phases share their speeds; its optimum is better than one that stops, and what is proved of those is not said of it."""
    design = design_of("SA", replace(TASK, speeds=("moving", "moving")))
    few = replace(OPTIONS, starts=8, within=0.0, kept=1, springs=1, rounds=1, refinement=Refinement(1e-3, rounds=1))
    result = solve_multistart(design, few)
    (some,) = MotionSearch(design, few).best(np.zeros(0), 0, [[result.best]])
    assert some[0].cost <= result.best.cost * (1 + 1e-2)  # on the fine mesh of 12 intervals
    assert len(some[0].solution.durations) == 2
    assert result.best.cost < 563.228  # the least E1 of a stiff arm that stops
    for solution in (some[0].solution, result.best.solution):
        go, back = (solution.at(i, np.array([0.0, 1.0]))[0][2:] for i in range(2))
        np.testing.assert_allclose(go, back[:, ::-1], atol=1e-6)
    known = certify(result.design, result.best)
    assert known.least is None
    assert known.second_order != "violated"
    assert max(known.primal, known.dual) < 1e-6
    assert any(
        "lower speed limit of joint2" in bound.name for bound in known.active
    )  # which holds where the payload is released


def test_springs_are_told_apart_by_their_torque():
    """The equilibrium of a spring without stiffness, and a thousandth of stiffness, make no difference."""
    values = ([0.0, 1.0, 1.0, 0.1], [0.0, -1.0, 1.0, 0.1], [0.0, 1.0, 1.001, 0.1], [5.0, 1.0, 1.0, 0.1], [5.0, 1.0, 1.0, 1.0])
    optima = [SimpleNamespace(number=i, solution=SimpleNamespace(parameters=np.array(v))) for i, v in enumerate(values)]
    assert [o.number for o in Springs(PEA).others(optima)] == [0, 3, 4]
    torques = [Springs(PEA).torque(o.solution.parameters) for o in optima]
    assert [alike(torques[1], t) for t in torques] == [True, True, True, False, False]


def test_an_infeasible_task_names_the_constraint():
    """Holding the load at the release needs 27.6 Nm of joint 2; it may give 5."""
    task = replace(TASK, torque=np.array([5.0, np.inf]))
    with pytest.raises(SolverFailure, match=r"load torque of joint2 at .* of phase 'go'") as failure:
        solve_multistart(design_of("SA", task), replace(OPTIONS, starts=2))
    assert failure.value.violation > 1
    assert failure.value.status != "Solve_Succeeded"


def test_without_a_compiler_the_optimum_is_the_same(monkeypatch, tmp_path):
    """From the same start; the virtual machine adds in another order."""
    options = replace(OPTIONS, starts=1, motions=0)
    compiled = solve_multistart(design_of("SA"), options).best.solution.cost
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    assert solve_multistart(design_of("SA"), options).best.solution.cost == pytest.approx(compiled, rel=1e-6)
    assert not list(tmp_path.iterdir())  # nothing was compiled


def stopping_after(number: int) -> Callable[[Start], None]:
    seen = []

    def progress(start: Start) -> None:
        seen.append(start)
        if len(seen) == number:
            raise KeyboardInterrupt

    return progress


@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_keeps_what_was_found(jobs):
    with workers(jobs):
        result = solve_multistart(PEA, replace(OPTIONS, starts=4), stopping_after(3))
    assert result.interrupted
    assert len(result.starts) == 3
    assert result.best.solution.cost == pytest.approx(66.75, rel=5e-3)


def test_ctrl_c_while_springs_are_improved_keeps_what_was_found(monkeypatch):
    """The fine mesh is all that follows: no motions are searched for any more."""

    def stop(*_) -> None:
        raise KeyboardInterrupt

    stages: list[str] = []
    monkeypatch.setattr(coarse, "_fitted", stop)
    few = replace(OPTIONS, starts=2, motions=6, springs=4)
    result = solve_multistart(PEA, few, report=lambda step: stages.append(step.stage))
    assert result.interrupted
    assert result.covered.springs == 1
    assert "other springs" in stages
    assert "best motions" not in stages
    assert result.best.cost == pytest.approx(66.75, rel=2e-2)


@pytest.mark.parametrize("step", ["_followed", "_with_best_motions", "_refined_close", "_with_other_swings"])
def test_ctrl_c_after_the_coarse_mesh_keeps_the_best_and_refines_it(monkeypatch, step):
    """Whichever step it interrupts; what follows is not begun, but for the refinement of the best. A second Ctrl-C ends that, too."""
    whole, calls = getattr(multistart, step), []

    def interrupted_once(*arguments):
        calls.append(step)
        if len(calls) == 1:
            raise KeyboardInterrupt
        return whole(*arguments)

    monkeypatch.setattr(multistart, step, interrupted_once)
    few = replace(OPTIONS, starts=2, motions=4, springs=2)
    result = solve_multistart(PEA, few)
    assert result.interrupted
    assert len(result.best.meshes) > 1
    assert result.best.cost == pytest.approx(66.75, rel=2e-2)
    with pytest.raises(KeyboardInterrupt):
        result.whole()


def test_progress_sees_every_start():
    seen: list[Start] = []
    result = solve_multistart(PEA, replace(OPTIONS, starts=3, within=0.0), seen.append)
    assert tuple(seen) == result.starts


def test_proposals_cost_what_their_motion_costs():
    """A start's `proposed` is the guess's own cost: here by the trapezoid rule on the guess."""
    vector = np.random.default_rng(0).random(dimensions(PEA, OPTIONS.via))
    start = polish(*Polisher(PEA, replace(OPTIONS, coarse=40)).proposal("sobol", vector, 0))
    parameters, durations, points = decode(PEA, vector, OPTIONS.via)
    guess, total, s = motion_guess(PEA, parameters, durations, points), 0.0, np.linspace(0, 1, 4001)
    for payload, motion in zip((5.0, 0.0), guess.phases, strict=True):
        x, u = motion.states(s), motion.controls(s)
        tau = np.array(PEA.torques(x[:2], x[2:], u, payload, parameters, np.full(PEA.model.widths.size, OPTIONS.width))[0])
        total += np.trapezoid((tau**2).sum(axis=0), s * motion.duration)
    assert start.proposed == pytest.approx(total, rel=2e-3)  # clipped accelerations have kinks inside the 40 intervals
    assert start.polished < start.proposed


def test_a_process_makes_a_value_once_for_each_piece_of_work():
    """Some keys in turn have a value each; one more replaces that which was not asked for longest, which is made anew when it comes back."""
    made: list[str] = []

    def value_of(key: str) -> list[str]:
        return once_per_process(key, lambda: made.append(key) or [key])

    keys = [f"key {i}" for i in range(KEPT)]
    assert [value_of(key) for key in keys] == [[key] for key in keys]
    assert value_of(keys[0]) is value_of(keys[0])
    value_of("another")
    value_of(keys[0])
    assert made == [*keys, "another"]
    value_of(keys[1])
    assert made == [*keys, "another", keys[1]]


def test_more_springs_are_never_worse():
    """A design starts from the optimum of one with fewer springs, too: there the others are slack, and the cost is the same."""
    few = replace(OPTIONS, starts=1, motions=0)
    inner = design_of("SA")
    solution = solve_multistart(inner, few).best.solution
    for name in ("PEA", "PEA+BPEA"):
        outer = design_of(name)
        guess = embedded(solution, inner, outer)
        assert guess is not None
        start = Transcription(outer.problem, solution.transcription.scheme, solution.transcription.mesh)
        cost = float(start.functions["nlp"](start.pack(guess), outer.data(few.widths[-1]))[0]) * outer.problem.cost_scale
        assert cost == pytest.approx(solution.cost, rel=1e-9)
        found = solve_multistart(outer, few, known=[guess]).best
        assert found.cost < solution.cost
        inner, solution = outer, found.solution
    assert embedded(solution, inner, design_of("PEA")) is None  # it has no spring across the joints


def test_what_slack_springs_differ_in_is_no_other_motion(found):
    """The search tries a motion once, whatever the springs are that have no effect on it; a motion that differs is tried."""
    best = found.best
    solution = best.solution
    w = solution.w.copy()
    w[1] = 0.5 * (w[1] + solution.transcription.bounds[0][1])  # another equilibrium, the motion and its cost as they are
    other = replace(best, solution=replace(solution, w=w))
    assert not same_optimum(solution, other.solution)
    assert moving_apart([best, other], 2) == [best]
    dearer = replace(best, solution=replace(solution, cost=1.01 * solution.cost))
    assert moving_apart([best, other, dearer, dearer], 4) == [best, dearer]
    assert moving_apart([best, dearer], 1) == [best]


def test_what_searches_cover_is_counted_together():
    one, other = MotionSearch(PEA, OPTIONS), MotionSearch(PEA, OPTIONS)
    one.proposed(PEA.problem.p_upper, 4)
    other.proposed(PEA.problem.p_upper, 2)
    other.proposed(PEA.problem.p_lower, 2)
    assert (one.covered, other.covered) == (Covered(1, 8), Covered(2, 8))
    one.join([other])
    assert one.covered == Covered(2, 16)  # the springs that both have tried are counted once


@pytest.fixture(scope="module")
def ways():
    """The paper's parallel springs on either side of their joints; one start of each, and few springs and motions."""
    task = load_task("paper")
    bare = replace(task, springs=tuple({k: v for k, v in spring.items() if k != "active"} for spring in task.springs))
    return [CoDesign(bare, springs) for springs in arrangements(bare, "PEA")], replace(OPTIONS, starts=1, motions=6, springs=6)


def test_all_ways_to_mount_the_springs_compete_on_the_coarse_mesh(ways):
    designs, few = ways
    found = coarse_search(designs, few, Progress(SHARES))
    assert len(found.starts) == len(found.costs) == len(designs) == 4
    assert found.way == int(np.argmin(found.costs))
    assert found.polisher.design is designs[found.way]
    fine = follow_to_fine_mesh(designs[found.way], few, found.optima[0].solution.guess())
    assert fine is not None
    assert found.costs[found.way] <= fine.cost
    assert found.search is not None
    assert 1 < found.search.covered.springs <= few.springs * SEVERAL  # those tried of all ways
    # the published springs pull below their rest, and none other is near
    assert [s.effect.active for s in designs[found.way].springs] == ["below", "below"]
    assert sorted(found.costs)[1] > 1.1 * found.costs[found.way]


def test_a_way_to_mount_the_springs_is_no_dearer_than_what_is_known_of_it(ways):
    designs, few = ways
    bare = replace(few, motions=0)
    best = coarse_search(designs[:1], replace(few, starts=4), Progress(SHARES)).optima[0]
    fine = follow_to_fine_mesh(designs[0], bare, best.solution.guess())
    assert fine is not None
    alone = coarse_search(designs, bare, Progress(SHARES))
    known = coarse_search(designs, bare, Progress(SHARES), [[best.solution.guess()], [], [], []])
    assert known.costs[0] <= fine.cost * (1 + 1e-4)
    assert known.costs[1:] == alone.costs[1:]

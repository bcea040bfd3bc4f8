"""How long co-design takes, step by step.

    python -m pytest tests/benchmarks/bench_*.py --benchmark-columns=median,iqr,rounds

Builds: the model of an arm, and problem with transcription, at 40 intervals a phase, with the generated C in the cache and
without. Solves: one from a fixed start of each configuration, after the build, and the same followed to narrow springs.
Searches: 20 starts on two processes, of one configuration and of all four. Cost, iterations and number of variables stand in
the saved json (`--benchmark-json`) beside each time.
"""

import numpy as np
import pytest

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.multistart import solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions, decode, dimensions, motion_guess
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.scheme import scheme, uniform_mesh
from rrr_oc.optimal_control.solver import Options, Solver
from rrr_oc.optimal_control.transcription import Transcription
from rrr_oc.parallel import workers

INTERVALS = 40
SCHEMES = {"hermite-simpson": scheme("hermite-simpson"), "lobatto-4": scheme("lobatto", 4)}
TASK = load_task("paper")
GOOD = {"SA": 565.0, "PEA": 67.5, "BPEA": 19.5, "PEA+BPEA": 13.6}  # E1 [N²m²s] that 20 starts come below
each_configuration = pytest.mark.parametrize("configuration", GOOD)
each_scheme = pytest.mark.parametrize("method", SCHEMES)


def design_of(configuration: str) -> CoDesign:
    return CoDesign(TASK, spring_bounds(TASK, configuration))


def start_of(design: CoDesign) -> Guess:
    """Springs and durations near the middle of their ranges, straight paths."""
    vector = np.random.default_rng(0).uniform(0.4, 0.6, dimensions(design, 0))
    return motion_guess(design, *decode(design, vector, 0)[:2])


def transcription(configuration: str, method: str) -> Transcription:
    problem = design_of(configuration).problem
    return Transcription(problem, SCHEMES[method], uniform_mesh(problem, INTERVALS), compiled=True)


def test_build_model(benchmark):
    """Task file to inverse dynamics with three springs."""

    def build():
        task = load_task("paper")
        return CoDesign(task, spring_bounds(task, "PEA+BPEA")).model.inverse

    assert benchmark.pedantic(build, rounds=5, warmup_rounds=1).n_out() == 2


@each_scheme
@each_configuration
def test_build_transcription(benchmark, configuration, method):
    """Problem, nonlinear program and all its derivatives, without task and IPOPT."""
    functions = benchmark.pedantic(lambda: transcription(configuration, method).functions, rounds=3, warmup_rounds=1)
    benchmark.extra_info["variables"] = functions["nlp"].size1_in(0)
    assert functions["nlp"].size1_in(0) > 2 * 6 * INTERVALS  # q, dq, ddq of two joints in each interval of two phases


@each_configuration
def test_build_transcription_without_cache(benchmark, configuration, monkeypatch, tmp_path):
    """The same, with the C of both phases compiled first."""

    def fresh():
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        folder.mkdir()
        monkeypatch.setenv("XDG_CACHE_HOME", str(folder))

    benchmark.pedantic(lambda: transcription(configuration, "lobatto-4").functions, setup=fresh, rounds=2)
    for folder in tmp_path.iterdir():
        assert list(folder.rglob("*.so")), "nothing was compiled"


@each_scheme
@each_configuration
def test_solve(benchmark, configuration, method):
    """IPOPT to 1e-8 from the fixed start, smoothing width 0.1 rad as in the search; the program is built before."""
    design = design_of(configuration)
    solver, data = Solver(transcription(configuration, method), Options()), design.data(0.1)
    guess = start_of(design)
    solver.solve(guess, data)
    solution = benchmark.pedantic(lambda: solver.solve(guess, data), rounds=5)
    benchmark.extra_info |= {"cost": solution.cost, "iterations": solution.iterations, "variables": solution.w.size}
    assert solution.status == "Solve_Succeeded"


@each_scheme
@pytest.mark.parametrize("configuration", [c for c in GOOD if c != "SA"])
def test_solve_and_follow(benchmark, configuration, method):
    """The same, then followed to a smoothing width of 0.01 rad."""
    design = design_of(configuration)
    solver, guess = Solver(transcription(configuration, method), Options()), start_of(design)
    widths = [design.data(width) for width in (0.03, 0.01)]

    def both():
        followed = solver.solve(guess, design.data(0.1))
        for data in widths:
            followed = solver.solve(followed, data)
        return followed

    both()
    solution = benchmark.pedantic(both, rounds=5)
    benchmark.extra_info["cost"] = solution.cost
    assert solution.status == "Solve_Succeeded"


def test_search_of_one_configuration(benchmark):
    """20 starts of PEA with refinement to 1e-6, on two processes, these included."""
    with workers(2):
        result = benchmark.pedantic(lambda: solve_multistart(design_of("PEA"), SearchOptions(starts=20)), rounds=1)
    benchmark.extra_info["cost"] = result.best.solution.cost
    assert result.best.solution.cost <= GOOD["PEA"]


def test_search_of_all_configurations(benchmark):
    """Four configurations with 20 starts each, end to end, without catalogue and re-simulation."""

    def all_four():
        return {c: solve_multistart(design_of(c), SearchOptions(starts=20)).best.solution.cost for c in GOOD}

    with workers(2):
        benchmark.extra_info["costs"] = costs = benchmark.pedantic(all_four, rounds=1)
    assert all(costs[c] <= GOOD[c] for c in GOOD)

"""Global search for a co-design: starting points are proposed, polished by IPOPT on a coarse mesh, and the best optima refined."""

import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.local_optima import Optimum, attached, distinct, follow_to_fine_mesh, hopped, refined, transcribed
from rrr_oc.codesign.search.proposals import (
    LAYERS,
    SearchOptions,
    cma_strategy,
    decode,
    dimensions,
    motion_guess,
    proposed_guess,
    sobol_points,
)
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.solver import Options, Solution, Solver, SolverFailure
from rrr_oc.parallel import once_per_process, ordered, unordered

TRIED = 4  # starts for each way to mount the springs; doubled, choosing among them takes twice as long and errs less often


@dataclass(frozen=True)
class Start:
    """A starting point and the optimum that IPOPT found from it.

    Attributes:
        layer: Its source (`LAYERS`).
        proposed: Cost of the starting point itself; its motion may exceed limits.
        polished: Cost after IPOPT, on the coarse mesh; infinite where IPOPT found no optimum.
        message: IPOPT's status.
        seconds: Wall time of the polish [s].
        w: Scaled variables of the optimum on the coarse mesh; empty where there is none.
    """

    layer: str
    proposed: float
    polished: float
    message: str
    seconds: float
    w: np.ndarray


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The result of a multistart.

    Attributes:
        design: The problem.
        optima: Distinct local optima, cheapest first.
        starts: All starting points, in the order of their polishes' ends.
        interrupted: Whether Ctrl-C ended the search early.
    """

    design: CoDesign
    optima: tuple[Optimum, ...]
    starts: tuple[Start, ...]
    interrupted: bool

    @property
    def best(self) -> Optimum:
        """The cheapest optimum."""
        return self.optima[0]

    def whole(self) -> "SearchResult":
        """The result itself; raises `KeyboardInterrupt` if the search was interrupted, so that no partial result is stored."""
        if self.interrupted:
            raise KeyboardInterrupt
        return self

    def layers(self) -> dict[str, dict[str, float]]:
        """By layer: number of starts and of failures, best and median cost, best cost before IPOPT, wall time [s]."""
        rows = {}
        for layer in LAYERS:
            starts = [s for s in self.starts if s.layer == layer]
            costs = [s.polished for s in starts if np.isfinite(s.polished)]
            if starts:
                rows[layer] = {
                    "starts": len(starts),
                    "failed": len(starts) - len(costs),
                    "best": min(costs, default=float("inf")),
                    "median": float(np.median(costs or [np.inf])),
                    "best_proposal": min(s.proposed for s in starts),
                    "seconds": float(sum(s.seconds for s in starts)),
                }
        return rows


class Polisher:
    """Solves the coarse problem from vectors in [0, 1]. Built once a process."""

    def __init__(self, design: CoDesign, options: SearchOptions) -> None:
        self.design, self.options = design, options
        transcription = transcribed(design, options, options.coarse)
        self.solver = Solver(transcription, Options(tolerance=1e-6, iterations=200))
        self.data = design.data(options.width)

    def __call__(self, layer: str, vector: np.ndarray) -> Start:
        """Polish one starting point."""
        transcription = self.solver.transcription
        w = transcription.pack(proposed_guess(self.design, vector, self.options.via))
        cost = float(transcription.functions["nlp"](w, self.data)[0]) * self.design.problem.cost_scale
        try:
            solution = self.solver.solve(w, self.data)
        except SolverFailure as failure:
            return Start(layer, cost, float("inf"), str(failure), 0.0, np.empty(0))
        return Start(layer, cost, solution.cost, solution.status, solution.seconds, solution.w)

    def solution(self, start: Start) -> Solution:
        """The optimum on the coarse mesh that a start led to, without multipliers."""
        empty = np.empty(0)
        return Solution(self.solver.transcription, start.w, empty, empty, start.polished, start.message, 0, 0.0)


def solve_multistart(
    design: CoDesign, options: SearchOptions | None = None, progress: Callable[[Start], None] | None = None
) -> SearchResult:
    """The best co-design from many starting points: every start is polished on a coarse mesh, the distinct optima are solved on a
    fine one, and the best of them refined. Ctrl-C ends the search early with what has been found.

    Args:
        progress: Called with every start that has been polished.

    Raises:
        SolverFailure: No start led to an optimum.
    """
    options = options or SearchOptions()
    polisher = Polisher(design, options)  # compiles the functions before the processes need them
    starts: list[Start] = []
    interrupted = False
    try:
        for start in _polished(design, options):
            starts.append(start)
            if progress:
                progress(start)
    except KeyboardInterrupt:
        interrupted = True
    if not any(s.w.size for s in starts):
        _raise_failure(design, options, starts)
    optima = _best_optima(polisher, starts, interrupted)
    return SearchResult(design, optima, tuple(starts), interrupted)


def best_arranged(designs: Sequence[CoDesign], options: SearchOptions) -> CoDesign:
    """Of designs that differ in how their springs are mounted, the one with the cheapest optimum on the coarse mesh, from the same few
    Sobol points each; without a solve where there is one alone."""
    if len(designs) == 1:
        return designs[0]
    few = replace(options, starts=min(options.starts, TRIED), layers=LAYERS[:1])
    costs = []
    for design in designs:
        Polisher(design, few)  # compiles the functions before the processes need them
        costs.append(min(start.polished for start in _polished(design, few)))
    return designs[int(np.argmin(costs))]


def starts_to_reach(design: CoDesign, options: SearchOptions, target: float) -> tuple[int, Solution | None]:
    """Solve from one Sobol point after the other, each on the fine mesh with the smallest smoothing width, until one costs no more
    than `target`.

    Returns:
        The number of starts, and the solution; None where `options.starts` were not enough.
    """
    polisher = Polisher(design, options)
    for count, vector in enumerate(sobol_points(dimensions(design, options.via), options.starts, options.seed), 1):
        start = polisher(LAYERS[0], vector)
        if not start.w.size or start.polished > 2 * target:  # the coarse mesh and the wide springs change the cost by far less
            continue
        found = follow_to_fine_mesh(design, options, polisher.solution(start).guess())
        if found is not None and found.cost <= target:
            return count, found.solution
    return options.starts, None


def continue_from(starts: list[tuple[CoDesign, Guess]], options: SearchOptions) -> list[tuple[int, Optimum]]:
    """Optima near given starts, each of a problem of its own, on the fine mesh; the cheapest one is refined.

    Returns:
        (index of the start, optimum), cheapest first; starts from which IPOPT found no optimum are missing.
    """
    followed = ordered(follow_to_fine_mesh, [(design, options, guess) for design, guess in starts])
    found = [(i, attached(starts[i][0], options, o)) for i, o in enumerate(followed) if o is not None]
    found.sort(key=lambda pair: pair[1].cost)
    if found:
        index, optimum = found[0]
        found[0] = index, refined(starts[index][0], options, [optimum])[0]
    return found


def _polished(design: CoDesign, options: SearchOptions) -> Iterator[Start]:
    """All starts: first Sobol points, then CMA-ES, which sees the costs after IPOPT and is restarted where it converges."""
    key, size = uuid.uuid4().hex, dimensions(design, options.via)
    half = (options.starts + 1) // 2 if options.layers == LAYERS else options.starts if LAYERS[0] in options.layers else 0

    def polish(layer: str, vectors: Iterable[np.ndarray]) -> Iterator[tuple[int, Start]]:
        return unordered(_polish, [(key, design, options, layer, i, v) for i, v in enumerate(vectors)])

    for _, start in polish("sobol", sobol_points(size, half, options.seed)):
        yield start
    left = options.starts - half
    while left > 0:
        strategy = cma_strategy(size, options, left)
        while left > 0 and not strategy.stop():
            vectors = strategy.ask()
            costs = np.full(len(vectors), np.inf)
            for i, start in polish("cma-es", vectors[:left]):
                costs[i] = start.polished
                yield start
            left -= len(vectors)
            worst = costs[np.isfinite(costs)].max(initial=1e6)
            strategy.tell(vectors, np.where(np.isfinite(costs), costs, 2 * worst).tolist())


def _polish(key: str, design: CoDesign, options: SearchOptions, layer: str, index: int, vector: np.ndarray):
    polisher = once_per_process(key, lambda: Polisher(design, options))
    return index, polisher(layer, vector)


def _raise_failure(design: CoDesign, options: SearchOptions, starts: list[Start]) -> None:
    """No start succeeded: solve from a straight motion at half of all ranges, and let that failure be raised."""
    if not starts:
        raise KeyboardInterrupt
    middle = motion_guess(design, *decode(design, np.full(dimensions(design, options.via), 0.5), options.via)[:2])
    Solver(transcribed(design, options, options.coarse)).solve(middle, design.data(options.width))


def _best_optima(polisher: Polisher, starts: list[Start], interrupted: bool) -> tuple[Optimum, ...]:
    """The distinct optima on a fine mesh, the best of them refined; cheapest first."""
    design, options = polisher.design, polisher.options
    starts = sorted((s for s in starts if s.w.size), key=lambda s: s.polished)
    coarse = distinct(Optimum(polisher.solution(s), [], 1) for s in starts)[: 1 if interrupted else options.kept]
    followed = ordered(follow_to_fine_mesh, [(design, options, o.solution.guess()) for o in coarse])
    pairs = [(o, f) for o, f in zip(coarse, followed, strict=True) if f is not None]
    if not pairs:
        raise SolverFailure("lost on the fine mesh", 0, 0.0, "")
    optima = distinct(replace(attached(design, options, f), reached=o.reached) for o, f in pairs)
    if not interrupted:
        optima = distinct([*optima, hopped(design, options, optima[0])])
    count = sum(o.cost <= optima[0].cost * (1 + options.within) for o in optima)
    return (*distinct(refined(design, options, optima[:count])), *optima[count:])

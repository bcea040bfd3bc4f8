"""Global search for a co-design: starting points are proposed, polished by IPOPT on a coarse mesh, and the best optima refined."""

import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.local_optima import (
    ACCEPTED,
    Optimum,
    Solvable,
    attached,
    distinct,
    follow_to_fine_mesh,
    refined,
    transcribed,
)
from rrr_oc.codesign.search.motions import LEAST_GAIN, Covered, MotionSearch, combined
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
from rrr_oc.progress import Progress, Step

SPRINGS = 3  # springs of which the best motions are searched at first; doubled, a search takes up to twice as long
APART = 0.03  # [1] of their torque by which springs differ to be others; halved, more of them that are nearly the same
POSTURES = 64  # in which their torque is compared; doubled, springs that differ in a few postures only are told apart
IDLE = 12  # springs tried one after the other without a lower cost, before no more are; doubled, slower and surer
# [1] above the best cost that a finer mesh and better motions may undo; doubled, more optima are solved in vain
PROMISING = 0.15
EACH = 8  # starts of each way to mount the springs, where there are several; doubled, these searches take longer, and miss fewer ways
FEWER = 3  # a fraction of the proposed motions is solved for each of the springs tried; doubled, it misleads more often
SHARED = 8  # optima whose motions are tried with each of the springs, too; doubled, somewhat slower and surer
AGAIN = 3  # times that optima are refined because others have become the best; doubled, one that is lost is tried for longer
FEW = 1  # meshes to which all optima close to the best are refined; more tell them apart better and take longer
# Initial barrier parameters of the starts from Sobol points, in turn; None is IPOPT's adaptive strategy, which all other starts have. A
# large one leads every start to the middle of all bounds first, and from there to one good optimum or few; more of them, and the
# optima that are not on that way are missed.
BARRIERS = (1.0, None, None, None)
# Share of the time of a search that each of its stages takes, by experience
SHARES = {
    "starts": 0.1,
    "other springs": 0.4,
    "fine mesh": 0.05,
    "best motions": 0.2,
    "refined meshes": 0.05,
    "swings": 0.1,
    "certificate": 0.1,
}


@dataclass(frozen=True)
class Start:
    """A starting point and the optimum that IPOPT found from it.

    Attributes:
        layer: Its source: of `LAYERS`, "motions" for the best motions of each phase put together, or "known" for what was known
            before; of several tasks that share the springs "alone" for the springs of one of them.
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
        covered: What the search for motions of held springs has solved.
    """

    design: CoDesign
    optima: tuple[Optimum, ...]
    starts: tuple[Start, ...]
    interrupted: bool
    covered: Covered

    @property
    def best(self) -> Optimum:
        """The cheapest optimum."""
        return self.optima[0]

    def whole(self) -> "SearchResult":
        """The result itself; raises `KeyboardInterrupt` if the search was interrupted, so that no partial result is stored."""
        if self.interrupted:
            raise KeyboardInterrupt
        return self


def layers(starts: Sequence[Start]) -> dict[str, dict[str, float]]:
    """By layer: number of starts and of failures, best and median cost, best cost before IPOPT, wall time [s]."""
    rows = {}
    for layer in dict.fromkeys(s.layer for s in starts):
        own = [s for s in starts if s.layer == layer]
        costs = [s.polished for s in own if np.isfinite(s.polished)]
        rows[layer] = {
            "starts": len(own),
            "failed": len(own) - len(costs),
            "best": min(costs, default=float("inf")),
            "median": float(np.median(costs or [np.inf])),
            "best_proposal": min(s.proposed for s in own),
            "seconds": float(sum(s.seconds for s in own)),
        }
    return rows


class CoarseSolver:
    """Solves a problem, of one task or of several, on the coarse mesh, with some initial barrier parameters."""

    def __init__(self, design: Solvable, options: SearchOptions, barriers: Iterable[float | None], iterations: int) -> None:
        settings = Options(tolerance=1e-6, iterations=iterations)
        self.transcription = transcribed(design, options, options.coarse)
        self.solvers = {b: Solver(self.transcription, replace(settings, barrier=b)) for b in barriers}
        self.data, self.unit = design.data(options.width), design.problem.cost_scale

    def started(self, layer: str, w: np.ndarray, barriers: Iterable[float | None]) -> Start:
        """The best optimum from scaled variables, solved once with each of some of the barrier parameters."""
        proposed = float(self.transcription.functions["nlp"](w, self.data)[0]) * self.unit
        tries = [self.solvers[b].solve(w, self.data, check=False) for b in barriers]
        seconds, found = sum(s.seconds for s in tries), [s for s in tries if s.status in ACCEPTED]
        best = min(found, key=lambda s: s.cost, default=None)
        if best is None:
            return Start(layer, proposed, float("inf"), tries[0].status, seconds, np.empty(0))
        return Start(layer, proposed, best.cost, best.status, seconds, best.w)

    def solution(self, start: Start) -> Solution:
        """The optimum on the coarse mesh that a start led to, without multipliers."""
        empty = np.empty(0)
        return Solution(self.transcription, start.w, empty, empty, start.polished, start.message, 0, 0.0)


class Polisher(CoarseSolver):
    """Solves the coarse problem of one task from vectors in [0, 1]. Built once a process."""

    def __init__(self, design: CoDesign, options: SearchOptions) -> None:
        super().__init__(design, options, {None, *BARRIERS}, 200)
        self.design, self.options = design, options

    def __call__(self, layer: str, index: int, vector: np.ndarray) -> Start:
        """Polish one starting point of a layer, of the index that it has there."""
        barrier = BARRIERS[index % len(BARRIERS)] if layer == LAYERS[0] else None
        return self.polished(layer, proposed_guess(self.design, vector, self.options.via), barrier)

    def polished(self, layer: str, guess: Guess, barrier: float | None = None) -> Start:
        """Polish a guess that has a layer as its source, with an initial barrier parameter of `BARRIERS`, or IPOPT's adaptive one."""
        return self.started(layer, self.transcription.pack(guess), (barrier,))


@dataclass(frozen=True, eq=False)
class Coarse:
    """A search on the coarse mesh, over one or several ways to mount the springs.

    Attributes:
        way: Number of the way with the cheapest optimum.
        costs: Of the cheapest optimum of each way; infinite where there is none.
        polisher, search: Of that way; there is no search of motions for held springs where the options or Ctrl-C leave it out.
        optima: The distinct optima of that way, cheapest first.
        starts: All starts, in the order of their polishes' ends.
        interrupted: Whether Ctrl-C ended it.
    """

    way: int
    costs: tuple[float, ...]
    polisher: Polisher
    search: MotionSearch | None
    optima: tuple[Optimum, ...]
    starts: tuple[Start, ...]
    interrupted: bool


def solve_multistart(
    design: CoDesign,
    options: SearchOptions | None = None,
    polished: Callable[[Start], None] = lambda _: None,
    known: Sequence[Guess] = (),
    report: Callable[[Step], None] = lambda _: None,
    coarse: Coarse | None = None,
) -> SearchResult:
    """The best co-design from many starting points: every start is polished on a coarse mesh, the distinct optima are solved on a
    fine one, the best motions for their springs are looked for phase by phase, the best optima are refined, and motions with a swing
    more or less are tried. Ctrl-C ends the search early with what has been found.

    Args:
        known: Further starting points, such as optima of designs with fewer springs; they are solved on the fine mesh.
        polished: Called with every start that has been polished.
        report: Is told how far the search is.
        coarse: The search on the coarse mesh, if it has been made.

    Raises:
        SolverFailure: No start led to an optimum.
    """
    options, progress = options or SearchOptions(), Progress(SHARES, report)
    found = coarse or coarse_search([design], options, progress, polished=polished)
    optima = _best_optima(found, known, progress)
    return SearchResult(design, optima, found.starts, found.interrupted, found.search.covered if found.search else Covered())


def coarse_search(
    ways: Sequence[CoDesign],
    options: SearchOptions,
    progress: Progress,
    known: Sequence[Sequence[Guess]] = (),
    polished: Callable[[Start], None] = lambda _: None,
) -> Coarse:
    """The optima on the coarse mesh from all starts, and from springs to which these led.

    What starts lead to gets cheaper by a factor of three and more once springs and motions are improved in turn, so that no way to mount
    the springs is left out before. All compete for that, and each is tried with the motions that others have found.

    Args:
        ways: Designs that differ in how their springs are mounted.
        known: Further starting points of each way where there are several, such as optima with fewer springs.

    Raises:
        SolverFailure: No start led to an optimum.
    """
    polishers = [Polisher(design, options) for design in ways]  # compiles the functions before the processes need them
    starts: list[list[Start]] = [[] for _ in ways]
    few, interrupted = range(min(EACH, options.starts)), False
    total = options.starts if len(ways) == 1 else len(ways) * len(few)
    streams = [_polished(ways[0], options)] if len(ways) == 1 else [sobol_starts(design, options, few) for design in ways]
    try:
        for some, stream in zip(starts, streams, strict=True):
            for start in stream:
                some.append(start)
                polished(start)
                every = [s for one in starts for s in one]
                progress.count("starts", len(every), total, _coarse_cost(every), "starts")
    except KeyboardInterrupt:
        interrupted = True
    for polisher, some, guesses in zip(polishers, starts, known, strict=False):
        some += [polisher.polished("known", guess) for guess in guesses]
    every = [s for some in starts for s in some]
    if not any(s.w.size for s in every):
        _raise_failure(ways[0], options, every)
    optima = [_distinct_starts(*pair) for pair in zip(polishers, starts, strict=True)]
    searches = [] if interrupted or not options.motions else [MotionSearch(design, options) for design in ways]
    if searches:
        optima = _with_better_springs(polishers, searches, optima, progress)
    costs = tuple(some[0].cost if some else float("inf") for some in optima)
    best = int(np.argmin(costs))
    search = searches[best] if searches else None
    return Coarse(best, costs, polishers[best], search, tuple(optima[best]), tuple(every), interrupted)


def _distinct_starts(polisher: Polisher, starts: Sequence[Start]) -> list[Optimum]:
    """The distinct optima to which starts led, cheapest first, and how many of the Sobol points led to each."""
    found = sorted((s for s in starts if s.w.size), key=lambda s: s.polished)
    return distinct(Optimum(polisher.solution(s), [], int(s.layer == LAYERS[0])) for s in found)


def starts_to_reach(design: CoDesign, options: SearchOptions, target: float) -> tuple[int, Solution | None]:
    """Solve from one Sobol point after the other, each on the fine mesh with the smallest smoothing width, until one costs no more
    than `target`.

    Returns:
        The number of starts, and the solution; None where `options.starts` were not enough.
    """
    polisher = Polisher(design, options)
    for index, vector in enumerate(sobol_points(dimensions(design, options.via), options.starts, options.seed)):
        start = polisher(LAYERS[0], index, vector)
        if not start.w.size or start.polished > 2 * target:  # the coarse mesh and the wide springs change the cost by far less
            continue
        found = follow_to_fine_mesh(design, options, polisher.solution(start).guess())
        if found is not None and found.cost <= target:
            return index + 1, found.solution
    return options.starts, None


def continue_from(starts: Sequence[tuple[Solvable, Guess]], options: SearchOptions) -> list[tuple[int, Optimum]]:
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

    yield from sobol_starts(design, options, range(half), key)
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


def sobol_starts(design: CoDesign, options: SearchOptions, numbers: range, key: str = "") -> Iterator[Start]:
    """The starts from the Sobol points of these numbers, in the order of their polishes' ends; a process keeps a polisher for each key."""
    points = sobol_points(dimensions(design, options.via), numbers.stop, options.seed)[numbers.start :]
    shared = key or uuid.uuid4().hex, design, options, LAYERS[0]
    for _, start in unordered(_polish, [(*shared, i, point) for i, point in zip(numbers, points, strict=True)]):
        yield start


def _polish(key: str, design: CoDesign, options: SearchOptions, layer: str, index: int, vector: np.ndarray):
    polisher = once_per_process(key, lambda: Polisher(design, options))
    return index, polisher(layer, index, vector)


def _raise_failure(design: CoDesign, options: SearchOptions, starts: list[Start]) -> None:
    """No start succeeded: solve from a straight motion at half of all ranges, and let that failure be raised."""
    if not starts:
        raise KeyboardInterrupt
    middle = motion_guess(design, *decode(design, np.full(dimensions(design, options.via), 0.5), options.via)[:2])
    Solver(transcribed(design, options, options.coarse)).solve(middle, design.data(options.width))


def _coarse_cost(starts: Sequence[Start]) -> str:
    """The least cost so far, which a coarse mesh misjudges."""
    best = min(s.polished for s in starts)
    return f"about {best:.4g} on the coarse mesh" if np.isfinite(best) else "none within the limits so far"


def _best_optima(found: Coarse, known: Sequence[Guess], progress: Progress) -> tuple[Optimum, ...]:
    """The distinct optima on a fine mesh, of no more than `kept` on the coarse one, the best of them refined; cheapest first."""
    design, options, search = found.polisher.design, found.polisher.options, found.search
    progress.tell("fine mesh")
    some = _promising(found.optima)[: 1 if found.interrupted else options.kept]
    guesses = [*(o.solution.guess() for o in some), *known]
    optima = _followed(design, options, guesses, [o.reached for o in some])
    if not optima:
        raise SolverFailure("lost on the fine mesh", 0, 0.0, "")
    if search is not None:
        optima = _with_best_motions(search, optima, progress)
    progress.tell("refined meshes", 0.0, f"best so far {optima[0].cost:.6g}")
    optima = _refined_close(design, options, optima, FEW, options.within)
    if search is not None:
        optima = _with_other_swings(search, optima, progress)
    return tuple(_refined_close(design, options, optima, options.refinement.rounds, options.within / 5))


def _refined_close(
    design: CoDesign, options: SearchOptions, optima: list[Optimum], rounds: int, within: float
) -> list[Optimum]:
    """Optima, cheapest first, those `within` a relative distance of the best on finer meshes, of which there are at most `rounds`; again,
    where finer meshes have made others the best."""
    rounds = min(rounds, options.refinement.rounds)
    some = replace(options, refinement=replace(options.refinement, rounds=rounds))
    for _ in range(AGAIN):
        close = [o.cost <= optima[0].cost * (1 + within) and not _fine(o, rounds) for o in optima]
        if not any(close):
            break
        new = refined(design, some, [o for o, is_close in zip(optima, close, strict=True) if is_close])
        optima = distinct([*new, *(o for o, is_close in zip(optima, close, strict=True) if not is_close)])
    return optima


def _fine(optimum: Optimum, rounds: int) -> bool:
    """Whether an optimum has been solved on as many finer meshes as its tolerance needs, or as are allowed."""
    return len(optimum.meshes) > rounds or optimum.meshes[-1].get("converged", False)


def _promising(optima: Sequence[Optimum]) -> list[Optimum]:
    """Those of some optima, cheapest first, that may turn out to be the best."""
    return [o for o in optima if o.cost <= optima[0].cost * (1 + PROMISING)]


def _followed(design: CoDesign, options: SearchOptions, guesses: Sequence[Guess], reached: Sequence[int] = ()) -> list[Optimum]:
    """The distinct optima on the fine mesh near guesses, the first of which so many starts have reached."""
    counts = [*reached, *[0] * (len(guesses) - len(reached))]
    found = zip(ordered(follow_to_fine_mesh, [(design, options, guess) for guess in guesses]), counts, strict=True)
    return distinct(replace(attached(design, options, o), reached=count) for o, count in found if o is not None)


def _with_better_springs(
    polishers: Sequence[Polisher], searches: Sequence[MotionSearch], optima: Sequence[list[Optimum]], progress: Progress
) -> list[list[Optimum]]:
    """Optima of each way to mount the springs on the coarse mesh, and those to which good motions for their springs lead.

    Most starts end with the same few springs, although other springs, with other motions, may be better. So the cheapest optimum
    whose springs have not been tried is taken, again and again: a few proposed motions and those of other optima are solved for its
    springs, and from the best of these springs and motions are solved together.
    """
    options, idle = polishers[0].options, 0
    springs, tried = [Springs(p.design) for p in polishers], list[np.ndarray]()
    optima = list(optima)
    while len(tried) < options.springs and idle < IDLE:
        every = sorted(((o, w) for w, some in enumerate(optima) for o in some), key=lambda pair: pair[0].cost)
        torques = ((o, w, springs[w].torque(o)) for o, w in every)
        new = next((one for one in torques if not any(alike(one[2], other) for other in tried)), None)
        if new is None:
            break
        best = every[0][0].cost
        progress.count("other springs", len(tried), options.springs, f"about {best:.4g} on the coarse mesh", "springs")
        optimum, w, torque = new
        tried.append(torque)
        parameters, known = optimum.solution.parameters, [o.solution for o, _ in every[:SHARED]]
        guesses = combined(searches[w].proposed(parameters, options.motions // FEWER, known=known), parameters)
        starts = [polishers[w].polished("motions", guess) for guess in guesses]
        optima[w] = distinct([*optima[w], *(Optimum(polishers[w].solution(s), []) for s in starts if s.w.size)])
        idle = 0 if optima[w][0].cost < best * (1 - LEAST_GAIN) else idle + 1
    return optima


def _with_best_motions(search: MotionSearch, optima: list[Optimum], progress: Progress) -> list[Optimum]:
    """Optima, and those to which the best motions for their springs lead; cheapest first.

    Springs and motions are improved in turn: the springs of the best optima get the best motion of each phase, and from these all is
    solved together. Then new motions are proposed for the best springs, as long as the cost falls.
    """
    design, options, motions = search.design, search.options, None
    springs = Springs(design)
    for number in range(options.rounds):
        best = optima[0].cost
        progress.count("best motions", number, options.rounds, f"best so far {best:.5g}", "rounds")
        for o in optima[:1] if number else springs.others(_promising(optima))[:SPRINGS]:
            parameters = o.solution.parameters
            motions = search.best(parameters, number * options.motions, motions)
            optima = distinct([*optima, *_followed(design, options.narrow, combined(motions, parameters))])
        if number and optima[0].cost > best * (1 - LEAST_GAIN):
            break
    return optima


def _with_other_swings(search: MotionSearch, optima: list[Optimum], progress: Progress) -> list[Optimum]:
    """Refined optima, and those to which a swing more or less leads; cheapest first.

    The first fine mesh misjudges a motion by more than a swing changes its cost. So the swings begin from the refined springs and
    motions of the best optimum, and what they lead to is refined before it is compared; again, as long as the cost falls.
    """
    design, options = search.design, search.options
    for number in range(options.rounds):
        best = optima[0]
        progress.count("swings", number, options.rounds, f"best so far {best.cost:.6g}", "rounds")
        guesses = combined(search.with_other_swings(best.solution.guess()), best.solution.parameters)
        if not (found := _followed(design, options.narrow, guesses)):
            break
        optima = distinct([*optima, *_refined_close(design, options, found, FEW, options.within)])
        if optima[0].cost > best.cost * (1 - LEAST_GAIN):
            break
    return optima


class Springs:
    """Tells springs apart by their torque in postures all over the joints' ranges, where parameters may differ without effect."""

    def __init__(self, design: CoDesign) -> None:
        lower, upper = design.task.lower[:, None], design.task.upper[:, None]
        self._q = lower + (upper - lower) * sobol_points(len(lower), POSTURES, 0).T
        self._torques, self._widths = design.torques, np.zeros(design.model.widths.size)

    def others(self, optima: Sequence[Optimum]) -> list[Optimum]:
        """Those optima of which none before has nearly the same springs."""
        torques, kept = list[np.ndarray](), []
        for o in optima:
            torque = self.torque(o)
            if not any(alike(torque, t) for t in torques):
                kept.append(o)
                torques.append(torque)
        return kept

    def torque(self, optimum: Optimum) -> np.ndarray:
        """Of the springs and of whatever the arm has [Nm], (m, number of postures)."""
        still = np.zeros_like(self._q)
        return np.array(self._torques(self._q, still, still, 0.0, optimum.solution.parameters, self._widths)[1])


def alike(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether springs have nearly the same torques."""
    return bool(np.linalg.norm(one - other) <= APART * max(np.linalg.norm(one), np.linalg.norm(other)))

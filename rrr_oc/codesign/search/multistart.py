"""Global search for a co-design: starting points are proposed, polished by IPOPT on a coarse mesh, and the best optima refined."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.coarse import Coarse, Springs, coarse_search
from rrr_oc.codesign.search.local_optima import (
    Optimum,
    Solvable,
    distinct,
    followed,
    moving_apart,
    refined,
)
from rrr_oc.codesign.search.motions import LEAST_GAIN, Covered, MotionSearch, combined
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.search.starts import Start
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.solver import SolverFailure
from rrr_oc.progress import Progress, Step

SPRINGS = 3  # springs of which the best motions are searched at first; doubled, a search takes up to twice as long
# [1] above the best cost that a finer mesh and better motions may undo; doubled, more optima are solved in vain
PROMISING = 0.15
AGAIN = 3  # times that optima are refined because others have become the best; doubled, one that is lost is tried for longer
FEW = 1  # meshes to which all optima close to the best are refined; more tell them apart better and take longer
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
    more or less are tried. Ctrl-C ends the search early with what has been found, of which the best optimum is refined.

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
    optima, interrupted = _best_optima(found, known, progress)
    return SearchResult(design, optima, found.starts, interrupted, found.search.covered if found.search else Covered())


def continue_from(starts: Sequence[tuple[Solvable, Guess]], options: SearchOptions) -> list[tuple[int, Optimum]]:
    """Optima near given starts, each of a problem of its own, on the fine mesh; the cheapest one is refined.

    Returns:
        (index of the start, optimum), cheapest first; starts from which IPOPT found no optimum are missing.
    """
    ends = followed([(design, options, guess) for design, guess in starts])
    found = sorted(((i, o) for i, o in enumerate(ends) if o is not None), key=lambda pair: pair[1].cost)
    if found:
        index, optimum = found[0]
        found[0] = index, refined([(starts[index][0], options, optimum)])[0]
    return found


def _best_optima(found: Coarse, known: Sequence[Guess], progress: Progress) -> tuple[tuple[Optimum, ...], bool]:
    """The distinct optima on a fine mesh, of no more than `kept` on the coarse one, the best of them refined; cheapest first. And whether
    Ctrl-C ended the search: then the best optimum that was known is refined, and nothing more is looked for."""
    design, options = found.polisher.design, found.polisher.options
    search, interrupted = None if found.interrupted else found.search, found.interrupted
    progress.tell("fine mesh")
    some = moving_apart(found.optima, 1 if interrupted else options.kept)
    guesses, reached = [*(o.solution.guess() for o in some), *known], [o.reached for o in some]
    try:
        optima = _followed(design, options, guesses, reached)
    except KeyboardInterrupt:
        interrupted, search = True, None
        optima = _followed(design, options, guesses[:1], reached[:1])
    if not optima:
        raise SolverFailure("lost on the fine mesh")
    try:
        if search is not None:
            optima = _with_best_motions(search, optima, progress)
        progress.tell("refined meshes", 0.0, f"best so far {optima[0].cost:.6g}")
        optima = _refined_close(design, options, optima, FEW, options.within)
        if search is not None:
            optima = _with_other_swings(search, optima, progress)
        optima = _refined_close(design, options, optima, options.refinement.rounds, options.within / 5)
    except KeyboardInterrupt:
        interrupted = True
        optima = [*_refined_close(design, options, optima[:1], FEW, options.within), *optima[1:]]
    return tuple(optima), interrupted


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
        new = refined([(design, some, o) for o, is_close in zip(optima, close, strict=True) if is_close])
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
    found = zip(followed([(design, options, guess) for guess in guesses]), counts, strict=True)
    return distinct(replace(o, reached=count) for o, count in found if o is not None)


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

"""Which way to mount the springs, where the tasks leave that open: a knock-out of searches on the coarse mesh.

Starts differ in their costs by far more than ways to mount the springs do, so that the best of a few starts says little. The ways
that cost most are left out first, those that stay get more starts, and the last ones get a whole search on the coarse mesh.
"""

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.multistart import SHARES, Coarse, Polisher, coarse_search, sobol_starts
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.solver import SolverFailure
from rrr_oc.progress import Progress, Step

TRIED = 4  # starts of each way in the first round; doubled, choosing takes twice as long and errs less often
RIVALS = 2  # ways that get a whole search on the coarse mesh; doubled, the last round takes twice as long
# [1] times the least cost that a rival may cost before its springs are improved, which lowers a cost to a third; doubled, more ways
# are searched in vain
CLOSE = 3.0
STAGE = "ways to mount"
Way = Sequence[CoDesign]  # the design of each task


def best_mounted(
    ways: Sequence[Way],
    options: SearchOptions,
    total: Callable[[int, Sequence[float]], float] = lambda _, costs: costs[0],
    known: Sequence[Sequence[Guess]] = (),
    report: Callable[[Step], None] = lambda _: None,
) -> tuple[int, list[Coarse]]:
    """The number of the best way to mount the springs, and the search on the coarse mesh of each of its tasks, if it was made.

    Args:
        ways: The designs of each way, (ways, tasks).
        total: The cost of a way, of this number, from those of its tasks.
        known: For each way, optima of its only task with fewer springs; its cost is not above theirs.
        report: Is told how far the choice is.
    """
    if len(ways) == 1:
        return 0, []
    progress, done = Progress({STAGE: 1.0}, report), itertools.count(1)
    visits = _visits(len(ways))
    left, costs = list(range(len(ways))), np.full((len(ways), len(ways[0])), np.inf)
    for w, guesses in enumerate(known):
        polisher = Polisher(ways[w][0], options)
        costs[w] = min([polisher.polished("known", guess).polished for guess in guesses], default=np.inf)
    begun, starts = 0, min(TRIED, options.starts)
    while len(left) > RIVALS:
        for w in left:
            costs[w] = np.minimum(costs[w], [_least(one, options, range(begun, starts)) for one in ways[w]])
            best = min(total(way, own) for way, own in enumerate(costs))
            progress.count(STAGE, next(done), visits, f"best so far about {best:.4g}" if np.isfinite(best) else "", STAGE)
        left = sorted(left, key=lambda w: total(w, costs[w]))[: max(RIVALS, len(left) // 2)]
        if starts == options.starts:
            break
        begun, starts = starts, min(2 * starts, options.starts)
    close = CLOSE * total(left[0], costs[left[0]])
    left = [w for w in left if not total(w, costs[w]) > close]
    if len(left) == 1:
        return left[0], []
    searched: dict[int, list[Coarse | None]] = {}
    for w in left:
        found = searched[w] = [_searched(one, options) for one in ways[w]]
        progress.count(STAGE, visits - RIVALS + len(searched), visits, "", STAGE)
        costs[w] = np.minimum(costs[w], [np.inf if one is None else one.optima[0].cost for one in found])
        if any(one is not None and one.interrupted for one in found):
            return w, [one for one in found if one is not None]
    best = min(left, key=lambda w: total(w, costs[w]))
    return best, [one for one in searched[best] if one is not None]


def _visits(ways: int) -> int:
    """How many searches, short or on the whole coarse mesh, so many ways need at most."""
    short = 0
    while ways > RIVALS:
        short, ways = short + ways, max(RIVALS, ways // 2)
    return short + ways


def _least(design: CoDesign, options: SearchOptions, numbers: range) -> float:
    """The cheapest optimum on the coarse mesh from the Sobol points of these numbers."""
    Polisher(design, options)  # compiles the functions before the processes need them
    return min(start.polished for start in sobol_starts(design, options, numbers))


def _searched(design: CoDesign, options: SearchOptions) -> Coarse | None:
    """The search on the coarse mesh; None where it finds nothing."""
    try:
        return coarse_search(design, options, Progress(SHARES))
    except SolverFailure:
        return None

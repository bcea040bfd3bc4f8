"""The search on a coarse mesh: from starting points to optima, and from these to better springs and motions, over all ways to mount
the springs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.local_optima import Optimum, distinct, transcribed
from rrr_oc.codesign.search.motions import LEAST_GAIN, MotionSearch, combined
from rrr_oc.codesign.search.proposals import LAYERS, SearchOptions, decode, dimensions, motion_guess, sobol_points
from rrr_oc.codesign.search.spring_fits import HeldMotion, fitted_springs
from rrr_oc.codesign.search.starts import Polisher, Start, all_polished, all_starts, sobol_starts
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.solver import Solver
from rrr_oc.parallel import ordered
from rrr_oc.progress import Progress

APART = 0.03  # [1] of their torque by which springs differ to be others; halved, more of them that are nearly the same
POSTURES = 64  # in which their torque is compared; doubled, springs that differ in a few postures only are told apart
IDLE = 16  # springs tried one after the other without a lower cost, before no more are; doubled, slower and surer
EACH = 4  # starts of each way to mount the springs, where there are several; doubled, these searches take longer
SEVERAL = 2  # times as many springs are tried where there are several ways; doubled, slower and surer
FEWER = 3  # a fraction of the proposed motions is solved for each of the springs tried; doubled, it misleads more often
SHARED = 8  # optima whose motions are tried with each of the springs, too; doubled, somewhat slower and surer
FITTED = 4  # ways to mount the springs that are solved with a motion to which they were fitted; doubled, slower and surer


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
    streams = [all_starts(ways[0], options)] if len(ways) == 1 else [sobol_starts(design, options, few) for design in ways]
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
    search = searches.pop(best) if searches else None
    if search is not None:
        search.join(searches)
    return Coarse(best, costs, polishers[best], search, tuple(optima[best]), tuple(every), interrupted)


def _distinct_starts(polisher: Polisher, starts: Sequence[Start]) -> list[Optimum]:
    """The distinct optima to which starts led, cheapest first, and how many of the Sobol points led to each."""
    found = sorted((s for s in starts if s.w.size), key=lambda s: s.polished)
    return distinct(Optimum(polisher.solution(s), [], int(s.layer == LAYERS[0])) for s in found)


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


def _with_better_springs(
    polishers: Sequence[Polisher], searches: Sequence[MotionSearch], optima: Sequence[list[Optimum]], progress: Progress
) -> list[list[Optimum]]:
    """Optima of each way to mount the springs on the coarse mesh, and those to which good motions for their springs lead.

    Most starts end with the same few springs, although other springs, with other motions, may be better. So the cheapest optimum
    whose springs have not been tried is taken, again and again: a few proposed motions and those of other optima are solved for its
    springs, and from the best of these springs and motions are solved together. To the best motion of those the springs of every way
    to mount them are fitted, and from the best of these all is solved together, too: what one way has found helps the others.
    """
    options, idle = polishers[0].options, 0
    most = options.springs * (1 if len(polishers) == 1 else SEVERAL)
    springs, tried = [Springs(p.design) for p in polishers], list[np.ndarray]()
    optima = list(optima)

    def added(guesses: Sequence[tuple[int, str, Guess]]) -> list[Optimum]:
        """The optima to which guesses of some ways and layers lead, which are put among those of their way."""
        starts = all_polished((polishers[w], layer, guess) for w, layer, guess in guesses)
        new = [(w, Optimum(polishers[w].solution(s), [])) for (w, _, _), s in zip(guesses, starts, strict=True) if s.w.size]
        for w, optimum in new:
            optima[w] = distinct([*optima[w], optimum])
        return [optimum for _, optimum in new]

    while len(tried) < most and idle < IDLE:
        every = sorted(((o, w) for w, some in enumerate(optima) for o in some), key=lambda pair: pair[0].cost)
        torques = ((o, w, springs[w].torque(o)) for o, w in every)
        new = next((one for one in torques if not any(alike(one[2], other) for other in tried)), None)
        if new is None:
            break
        best = every[0][0].cost
        progress.count("other springs", len(tried), most, f"about {best:.4g} on the coarse mesh", "springs")
        optimum, w, torque = new
        tried.append(torque)
        parameters, known = optimum.solution.parameters, [o.solution for o, _ in every[:SHARED]]
        motions = combined(searches[w].proposed(parameters, options.motions // FEWER, known=known), parameters)
        found = added([(w, "motions", guess) for guess in motions])
        moved = min([optimum, *found], key=lambda o: o.cost).solution.guess()
        found += added([(v, "springs", replace(moved, parameters=theta)) for v, theta in _fitted(polishers, moved)])
        idle = 0 if min((o.cost for o in found), default=best) < best * (1 - LEAST_GAIN) else idle + 1
    return optima


def _fitted(polishers: Sequence[Polisher], guess: Guess) -> list[tuple[int, np.ndarray]]:
    """The springs that leave the least torque along a guess's motion: (way to mount them, parameters) of the best ways."""
    design = polishers[0].design
    if design.series.rows or not np.any(design.problem.p_lower < design.problem.p_upper):
        return []
    motions = [HeldMotion.of(phase) for phase in guess.phases]
    fits = ordered(fitted_springs, [(p.design, motions, p.options.width) for p in polishers])
    order = sorted(range(len(fits)), key=lambda way: fits[way][0])
    return [(way, fits[way][1]) for way in order[:FITTED]]


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

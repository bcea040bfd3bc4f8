"""The search on a coarse mesh: from starting points to optima, and from these to better springs and motions, over all ways to mount
the springs."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import TypeVar

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.local_optima import Optimum, distinct, followed, moving_apart, same_motion, transcribed
from rrr_oc.codesign.search.motions import LEAST_GAIN, MotionSearch, combined
from rrr_oc.codesign.search.proposals import SearchOptions, decode, dimensions, motion_guess, sobol_points
from rrr_oc.codesign.search.spring_fits import HeldMotion, fitted_springs
from rrr_oc.codesign.search.starts import Polisher, Start, all_starts, polish, sobol_starts
from rrr_oc.codesign.task import PHASES
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.solver import Solver
from rrr_oc.parallel import ordered
from rrr_oc.progress import Progress

_T = TypeVar("_T")
APART = 0.03  # [1] of their torque by which springs differ to be others; halved, more of them that are nearly the same
POSTURES = 64  # in which their torque is compared; doubled, springs that differ in a few postures only are told apart
IDLE = 16  # springs tried one after the other without a lower cost, before no more are; doubled, slower and surer
EACH = 4  # starts of each way to mount the springs, where there are several; doubled, these searches take longer
SEVERAL = 2  # times as many springs are tried where there are several ways; doubled, slower and surer
FEWER = 3  # a fraction of the proposed motions is solved for each of the springs tried; doubled, it misleads more often
SHARED = 8  # optima whose motions are tried with each of the springs, too; doubled, somewhat slower and surer
FITS = 2  # of springs of a way to a motion, at least; doubled, slower and surer
FITTED = 4  # springs that are solved with the motion to which they were fitted; doubled, slower and surer


@dataclass(frozen=True, eq=False)
class Coarse:
    """A search on the coarse mesh, over one or several ways to mount the springs.

    Attributes:
        way: Number of the way with the least cost.
        costs: Of the cheapest optimum of each way, on the fine mesh where several ways were compared; infinite where there is none.
        polisher, search: Of that way; there is no search of motions for held springs where the options or Ctrl-C leave it out.
        optima: The distinct optima of that way, cheapest first.
        starts: All starts way by way, in the order of their polishes' ends, then what was known.
        interrupted: Whether Ctrl-C ended it.
    """

    way: int
    costs: tuple[float, ...]
    polisher: Polisher[CoDesign]
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
    few = min(EACH, options.starts)
    total = options.starts if len(ways) == 1 else len(ways) * few
    streams = [all_starts(polishers[0])] if len(ways) == 1 else [sobol_starts(polisher, few) for polisher in polishers]
    searches, costs, interrupted = list[MotionSearch](), list[float](), False
    try:
        for some, stream in zip(starts, streams, strict=True):
            for start in stream:
                some.append(start)
                polished(start)
                every = [s for one in starts for s in one]
                progress.count("starts", len(every), total, coarse_cost(every), "starts")
        for polisher, some, guesses in zip(polishers, starts, known or [()] * len(ways), strict=True):
            some += ordered(polish, [polisher.call(guess, "known") for guess in guesses])
    except KeyboardInterrupt:
        interrupted = True
    every = [s for some in starts for s in some]
    if not any(s.w.size for s in every):
        _raise_failure(ways[0], options, every)
    optima = [polisher.optima(some) for polisher, some in zip(polishers, starts, strict=True)]
    try:
        if not interrupted and options.motions:
            searches = [MotionSearch(design, options) for design in ways]
            _add_better_springs(polishers, searches, optima, progress)
        if not interrupted and len(ways) > 1:
            costs = _costs(ways, options, optima)
    except KeyboardInterrupt:
        interrupted = True
    costs = costs or [_least(some) for some in optima]
    best = int(np.argmin(costs))
    search = searches.pop(best) if searches else None
    if search is not None:
        search.join(searches)
    return Coarse(best, tuple(costs), polishers[best], search, tuple(optima[best]), tuple(every), interrupted)


def _costs(ways: Sequence[CoDesign], options: SearchOptions, optima: Sequence[Sequence[Optimum]]) -> list[float]:
    """Of the cheapest optimum of each way on the fine mesh, near the cheapest of the way and the cheapest of all on the coarse mesh, which
    misjudges by a multiple what costs next to nothing; as on the coarse mesh where none is found on the fine one."""
    every = sorted(((o, w) for w, some in enumerate(optima) for o in some), key=lambda pair: pair[0].cost)
    chosen = [pair for i, pair in enumerate(every) if i < options.kept or pair[0] is optima[pair[1]][0]]
    ends = followed([(ways[w], options, o.solution.guess()) for o, w in chosen])
    costs = np.full(len(ways), np.inf)
    for (_, w), found in zip(chosen, ends, strict=True):
        costs[w] = min(costs[w], np.inf if found is None else found.cost)
    return costs.tolist() if np.isfinite(costs).any() else [_least(some) for some in optima]


def _least(optima: Sequence[Optimum]) -> float:
    return optima[0].cost if optima else float("inf")


def _raise_failure(design: CoDesign, options: SearchOptions, starts: list[Start]) -> None:
    """No start succeeded: solve from a straight motion at half of all ranges, and let that failure be raised."""
    if not starts:
        raise KeyboardInterrupt
    middle = motion_guess(design, *decode(design, np.full(dimensions(design, options.via), 0.5), options.via)[:2])
    Solver(transcribed(design, options, options.coarse)).solve(middle, design.data(options.width))


def coarse_cost(starts: Sequence[Start]) -> str:
    """The least cost so far, which a coarse mesh misjudges."""
    best = min(s.polished for s in starts)
    return f"about {best:.4g} on the coarse mesh" if np.isfinite(best) else "none within the limits so far"


def _add_better_springs(
    polishers: Sequence[Polisher[CoDesign]], searches: Sequence[MotionSearch], optima: list[list[Optimum]], progress: Progress
) -> None:
    """Add to the optima of each way to mount the springs those to which good motions for their springs lead, and good springs for these.

    Most starts end with the same few springs, although other springs, with other motions, may be better. So the cheapest optimum
    that differs from those tried in springs and motion is taken, again and again: a few proposed motions and those of other optima are
    solved for its springs, and from the best of these springs and motions are solved together. To the best motion of those the springs of
    every way to mount them are fitted, and from the best fits all is solved together, too: what one way has found helps the others.
    """
    options, idle = polishers[0].options, 0
    most = options.springs * (1 if len(polishers) == 1 else SEVERAL)
    springs, tried, fitted = [Springs(p.design) for p in polishers], list[tuple[np.ndarray, Optimum]](), list[Optimum]()

    def add(guesses: Sequence[tuple[int, Guess]]) -> list[Optimum]:
        """The optima to which guesses of some ways lead, now among those of their way."""
        starts = ordered(polish, [polishers[w].call(guess) for w, guess in guesses])
        added = [(w, Optimum(polishers[w].solution(s), [])) for (w, _), s in zip(guesses, starts, strict=True) if s.w.size]
        for w, optimum in added:
            optima[w] = distinct([*optima[w], optimum])
        return [optimum for _, optimum in added]

    def is_new(torque: np.ndarray, optimum: Optimum) -> bool:
        return not any(alike(torque, t) or same_motion(optimum.solution, o.solution) for t, o in tried)

    while len(tried) < most and idle < IDLE:
        every = sorted(((o, w) for w, some in enumerate(optima) for o in some), key=lambda pair: pair[0].cost)
        torques = ((o, w, springs[w].torque(o.solution.parameters)) for o, w in every)
        new = next((one for one in torques if is_new(one[2], one[0])), None)
        if new is None:
            break
        best = every[0][0].cost
        progress.count("other springs", len(tried), most, f"about {best:.4g} on the coarse mesh", "springs")
        optimum, w, torque = new
        tried.append((torque, optimum))
        parameters, known = optimum.solution.parameters, moving_apart((o for o, _ in every), SHARED)
        motions = searches[w].proposed(parameters, options.motions // FEWER, known=[o.solution for o in known])
        found = add([(w, guess) for guess in combined(motions, parameters)])
        moved = min([optimum, *found], key=lambda o: o.cost)
        if not any(same_motion(moved.solution, o.solution) for o in fitted):
            fitted.append(moved)
            found += add(_fitted(polishers, springs, moved.solution.guess()))
        idle = 0 if min((o.cost for o in found), default=best) < best * (1 - LEAST_GAIN) else idle + 1


def _fitted(polishers: Sequence[Polisher[CoDesign]], springs: Sequence["Springs"], guess: Guess) -> list[tuple[int, Guess]]:
    """A guess's motion with the different springs that leave the least torque along it, of any way to mount them; none where springs
    stand between drives and links, or none is free."""
    design = polishers[0].design
    if design.series.rows or not np.any(design.problem.p_lower < design.problem.p_upper):
        return []
    motions, fits = [HeldMotion.of(design, phase) for phase in guess.phases], max(FITTED // len(polishers), FITS)
    found = ordered(fitted_springs, [(p.design, motions, fits, p.options.width) for p in polishers])
    every = [(left, way, theta) for way, some in enumerate(found) for left, theta in some]
    order = ((way, theta) for _, way, theta in sorted(every, key=lambda one: one[0]))
    different = unlike((springs[way].torque(theta), (way, replace(guess, parameters=theta))) for way, theta in order)
    return list(islice(different, FITTED))


class Springs:
    """Tells springs apart by their torque in postures all over the joints' ranges, where parameters may differ without effect."""

    def __init__(self, design: CoDesign) -> None:
        lower, upper = design.task.lower[:, None], design.task.upper[:, None]
        self._q = lower + (upper - lower) * sobol_points(len(lower), POSTURES, 0).T
        self._design, self._widths = design, np.zeros(design.model.widths.size)

    def others(self, optima: Sequence[Optimum]) -> list[Optimum]:
        """Those optima of which none before has nearly the same springs."""
        return list(unlike((self.torque(o.solution.parameters), o) for o in optima))

    def torque(self, parameters: np.ndarray) -> np.ndarray:
        """Of springs of parameters (np,) and of whatever the arm has [Nm], phase by phase: (m, number of postures of both)."""
        still = np.zeros_like(self._q)
        engaged = [self._design.engaged(phase, parameters) for phase in range(len(PHASES))]
        return np.hstack([np.array(self._design.torques(self._q, still, still, 0.0, p, self._widths)[1]) for p in engaged])


def unlike(springs: Iterable[tuple[np.ndarray, _T]]) -> Iterator[_T]:
    """What springs belong to, given with their torques, of which none before has nearly the same."""
    torques = list[np.ndarray]()
    for torque, what in springs:
        if not any(alike(torque, other) for other in torques):
            torques.append(torque)
            yield what


def alike(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether springs have nearly the same torques."""
    return bool(np.linalg.norm(one - other) <= APART * max(np.linalg.norm(one), np.linalg.norm(other)))

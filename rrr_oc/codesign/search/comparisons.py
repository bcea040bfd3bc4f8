"""What designs are compared with: springs that balance the arm at rest, and every design at equal cycle times."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import embedded
from rrr_oc.codesign.search.local_optima import Optimum, followed, refined
from rrr_oc.codesign.search.multistart import continue_from, solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.search.spring_fits import HeldMotion, fitted_springs
from rrr_oc.codesign.task import PHASES
from rrr_oc.optimal_control.problem import Guess, PhaseGuess
from rrr_oc.optimal_control.solver import Solution

POSTURES = 41  # on the way, in which springs balance the arm; doubled, nothing changes
TRIED = 32  # springs from which the balance is sought; doubled, slower and surer
SAME = 0.02  # [1] by which cycle times differ to be others; doubled, two columns say less often the same
EQUAL = 1e-3  # [1] to which cycle times are equal; with less, IPOPT has no room where the time is the shortest possible


def balancing_springs(design: CoDesign) -> np.ndarray | None:
    """Parameters (np,) of the springs that leave the least mean squared torque where the arm stands still: in postures on the straight
    way of the joints from start to release, with the payload of each phase. None where there are no springs, or some stand between
    drives and links, which balance nothing."""
    if all(spring.known for spring in design.springs) or design.series.rows:
        return None
    start, release = design.task.start, design.task.release
    way = start[:, None] + (release - start)[:, None] * np.linspace(0, 1, POSTURES)
    phases = [HeldMotion.at_rest(way)] * len(PHASES)
    return fitted_springs(design, phases, TRIED, evaluations=None)[0][1]


def best_motion(held: CoDesign, options: SearchOptions) -> Solution:
    """The best motion that is found for springs that are held; raises `SolverFailure` where none is found."""
    few = replace(options, starts=max(4, options.starts // 4), kept=3, springs=1, rounds=1)
    return solve_multistart(held, few).whole().best.solution


def freed(design: CoDesign, best: Solution, others: Mapping[float, Solution], options: SearchOptions) -> Solution:
    """The cheaper of a design's optimum and of the one near the best of those at given cycle times, where that is cheaper."""
    cheapest = min(others.values(), key=lambda solution: solution.cost, default=best)
    found = continue_from([(design, cheapest.guess())], options) if cheapest.cost < best.cost else []
    return min([best, *(optimum.solution for _, optimum in found)], key=lambda solution: solution.cost)


def cycle_times(stiff: float | None, best: float) -> tuple[float, ...]:
    """The times at which designs are compared where none are asked for [s]: those of stiff actuation and of the best design."""
    if stiff is None or abs(best / stiff - 1) < SAME:
        return (best,)
    return min(stiff, best), max(stiff, best)


def at_cycle_times(
    design: CoDesign,
    solution: Solution,
    times: Sequence[float],
    inner: Sequence[tuple[CoDesign, Mapping[float, Solution]]],
    options: SearchOptions,
) -> dict[float, Solution]:
    """The best springs and motions that are found at each of some cycle times [s], refined; times at which none is found are missing.

    The search goes from time to time, away from that of an optimum and back again.

    Args:
        inner: Designs with fewer springs or none, with what was found for these; springs that do nothing are where a search starts, too.
    """
    own, found = float(solution.durations.sum()), dict[float, Optimum]()

    def tried(time: float, guesses: Sequence[Guess], widths: SearchOptions) -> None:
        calls = [(_taking(design, time), widths, guess) for guess in guesses]
        some = [o for o in (found.get(time), *followed(calls)) if o is not None]
        if some:
            found[time] = min(some, key=lambda o: o.cost)

    later, earlier = sorted(t for t in times if t > own), sorted((t for t in times if t < own), reverse=True)
    for side in (later, earlier):
        before = solution
        for time in side:
            there = _taking(design, time)
            others = [embedded(of[time], one, there) for one, of in inner if time in of]
            tried(time, [*stretched(design, before, time), *(guess for guess in others if guess is not None)], options)
            before = found[time].solution if time in found else before
    order = [*reversed(earlier), *later]
    for path in (order[::-1], order):
        for before, time in pairwise(path):
            if before in found:
                tried(time, stretched(design, found[before].solution, time)[:1], options.narrow)
    calls = [(_taking(design, time), options, o) for time, o in found.items()]
    result = {time: o.solution for time, o in zip(found, refined(calls), strict=True)}
    return result | ({own: solution} if own in times else {})


def _taking(design: CoDesign, seconds: float) -> CoDesign:
    """The same design with a given cycle time [s], to `EQUAL`."""
    return replace(design, task=replace(design.task, cycle=((1 - EQUAL) * seconds, (1 + EQUAL) * seconds)))


def stretched(design: CoDesign, solution: Solution, seconds: float) -> list[Guess]:
    """A solution run through in another time [s]: both phases by the same factor, and each alone as far as its bounds allow."""
    now, (shortest, longest) = solution.durations, design.task.duration
    guess, made = solution.guess(), []
    for stretched in (np.arange(len(PHASES)), *([i] for i in range(len(PHASES)))):
        durations = now.copy()
        rest = seconds - now.sum() + now[stretched].sum()
        durations[stretched] = np.clip(now[stretched] * rest / now[stretched].sum(), shortest, longest)
        phases = tuple(_faster(design, phase, float(T)) for phase, T in zip(guess.phases, durations, strict=True))
        made.append(Guess(phases, guess.parameters))
    return made


def _faster(design: CoDesign, phase: PhaseGuess, duration: float) -> PhaseGuess:
    """The motion of a phase run through in another duration [s]."""
    of_states, of_controls = ((phase.duration / duration) ** orders[:, None] for orders in design.orders)
    return PhaseGuess(duration, lambda s: of_states * phase.states(s), lambda s: of_controls * phase.controls(s))

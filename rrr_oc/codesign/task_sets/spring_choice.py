"""Which of the offered springs a set of tasks should have, and how they are mounted, where each spring has a price.

The springs on held motions are a problem of a few numbers, which ranks all springs, ways to mount them, removals and exchanges. The
best of each ranking get motions for these springs, and the joint problem of springs and motions is solved from there. No step depends
on the number of combinations.
"""

import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca
import numpy as np
from scipy.optimize import minimize

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.local_optima import SOLVED, Optimum, transcribed
from rrr_oc.codesign.search.proposals import SearchOptions, sobol_points
from rrr_oc.codesign.springs import drawn_bounds, from_drawn
from rrr_oc.codesign.task_sets.held_motions import SpringCost
from rrr_oc.codesign.task_sets.set_search import searched_optimum
from rrr_oc.codesign.task_sets.task_set import SetDesign
from rrr_oc.model.parameters import offsets
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.solver import Options, Solution, Solver
from rrr_oc.parallel import once_per_process, ordered

DRAWN = 3  # springs from which a way to mount one is fitted; doubled, twice the time, and fewer local optima are missed
STEPS = 30  # of such a fit; doubled, it takes longer, and the next round would have found the rest
TRIED = 2  # removals and exchanges of a number of springs whose motions are solved; doubled, twice the time and a surer front
GAIN = 1e-3  # [1] of the objective by which a point must be better than another; doubled, fewer points are on the front
Held = Callable[[np.ndarray], tuple[float, np.ndarray]]  # parameters (np,) -> the objective on held motions, and its gradient
BARRIERS = (1e-4, 1e-2)  # initial barrier parameters of a motion for changed springs; the second where the first finds none


@dataclass(frozen=True, eq=False)
class ChoicePoint:
    """Springs and the motions for them.

    Attributes:
        springs: Indices of the springs among the offered ones, each mounted in one way, ascending.
        parameters: Of all offered springs (np,); those that are not chosen have no amplitude.
        motions: Scaled variables of each task (T).
        total: The objective.
    """

    springs: tuple[int, ...]
    parameters: np.ndarray
    motions: tuple[np.ndarray, ...]
    total: float


@dataclass(frozen=True, eq=False)
class SpringFront:
    """The least cost that was found for each number of springs.

    Attributes:
        points: Fewest springs first; each costs less than those before.
        solved: Number of sets of springs whose motions were solved.
    """

    points: tuple[ChoicePoint, ...]
    solved: int

    def at(self, price: float) -> ChoicePoint:
        """The point of least cost with its springs paid for."""
        return min(self.points, key=lambda p: p.total + price * len(p.springs))


def spring_front(
    design: SetDesign,
    stiff: Sequence[Optimum],
    options: SearchOptions,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> SpringFront:
    """The front of the number of springs against the objective, from all offered springs to none.

    Every solve ends in a local optimum: a point is the best that was found, not a proven one.

    Args:
        design: All offered springs, each in every way to mount it; ways of one spring act on the same joints. Its objective is "sum",
            with one scenario.
        stiff: The optimum of each task without springs (T).
        progress: Called with the number of springs left and the number of all.
    """
    search = _Search(design, options)
    none = search.of_stiff(stiff)
    best = {0: none}
    point = search.everything(none)
    count = len(point.springs)
    while point.springs:
        progress(len(point.springs), count)
        fewer = search.without_one(point)
        if fewer.total > point.total * (1 + GAIN):  # else so many springs are not worth having, however they are exchanged
            other = search.exchanged(point)
            fewer, point = (fewer if other is point else search.without_one(other)), other
        best[len(point.springs)], point = point, fewer
    for number in range(1, count + 1):
        if best[number].total >= best[number - 1].total * (1 - GAIN):  # then what the smaller set found may help the larger one
            grown = search.with_one(best[number - 1])
            if grown is None or grown.total >= best[number - 1].total * (1 - GAIN):
                break
            best[number] = grown
    kept: list[ChoicePoint] = []
    for number in sorted(best):
        if not kept or best[number].total < kept[-1].total * (1 - GAIN):
            kept.append(best[number])
    return SpringFront(tuple(kept), search.solved)


class _Search:
    """The steps of the search.

    Attributes:
        places: For each place, the indices of the springs that may be mounted there, of which one can be.
        own, amplitudes: For each offered spring, where its parameters are, and its amplitudes among them.
        costs: Of each task, by its springs on held motions (T).
        solved: Number of sets of springs whose motions were solved.
    """

    def __init__(self, design: SetDesign, options: SearchOptions) -> None:
        self.design, self.options, self.key, self.solved = design, options, uuid.uuid4().hex, 0
        problem = design.first.problem
        self.lower, self.upper = problem.p_lower, problem.p_upper
        self.transcriptions = [transcribed(one, options, options.fine) for one in design.designs]
        self.data = [one.data(options.widths[-1]) for one in design.designs]
        each = zip(design.designs, self.transcriptions, self.data, strict=True)
        self.costs = [SpringCost(*one) for one in each]
        effects = [spring.effect for spring in design.springs]
        self.own = [np.arange(*ends) for ends in pairwise(offsets(effects))]
        names = [[p.name for p in effect.parameters] for effect in effects]
        self.amplitudes = [own[np.isin(n, e.amplitudes)] for own, n, e in zip(self.own, names, effects, strict=True)]
        self.places: dict[tuple, list[int]] = {}
        for i, spring in enumerate(design.springs):
            if not spring.known:
                self.places.setdefault(spring.place, []).append(i)

    def of_stiff(self, stiff: Sequence[Optimum]) -> ChoicePoint:
        """The point without springs, its motions solved on the search's mesh."""
        p = self.cleared(0.5 * (self.lower + self.upper), ())
        packed = [t.pack(Guess(o.solution.guess().phases, p)) for t, o in zip(self.transcriptions, stiff, strict=True)]
        moved = self.moved(p, packed)
        return ChoicePoint((), p, *(moved or (tuple(packed), self.design.total([o.cost for o in stiff]))))

    def cleared(self, parameters: np.ndarray, springs: Sequence[int]) -> np.ndarray:
        """The parameters with no amplitude of springs that are not among some; known effects stay."""
        p = parameters.copy()
        for i, spring in enumerate(self.design.springs):
            if i not in springs and not spring.known:
                p[self.amplitudes[i]] = 0.0
        return p

    def held(self, parameters: np.ndarray, motions: Sequence[np.ndarray]) -> Held:
        """The objective on some motions, for fits of springs."""
        along = [cost.along(w, parameters) for cost, w in zip(self.costs, motions, strict=True)]

        def objective(p: np.ndarray) -> tuple[float, np.ndarray]:
            values, slopes = zip(*(cost(one, p) for cost, one in zip(self.costs, along, strict=True)), strict=True)
            weights = self.design.tasks.weights
            return float(weights @ np.array(values)), weights @ np.array(slopes)

        return objective

    def fitted(self, parameters: np.ndarray, held: Held, springs: Sequence[int]) -> tuple[float, np.ndarray]:
        """(objective, parameters) with some springs optimised on held motions, from their present parameters."""
        free = np.concatenate([np.zeros(0, int), *[self.own[i] for i in springs]])
        if not free.size:
            return held(parameters)[0], parameters
        scale = self.design.first.problem.p_scale[free]
        unit = max(held(parameters)[0], 1e-9)

        def whole(x: np.ndarray) -> np.ndarray:
            p = parameters.copy()
            p[free] = x * scale
            return p

        def value(x: np.ndarray) -> tuple[float, np.ndarray]:
            total, slope = held(whole(x))
            return total / unit, slope[free] * scale / unit

        bounds = list(zip(self.lower[free] / scale, self.upper[free] / scale, strict=True))
        found = minimize(value, parameters[free] / scale, jac=True, bounds=bounds, **self._constrained(whole, free, scale))
        p = whole(found.x)
        p[free] = np.clip(p[free], self.lower[free], self.upper[free])
        return (found.fun * unit, p) if found.fun < 1 else (unit, parameters)

    def _constrained(self, whole: Callable[[np.ndarray], np.ndarray], free: np.ndarray, scale: np.ndarray) -> dict:
        """Method and constraints of the fit: hardware must exist where parameters are functions of it."""
        exists = self.design.first.problem.design
        if exists is None:
            return {"method": "L-BFGS-B", "options": {"maxiter": STEPS}}
        d, slope = self.data[0], exists.jacobian()
        return {
            "method": "SLSQP",
            "options": {"maxiter": STEPS},
            "constraints": {
                "type": "ineq",
                "fun": lambda x: -np.array(exists(whole(x), d)).ravel(),
                "jac": lambda x: -np.array(ca.DM(slope(whole(x), d, 0)[0]))[:, free] * scale,
            },
        }

    def mounted(self, parameters: np.ndarray, held: Held, place: Sequence[int]) -> tuple[float, int, np.ndarray]:
        """(objective, spring, parameters) of the best spring of a place on held motions, from several drawn ones."""
        tries = []
        for i in place:
            low, high = drawn_bounds([self.design.springs[i]])
            for point in sobol_points(len(low), DRAWN, self.options.seed):
                p = self.cleared(parameters, [j for j in range(len(self.own)) if j not in place or j == i])
                p[self.own[i]] = from_drawn([self.design.springs[i]], low + (high - low) * point)
                total, p = self.fitted(p, held, [i])
                tries.append((total, i, p))
        return min(tries, key=lambda t: t[0])

    def moved(self, parameters: np.ndarray, motions: Sequence[np.ndarray]) -> tuple[tuple[np.ndarray, ...], float] | None:
        """The motions for held springs near some, and the objective; None where a task has none."""
        designs = self.design.designs
        calls = [(self.key, designs[t], self.options, (t, w), parameters) for t, w in enumerate(motions)]
        found = ordered(_moved, calls)
        if any(one is None for one in found):
            return None
        return tuple(w for _, w in found), self.design.total([cost for cost, _ in found])

    def started(self, springs: Sequence[int], parameters: np.ndarray, motions: Sequence[np.ndarray]) -> ChoicePoint | None:
        """Springs fitted to motions, and the motions for these; None where a task has none."""
        p = self.cleared(parameters, springs)
        p = self.fitted(p, self.held(p, motions), springs)[1]
        moved = self.moved(p, motions)
        return moved and ChoicePoint(tuple(sorted(springs)), p, *moved)

    def solved_jointly(self, points: Sequence[ChoicePoint | None]) -> ChoicePoint | None:
        """The cheapest of the joint optima near some points; None where there are no points."""
        some = [p for p in points if p is not None]
        self.solved += len(some)
        sprung = [p for p in some if p.springs]
        found = ordered(searched_optimum, [(*chosen(self.design, self.options, p), self.options) for p in sprung])
        bare = [p for p in some if not p.springs]
        return min([*bare, *map(self.absorbed, sprung, found)], key=lambda p: p.total, default=None)

    def everything(self, none: ChoicePoint) -> ChoicePoint:
        """A spring in every place, mounted in the way that is best on the motions without springs."""
        p, springs, held = none.parameters, [], self.held(none.parameters, none.motions)
        for place in self.places.values():
            _, i, p = self.mounted(p, held, place)
            springs.append(i)
        return self.solved_jointly([self.started(springs, p, none.motions)]) or none

    def absorbed(self, point: ChoicePoint, found: Optimum | None) -> ChoicePoint:
        """The point, or the joint optimum of its springs where that costs less."""
        if found is None or found.cost >= point.total:
            return point
        guess, p = found.solution.guess(), point.parameters.copy()
        p[np.concatenate([self.own[i] for i in kept_springs(self.design, point)])] = guess.parameters
        motions = [Guess(m.phases, p) for m in self.design.motions(guess)]
        packed = tuple(t.pack(m) for t, m in zip(self.transcriptions, motions, strict=True))
        return ChoicePoint(point.springs, p, packed, found.cost)

    def without_one(self, point: ChoicePoint) -> ChoicePoint:
        """The best of the points with one spring less; those that cost least on the motions at hand are solved.

        Where the least needs no more than all springs did, a spring did nothing, and no joint problem is solved.
        """
        ranked, held = [], self.held(point.parameters, point.motions)
        for i in point.springs:
            left = [j for j in point.springs if j != i]
            total, p = self.fitted(self.cleared(point.parameters, left), held, left)
            ranked.append((total, left, p))
        started = self._best_started(ranked, point.motions)
        least = min((p for p in started if p is not None), key=lambda p: p.total, default=None)
        if least is not None and least.total <= point.total * (1 + GAIN / len(self.places)):  # of all removals together, `GAIN`
            return least
        found = self.solved_jointly(started)
        if found is not None:
            return found
        total, left, p = min(ranked, key=lambda r: r[0])
        return ChoicePoint(tuple(left), p, point.motions, total)

    def _best_started(
        self, ranked: list[tuple[float, list[int], np.ndarray]], motions: Sequence[np.ndarray]
    ) -> list[ChoicePoint | None]:
        """Of (objective, springs, parameters) on motions, those that cost least, with motions for them."""
        return [self.started(springs, p, motions) for _, springs, p in sorted(ranked, key=lambda r: r[0])[:TRIED]]

    def exchanged(self, point: ChoicePoint) -> ChoicePoint:
        """The point, or one with a spring mounted elsewhere or in another way where that costs less."""
        ranked, held = [], self.held(point.parameters, point.motions)
        for place in self.places.values():
            here = [i for i in point.springs if i in place]
            rest = self.cleared(point.parameters, [i for i in point.springs if i not in here])
            for k in place:
                if k not in here:
                    _, _, p = self.mounted(rest, held, [k])
                    for i in here or point.springs:
                        springs = [*(j for j in point.springs if j != i), k]
                        cleared = self.cleared(p, springs)
                        ranked.append((held(cleared)[0], springs, cleared))
        started = self._best_started(ranked, point.motions)
        other = self.solved_jointly([p for p in started if p is not None and p.total < point.total])
        return other if other is not None and other.total < point.total * (1 - GAIN) else point

    def with_one(self, point: ChoicePoint) -> ChoicePoint | None:
        """The best of the points with one spring more; None where every place has one."""
        taken = {self.design.springs[i].place for i in point.springs}
        free = [springs for place, springs in self.places.items() if place not in taken]
        held = self.held(point.parameters, point.motions)
        ranked = sorted((self.mounted(point.parameters, held, place) for place in free), key=lambda r: r[0])
        return self.solved_jointly([self.started([*point.springs, i], p, point.motions) for _, i, p in ranked[:1]])


def _moved(
    key: str, one: CoDesign, options: SearchOptions, at: tuple[int, np.ndarray], parameters: np.ndarray
) -> tuple[float, np.ndarray] | None:
    """Cost and scaled variables of the motion of a task near one, `at` = (its number, scaled variables), with springs held."""
    solvers = once_per_process(key, dict[int, list[Solver]])
    t, w = at
    if t not in solvers:
        transcription = transcribed(one, options, options.fine)
        solvers[t] = [Solver(transcription, Options(tolerance=1e-6, iterations=200, barrier=b)) for b in BARRIERS]
    start = np.r_[parameters / one.problem.p_scale, w[len(parameters) :]]
    for solver in solvers[t]:
        found = solver.solve(start, one.data(options.widths[-1]), check=False, parameters=(parameters, parameters))
        if found.status == SOLVED:
            return found.cost, found.w
    return None


def kept_springs(design: SetDesign, point: ChoicePoint) -> list[int]:
    """Indices of the springs of a point, and of the known effects."""
    return [i for i, s in enumerate(design.springs) if s.known or i in point.springs]


def chosen(design: SetDesign, options: SearchOptions, point: ChoicePoint) -> tuple[SetDesign, Guess]:
    """The set with the springs of a point alone, and the point as a starting point of its joint problem."""
    kept = kept_springs(design, point)
    parts = np.split(point.parameters, offsets([s.effect for s in design.springs])[1:-1])
    p, pairs = np.concatenate([np.zeros(0), *[parts[i] for i in kept]]), zip(design.designs, point.motions, strict=True)
    solutions = [Solution.bare(transcribed(one, options, options.fine), w) for one, w in pairs]
    reduced = design.with_springs(tuple(design.springs[i] for i in kept))
    return reduced, reduced.guess([s.guess() for s in solutions], p)

"""Purchasable hardware: the best springs and pulleys of a catalogue, with motion and equilibria optimised for each choice.

The search is branch and bound. A part of the catalogue holds some of the choices for each spring. With parameters anywhere between
those of the part's choices, the optimum costs no more than any of these choices. A part whose optimum costs more than choices that
are known already is excluded; any other is halved, down to single choices. What is excluded is so as far as the local optimum that
IPOPT finds for a part is the global one.
"""

import uuid
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from msgspec import Struct

from rrr_oc.codesign.catalogue import Catalogue, Choices, Kinds, choices_of
from rrr_oc.codesign.search.local_optima import ACCEPTED, Optimum, transcribed
from rrr_oc.codesign.search.multistart import continue_from
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.task_sets.task_set import SetDesign
from rrr_oc.errors import UserError
from rrr_oc.optimal_control.solver import Options, Solution, Solver, SolverFailure
from rrr_oc.parallel import once_per_process, ordered

FINALISTS = 6  # best choices to be found, of which the refined mesh decides; doubled, fewer parts of the catalogue are excluded
BATCH = 8  # parts that are halved at once; doubled, more processes are busy and more problems are solved in vain
MOST = 2000  # problems solved before the search gives up the rest; doubled, a hopeless search takes twice as long


class Coverage(Struct, frozen=True):
    """How much of the catalogue was searched.

    Attributes:
        combinations: Number of combinations in the catalogue.
        distinct: Number of those that differ in kappa, rho or a stiffness, and so in the torque on the arm.
        solved: Number of problems solved, for parts of the catalogue and for single choices.
        single: Number of choices that were solved with their hardware held.
        excluded: Number of choices in excluded parts.
        failed: Number of choices that IPOPT did not solve.
        left: Number of all other choices, where the search ended early.
        margin: Least relative excess of an excluded part's optimum over the best choice; null where no part was excluded [1].
        undercut: Largest relative amount by which the optimum of a half was below that of the part, which shows that the latter was
            not the global one. Bounds are uncertain by as much [1].
    """

    combinations: int
    distinct: int
    solved: int
    single: int
    excluded: int
    failed: int
    left: int
    margin: float | None
    undercut: float


@dataclass(frozen=True, eq=False)
class CatalogueResult:
    """The best of a catalogue.

    Attributes:
        design: The problem with the best hardware held and the rest free.
        optimum: Its optimum.
        hardware: Hardware to buy, in SI units.
        coverage: How much of the catalogue was searched.
        runners_up: Costs and hardware of the best choices on the fine mesh.
    """

    design: SetDesign
    optimum: Optimum
    hardware: dict[str, float]
    coverage: Coverage
    runners_up: list[dict]


@dataclass(frozen=True, eq=False)
class PartChoice:
    """Some choices of a catalogue, and the optimum with parameters between theirs.

    Attributes:
        kinds: The choices.
        bound: Cost of the optimum; where IPOPT found none, that of the part which was halved.
        parameters, w: The optimum's parameters (np,) and scaled variables.
        solved: Whether IPOPT found an optimum.
        undercut: Relative amount by which it is below the optimum of the part which was halved.
    """

    kinds: Kinds
    bound: float
    parameters: np.ndarray
    w: np.ndarray
    solved: bool
    undercut: float

    @property
    def size(self) -> int:
        """Number of choices."""
        return int(np.prod([k.size for k in self.kinds]))


class PartSearch:
    """Branch and bound over a catalogue, from the continuous optimum `start`, on the fine mesh with the smallest smoothing width.

    Attributes:
        parts: All parts that were solved, in their order.
        single: The choices that were solved, cheapest first.
        others: The parts with all other choices, least bound first.
    """

    def __init__(self, choices: Choices, start: Solution, options: SearchOptions) -> None:
        self.choices = choices
        self.single, self.others, self.parts = list[PartChoice](), list[PartChoice](), list[PartChoice]()
        w = transcribed(choices.design, options, options.fine).pack(start.guess())
        self._problem = uuid.uuid4().hex, choices.design, options, w
        self._add([(choices.every, PartChoice(choices.every, start.cost, start.parameters, w, False, 0.0))])

    @property
    def limit(self) -> float:
        """Cost from which on a part is excluded."""
        return self.single[FINALISTS - 1].bound if len(self.single) >= FINALISTS else float("inf")

    def halve(self) -> bool:
        """Halve the most promising parts; False where all are excluded."""
        now = [part for part in self.others[:BATCH] if part.bound < self.limit]
        self.others = self.others[len(now) :]
        self._add([(half, part) for part in now for half in self.choices.halves(part.kinds, part.parameters)])
        return bool(now)

    def _add(self, halves: list[tuple[Kinds, PartChoice]]) -> None:
        """Solve choices, each given with the part that was halved."""
        solutions = ordered(_solve, [(*self._problem, of.w, self.choices.between(kinds)) for kinds, of in halves])
        found = [_part(kinds, of, s) for (kinds, of), s in zip(halves, solutions, strict=True)]
        self.parts += found
        self.single = sorted([*self.single, *(p for p in found if p.size == 1 and p.solved)], key=lambda p: p.bound)
        self.others = sorted([*self.others, *(p for p in found if p.size > 1)], key=lambda p: p.bound)

    def coverage(self) -> Coverage:
        """What has been searched."""
        left = sum(p.size for p in self.others if p.bound < self.limit)
        excluded = [p for p in self.others if p.bound >= self.limit]
        failed = sum(p.size == 1 and not p.solved for p in self.parts)
        margin = excluded[0].bound / self.single[0].bound - 1 if excluded else None
        counts = len(self.parts), len(self.single), sum(p.size for p in excluded), failed, left
        undercut = max(0.0, *(p.undercut for p in self.parts))
        return Coverage(self.choices.combinations, self.parts[0].size, *counts, margin, undercut)


def _part(kinds: Kinds, of: PartChoice, solution: tuple[float, np.ndarray, np.ndarray] | None) -> PartChoice:
    if solution is None:
        return replace(of, kinds=kinds, solved=False, undercut=0.0)
    cost, parameters, w = solution
    return PartChoice(kinds, cost, parameters, w, True, 1 - cost / of.bound if of.solved else 0.0)


def _solve(
    key: str,
    design: SetDesign,
    options: SearchOptions,
    first: np.ndarray,
    near: np.ndarray,
    between: tuple[np.ndarray, np.ndarray],
) -> tuple[float, np.ndarray, np.ndarray] | None:
    """Cost, parameters and scaled variables of the optimum with parameters between bounds, the better one of those from a near
    optimum and from the first one; None where IPOPT finds none."""
    settings = Options(iterations=200, barrier=1e-6)
    solver = once_per_process(key, lambda: Solver(transcribed(design, options, options.fine), settings))
    data = design.data(options.widths[-1])
    solutions = [solver.solve(start, data, check=False, parameters=between) for start in (near, first)]
    solved = [(s.cost, s.parameters, s.w) for s in solutions if s.status in ACCEPTED]
    return min(solved, key=lambda s: s[0], default=None)


def search_catalogue(
    design: SetDesign,
    start: Solution,
    catalogue: Catalogue,
    options: SearchOptions | None = None,
    progress: Callable[[int], None] | None = None,
) -> CatalogueResult:
    """The best purchasable hardware near the continuous optimum `start`, everything else optimised anew for each choice. Of several tasks
    that share the springs, the joint problem is solved for each.

    Args:
        progress: Called with the number of problems solved so far.

    Raises:
        UserError: The design has effects known from a diagnosis, or the catalogue lacks a spring.
        SolverFailure: No choice could be solved.
    """
    if any(s.known for s in design.springs):
        raise UserError("the catalogue's search takes a task as it stands; effects known from a diagnosis are not supported")
    options = options or SearchOptions()
    search = PartSearch(choices_of(design, catalogue), start, options)
    while len(search.parts) < MOST and search.halve():
        if progress:
            progress(len(search.parts))
    return _refined(search, start, options)


def _refined(search: PartSearch, start: Solution, options: SearchOptions) -> CatalogueResult:
    """The best choices followed to the smallest smoothing width once more, and the best of them refined, unless several tasks refine
    meshes of their own."""
    design, best = search.choices.design, search.single[:FINALISTS]
    if len(design.designs) > 1:
        options = replace(options, refinement=replace(options.refinement, rounds=0))
    free = [name for s in design.springs for name in s.form.free_names(s.effect.joints)]
    held = [design.with_fixed(search.choices.hardware(part.kinds), free) for part in best]
    starts = [replace(start.guess(), parameters=part.parameters) for part in best]
    found = continue_from(list(zip(held, starts, strict=True)), options)
    if not found:
        raise SolverFailure("no choice of the catalogue could be solved")
    first, optimum = found[0]
    runners_up = [{"cost": o.cost, **held[i].first.hardware(o.solution.parameters)} for i, o in found]
    hardware = held[first].first.hardware(optimum.solution.parameters)
    return CatalogueResult(held[first], optimum, hardware, search.coverage(), runners_up)

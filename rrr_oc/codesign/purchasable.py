"""Purchasable hardware: the best springs and pulleys of a catalogue, with motion and equilibria optimised for each choice."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.codesign.catalogue import Catalogue, Choice, choices_of
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.screening import ChoiceSolver, Screened, screened
from rrr_oc.codesign.search.local_optima import Optimum
from rrr_oc.codesign.search.multistart import continue_from
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.errors import UserError
from rrr_oc.optimal_control.solver import Solution, SolverFailure

METHODS = ("exhaustive", "screened")
FINALISTS = 6  # choices solved on the fine mesh; doubled, choices that the coarse mesh ranks lower are tried too
ROUGH = {"scheme": "hermite-simpson", "coarse": 10}  # with which every biarticular spring is solved in an exhaustive search
PROMISING = 200  # of those, solved again on the coarse mesh; doubled, the second pass takes twice as long


@dataclass(frozen=True)
class Coverage:
    """How much of the catalogue was searched.

    Attributes:
        combinations: Number of combinations in the catalogue.
        distinct: Number of those that differ in kappa, rho or a stiffness, and so in the torque on the arm.
        solved: Number of those that were solved with the hardware held.
        complete: Whether every distinct one was solved.
        neighbours: Whether of the parallel springs only those were solved whose stiffness is next to the optimal one of their
            biarticular spring. The best is likely among them, because the cost is smooth, but that is not certain.
        relaxed: Number of problems solved for screening, with parallel stiffnesses free or kappa and rho off the catalogue.
        margin: Relative excess over the best cost of the interpolated cost of the best biarticular spring that was not solved;
            infinite where all were.
        failed: Number of problems that IPOPT did not solve.
    """

    combinations: int
    distinct: int
    solved: int
    complete: bool
    neighbours: bool
    relaxed: int
    margin: float
    failed: int


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

    design: CoDesign
    optimum: Optimum
    hardware: dict[str, float]
    coverage: Coverage
    runners_up: list[dict]


def search_catalogue(
    design: CoDesign,
    start: Solution,
    catalogue: Catalogue,
    options: SearchOptions | None = None,
    method: str = "exhaustive",
    progress: Callable[[int], None] | None = None,
) -> CatalogueResult:
    """The best purchasable hardware near the continuous optimum `start`, everything else optimised anew for each choice.

    Args:
        method: "exhaustive" solves every choice of parallel springs, or every distinct (kappa, rho) of a biarticular spring.
            "screened" solves the best of a surface of the cost over (kappa, rho), see `screened`; it is taken in any case for
            parallel and biarticular springs together.
        progress: Called with the number of choices solved so far.

    Raises:
        UserError: The method is unknown, the design has effects known from a diagnosis, or the catalogue lacks a spring.
        SolverFailure: No choice could be solved.
    """
    if method not in METHODS:
        raise UserError(f"unknown catalogue search {method!r}; there are {', '.join(METHODS)}")
    if any(s.known for s in design.springs):
        raise UserError("the catalogue's search takes a task as it stands; effects known from a diagnosis are not supported")
    options = options or SearchOptions()
    choices = choices_of(design, catalogue)
    spring, several = choices.derived, len(choices.of_spring) > 1
    solver = ChoiceSolver(design, start, options, progress)
    if spring is not None and (several or method == "screened"):
        best = screened(choices, spring, solver, FINALISTS)
    else:
        candidates = choices.all()
        if spring is not None:
            rough = ChoiceSolver(design, start, replace(options, **ROUGH), progress)
            candidates = [choice for _, choice, _ in rough.solve(candidates)[:PROMISING]]
            solver.solved, solver.failed = rough.solved - len(candidates), rough.failed
        best = Screened([(cost, choice) for cost, choice, _ in solver.solve(candidates)], 0, float("inf"))
    solved, neighbours = solver.solved - best.relaxed, spring is not None and several
    complete = solved == choices.distinct and not solver.failed
    counts = choices.combinations, choices.distinct, solved
    coverage = Coverage(*counts, complete, neighbours and not complete, best.relaxed, best.margin, solver.failed)
    return _on_fine_mesh(design, start, options, [c for _, c in best.ranked[:FINALISTS]], coverage)


def _on_fine_mesh(
    design: CoDesign, start: Solution, options: SearchOptions, choices: list[Choice], coverage: Coverage
) -> CatalogueResult:
    """Solve the best choices on the fine mesh, and refine the best of them."""
    free = [name for s in design.springs for name in s.form.free_names(s.effect.joints)]
    held = [design.with_fixed(c.hardware, free) for c in choices]
    starts = [replace(start.guess(), parameters=np.clip(start.parameters, c.lower, c.upper)) for c in choices]
    found = continue_from(list(zip(held, starts, strict=True)), options)
    if not found:
        raise SolverFailure("no choice of the catalogue could be solved", 0, 0.0, "")
    best, optimum = found[0]
    runners_up = [{"cost": o.cost, **held[i].hardware(o.solution.parameters)} for i, o in found]
    return CatalogueResult(held[best], optimum, held[best].hardware(optimum.solution.parameters), coverage, runners_up)

"""The choices of a catalogue solved on a coarse mesh, and the best of them found without solving all: screened on a smooth surface."""

import uuid
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from rrr_oc.codesign.catalogue import Choice, Choices
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.local_optima import transcribed
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.optimal_control.solver import Options, Solution, Solver
from rrr_oc.parallel import once_per_process, unordered

GRID = 12  # nodes an axis of the surface; twice as many solve four times the problems for a surface that is smooth anyway
MARGIN = 0.02  # [1] screening ends at this distance above the best cost; doubled it solves more and trusts the surface less
BATCH = 64  # choices solved at once between two decisions to end; doubled, more are solved than the decision needs
CHUNK = 40  # choices that one process solves in turn; doubled, processes wait longer for the last one
ACCEPTED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
Solved = tuple[float, Choice, np.ndarray]  # cost (infinite where IPOPT failed), choice, parameters (np,)


class ChoiceSolver:
    """Solves choices of a design, counted in `solved` and `failed`."""

    def __init__(
        self, design: CoDesign, start: Solution, options: SearchOptions, progress: Callable[[int], None] | None = None
    ) -> None:
        coarse = Solver(transcribed(design, options, options.coarse), Options(barrier=1e-4))
        w = coarse.solve(start.guess(), design.data(options.widths[0])).w
        self._problem = uuid.uuid4().hex, design, options, w
        self._progress = progress
        self.solved = self.failed = 0

    def solve(self, choices: list[Choice]) -> list[Solved]:
        """(cost, choice, parameters), cheapest first. Neighbours are solved in turn, each started from the one before."""
        ordered = sorted(choices, key=lambda c: c.lower.tolist())
        arguments = [(*self._problem, ordered[i : i + CHUNK]) for i in range(0, len(ordered), CHUNK)]
        results: list[Solved] = []
        for part in unordered(_solve_chunk, arguments):
            results += part
            self.solved += len(part)
            if self._progress:
                self._progress(self.solved)
        self.failed += sum(not np.isfinite(r[0]) for r in results)
        return sorted(results, key=lambda r: (r[0], r[1].lower.tolist()))


def _solve_chunk(key: str, design: CoDesign, options: SearchOptions, w: np.ndarray, choices: list[Choice]) -> list[Solved]:
    settings = Options(tolerance=1e-5, iterations=100, barrier=1e-4)
    solver = once_per_process(key, lambda: Solver(transcribed(design, options, options.coarse), settings))
    results, data, start = [], design.data(options.widths[0]), w
    for choice in choices:
        bounds = choice.lower, choice.upper
        solution = solver.solve(start, data, check=False, parameters=bounds)
        if solution.status not in ACCEPTED:
            solution = solver.solve(w, data, check=False, parameters=bounds)
        solved = solution.status in ACCEPTED
        start = solution if solved else w
        results.append((solution.cost if solved else float("inf"), choice, solution.parameters))
    return results


class Screened(NamedTuple):
    """(cost, choice) of what was solved with the hardware held, cheapest first; and of `Coverage` the number `relaxed` and the
    `margin`."""

    ranked: list[tuple[float, Choice]]
    relaxed: int
    margin: float


def screened(choices: Choices, spring: int, solver: ChoiceSolver, finalists: int) -> Screened:
    """The catalogue's best by screening, for a biarticular spring with or without parallel ones.

    With the parallel stiffnesses free, the optimal cost is a smooth function of (kappa, rho), and a lower bound of what any
    catalogued parallel springs can reach. It is solved on a grid and interpolated for every catalogued (kappa, rho). In the order
    of these values each (kappa, rho) is solved itself, then with the catalogued stiffnesses next to its optimal ones, until the
    next value is more than `MARGIN` above the best cost found.
    """
    kinds = choices.of_spring[spring]
    values, relaxed = np.full(len(kinds), -np.inf), 0  # so few that all are solved
    if len(kinds) > GRID**2:
        values, relaxed = _surface(choices, solver, spring), GRID**2
    order = np.argsort(values, kind="stable")
    ranked: list[tuple[float, Choice]] = []
    for position in range(0, len(order), BATCH):
        value = float(np.exp(values[order[position]]))
        if ranked and value > ranked[0][0] * (1 + MARGIN):
            return Screened(ranked, relaxed, value / ranked[0][0] - 1)
        solved = solver.solve([choices.alone(kinds[i], spring) for i in order[position : position + BATCH]])
        if len(choices.of_spring) > 1:
            relaxed += len(solved)
            limit = ranked[min(finalists, len(ranked)) - 1][0] if ranked else float("inf")
            near = [c for cost, choice, p in solved if cost < limit for c in choices.neighbours(choice, p)]
            solved = solver.solve(near)
        ranked = sorted([*ranked, *[(cost, c) for cost, c, _ in solved]], key=lambda r: r[0])
    return Screened(ranked, relaxed, float("inf"))


def _surface(choices: Choices, solver: ChoiceSolver, spring: int) -> np.ndarray:
    """Logarithm of the optimal cost with parallel springs free, for every choice of the biarticular spring, by cubic interpolation
    in (log kappa, rho)."""
    kinds, at = choices.of_spring[spring], sum(len(s.lower) for s in choices.design.springs[:spring])
    kappa, rho = (np.array([c.lower[i] for c in kinds]) for i in (0, 1))
    axes = np.geomspace(kappa.min(), kappa.max(), GRID), np.linspace(rho.min(), rho.max(), GRID)
    low, high = min(c.lower[2] for c in kinds), max(c.upper[2] for c in kinds)
    nodes = [Choice({}, np.array([k, r, low]), np.array([k, r, high])) for k in axes[0] for r in axes[1]]
    solved = solver.solve([choices.alone(node, spring) for node in nodes])
    costs = {(c.lower[at], c.lower[at + 1]): cost for cost, c, _ in solved}
    table = np.array([[costs[k, r] for r in axes[1]] for k in axes[0]])
    table[~np.isfinite(table)] = table[np.isfinite(table)].max()
    surface = RegularGridInterpolator((np.log(axes[0]), axes[1]), np.log(table), method="cubic")
    return surface(np.c_[np.log(kappa), rho])

"""Local optima of a co-design: followed from the coarse to the fine mesh, compared, and refined."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.task_sets.task_set import SetDesign
from rrr_oc.optimal_control.optimality import Kkt
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.refinement import mesh_row, refine
from rrr_oc.optimal_control.scheme import scheme, uniform_mesh
from rrr_oc.optimal_control.solver import Options, Solution, Solver, SolverFailure
from rrr_oc.optimal_control.transcription import Transcription
from rrr_oc.parallel import ordered

Solvable = CoDesign | SetDesign  # springs and motion of one task, or of several
SOLVED = "Solve_Succeeded"
ACCEPTED = (SOLVED, "Solved_To_Acceptable_Level")  # statuses of an optimum that is refined later


@dataclass(frozen=True, eq=False)
class Optimum:
    """A local optimum on a fine mesh.

    Attributes:
        solution: On its last mesh, with the smallest smoothing width.
        meshes: One row a mesh, as `refine` returns them; a single row where it was not refined.
        reached: Number of starts from Sobol points that led here, which are independent of one another. 0 where it was put together
            from motions of single phases, or found from other optima.
    """

    solution: Solution
    meshes: list[dict]
    reached: int = 0

    @property
    def cost(self) -> float:
        """The solution's cost."""
        return self.solution.cost


def transcribed(design: Solvable, options: SearchOptions, intervals: int, everywhere: bool = False) -> Transcription:
    """The problem on a uniform mesh with the search's scheme, its functions compiled; limits of controls hold at the stages or
    `everywhere`."""
    method, mesh = scheme(options.scheme, options.stages, everywhere), uniform_mesh(design.problem, intervals)
    return Transcription(design.problem, method, mesh, compiled=True)


def same_optimum(a: Solution, b: Solution) -> bool:
    """Whether two solutions are one optimum: cost within 0.2 %, springs within 1 % of their range, durations within 0.03 s and
    paths within 0.03 rad. Springs are compared in kappa, rho, phi, so that equivalent hardware is one design.
    """
    return _same_springs(a, b) and same_motion(a, b)


def same_motion(a: Solution, b: Solution) -> bool:
    """As `same_optimum`, for springs that may differ: in what has no effect on this motion, as the equilibrium of a slack spring."""
    if abs(a.cost - b.cost) > 2e-3 * abs(b.cost) or np.abs(a.durations - b.durations).max() > 0.03:
        return False
    s = np.linspace(0, 1, 41)
    m = len(a.problem.phases[0].u)  # the first states are the angles
    return all(np.abs(a.at(i, s)[0][:m] - b.at(i, s)[0][:m]).max() < 0.03 for i in range(len(a.durations)))


def _same_springs(a: Solution, b: Solution) -> bool:
    """Whether the springs of two solutions are the same, to 1 % of their range."""
    return bool(np.all(np.abs(a.parameters - b.parameters) <= 0.01 * a.problem.p_scale))


def distinct(optima: Iterable[Optimum]) -> list[Optimum]:
    """The different ones of some optima, cheapest first: of equal ones the cheaper, with the starts of both."""
    kept: list[Optimum] = []
    for found in optima:
        same = next((i for i, other in enumerate(kept) if same_optimum(found.solution, other.solution)), None)
        if same is None:
            kept.append(found)
        else:
            reached = found.reached + kept[same].reached
            kept[same] = replace(min(found, kept[same], key=lambda o: o.cost), reached=reached)
    return sorted(kept, key=lambda o: o.cost)


def moving_apart(optima: Iterable[Optimum], most: int) -> list[Optimum]:
    """The first optima, at most so many, of which none before has the same motion, whatever the springs."""
    kept: list[Optimum] = []
    for o in optima:
        if len(kept) == most:
            break
        if not any(same_motion(o.solution, other.solution) for other in kept):
            kept.append(o)
    return kept


def attached(design: Solvable, options: SearchOptions, optimum: Optimum) -> Optimum:
    """An optimum of `design` that another process found, on this process's own problem and scheme, whose functions exist already."""
    s = optimum.solution
    problem = replace(design.problem, data=s.problem.data)
    own = transcribed(design, options, 1, s.transcription.scheme.everywhere)
    transcription = replace(own, problem=problem, mesh=s.transcription.mesh)
    return replace(optimum, solution=replace(s, transcription=transcription))


def follow_to_fine_mesh(design: Solvable, options: SearchOptions, guess: Guess) -> Optimum | None:
    """The optimum near a guess on the fine mesh with the smallest smoothing width; None where IPOPT loses it."""
    solver = Solver(transcribed(design, options, options.fine), Options(barrier=1e-6))
    try:
        followed = solver.solve(guess, design.data(options.width))
        for width in options.widths if design.springs else options.widths[-1:]:
            followed = solver.solve(followed, design.data(width))
        followed = leave_saddle(solver, followed)
    except SolverFailure:
        return None
    return Optimum(followed, [mesh_row(followed)])


def followed(calls: Sequence[tuple[Solvable, SearchOptions, Guess]]) -> list[Optimum | None]:
    """As `follow_to_fine_mesh`, in parallel."""
    return [o and attached(*call[:2], o) for call, o in zip(calls, ordered(follow_to_fine_mesh, calls), strict=True)]


def leave_saddle(solver: Solver, solution: Solution, rounds: int = 3) -> Solution:
    """Where the curvature is negative along some direction, go both ways along it and solve again."""
    for _ in range(rounds):
        conditions = Kkt(solution)
        if conditions.verdict() != "violated":
            break
        direction = conditions.second_order()[2]
        step = 0.1 * direction / np.abs(direction).max()
        tries = [solver.solve(solution.w + s * step, solution.problem.data, check=False) for s in (1, -1)]
        lower = [t for t in tries if t.status == SOLVED and t.cost < solution.cost * (1 - 1e-6)]
        if not lower:
            break
        solution = min(lower, key=lambda s: s.cost)
    return solution


def refined(calls: Sequence[tuple[Solvable, SearchOptions, Optimum]]) -> list[Optimum]:
    """Optima refined to the mesh tolerance, in parallel; one that is lost on a finer mesh stays as it was, with its error."""
    return [attached(*call[:2], o) for call, o in zip(calls, ordered(_refined, calls), strict=True)]


def _refined(design: Solvable, options: SearchOptions, optimum: Optimum) -> Optimum:
    try:
        solution, rows = refine(attached(design, options, optimum).solution, options.refinement)
        left = leave_saddle(Solver(solution.transcription, Options(barrier=1e-6)), solution)
        if left is not solution:
            solution, more = refine(left, options.refinement)
            rows += more
    except SolverFailure:
        return optimum
    return Optimum(solution, rows, optimum.reached)

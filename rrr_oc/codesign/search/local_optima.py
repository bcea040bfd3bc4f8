"""Local optima of a co-design: followed from the coarse to the fine mesh, compared, refined, and improved by basin hopping."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.optimal_control.optimality import Kkt
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.refinement import mesh_row, refine
from rrr_oc.optimal_control.scheme import scheme, uniform_mesh
from rrr_oc.optimal_control.solver import Options, Solution, Solver, SolverFailure
from rrr_oc.optimal_control.transcription import Transcription
from rrr_oc.parallel import ordered

SOLVED = "Solve_Succeeded"
STRETCHES = (0.85, 0.92, 1.08, 1.15)  # [1] factors on a duration that a hop tries; with steps twice as large it skips optima
BARRIERS = (1e-2, 1e-6)  # [1] initial barrier parameters of a hop: far from the bounds, and close to the stretched optimum


@dataclass(frozen=True, eq=False)
class Optimum:
    """A local optimum on a fine mesh.

    Attributes:
        solution: On its last mesh, with the smallest smoothing width.
        meshes: One row a mesh, as `refine` returns them; a single row where it was not refined.
        reached: Number of starts that ended here; 0 where it was found from another optimum (hopping, `continue_from`).
    """

    solution: Solution
    meshes: list[dict]
    reached: int = 0

    @property
    def cost(self) -> float:
        """The solution's cost."""
        return self.solution.cost


def transcribed(design: CoDesign, options: SearchOptions, intervals: int) -> Transcription:
    """The problem on a uniform mesh with the search's scheme, its functions compiled."""
    method, mesh = scheme(options.scheme, options.stages), uniform_mesh(design.problem, intervals)
    return Transcription(design.problem, method, mesh, compiled=True)


def same_optimum(a: Solution, b: Solution) -> bool:
    """Whether two solutions are one optimum: cost within 0.2 %, springs within 1 % of their range, durations within 0.03 s and
    paths within 0.03 rad. Springs are compared in kappa, rho, phi, so that equivalent hardware is one design.
    """
    if abs(a.cost - b.cost) > 2e-3 * abs(b.cost) or np.abs(a.durations - b.durations).max() > 0.03:
        return False
    if np.any(np.abs(a.parameters - b.parameters) > 0.01 * a.problem.p_scale):
        return False
    s = np.linspace(0, 1, 41)
    half = len(a.problem.phases[0].states) // 2
    return all(np.abs(a.at(i, s)[0][:half] - b.at(i, s)[0][:half]).max() < 0.03 for i in range(len(a.durations)))


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


def attached(design: CoDesign, options: SearchOptions, optimum: Optimum) -> Optimum:
    """An optimum of `design` that another process found, on this process's own problem and scheme, whose functions exist already."""
    s = optimum.solution
    problem = replace(design.problem, data=s.problem.data)
    transcription = replace(transcribed(design, options, 1), problem=problem, mesh=s.transcription.mesh)
    return replace(optimum, solution=replace(s, transcription=transcription))


def follow_to_fine_mesh(design: CoDesign, options: SearchOptions, guess: Guess) -> Optimum | None:
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


def refined(design: CoDesign, options: SearchOptions, optima: list[Optimum]) -> list[Optimum]:
    """Optima refined to the mesh tolerance, in parallel; one that is lost on a finer mesh stays as it was, with its error."""
    found = ordered(_refine, [(design, options, o) for o in optima])
    return [attached(design, options, o) for o in found]


def _refine(design: CoDesign, options: SearchOptions, optimum: Optimum) -> Optimum:
    try:
        solution, rows = refine(attached(design, options, optimum).solution, options.refinement)
        left = leave_saddle(Solver(solution.transcription, Options(barrier=1e-6)), solution)
        if left is not solution:
            solution, more = refine(left, options.refinement)
            rows += more
    except SolverFailure:
        return optimum
    return Optimum(solution, rows, optimum.reached)


def hopped(design: CoDesign, options: SearchOptions, optimum: Optimum) -> Optimum:
    """Basin hopping over the durations, as long as it lowers the cost. Optima of nearly equal cost differ in the number of
    swings, so the best one is stretched or shortened, phase by phase, and solved again."""
    for _ in range(options.hops):
        best = optimum
        tries = [(design, options, optimum, i, f, barrier) for i in range(2) for f in STRETCHES for barrier in BARRIERS]
        for found in ordered(_hop, tries):
            if found is not None and found.cost < best.cost * (1 - 1e-5):
                best = attached(design, options, found)
        if best is optimum:
            break
        optimum = best
    return replace(optimum, reached=0)


def _hop(
    design: CoDesign, options: SearchOptions, optimum: Optimum, phase: int, factor: float, barrier: float
) -> Optimum | None:
    start = attached(design, options, optimum).solution
    guess = start.guess()
    motions = list(guess.phases)
    motions[phase] = replace(motions[phase], duration=float(np.clip(factor * motions[phase].duration, *design.task.duration)))
    solver = Solver(transcribed(design, options, options.fine), Options(barrier=barrier, iterations=200))
    found = solver.solve(Guess(tuple(motions), guess.parameters), start.problem.data, check=False)
    return Optimum(found, [mesh_row(found)]) if found.status == SOLVED else None

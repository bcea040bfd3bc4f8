"""Local optima of a co-design: followed from the coarse to the fine mesh, compared, refined, and improved by basin hopping."""

from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.proposals import SearchOptions
from rrr_oc.optimal_control.optimality import Kkt
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.refinement import mesh_row, refine
from rrr_oc.optimal_control.scheme import scheme, uniform_mesh
from rrr_oc.optimal_control.solver import Options, Solution, Solver, SolverFailure, continue_in
from rrr_oc.optimal_control.transcription import Transcription
from rrr_oc.parallel import ordered

SOLVED = "Solve_Succeeded"
STRETCHES = (0.85, 0.92, 1.08, 1.15)  # [1] factors on a duration that a hop tries
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
    problem = design.problem
    return Transcription(problem, scheme(options.scheme, options.stages), uniform_mesh(problem, intervals), compiled=True)


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


def join_optimum(optima: list[Optimum], found: Optimum) -> None:
    """Add an optimum to distinct ones. Where it equals one of them, the cheaper of both stands, with the starts of both."""
    for i, other in enumerate(optima):
        if same_optimum(found.solution, other.solution):
            better = min(found, other, key=lambda o: o.cost)
            optima[i] = replace(better, reached=found.reached + other.reached)
            return
    optima.append(found)


@dataclass(frozen=True)
class PackedOptimum:
    """An optimum as plain arrays, to be passed between processes: compiled functions cannot be."""

    mesh: tuple[np.ndarray, ...]
    data: np.ndarray
    arrays: tuple[np.ndarray, np.ndarray, np.ndarray]
    numbers: tuple[float, str, int, float]
    meshes: list[dict]
    reached: int

    @classmethod
    def of(cls, optimum: Optimum) -> "PackedOptimum":
        """Pack an optimum."""
        s = optimum.solution
        numbers = s.cost, s.status, s.iterations, s.seconds
        return cls(s.transcription.mesh, s.problem.data, (s.w, s.lam_g, s.lam_w), numbers, optimum.meshes, optimum.reached)

    def of_design(self, design: CoDesign, options: SearchOptions) -> Optimum:
        """The optimum as one of `design`, which must be the design that it was packed from."""
        problem = replace(design.problem, data=self.data)
        transcription = Transcription(problem, scheme(options.scheme, options.stages), self.mesh, compiled=True)
        return Optimum(Solution(transcription, *self.arrays, *self.numbers), self.meshes, self.reached)


def follow_to_fine_mesh(design: CoDesign, options: SearchOptions, guess: Guess) -> PackedOptimum | None:
    """The optimum near a guess on the fine mesh with the smallest smoothing width; None where IPOPT loses it."""
    solver = Solver(transcribed(design, options, options.fine), Options(barrier=1e-6))
    try:
        followed = solver.solve(guess, design.data(options.width))
        widths = options.widths if design.springs else options.widths[-1:]
        followed = continue_in(solver, followed, [design.data(width) for width in widths])
        followed = leave_saddle(solver, followed)
    except SolverFailure:
        return None
    return PackedOptimum.of(Optimum(followed, [mesh_row(followed)]))


def leave_saddle(solver: Solver, solution: Solution, rounds: int = 3) -> Solution:
    """Where the curvature is negative along some direction, go both ways along it and solve again."""
    for _ in range(rounds):
        conditions = Kkt(solution)
        if conditions.verdict() != "violated":
            break
        direction = conditions.second_order()[2]
        step = 0.1 * direction / np.abs(direction).max()
        found = []
        for sign in (1, -1):
            away = solver.solve(solution.w + sign * step, solution.problem.data, check=False)
            if away.status == SOLVED and away.cost < solution.cost * (1 - 1e-6):
                found.append(away)
        if not found:
            break
        solution = min(found, key=lambda s: s.cost)
    return solution


def refined(design: CoDesign, options: SearchOptions, optima: list[Optimum]) -> list[Optimum]:
    """Optima refined to the mesh tolerance, in parallel; one that is lost on a finer mesh stays as it was, with its error."""
    packed = ordered(_refine, [(design, options, PackedOptimum.of(o)) for o in optima], options.jobs)
    return [p.of_design(design, options) for p in packed]


def _refine(design: CoDesign, options: SearchOptions, packed: PackedOptimum) -> PackedOptimum:
    try:
        solution, rows = refine(packed.of_design(design, options).solution, options.refinement)
        left = leave_saddle(Solver(solution.transcription, Options(barrier=1e-6)), solution)
        if left is not solution:
            solution, more = refine(left, options.refinement)
            rows += more
    except SolverFailure:
        return packed
    return PackedOptimum.of(Optimum(solution, rows, packed.reached))


def hopped(design: CoDesign, options: SearchOptions, optimum: Optimum) -> Optimum:
    """Basin hopping over the durations, as long as it lowers the cost. Optima of nearly equal cost differ in the number of
    swings, so the best one is stretched or shortened, phase by phase, and solved again."""
    for _ in range(options.hops):
        packed, best = PackedOptimum.of(optimum), optimum
        tries = [(design, options, packed, i, f, barrier) for i in range(2) for f in STRETCHES for barrier in BARRIERS]
        for found in ordered(_hop, tries, options.jobs):
            if found is not None and found.numbers[0] < best.cost * (1 - 1e-5):
                best = found.of_design(design, options)
        if best is optimum:
            break
        optimum = best
    return replace(optimum, reached=0)


def _hop(
    design: CoDesign, options: SearchOptions, packed: PackedOptimum, phase: int, factor: float, barrier: float
) -> PackedOptimum | None:
    guess = packed.of_design(design, options).solution.guess()
    motions = list(guess.phases)
    motions[phase] = replace(motions[phase], duration=float(np.clip(factor * motions[phase].duration, *design.task.duration)))
    solver = Solver(transcribed(design, options, options.fine), Options(barrier=barrier, iterations=200))
    found = solver.solve(Guess(tuple(motions), guess.parameters), packed.data, check=False)
    return PackedOptimum.of(Optimum(found, [mesh_row(found)])) if found.status == SOLVED else None

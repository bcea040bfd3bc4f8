"""Solve a transcribed problem with IPOPT, measure its error between the nodes, and refine the mesh until it is small."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.optimal_control.problem import Guess, PhaseGuess, Problem
from rrr_oc.optimal_control.transcription import Scheme, Transcription, scheme, uniform_mesh


class SolverFailure(Exception):
    """IPOPT found no optimum. Carries what it had: `status`, `iterations`, `violation` and `violated` (in words)."""

    def __init__(self, status: str, iterations: int, violation: float, violated: str) -> None:
        self.status, self.iterations, self.violation, self.violated = status, iterations, violation, violated
        where = f"; most violated: {violated}, by {violation:.2g} (scaled)" if violation > 1e-6 else ""
        super().__init__(f"IPOPT stopped after {iterations} iterations with {status!r}{where}")


@dataclass(frozen=True)
class Options:
    """How IPOPT runs.

    Attributes:
        tolerance: Of the optimality conditions, scaled.
        iterations: Limit.
        barrier: Initial barrier parameter; None is IPOPT's own choice. Small for a warm start.
        linear_solver: One that the casadi wheel carries (mumps, spral).
        seconds: Limit of wall time [s].
    """

    tolerance: float = 1e-8
    iterations: int = 500
    barrier: float | None = None
    linear_solver: str = "mumps"
    seconds: float = 600.0

    def ipopt(self) -> dict[str, object]:
        """The options by IPOPT's names."""
        named: dict[str, object] = {
            "tol": self.tolerance,
            "max_iter": self.iterations,
            "max_wall_time": self.seconds,
            "linear_solver": self.linear_solver,
            "print_level": 0,
            "sb": "yes",
            "mu_strategy": "adaptive",
            "bound_relax_factor": 1e-12,  # the default of 1e-8 would be the floor of the accuracy
        }
        if self.barrier is not None:
            named |= {
                "mu_strategy": "monotone",
                "mu_init": self.barrier,
                "warm_start_init_point": "yes",
                "warm_start_bound_push": self.barrier,
                "warm_start_mult_bound_push": self.barrier,
                "warm_start_slack_bound_push": self.barrier,
            }
        return named


@dataclass(frozen=True, eq=False)
class Solution:
    """An optimum on a mesh, with its problem and statistics.

    Attributes:
        transcription: Problem, scheme and mesh.
        w: Scaled variables.
        lam_g, lam_w: Multipliers of the constraints and of the bounds, of the scaled problem.
        cost: The problem's cost, in its own unit.
        status: IPOPT's word.
        iterations, seconds: Effort.
    """

    transcription: Transcription
    w: np.ndarray
    lam_g: np.ndarray
    lam_w: np.ndarray
    cost: float
    status: str
    iterations: int
    seconds: float

    @property
    def problem(self) -> Problem:
        """What was solved."""
        return self.transcription.problem

    @cached_property
    def values(self) -> np.ndarray:
        """Variables in their own units."""
        return self.w * self.transcription.scale

    @property
    def parameters(self) -> np.ndarray:
        """Decision parameters p."""
        return self.values[: len(self.problem.parameters)]

    @property
    def durations(self) -> np.ndarray:
        """Duration of each phase [s]."""
        return np.array([self.values[block.duration] for block in self.transcription.blocks])

    def sample(self, phase: int, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The method's own interpolants at points inside every interval of a phase.

        Args:
            phase: Index of the phase.
            inside: Points in [0, 1] of each interval, (K,).

        Returns:
            t (N, K) [s] since the phase's start, x (nx, N, K), dx/dt (nx, N, K), u (nu, N, K).
        """
        transcription = self.transcription
        block, s = transcription.blocks[phase], transcription.scheme
        T, h = self.durations[phase], transcription.mesh[phase] * self.durations[phase]
        lagrange, integrals = s.at(np.asarray(inside))
        x_stages, u_stages = self.values[block.stage_x], self.values[block.stage_u]  # (·, d, N)
        f = self._rates(phase, x_stages, u_stages)[0]
        start = self.values[block.nodes[:, :-1]]
        t = T * (np.r_[0, np.cumsum(transcription.mesh[phase])[:-1]][:, None]) + h[:, None] * inside
        x = start[:, :, None] + np.einsum("kd,xdn,n->xnk", integrals, f, h)
        return t, x, np.einsum("kd,xdn->xnk", lagrange, f), np.einsum("kd,udn->unk", lagrange, u_stages)

    def _rates(self, phase: int, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rates, cost rate and paths at states and controls of any trailing shape."""
        shape = x.shape[1:]
        p, d = self.parameters[:, None], self.problem.data[:, None]
        rates = self.problem.phases[phase].rates
        count = int(np.prod(shape))
        outputs = rates(x.reshape(len(x), count), u.reshape(len(u), count), p, d)
        f, cost, path = (np.array(o) for o in outputs)
        return f.reshape(len(f), *shape), cost.reshape(shape), path.reshape(len(path), *shape)

    @cached_property
    def error(self) -> "MeshError":
        """Error of the collocation between the nodes."""
        return _mesh_error(self)

    def guess(self) -> Guess:
        """This solution as a start for another mesh."""
        phases = []
        for i, block in enumerate(self.transcription.blocks):
            phases.append(
                PhaseGuess(self.values[block.duration], lambda s, i=i: self.at(i, s)[0], lambda s, i=i: self.at(i, s)[1])
            )
        return Guess(tuple(phases), self.parameters)

    def at(self, phase: int, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (nx, K) and controls (nu, K) at normalised times s in [0, 1] of a phase."""
        edges = np.r_[0, np.cumsum(self.transcription.mesh[phase])]
        edges[-1] = 1.0
        k = np.clip(np.searchsorted(edges, s, side="right") - 1, 0, len(edges) - 2)
        inside = (s - edges[k]) / (edges[k + 1] - edges[k])
        block, method = self.transcription.blocks[phase], self.transcription.scheme
        lagrange, integrals = method.at(inside)
        u_stages = self.values[block.stage_u]
        f = self._rates(phase, self.values[block.stage_x], u_stages)[0]
        h = self.transcription.mesh[phase] * self.durations[phase]
        x = self.values[block.nodes[:, k]] + np.einsum("kd,xdk,k->xk", integrals, f[:, :, k], h[k])
        return x, np.einsum("kd,udk->uk", lagrange, u_stages[:, :, k])


@dataclass(frozen=True)
class MeshError:
    """How far a collocated solution is from solving the differential equations between its nodes.

    Attributes:
        intervals: For each phase, the relative error of each interval: ∫ |x' − f(x, u)| dt over the states' scale, and the
            error of the cost's quadrature over the whole cost (N,).
        largest: The largest of them.
        quadrature: Relative difference between the cost with the scheme's weights and by fine quadrature on the same motion.
            Not the cost's distance from the optimum: that shows in its change from mesh to mesh.
        violation: Largest excess of bounds between the nodes, relative to the variables' scales; of paths, in their own unit.
    """

    intervals: tuple[np.ndarray, ...]
    largest: float
    quadrature: float
    violation: float


def _mesh_error(solution: Solution) -> MeshError:
    """Betts, "Practical Methods for Optimal Control", section 4.7: the residual of the interpolants, integrated."""
    nodes, weights = np.polynomial.legendre.leggauss(2 * solution.transcription.scheme.d + 3)
    inside, weights = (nodes + 1) / 2, weights / 2
    intervals, fine_total, violation = [], 0.0, 0.0
    scale = _magnitude(solution)
    for i, (phase, block) in enumerate(zip(solution.problem.phases, solution.transcription.blocks, strict=True)):
        _, x, dx, u = solution.sample(i, inside)
        f, cost, path = solution._rates(i, x, u)
        h = solution.transcription.mesh[i] * solution.durations[i]
        defect = np.einsum("xnk,k,n->xn", np.abs(dx - f), weights, h)
        magnitude = 1 * phase.x_scale + np.abs(solution.values[block.nodes]).max(axis=1)
        coarse = solution._rates(i, solution.values[block.stage_x], solution.values[block.stage_u])[1]
        fine = np.einsum("nk,k,n->n", cost, weights, h)
        quadrature = np.abs(fine - np.einsum("dn,d,n->n", coarse, solution.transcription.scheme.b, h)) / scale
        intervals.append(np.maximum((defect / magnitude[:, None]).max(axis=0), quadrature))
        fine_total += fine.sum()
        for value, lower, upper, size in (
            (x, phase.x_lower, phase.x_upper, phase.x_scale),
            (u, phase.u_lower, phase.u_upper, phase.u_scale),
            (path, phase.path_lower, phase.path_upper, np.ones(len(phase.paths))),
        ):
            excess = np.maximum(lower[:, None, None] - value, value - upper[:, None, None]) / size[:, None, None]
            violation = max(violation, float(excess.max(initial=0.0)))
    largest = max(float(e.max()) for e in intervals)
    return MeshError(tuple(intervals), largest, abs(fine_total - solution.cost) / scale, violation)


class Solver:
    """A transcription made ready for IPOPT; solves from many starts without being built again."""

    def __init__(self, transcription: Transcription, options: Options | None = None) -> None:
        self.transcription = transcription
        self.options = options or Options()
        functions = dict(transcription.functions)
        self._functions = functions
        self._nlp = functions.pop("nlp")
        self._solvers: dict[float | None, ca.Function] = {}

    def solve(
        self,
        start: Guess | Solution | np.ndarray,
        data: np.ndarray | None = None,
        check: bool = True,
        parameters: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> Solution:
        """Solve from a guess, from scaled variables, or from a solution on the same mesh (its multipliers serve too).

        Args:
            start: Where to start. A solution starts IPOPT warm.
            data: Values of d; default the problem's.
            check: Raise `SolverFailure` unless IPOPT reports an optimum; otherwise the solution carries the status.
            parameters: Bounds of the parameters for this solve only; default the problem's.
        """
        transcription = self.transcription
        problem = transcription.problem if data is None else replace(transcription.problem, data=np.asarray(data, float))
        warm = isinstance(start, Solution)
        w0 = start.w if isinstance(start, Solution) else transcription.pack(start) if isinstance(start, Guess) else start
        if problem.data.size != transcription.problem.data.size or np.size(w0) != transcription.size:
            raise UserError(
                f"the start has {np.size(w0)} variables and {problem.data.size} data; this mesh needs {transcription.size} and "
                f"{transcription.problem.data.size} (a solution on another mesh starts a solve by its guess())"
            )
        lower, upper = (b.copy() for b in transcription.bounds)
        if parameters is not None:
            n_p = len(problem.parameters)
            lower[:n_p], upper[:n_p] = (b / problem.p_scale for b in parameters)
        arguments = {"x0": np.clip(w0, lower, upper), "p": problem.data, "lbx": lower, "ubx": upper}
        arguments["lbg"], arguments["ubg"] = transcription.row_bounds
        if isinstance(start, Solution) and start.lam_g.size == arguments["lbg"].size:
            arguments |= {"lam_g0": start.lam_g, "lam_x0": start.lam_w}
        barrier = (self.options.barrier or 1e-7) if warm else self.options.barrier
        solver, began = self._solver(barrier), time.perf_counter()
        result = solver(**arguments)
        seconds, stats = time.perf_counter() - began, solver.stats()
        if stats["return_status"] == "NonIpopt_Exception_Thrown":
            raise KeyboardInterrupt
        g = np.array(result["g"]).ravel()
        if check and not stats["success"]:
            raise self._failure(stats, g, arguments)
        solved = transcription if data is None else replace(transcription, problem=problem)
        return Solution(
            solved,
            np.array(result["x"]).ravel(),
            np.array(result["lam_g"]).ravel(),
            np.array(result["lam_x"]).ravel(),
            float(result["f"]) * problem.cost_scale,
            stats["return_status"],
            stats["iter_count"],
            seconds,
        )

    def _solver(self, barrier: float | None) -> ca.Function:
        if barrier not in self._solvers:
            options = {
                "ipopt": replace(self.options, barrier=barrier).ipopt(),
                "print_time": False,
                "calc_lam_p": False,
                "no_nlp_grad": True,  # compiled functions have no derivatives, and none is needed
            }
            self._solvers[barrier] = ca.nlpsol("solver", "ipopt", self._nlp, options | self._functions)
        return self._solvers[barrier]

    def _failure(self, stats: dict, g: np.ndarray, arguments: dict) -> SolverFailure:
        excess = np.maximum(arguments["lbg"] - g, g - arguments["ubg"])
        worst = int(np.argmax(excess))
        name = self.transcription.row_name(worst)
        return SolverFailure(stats["return_status"], stats["iter_count"], float(excess[worst]), name)


@dataclass(frozen=True)
class Refinement:
    """When a mesh is fine enough.

    Attributes:
        tolerance: Relative; of the error between the nodes, and of the cost's change from mesh to mesh.
        rounds: Limit of meshes.
        largest: Limit of intervals a phase.
    """

    tolerance: float = 1e-6
    rounds: int = 12
    largest: int = 640


def refine(
    solution: Solution, refinement: Refinement | None = None, options: Options | None = None
) -> tuple[Solution, list[dict]]:
    """Solve on finer meshes until the error between the nodes and the change of the cost are below the tolerance.

    Intervals whose error is too large are split in two, or in up to four by the scheme's order; the rest stay. The barrier
    starts small, so that a refined solve stays with its optimum where others that cost nearly the same are close by. IPOPT's
    tolerance is a thousandth of the mesh's: what its barrier adds to the cost grows with the number of bounds.

    Returns:
        The last solution, and a row a mesh: intervals, cost, error, violation, seconds, and from the second on the cost's
        relative change and whether the tolerance is met. It is not where `rounds` or `largest` ended the refinement. Limits
        hold at nodes and stages; `violation` says by how much they are exceeded between, and is no part of the tolerance.
    """
    refinement, options = refinement or Refinement(), options or Options()
    options = replace(options, barrier=1e-8, tolerance=min(options.tolerance, 1e-3 * refinement.tolerance))
    rows = [_row(solution)]
    for _ in range(refinement.rounds):
        mesh = _split(solution, refinement)
        if mesh is None:
            break
        finer = replace(solution.transcription, mesh=mesh)
        previous, solution = solution, Solver(finer, options).solve(solution.guess())
        rows.append(_row(solution))
        moved = abs(solution.cost - previous.cost) / _magnitude(solution)
        rows[-1] |= {"change": moved, "converged": max(solution.error.largest, moved) <= refinement.tolerance}
        if rows[-1]["converged"]:
            break
    return solution, rows


def _magnitude(solution: Solution) -> float:
    return max(abs(solution.cost), 1e-12 * solution.problem.cost_scale)


def _row(solution: Solution) -> dict:
    return {
        "intervals": [len(m) for m in solution.transcription.mesh],
        "cost": solution.cost,
        "error": solution.error.largest,
        "quadrature": solution.error.quadrature,
        "violation": solution.error.violation,
        "iterations": solution.iterations,
        "seconds": solution.seconds,
    }


def _split(solution: Solution, refinement: Refinement) -> tuple[np.ndarray, ...] | None:
    """A finer mesh; None where it would be too fine. Where no interval is too coarse, the coarsest third is split."""
    order = solution.transcription.scheme.d + 1
    error = solution.error
    threshold = min(refinement.tolerance, np.quantile(np.concatenate(error.intervals), 2 / 3))
    meshes = []
    for fractions, errors in zip(solution.transcription.mesh, error.intervals, strict=True):
        pieces = np.ones(len(fractions), int)
        coarse = errors > threshold
        pieces[coarse] = np.clip(np.ceil((errors[coarse] / refinement.tolerance) ** (1 / order)), 2, 4)
        meshes.append(np.repeat(fractions / pieces, pieces))
    return None if max(len(m) for m in meshes) > refinement.largest else tuple(meshes)


def solve(
    problem: Problem, guess: Guess, intervals: int = 40, method: Scheme | None = None, options: Options | None = None
) -> Solution:
    """Transcribe on a uniform mesh and solve once; raises `SolverFailure`."""
    return Solver(Transcription(problem, method or scheme(), uniform_mesh(problem, intervals)), options).solve(guess)


def continue_in(solver: Solver, solution: Solution, values: Sequence[np.ndarray]) -> Solution:
    """Follow an optimum while the problem's data move through `values`, each solve started warm from the last."""
    for data in values:
        solution = solver.solve(solution, data)
    return solution

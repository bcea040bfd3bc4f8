"""Solve a transcribed problem with IPOPT."""

import time
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.optimal_control.problem import Guess, PhaseGuess, Problem
from rrr_oc.optimal_control.scheme import Scheme, scheme, uniform_mesh
from rrr_oc.optimal_control.transcription import Transcription

LONGEST = 600.0  # [s] of a solve, in wall time; doubled, a solve that does not converge holds the search up for longer
WARM = 1e-7  # initial barrier parameter from a solution; doubled, IPOPT starts further from it and takes an iteration more


class SolverFailure(Exception):
    """IPOPT found no optimum; has its `status` and `iterations`, and the largest `violation` (scaled) of what is `violated`."""

    def __init__(self, status: str, iterations: int = 0, violation: float = 0.0, violated: str = "") -> None:
        self.status, self.iterations, self.violation, self.violated = status, iterations, violation, violated
        where = f"; most violated: {violated}, by {violation:.2g} (scaled)" if violation > 1e-6 else ""
        super().__init__(f"IPOPT stopped after {iterations} iterations with {status!r}{where}")


@dataclass(frozen=True)
class Options:
    """Settings of IPOPT.

    Attributes:
        tolerance: Tolerance of the scaled optimality conditions.
        iterations: Largest number of iterations.
        barrier: Initial barrier parameter, small for a warm start; None for IPOPT's adaptive strategy.
    """

    tolerance: float = 1e-8
    iterations: int = 500
    barrier: float | None = None

    def ipopt(self) -> dict[str, object]:
        """The options by IPOPT's names."""
        named: dict[str, object] = {
            "tol": self.tolerance,
            "max_iter": self.iterations,
            "max_wall_time": LONGEST,
            "linear_solver": "mumps",
            "print_level": 0,
            "sb": "yes",
            "mu_strategy": "adaptive",
            "bound_relax_factor": 1e-12,  # the default of 1e-8 would be the floor of the accuracy
        }
        if self.barrier is not None:
            pushes = (f"warm_start_{what}_push" for what in ("bound", "mult_bound", "slack_bound"))
            named |= {"mu_strategy": "monotone", "mu_init": self.barrier, "warm_start_init_point": "yes"}
            named |= dict.fromkeys(pushes, self.barrier)
        return named


@dataclass(frozen=True, eq=False)
class Solution:
    """An optimum on a mesh, with its problem and statistics.

    Attributes:
        transcription: Problem, scheme and mesh.
        w: Scaled variables.
        lam_g, lam_w: Multipliers of the constraints and of the bounds, of the scaled problem.
        cost: The problem's cost, in its own unit.
        status: IPOPT's return status.
        iterations, seconds: Number of iterations and wall time [s].
    """

    transcription: Transcription
    w: np.ndarray
    lam_g: np.ndarray
    lam_w: np.ndarray
    cost: float
    status: str
    iterations: int
    seconds: float

    @classmethod
    def bare(cls, transcription: Transcription, w: np.ndarray, cost: float = 0.0) -> "Solution":
        """One of which scaled variables and cost are known, without multipliers."""
        return cls(transcription, w, np.empty(0), np.empty(0), cost, "", 0, 0.0)

    @property
    def problem(self) -> Problem:
        """The problem that was solved."""
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

    def controls(self, phase: int) -> np.ndarray:
        """Controls of a phase at the stages, (nu, d, N)."""
        variables = self.values[self.transcription.blocks[phase].controls]
        return np.einsum("dk,ukn->udn", self.transcription.scheme.basis, variables)

    def sample(self, phase: int, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The collocation method's own interpolants at points inside every interval of a phase.

        Args:
            phase: Index of the phase.
            inside: Points in [0, 1] of each interval, (K,).

        Returns:
            t (N, K) [s] since the phase's start, x (nx, N, K), dx/dt (nx, N, K), u (nu, N, K).
        """
        transcription = self.transcription
        block, s = transcription.blocks[phase], transcription.scheme
        T, mesh = self.durations[phase], transcription.mesh[phase]
        lagrange, integrals = s.at(np.asarray(inside))
        x_stages, u_stages = self.values[block.stage_x], self.controls(phase)  # (·, d, N)
        f = self.rates(phase, x_stages, u_stages)[0]
        h = mesh * T
        t = T * (np.r_[0, np.cumsum(mesh)[:-1]][:, None]) + h[:, None] * inside
        x = self.values[block.nodes[:, :-1]][:, :, None] + np.einsum("kd,xdn,n->xnk", integrals, f, h)
        return t, x, np.einsum("kd,xdn->xnk", lagrange, f), np.einsum("kd,udn->unk", lagrange, u_stages)

    def rates(self, phase: int, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rates, cost rates and paths, each with one row for each of them, at states and controls of any trailing shape."""
        shape, own = x.shape[1:], self.problem.phases[phase]
        columns = (v.reshape(len(v), int(np.prod(shape))) for v in (x, u))
        data = self.problem.data if own.data is None else self.problem.data[own.data]
        f, cost, path = (np.array(o) for o in own.rates(*columns, self.parameters[:, None], data[:, None]))
        return f.reshape(len(f), *shape), cost.reshape(len(cost), *shape), path.reshape(len(path), *shape)

    def guess(self) -> Guess:
        """This solution as a starting point on any mesh."""
        phases = [
            PhaseGuess(T, lambda s, i=i: self.at(i, s)[0], lambda s, i=i: self.at(i, s)[1])
            for i, T in enumerate(self.durations)
        ]
        return Guess(tuple(phases), self.parameters)

    def at(self, phase: int, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (nx, K) and controls (nu, K) at normalised times s in [0, 1] of a phase."""
        edges = np.r_[0, np.cumsum(self.transcription.mesh[phase])]
        edges[-1] = 1.0
        k = np.clip(np.searchsorted(edges, s, side="right") - 1, 0, len(edges) - 2)
        inside = (s - edges[k]) / (edges[k + 1] - edges[k])
        block, method = self.transcription.blocks[phase], self.transcription.scheme
        lagrange, integrals = method.at(inside)
        u_stages = self.controls(phase)
        f = self.rates(phase, self.values[block.stage_x], u_stages)[0]
        h = self.transcription.mesh[phase] * self.durations[phase]
        x = self.values[block.nodes[:, k]] + np.einsum("kd,xdk,k->xk", integrals, f[:, :, k], h[k])
        return x, np.einsum("kd,udk->uk", lagrange, u_stages[:, :, k])


class Solver:
    """IPOPT for one transcription, built once for solves from many starting points."""

    def __init__(self, transcription: Transcription, options: Options | None = None) -> None:
        self.transcription, self.options = transcription, options or Options()
        self._solvers: dict[float | None, ca.Function] = {}

    def solve(
        self,
        start: Guess | Solution | np.ndarray,
        data: np.ndarray | None = None,
        check: bool = True,
        parameters: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> Solution:
        """Solve from a guess, from scaled variables, or from a solution on the same mesh, whose multipliers are used too.

        Args:
            start: Starting point. A solution starts IPOPT warm.
            data: Values of d (nd,); default the problem's.
            check: Whether to raise `SolverFailure` unless IPOPT reports an optimum.
            parameters: Bounds of the parameters for this solve only, (np,) each; default the problem's.

        Raises:
            SolverFailure: See `check`.
            UserError: The start or the data do not fit this mesh.
        """
        transcription = self.transcription
        problem = transcription.problem if data is None else replace(transcription.problem, data=np.asarray(data, float))
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
        barrier = self.options.barrier
        if isinstance(start, Solution):
            barrier = barrier or WARM
            if start.lam_g.size == arguments["lbg"].size:
                arguments |= {"lam_g0": start.lam_g, "lam_x0": start.lam_w}
        solver, began = self._solver(barrier), time.perf_counter()
        result = solver(**arguments)
        seconds, stats = time.perf_counter() - began, solver.stats()
        if stats["return_status"] == "NonIpopt_Exception_Thrown":
            raise KeyboardInterrupt
        found = {name: np.array(value).ravel() for name, value in result.items()}
        if check and not stats["success"]:
            excess = np.maximum(arguments["lbg"] - found["g"], found["g"] - arguments["ubg"])
            worst = int(np.argmax(excess))
            violated = float(excess[worst]), transcription.row_name(worst)
            raise SolverFailure(stats["return_status"], stats["iter_count"], *violated)
        solved = transcription if data is None else replace(transcription, problem=problem)
        cost, effort = float(found["f"][0]) * problem.cost_scale, (stats["return_status"], stats["iter_count"], seconds)
        return Solution(solved, found["x"], found["lam_g"], found["lam_x"], cost, *effort)

    def _solver(self, barrier: float | None) -> ca.Function:
        if barrier not in self._solvers:
            derivatives = dict(self.transcription.functions)
            nlp, ipopt = derivatives.pop("nlp"), replace(self.options, barrier=barrier).ipopt()
            # compiled functions have no derivatives, and none is needed
            options = {"ipopt": ipopt, "print_time": False, "calc_lam_p": False, "no_nlp_grad": True}
            self._solvers[barrier] = ca.nlpsol("solver", "ipopt", nlp, options | derivatives)
        return self._solvers[barrier]


def solve(
    problem: Problem, guess: Guess, intervals: int = 40, method: Scheme | None = None, options: Options | None = None
) -> Solution:
    """Transcribe on a uniform mesh and solve once; raises `SolverFailure`."""
    return Solver(Transcription(problem, method or scheme(), uniform_mesh(problem, intervals)), options).solve(guess)

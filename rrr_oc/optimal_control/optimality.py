"""First- and second-order optimality conditions of a solution, evaluated on the nonlinear program itself."""

from dataclasses import replace
from functools import cached_property

import casadi as ca
import numpy as np
import scipy.sparse
from scipy.sparse.linalg import splu

from rrr_oc.optimal_control.solver import Solution

FLAT = 1e-4  # [1] negative curvature up to this is taken for rounding and the condition for weakly met: a step of 0.1 of a scale along
# it changes the cost by 5e-7 of its magnitude; doubled, flatter saddles pass
NEAR = 1e-3  # [1] of a variable's scale: a bound this close counts as weakly active; doubled, "weak" is found more often


class Kkt:
    """The Karush–Kuhn–Tucker conditions at a solution of the scaled problem: residuals, active set, Jacobian and Hessian.

    Attributes:
        dual, primal, complementarity: Residuals, infinity norms.
        at_bound, active_rows: Active bounds of variables and active constraints; `near_bound`, `near_rows` weakly active ones too.
    """

    def __init__(self, solution: Solution) -> None:
        self.solution = solution
        t, self.d = solution.transcription, solution.problem.data
        functions = t.functions
        w, lam = solution.w, solution.lam_g
        _, gradient = functions["grad_f"](w, self.d)
        g, jacobian = functions["jac_g"](w, self.d)
        self.jacobian, self.g = ca.DM(jacobian), np.array(g).ravel()
        self.hessian = ca.DM(functions["hess_lag"](w, self.d, 1.0, lam))
        self.lower, self.upper = t.bounds
        self.row_lower, self.row_upper = t.row_bounds
        stationarity = np.array(gradient).ravel() + np.array(self.jacobian.T @ lam).ravel() + solution.lam_w
        fixed = self.lower == self.upper
        self.dual = float(np.abs(np.where(fixed, 0.0, stationarity)).max())
        self.primal = float(
            max(
                np.maximum(self.lower - w, w - self.upper).max(),
                np.maximum(self.row_lower - self.g, self.g - self.row_upper).max(initial=0.0),
            )
        )
        gap = np.minimum(w - self.lower, self.upper - w)
        row_gap = np.minimum(self.g - self.row_lower, self.row_upper - self.g)
        finite = np.isfinite(gap) & ~fixed
        finite_row = np.isfinite(row_gap) & (self.row_lower < self.row_upper)
        self.complementarity = float(
            max(
                np.abs(solution.lam_w[finite] * gap[finite]).max(initial=0.0),
                np.abs(lam[finite_row] * row_gap[finite_row]).max(initial=0.0),
            )
        )
        # active if the multiplier exceeds the distance (strict complementarity); equalities always are
        self.at_bound = fixed | (np.abs(solution.lam_w) > gap)
        self.active_rows = (self.row_lower == self.row_upper) | (np.abs(lam) > row_gap)
        self.near_bound = self.at_bound | (gap < NEAR)
        self.near_rows = self.active_rows | (row_gap < NEAR)

    @property
    def data_gradient(self) -> np.ndarray:
        """Derivative of the optimal cost with respect to the problem's data, in the cost's unit."""
        solution = self.solution
        nlp = replace(solution.transcription, compiled=False).functions["nlp"]
        w, d = ca.MX.sym("w", solution.w.size), ca.MX.sym("d", self.d.size)
        f, g = nlp(w, d)
        lagrangian = f + ca.dot(ca.MX(ca.DM(solution.lam_g)), g)
        gradient = ca.Function("data_gradient", [w, d], [ca.gradient(lagrangian, d)])
        return np.array(gradient(solution.w, self.d)).ravel() * solution.problem.cost_scale

    def second_order(self) -> tuple[str, float, np.ndarray]:
        """Whether the Hessian of the Lagrangian is positive definite on the null space of the active constraints.

        [[H, Aᵀ], [A, −δ I]] over the free variables and active rows has as many negative eigenvalues as rows exactly if
        H + AᵀA/δ is positive definite, which for small δ is so exactly if H is on the null space of A (Debreu's lemma).

        Returns:
            The verdict. "strict": the sufficient condition holds. "weak": it holds only if weakly active bounds are kept active;
            this is less than the necessary condition, because the cost may decrease inward from such a bound. "violated": not
            even that. Then the smallest curvature (eigenvalue for variables weighted by their share of time), and its direction
            (size of w,), of unit length in those weights.
        """
        verdict = self.verdict()
        value, direction = self._curvature(self.at_bound, self.active_rows)
        return verdict, value, direction

    def verdict(self) -> str:
        """The verdict of `second_order` alone, from the inertia of one or two factorisations."""
        if self._below(self.at_bound, self.active_rows, 0.0) == 0:
            return "strict"
        return "weak" if self._below(self.near_bound, self.near_rows, -FLAT) == 0 else "violated"

    def _reduced(self, at_bound: np.ndarray, active_rows: np.ndarray):
        free, rows = np.flatnonzero(~at_bound), np.flatnonzero(active_rows)
        return self._H[free][:, free], self._A[rows][:, free], self.weights[free], free

    def _below(self, at_bound: np.ndarray, active_rows: np.ndarray, shift: float) -> int:
        return _below(*self._reduced(at_bound, active_rows)[:3], shift)

    def _curvature(self, at_bound: np.ndarray, active_rows: np.ndarray) -> tuple[float, np.ndarray]:
        H, A, weights, free = self._reduced(at_bound, active_rows)
        value, vector = _smallest(H, A, weights)
        direction = np.zeros(at_bound.size)
        direction[free] = vector
        return value, direction

    @cached_property
    def _H(self):
        return _sparse(ca.triu2symm(self.hessian))

    @cached_property
    def _A(self):
        return _sparse(self.jacobian)

    @cached_property
    def weights(self) -> np.ndarray:
        """Share of a phase's time that each variable stands for; 1 for parameters and durations."""
        t = self.solution.transcription
        weights = np.ones(t.size)
        for block, fractions in zip(t.blocks, t.mesh, strict=True):
            for stages in (block.stage_x, block.stage_u):
                weights[stages] = np.maximum(fractions * t.scheme.b[:, None], 1e-12)
            weights[block.nodes] = np.maximum(np.r_[fractions, fractions[-1]] / 4, 1e-12)
        return weights

    def dominant(self, direction: np.ndarray) -> tuple[str, ...]:
        """Names of the parameters and durations, or "motion", with more than 5 % of the squared length of a direction."""
        t, problem = self.solution.transcription, self.solution.problem
        energy: dict[str, float] = {}
        labels: dict[int, str] = dict(enumerate(problem.parameters))
        for phase, block in zip(problem.phases, t.blocks, strict=True):
            labels[block.duration] = f"duration of {phase.name}"
        for index, value in enumerate(self.weights * direction**2):
            name = labels.get(index, "motion")
            energy[name] = energy.get(name, 0.0) + float(value)
        total = sum(energy.values())
        return tuple(k for k, v in sorted(energy.items(), key=lambda kv: -kv[1]) if v > 0.05 * total)


def _sparse(matrix: ca.DM) -> scipy.sparse.csc_array:
    return scipy.sparse.csc_array(matrix.sparse())


def _factor(H, A, diagonal: np.ndarray, delta: float = 1e-9):
    """Factors of the quasi-definite KKT matrix and its number of negative eigenvalues: without pivoting, the signs of U's diagonal
    are the inertia.

    Adding AᵀA to the first block changes nothing on the null space of A, and gives variables without curvature pivots of the size
    of their constraints. The shift gives variables in neither H nor A a positive pivot. Where a pivot cancels exactly, the shift is
    increased, up to 1e-8, far below `FLAT`. Raises `ArithmeticError` if that is not enough.
    """
    rows, quadratic = A.shape[0], H + A.T @ A
    for shift in (1e-12, 1e-10, 1e-8):
        first = quadratic + scipy.sparse.diags_array(diagonal + shift)
        K = scipy.sparse.block_array([[first, A.T], [A, -delta * scipy.sparse.eye_array(rows)]]).tocsc()
        try:
            factors = splu(K, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError:  # "Factor is exactly singular"
            continue
        return factors, int((factors.U.diagonal() < 0).sum())
    raise ArithmeticError("the optimality system is singular with every shift up to 1e-8")


def _below(H, A, weights: np.ndarray, shift: float) -> int:
    """Number of eigenvalues of the reduced Hessian below a shift: negative eigenvalues of the KKT matrix beyond the number of rows."""
    return _factor(H, A, -shift * weights)[1] - A.shape[0]


def _smallest(H, A, weights: np.ndarray) -> tuple[float, np.ndarray]:
    """Smallest eigenvalue of H x = λ diag(weights) x on the null space of A, by bisection on the inertia, and its eigenvector by inverse
    iteration."""

    def below(shift: float) -> int:
        return _below(H, A, weights, shift)

    low, high = (-1e-6, 1e-6) if below(0.0) == 0 else (-1e-5, 0.0)
    while below(low) > 0:
        low, high = 10 * low, low
    while below(high) == 0 and high < 1e6:
        low, high = high, 10 * high
    while high - low > 0.3 * max(abs(low), abs(high)):
        middle = (low + high) / 2
        low, high = (low, middle) if below(middle) else (middle, high)
    factors, x, value = _factor(H, A, -low * weights)[0], np.random.default_rng(0).normal(size=len(weights)), np.inf
    for _ in range(50):
        y = factors.solve(np.r_[weights * x, np.zeros(A.shape[0])])[: len(weights)]
        previous, value = value, float((weights * x * x).sum() / (weights * x * y).sum())
        x = y / np.sqrt((weights * y**2).sum())
        if abs(value - previous) < 1e-3 * abs(value):
            break
    return low + value, x

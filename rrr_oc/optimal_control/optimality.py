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
        self.solution, self.d = solution, solution.problem.data
        t, w, lam = solution.transcription, solution.w, solution.lam_g
        _, gradient = t.functions["grad_f"](w, self.d)
        g, jacobian = t.functions["jac_g"](w, self.d)
        hessian = t.functions["hess_lag"](w, self.d, 1.0, lam)
        self.jacobian = scipy.sparse.csc_array(ca.DM(jacobian).sparse())
        self.hessian = scipy.sparse.csc_array(ca.triu2symm(ca.DM(hessian)).sparse())
        gap, row_gap = _distance(w, *t.bounds), _distance(np.array(g).ravel(), *t.row_bounds)
        fixed, equal = t.bounds[0] == t.bounds[1], t.row_bounds[0] == t.row_bounds[1]
        stationarity = np.array(gradient).ravel() + self.jacobian.T @ lam + solution.lam_w
        self.dual = float(np.abs(np.where(fixed, 0.0, stationarity)).max())
        self.primal = float(max(-gap.min(), -row_gap.min(initial=0.0)))
        self.complementarity = 0.0
        for multiplier, distance, held in ((solution.lam_w, gap, fixed), (lam, row_gap, equal)):
            k = np.isfinite(distance) & ~held
            self.complementarity = float(np.abs(multiplier[k] * distance[k]).max(initial=self.complementarity))
        # active if the multiplier exceeds the distance (strict complementarity); equalities always are
        self.at_bound = fixed | (np.abs(solution.lam_w) > gap)
        self.active_rows = equal | (np.abs(lam) > row_gap)
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
        H, A, weights = self._reduced(self.at_bound, self.active_rows)
        value, direction = _smallest(H, A, weights)
        whole = np.zeros(self.at_bound.size)
        whole[~self.at_bound] = direction
        return self.verdict(), value, whole

    def verdict(self) -> str:
        """The verdict of `second_order` alone, from the inertia of one or two factorisations."""
        if _below(*self._reduced(self.at_bound, self.active_rows), 0.0) == 0:
            return "strict"
        return "weak" if _below(*self._reduced(self.near_bound, self.near_rows), -FLAT) == 0 else "violated"

    def _reduced(self, at_bound: np.ndarray, active_rows: np.ndarray):
        """Hessian, Jacobian and weights of the variables that are free and the rows that are active."""
        free = np.flatnonzero(~at_bound)
        return self.hessian[free][:, free], self.jacobian[np.flatnonzero(active_rows)][:, free], self.weights[free]

    @cached_property
    def weights(self) -> np.ndarray:
        """Share of a phase's time that each variable stands for; 1 for parameters and durations."""
        t = self.solution.transcription
        weights = np.ones(t.size)
        for block, fractions in zip(t.blocks, t.mesh, strict=True):
            for variables, share in ((block.stage_x, t.scheme.b), (block.controls, t.scheme.basis.T @ t.scheme.b)):
                weights[variables] = np.maximum(fractions * share[:, None], 1e-12)
            weights[block.nodes] = np.maximum(np.r_[fractions, fractions[-1]] / 4, 1e-12)
        return weights

    def dominant(self, direction: np.ndarray) -> tuple[str, ...]:
        """Names of the parameters and durations, or "motion", with more than 5 % of the squared length of a direction."""
        names, squares = [*self.solution.problem.parameters], self.weights * direction**2
        places = [*range(len(names))]
        for phase, block in zip(self.solution.problem.phases, self.solution.transcription.blocks, strict=True):
            names.append(f"duration of {phase.name}")
            places.append(block.duration)
        shares = dict(zip(names, squares[places], strict=True)) | {"motion": np.delete(squares, places).sum()}
        return tuple(sorted((k for k, v in shares.items() if v > 0.05 * squares.sum()), key=lambda k: -shares[k]))


def _distance(value: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Distance to the nearer bound, negative outside."""
    return np.minimum(value - lower, upper - value)


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

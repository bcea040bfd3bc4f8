"""Bounded nonlinear least squares on normal equations: Gauss–Newton with a line search, and Levenberg–Marquardt.

Every fit of the package ends here: parameters of a model's terms (`term_fit`), the links' inertial parameters
(`calibrate`), the simulated response (`response`).
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.optimize import lsq_linear

from rrr_oc.calibration.regression import Rows
from rrr_oc.numerics.rank import DETERMINED, Directions

Point = TypeVar("Point")  # parameters, with whatever was computed at them
# At first, least and most, of the diagonal; doubled, no change beyond a hundredth of standard errors
DAMPING = 1e-3, 1e-12, 1e8
RAISED, LOWERED = 5.0, 10.0  # factors of the damping after a step that failed or succeeded; doubled, the same


class Quadratic(NamedTuple):
    """The cost near a point, value − 2 rightᵀ d + dᵀ matrix d for a step d (p,), with the bounds of the step."""

    value: float
    matrix: np.ndarray
    right: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


@dataclass(frozen=True)
class GaussNewton:
    """Options of `gauss_newton`.

    Attributes:
        steps: Most steps.
        promise: Least share of the cost by which the quadratic must fall over a step.
        gain: Least share of the cost by which it must fall for another step to follow.
        fractions: Of a step, in the order in which they are tried.
        rise: Share of the cost by which it may rise, by rounding.
    """

    steps: int
    promise: float = 0.0
    gain: float = -math.inf
    fractions: tuple[float, ...] = (1.0, 0.5, 0.25, 0.1, 0.02)
    rise: float = 0.0


def gauss_newton(
    at: Point,
    near: Callable[[Point], Quadratic],
    tried: Callable[[Point, Sequence[np.ndarray]], Iterable[tuple[Point, float]]],
    how: GaussNewton,
    accepted: Callable[[Point, Point], Point] = lambda _, there: there,
) -> Point:
    """The point of least cost, from a start: steps to the minimum of the quadratic, shortened until the cost falls.

    Args:
        near: The cost near a point; weights that depend on the residual are those of the point.
        tried: Points after steps from a point, and their costs under its weights, one by one as they are asked for.
        accepted: The point to go on from after a successful step, from the points before and after it.
    """
    for _ in range(how.steps):
        value, matrix, right, lower, upper = near(at)
        step = box_step(matrix, right, lower, upper)
        if step @ (2 * right - matrix @ step) < how.promise * value:
            break
        results = tried(at, [fraction * step for fraction in how.fractions])
        found = next((one for one in results if one[1] <= value * (1 + how.rise)), None)
        if found is None:
            break
        at = accepted(at, found[0])
        if value - found[1] < how.gain * value:
            break
    return at


def levenberg_marquardt(
    at: np.ndarray, near: Callable[[np.ndarray], Quadratic], cost: Callable[[np.ndarray], float], steps: int, gain: float
) -> np.ndarray:
    """The parameters (p,) of least cost, from a start; for normal equations that are nearly singular.

    Args:
        near: The cost near a point, with the bounds of a step.
        steps: Most steps.
        gain: Of the cost: a step that gains no more is not taken, and the last.
    """
    damping, least, most = DAMPING
    for _ in range(steps):
        value, matrix, *rest = near(at)
        diagonal = np.diag(np.maximum(np.diag(matrix), 1e-9))
        while True:
            there = at + _regular_step(matrix + damping * diagonal, *rest)
            gained = value - cost(there)
            if gained > 0 or damping > most:
                break
            damping *= RAISED
        if not gained > gain:
            break
        at, damping = there, max(damping / LOWERED, least)
    return at


def _regular_step(matrix: np.ndarray, right: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """As `box_step`, exact where the matrix is positive definite and the minimum lies inside the bounds."""
    free, step = lower < upper, np.zeros_like(right)
    step[free] = np.linalg.solve(matrix[np.ix_(free, free)], right[free])
    return step if np.all((step >= lower) & (step <= upper)) else box_step(matrix, right, lower, upper)


def normal_equations(rows: Rows, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """H = Σ_j w_j J_jᵀ J_j (p, p) and g = Σ_j w_j J_jᵀ r_j (p,), for weights of the joints (n,)."""
    weighted = rows.jacobian * weights[:, None, None]
    matrix = sum(w.T @ j for w, j in zip(weighted, rows.jacobian, strict=True))
    right = sum(w.T @ r for w, r in zip(weighted, rows.residual, strict=True))
    return np.asarray(matrix), np.asarray(right)


def box_step(matrix: np.ndarray, right: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """argmin dᵀ H d − 2 gᵀ d within bounds; where H is singular, about the minimum that is nearest to 0."""
    near = Directions.of(matrix)
    curvature = np.maximum(near.values, DETERMINED * max(near.values.max(initial=0.0), 1e-300))
    target = near.vectors.T @ (right / near.scale)
    step, low, high = near.vectors @ (target / curvature), lower * near.scale, upper * near.scale
    if np.any(step < low) or np.any(step > high):
        free = low < high
        root = np.sqrt(curvature)[:, None] * near.vectors.T[:, free]
        step = np.zeros_like(step)
        step[free] = lsq_linear(root, target / np.sqrt(curvature), (low[free], high[free]), method="bvls").x
    return step / near.scale

"""Bounded nonlinear least squares on normal equations: Gauss–Newton with a line search, and Levenberg–Marquardt.

All fits of the package are problems of this module: parameters of a model's terms (`term_fit`), the links' inertial parameters
(`inertial_identification`), the simulated response (`response`). Their tolerances are data, since they serve different ends.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from scipy.optimize import lsq_linear

from rrr_oc.calibration.regression import Rows
from rrr_oc.numerics.rank import DETERMINED, Directions

Point = TypeVar("Point")


@dataclass(frozen=True)
class GaussNewton:
    """Steps to the minimum of the quadratic, shortened until the cost falls.

    Attributes:
        steps: Most steps.
        promise: Share of the cost that a step must promise to be tried.
        gain: Share of the cost that a step must gain for another to follow.
        fractions: Of a step, in the order in which they are tried.
        rise: Share of the cost by which it may rise, by rounding.
    """

    steps: int
    promise: float = 0.0
    gain: float = -math.inf
    fractions: tuple[float, ...] = (1.0, 0.5, 0.25, 0.1, 0.02)
    rise: float = 0.0


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Steps damped by a share of the matrix's diagonal, which is raised until the cost falls and lowered after it fell.

    Attributes:
        steps: Most steps.
        gain: Of the cost: a step that gains no more is not taken, and the last.
        damping: At first.
        range: Of the damping.
        raised, lowered: Factors of the damping.
    """

    steps: int
    gain: float
    damping: float = 1e-3
    range: tuple[float, float] = (1e-12, 1e8)
    raised: float = 5.0
    lowered: float = 10.0


@dataclass(frozen=True)
class Quadratic:
    """The cost near a point, value − 2 rightᵀ d + dᵀ matrix d for a step d (p,), and the box that the step may not leave."""

    value: float
    matrix: np.ndarray
    right: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    def step(self) -> np.ndarray:
        """The minimum within the box."""
        return box_step(self.matrix, self.right, self.lower, self.upper)

    def damped_step(self, damping: float) -> np.ndarray:
        """The minimum within the box of the quadratic with a damped, positive definite matrix."""
        matrix = self.matrix + damping * np.diag(np.maximum(np.diag(self.matrix), 1e-9))
        free, step = self.lower < self.upper, np.zeros_like(self.right)
        step[free] = np.linalg.solve(matrix[np.ix_(free, free)], self.right[free])
        inside = np.all((step >= self.lower) & (step <= self.upper))
        return step if inside else box_step(matrix, self.right, self.lower, self.upper)

    def promised(self, step: np.ndarray) -> float:
        """By how much the quadratic falls over a step."""
        return float(step @ (2 * self.right - self.matrix @ step))


class Problem(ABC, Generic[Point]):
    """What is to be minimised. A point holds the parameters and whatever was computed at them."""

    @abstractmethod
    def quadratic(self, at: Point) -> Quadratic:
        """The cost near a point; weights that depend on the residual are those of the point."""

    @abstractmethod
    def tried(self, at: Point, steps: Sequence[np.ndarray]) -> Iterable[tuple[Point, float]]:
        """Points after steps, and their costs under the weights of the point they start from, one by one, as they are asked for."""

    def accepted(self, before: Point, there: Point) -> Point:
        """The point that the search goes on from; a problem may renew derivatives here."""
        return there

    def freed(self, at: Point) -> Point | None:
        """The point with fixed parameters set free, where no step promises enough; None if there are none, which ends the search."""
        return None

    def renewed(self, at: Point) -> Point | None:
        """The point with derivatives renewed, where no step from it lowers the cost; None if they are new, which ends the search."""
        return None


def minimise(problem: Problem[Point], at: Point, how: GaussNewton | LevenbergMarquardt) -> Point:
    """The point at which the cost is least, from a start."""
    return _levenberg_marquardt(problem, at, how) if isinstance(how, LevenbergMarquardt) else _gauss_newton(problem, at, how)


def _gauss_newton(problem: Problem[Point], at: Point, how: GaussNewton) -> Point:
    for _ in range(how.steps):
        near = problem.quadratic(at)
        step = near.step()
        if near.promised(step) < how.promise * near.value:
            if (free := problem.freed(at)) is None:
                break
            at = free
            continue
        limit = near.value * (1 + how.rise)
        tried = problem.tried(at, [fraction * step for fraction in how.fractions])
        found = next((one for one in tried if one[1] <= limit), None)
        if found is not None:
            at = problem.accepted(at, found[0])
            if near.value - found[1] < how.gain * near.value:
                break
        elif (fresh := problem.renewed(at)) is not None:
            at = fresh
        else:
            break
    return at


def _levenberg_marquardt(problem: Problem[Point], at: Point, how: LevenbergMarquardt) -> Point:
    damping, (least, most) = how.damping, how.range
    for _ in range(how.steps):
        near = problem.quadratic(at)
        while True:
            ((there, cost),) = problem.tried(at, [near.damped_step(damping)])
            if cost < near.value or damping > most:
                break
            damping *= how.raised
        if not near.value - cost > how.gain:
            break
        at, damping = problem.accepted(at, there), max(damping / how.lowered, least)
    return at


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

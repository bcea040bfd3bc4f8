"""Collocation schemes and meshes.

Every scheme is an implicit Runge–Kutta method with d stages (A, b, c). On an interval of length h, with f the rates at the
stages, x_i = x_0 + h Σ_j A_ij f_j and x_1 = x_0 + h Σ_j b_j f_j; the cost is quadrature with b. Hermite–Simpson is
Lobatto IIIA with three stages. The first and last stages of Lobatto's methods are the nodes, so neighbouring intervals share
them, controls included. Lobatto IIIA, Gauss–Legendre and Radau IIA have a chosen number of stages. See Betts, "Practical
Methods for Optimal Control", ch. 4; Hairer & Wanner II, IV.5.

A control is a polynomial of degree d − 1 on an interval. Its variables are its values at the stages, where alone its limits hold
then; or its Bernstein coefficients, between which it lies (Farin, "Curves and Surfaces for CAGD", ch. 6), so that limits hold at
every instant. The latter needs short intervals where a control switches from one limit to another.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np
from scipy.special import comb

from rrr_oc.errors import UserError
from rrr_oc.optimal_control.problem import Problem

SCHEMES = ("hermite-simpson", "lobatto", "gauss", "radau")


@dataclass(frozen=True, eq=False)
class Scheme:
    """A collocation method.

    Attributes:
        name: One of `SCHEMES`.
        c: Stages within an interval, in [0, 1], shape (d,).
        A, b: Runge–Kutta coefficients, shapes (d, d) and (d,).
        order: Order of the Runge–Kutta method. For smooth problems the optimal cost converges with it; so do the states, except
            that controls shared at the nodes limit the states of Lobatto's methods to order 4.
        everywhere: Whether limits of controls hold at every instant, else at the stages.
    """

    name: str
    c: np.ndarray
    A: np.ndarray
    b: np.ndarray
    order: int
    everywhere: bool = False

    @property
    def d(self) -> int:
        """Number of stages."""
        return len(self.c)

    @property
    def shares_first(self) -> bool:
        """Whether the first stage is the node at the interval's start."""
        return self.c[0] == 0

    @property
    def shares_last(self) -> bool:
        """Whether the last stage is the node at the interval's end."""
        return self.c[-1] == 1

    @property
    def inner(self) -> list[int]:
        """Stages that are no nodes."""
        return list(range(self.d))[int(self.shares_first) : self.d - self.shares_last]

    @property
    def defects(self) -> int:
        """Number of defects of each state in an interval: of the stages that are not its start, and of its end unless it is a stage."""
        return self.d - self.shares_first + (not self.shares_last)

    @cached_property
    def basis(self) -> np.ndarray:
        """Values of a control at the stages = basis @ its variables in an interval, (d, d)."""
        if not self.everywhere:
            return np.eye(self.d)
        k, c = np.arange(self.d), self.c[:, None]
        return comb(self.d - 1, k) * c**k * (1 - c) ** (self.d - 1 - k)

    def at(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interpolation inside an interval at s in [0, 1], (K,): weights of stage values and of stage rates.

        Returns:
            Lagrange weights (K, d), so that u(s) = weights @ u_stages, and their integrals from 0 (K, d), so that
            x(s) = x_0 + h integrals @ f_stages.
        """
        powers = np.vander(s, self.d, increasing=True)  # (K, d)
        integrals = powers * np.asarray(s)[:, None] / np.arange(1, self.d + 1)
        inverse = np.linalg.inv(np.vander(self.c, self.d, increasing=True))
        return powers @ inverse, integrals @ inverse


@lru_cache
def scheme(name: str = "gauss", stages: int = 3, everywhere: bool = False) -> Scheme:
    """A collocation scheme with `stages` stages; Hermite–Simpson always has 3. Limits of controls hold at the stages or `everywhere`.
    Raises `UserError` for unknown ones."""
    if name not in SCHEMES:
        raise UserError(f"unknown collocation scheme {name!r}; there are {', '.join(SCHEMES)}")
    fewest = 2 if name == "lobatto" else 1
    if not fewest <= stages <= 9:
        raise UserError(f"{name} with {stages} stages; allowed are {fewest} … 9")
    if name == "hermite-simpson":
        c, order = np.array([0.0, 0.5, 1.0]), 4
    elif name == "lobatto":  # the ends and the extrema of the Legendre polynomial
        inner = np.asarray(np.polynomial.legendre.Legendre.basis(stages - 1).deriv().roots(), float)
        c, order = np.r_[0.0, (np.sort(inner) + 1) / 2, 1.0], 2 * stages - 2
    elif name == "gauss":
        c, order = (np.asarray(np.polynomial.legendre.leggauss(stages)[0], float) + 1) / 2, 2 * stages
    else:
        c, order = np.array(ca.collocation_points(stages, "radau")), 2 * stages - 1
    d = len(c)
    inverse = np.linalg.inv(np.vander(c, d, increasing=True))
    integrals = np.vander(c, d, increasing=True) * c[:, None] / np.arange(1, d + 1)
    b = (1 / np.arange(1, d + 1)) @ inverse
    return Scheme(name, c, integrals @ inverse, b, order, everywhere)


def uniform_mesh(problem: Problem, intervals: int) -> tuple[np.ndarray, ...]:
    """`intervals` equal fractions for each phase; raises `UserError` unless there is at least one.

    Where a phase has boundaries within it, its parts have so many of them as is near their shares of the time, at least one each.
    """
    if intervals < 1:
        raise UserError(f"a mesh needs at least 1 interval a phase, got {intervals}")
    return tuple(_parts_of(np.diff([0.0, *phase.shares, 1.0]), intervals) for phase in problem.phases)


def _parts_of(parts: np.ndarray, intervals: int) -> np.ndarray:
    """Fractions, equal within each part of a phase, whose shares of the time are given."""
    numbers = np.maximum(np.round(parts * intervals), 1).astype(int)
    return np.repeat(parts / numbers, numbers)

"""Possible bodies that need the same torques as inertial parameters of which single links may be none."""

from dataclasses import dataclass

import numpy as np

from rrr_oc.robot.inertial_parameters import base_parameters, is_possible, pseudo_inertia
from rrr_oc.robot.robot import Robot

UNITS = np.array([pseudo_inertia(unit) for unit in np.eye(10)])  # (10, 4, 4): a pseudo-inertia is linear in the ten numbers
THICK = 1e-6  # [1] of a body's largest moment, which bodies without extent get; doubled, nothing changes
STEPS = 100  # of Newton's method; where there are such bodies, fewer than 30 are needed
SHORTEST = 1e-4  # step, as a share of Newton's, from which there are none; a hundred times less, the same ones are found
DECREMENT = 0.1  # of Newton's method, at which the bodies are close enough to the closest


@dataclass(frozen=True)
class SameTorques:
    """Bodies of a chain that need given torques.

    Attributes:
        roots: Lower triangular roots L of pseudo-inertias P₀ = L Lᵀ of possible bodies, to which others are as close as they can be,
            (n, 4, 4).
        from_own: Inertial parameters by the ten numbers of L⁻¹ P L⁻ᵀ, link by link, (10 n, 10 n).
        rows: Torques depend on rows @ (all 10 n inertial parameters), (b, 10 n).
    """

    roots: np.ndarray
    from_own: np.ndarray
    rows: np.ndarray

    @classmethod
    def of(cls, robot: Robot) -> "SameTorques":
        """With the bodies of a robot, under its gravity."""
        roots, from_own = np.linalg.cholesky([_with_extent(x) for x in robot.inertial.T]), np.zeros((10 * robot.n,) * 2)
        for i, root in enumerate(roots):
            own = slice(10 * i, 10 * i + 10)
            from_own[own, own] = np.array([_numbers(root @ unit @ root.T) for unit in UNITS]).T
        return cls(roots, from_own, base_parameters(robot).projection)

    def bodies(self, inertial: np.ndarray) -> np.ndarray | None:
        """Possible bodies (10, n) that need the torques of inertial parameters (10, n); None where there are none.

        Parameters of possible bodies are returned as they are. Else the bodies are those closest to P₀ by the divergence
        Σ tr(P₀⁻¹ P) − log det P, which frames and units do not change (Lee, Wensing & Park 2020), by Newton's method from P₀, whose
        steps keep P positive definite.
        """
        if all(is_possible(x) for x in inertial.T):
            return inertial
        rows = self.rows @ self.from_own
        left, sizes, right = np.linalg.svd(rows, full_matrices=False)
        wanted = (left.T @ (self.rows @ inertial.T.ravel())) / sizes
        y = np.tile(_numbers(np.eye(4)), len(self.roots))
        for _ in range(STEPS):
            step, decrement = _newton(y, right, wanted)
            length = _longest(y, step)
            y, close = y + length * step, length == 1.0 and decrement < DECREMENT
            if length < SHORTEST:
                return None
            if close:
                found = (self.from_own @ y).reshape(-1, 10).T
                return found if all(is_possible(x) for x in found.T) else None
        return None


def _newton(y: np.ndarray, rows: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, float]:
    """Newton's step for Σ tr P − log det P subject to rows @ y = wanted, and its length in the metric of the function."""
    inverse = np.linalg.inv(_matrices(y))
    pulled = np.einsum("iab,kbc->ikac", inverse, UNITS)  # (n, 10, 4, 4)
    gradient = (np.einsum("kaa->k", UNITS) - np.einsum("ikaa->ik", pulled)).ravel()
    hessian = np.zeros((len(y),) * 2)
    for i, own in enumerate(np.einsum("ikab,ilba->ikl", pulled, pulled)):
        hessian[10 * i : 10 * i + 10, 10 * i : 10 * i + 10] = own
    system = np.block([[hessian, rows.T], [rows, np.zeros((len(rows),) * 2)]])
    step = np.linalg.solve(system, np.concatenate([-gradient, wanted - rows @ y]))[: len(y)]
    return step, float(np.sqrt(max(step @ hessian @ step, 0.0)))


def _longest(y: np.ndarray, step: np.ndarray) -> float:
    """The longest of 1, 1/2, 1/4 … by which a step, and half as much again, leaves matrices positive definite; 0 below `SHORTEST`."""
    length = 1.0
    while length >= SHORTEST:
        if np.linalg.eigvalsh(_matrices(y + (1.5 if length < 1 else 1.0) * length * step)).min() > 0:
            return length
        length /= 2
    return 0.0


def _matrices(y: np.ndarray) -> np.ndarray:
    """(n, 4, 4) of ten numbers each, (10 n,)."""
    return np.einsum("ik,kab->iab", y.reshape(-1, 10), UNITS)


def _numbers(p: np.ndarray) -> np.ndarray:
    """The ten inertial parameters of a pseudo-inertia (4, 4)."""
    inertia = np.trace(p[:3, :3]) * np.eye(3) - p[:3, :3]
    return np.array([p[3, 3], *p[:3, 3], *inertia[np.tril_indices(3)]])


def _with_extent(parameters: np.ndarray) -> np.ndarray:
    """The pseudo-inertia of a body, positive definite even if the body has no extent."""
    values, vectors = np.linalg.eigh(pseudo_inertia(parameters))
    return (vectors * np.maximum(values, THICK * values[-1])) @ vectors.T

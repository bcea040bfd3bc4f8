"""Which directions of a least-squares problem the data determine: one test, on columns scaled to length 1."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

# Tolerances, and what they decide. A direction below its tolerance is taken for undetermined. Of normal matrices, eigenvalues
# count, which are squares of singular values.
DETERMINED = 1e-10  # over the largest: steps, estimates, pseudo-inverses. Rounding is 1e-16 per parameter; doubled, no change
ROUNDING = 1e-15  # over the largest: a condition number is infinite. Tighter, since 1e6 is worth reporting; doubled, no change
COLUMN = 1e-8  # length of a column's rest over its own, or over 1 if that is more: structural dependence, tested at random states without noise
TAKES_PART = 1e-3  # share of an undetermined direction: a parameter with more of it is undetermined; doubled, no change


@dataclass(frozen=True)
class Directions:
    """Eigenvectors of a normal matrix whose columns were scaled.

    Attributes:
        scale: Lengths that the columns were divided by, (p,).
        values: Eigenvalues of the scaled matrix, ascending, (p,).
        vectors: Eigenvectors, in columns, (p, p).
        determined: Which directions the data determine, (p,).
    """

    scale: np.ndarray
    values: np.ndarray
    vectors: np.ndarray
    determined: np.ndarray

    @classmethod
    def of(cls, matrix: np.ndarray, tolerance: float = DETERMINED) -> "Directions":
        """The directions of a normal matrix (p, p), and which are determined: eigenvalues above `tolerance` times the largest."""
        scale = lengths(matrix)
        values, vectors = eigh(matrix / np.outer(scale, scale))  # numpy's (LAPACK's syevd) fails on some finite matrices
        return cls(scale, values, vectors, values > tolerance * max(values.max(initial=0.0), 1e-300))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The least solution of matrix @ x = right in scaled parameters, with undetermined directions left out, (p,)."""
        vectors = self.vectors[:, self.determined]
        return vectors @ ((vectors.T @ (right / self.scale)) / self.values[self.determined]) / self.scale


def lengths(matrix: np.ndarray) -> np.ndarray:
    """Lengths of the columns that a normal matrix is made of, (p,); 1 for a column of zeros."""
    norms = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    return np.where(norms > 0, norms, 1.0)


def pseudo_inverse(matrix: np.ndarray) -> np.ndarray:
    """Of a normal matrix (p, p), with columns scaled and undetermined directions left out."""
    scale = np.outer(lengths(matrix), lengths(matrix))
    return np.linalg.pinv(matrix / scale, rcond=DETERMINED, hermitian=True) / scale


def undetermined(matrix: np.ndarray) -> np.ndarray:
    """Which parameters the data of a normal matrix do not determine, (p,)."""
    found = Directions.of(matrix)
    return np.any(np.abs(found.vectors[:, ~found.determined]) > TAKES_PART, axis=1) | (np.diag(matrix) <= 0)


def condition(matrix: np.ndarray) -> float:
    """Condition number of the scaled Jacobian of a normal matrix; infinite if it is singular."""
    found = Directions.of(matrix, ROUNDING)
    return float(np.sqrt(found.values[-1] / found.values[0])) if len(found.values) and found.determined.all() else float("inf")


def independent_columns(columns: np.ndarray) -> np.ndarray:
    """Indices of columns (K, p) that do not depend linearly on those taken before them, from the first to the last."""
    upper = np.asarray(np.linalg.qr(columns, mode="r"))
    chosen: list[int] = []
    for column in range(columns.shape[1]):
        target = upper[:, column]
        rest = target - upper[:, chosen] @ np.linalg.lstsq(upper[:, chosen], target, rcond=None)[0] if chosen else target
        if np.linalg.norm(rest) > COLUMN * max(1.0, float(np.linalg.norm(target))):
            chosen.append(column)
    return np.array(chosen, int)

"""Sums of small dense blocks in large sparse matrices and vectors."""

from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse


class Scatter:
    """Collects entries of a sparse matrix, (rows, columns, values) of equal shape; entries at one place add up."""

    def __init__(self) -> None:
        self._entries: list[tuple[np.ndarray, np.ndarray, ca.MX]] = []

    def add(self, rows: np.ndarray, columns: np.ndarray, values: ca.MX) -> None:
        self._entries.append((rows.ravel(order="F"), columns.ravel(order="F"), ca.vec(values)))

    def matrix(self, n_rows: int, n_columns: int) -> ca.MX:
        rows, columns, values = zip(*self._entries, strict=True)
        keys, slot = np.unique(np.concatenate(columns) * n_rows + np.concatenate(rows), return_inverse=True)
        sparsity = ca.Sparsity.triplet(n_rows, n_columns, (keys % n_rows).tolist(), (keys // n_rows).tolist())
        return ca.MX(sparsity, sum_into(keys.size, slot, ca.vertcat(*values)))


def sum_into(size: int, places: np.ndarray, values: ca.MX) -> ca.MX:
    """A vector (size,) to whose element places[k] value k is added."""
    rows = places.ravel(order="F")
    entries = np.ones(rows.size), (rows, np.arange(rows.size))
    return multiplied(scipy.sparse.coo_array(entries, (size, rows.size)), ca.vec(values))


def multiplied(matrix: scipy.sparse.coo_array, values: ca.MX) -> ca.MX:
    """A constant sparse matrix times a vector."""
    by_columns: Any = scipy.sparse.csc_array(matrix)  # entries at one place added up
    # casadi reads these lists much faster than the matrix itself
    height, width = by_columns.shape
    sparsity = ca.Sparsity(height, width, by_columns.indptr.tolist(), by_columns.indices.tolist())
    return ca.MX(ca.DM(sparsity, by_columns.data.tolist())) @ values


def nonzeros_of(sparsity: ca.Sparsity) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of a pattern's nonzeros, column by column."""
    rows, columns = sparsity.get_triplet()
    return np.array(rows, int), np.array(columns, int)

"""Sums of small dense blocks in large sparse matrices and vectors."""

import casadi as ca
import numpy as np


class Scatter:
    """Collects entries of a sparse matrix, (rows, columns, values) of equal shape; entries at one place add up."""

    def __init__(self) -> None:
        self._rows: list[np.ndarray] = []
        self._columns: list[np.ndarray] = []
        self._values: list[ca.MX] = []

    def add(self, rows: np.ndarray, columns: np.ndarray, values: ca.MX) -> None:
        self._rows.append(rows.ravel(order="F"))
        self._columns.append(columns.ravel(order="F"))
        self._values.append(ca.vec(values))

    def matrix(self, n_rows: int, n_columns: int) -> ca.MX:
        rows, columns = np.concatenate(self._rows), np.concatenate(self._columns)
        keys, slot = np.unique(columns * n_rows + rows, return_inverse=True)
        sparsity = ca.Sparsity.triplet(n_rows, n_columns, (keys % n_rows).tolist(), (keys // n_rows).tolist())
        summed = ca.MX(incidence(keys.size, slot)) @ ca.vertcat(*self._values)
        return ca.MX(sparsity, summed)


def incidence(n_rows: int, slot: np.ndarray) -> ca.DM:
    """Sparse 0/1 matrix that adds value k to row slot[k]."""
    return ca.DM(ca.Sparsity.triplet(n_rows, slot.size, slot.tolist(), list(range(slot.size))), 1)


def sum_into(size: int, gather: np.ndarray, values: ca.MX) -> ca.MX:
    return ca.MX(incidence(size, gather.ravel(order="F"))) @ ca.vec(values)

"""Least squares on columns of torque: how much of a torque they explain beside those of plain friction and rotors."""

import numpy as np


def plain_columns(v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Dry friction, viscous friction and rotor of each joint, (n, K, 3 n)."""
    n, count = v.shape
    result = np.zeros((n, count, 3 * n))
    for j in range(n):
        result[j, :, 3 * j : 3 * j + 3] = np.column_stack([np.tanh(v[j] / 0.02), v[j], a[j]])
    return result


def explained(torque: np.ndarray, columns: np.ndarray, beside: np.ndarray) -> float:
    """Share of the squares that columns (n, K, p), which contain those `beside`, explain of what these leave of a torque (n, K)."""
    left, less = (rest(torque, x) for x in (beside, columns))
    return float(1 - less / left) if left > 1e-12 * max(float(np.sum(torque**2)), 1e-30) else 0.0


def rest(torque: np.ndarray, columns: np.ndarray) -> float:
    """Sum of squares that columns (n, K, p) leave of a torque (n, K)."""
    A, y = columns.reshape(-1, columns.shape[-1]), torque.ravel()
    A = A / np.maximum(np.linalg.norm(A, axis=0), 1e-12)
    return float(np.sum((y - A @ np.linalg.lstsq(A, y, rcond=1e-9)[0]) ** 2))

"""The noise of one joint: an autoregressive process, larger where the joint turns."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from rrr_oc.calibration.samples import STRIDE
from rrr_oc.discovery.knobs import MEMORY

ROWS_PER_LAG = 30  # rows that each lag needs; with fewer the order is lower
LEAST_TURNING = 20  # rows at reversals from which their larger noise is estimated


@dataclass(frozen=True)
class Noise:
    """Prediction-error filters of the residual of one joint.

    Attributes:
        filters: For each order k = 0 … p the weights of the k rows before, (k,).
        spreads: Standard deviation of the prediction error of each order over that of the last, (p + 1,).
        turning: Standard deviation at rows where the joint turns, over that elsewhere.
    """

    filters: tuple[np.ndarray, ...]
    spreads: np.ndarray
    turning: float

    @classmethod
    def of(cls, residual: np.ndarray, place: np.ndarray, turning: np.ndarray) -> "Noise":
        """Estimated by least squares from a residual (M,).

        Args:
            place: Number of rows without a gap before each row; −1 where a row does not count, (M,).
            turning: Where the joint turns, (M,).
        """
        count = np.count_nonzero(place >= 0)
        order = int(np.clip(count // ROWS_PER_LAG, 0, round(MEMORY / STRIDE / 2)))
        lags = np.zeros((len(residual), order))
        for k in range(order):
            lags[k + 1 :, k] = residual[: -k - 1]
        calm = ~turning
        filters, spreads, factor = [], [], 1.0
        for k in range(order + 1):
            rows = (place >= k) & calm
            if np.count_nonzero(rows) < max(3 * k, 10):
                rows = place >= k
            x, y = lags[rows, :k], residual[rows]
            weights = np.linalg.solve(x.T @ x + 1e-9 * (y @ y + 1e-300) * np.eye(k), x.T @ y) if k else np.zeros(0)
            filters.append(weights)
            spreads.append(float(np.sqrt(np.mean((y - x @ weights) ** 2))) if len(y) else 1.0)
        turned = (place >= order) & turning
        if np.count_nonzero(turned) > LEAST_TURNING and spreads[-1] > 0:
            error = residual[turned] - lags[turned] @ filters[-1]
            factor = max(1.0, float(np.sqrt(np.mean(error**2))) / spreads[-1])
        last = spreads[-1] or 1.0
        return cls(tuple(filters), np.maximum(np.array(spreads) / last, 1e-6), factor)

    def whitening(self, place: np.ndarray, turning: np.ndarray) -> tuple[csr_matrix, float]:
        """The matrix (M, M) that turns the noise white, rows that do not count being 0, and the logarithm of its determinant."""
        order, size = len(self.filters) - 1, len(place)
        at = np.clip(place, 0, order)
        table = np.zeros((order + 1, order + 1))
        for k, weights in enumerate(self.filters):
            table[k] = np.concatenate([[1.0], -weights, np.zeros(order - k)]) / self.spreads[k]
        scale = np.where(place >= 0, np.where(turning, 1 / self.turning, 1.0), 0.0)
        bands = table[at] * scale[:, None]  # (M, order + 1)
        rows = np.repeat(np.arange(size), order + 1)
        columns = rows - np.tile(np.arange(order + 1), size)
        values = bands.ravel()
        kept = (values != 0) & (columns >= 0)
        matrix = csr_matrix((values[kept], (rows[kept], columns[kept])), shape=(size, size))
        counted = place >= 0
        return matrix, float(np.sum(np.log(scale[counted] / self.spreads[at[counted]])))

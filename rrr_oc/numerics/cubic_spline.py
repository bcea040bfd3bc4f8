"""Natural cubic splines, of casadi expressions, numpy arrays and enclosures.

Between the points run cubics with a continuous slope and curvature. The curvature is zero at both ends, and beyond them the curve is a
straight line with the slope of the end. So it is twice continuously differentiable everywhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from rrr_oc.numerics.smooth import fmax, fmin


@dataclass(frozen=True, eq=False)
class NaturalSpline:
    """A curve through points.

    Attributes:
        x, y: The points, x ascending, (N,).
        cubics: Coefficients (b, c, d) of each interval, y + b s + c s² + d s³ with s from 0 to its width, (N − 1, 3).
        ends: Slopes at both ends.
    """

    x: np.ndarray
    y: np.ndarray
    cubics: np.ndarray
    ends: tuple[float, float]

    def value(self, x: Any) -> Any:
        """The curve; numbers, (..., K) arrays, casadi's scalars or enclosures.

        Each interval adds what the curve rises in it up to x, so that one formula serves all of these.
        """
        total, below, above = self.y[0], fmin(x - self.x[0], 0.0), fmax(x - self.x[-1], 0.0)
        for s, (b, c, d) in zip(self._inside(x), self.cubics, strict=True):
            total = total + s * (b + s * (c + s * d))
        return total + self.ends[0] * below + self.ends[1] * above

    def integral(self, x: Any) -> Any:
        """The integral of the curve from its first point to x; arguments as of `value`."""
        below, above = fmin(x - self.x[0], 0.0), fmax(x - self.x[-1], 0.0)
        total = below * (self.y[0] + self.ends[0] / 2 * below) + above * (self.y[-1] + self.ends[1] / 2 * above)
        for s, y, (b, c, d) in zip(self._inside(x), self.y[:-1], self.cubics, strict=True):
            total = total + s * (y + s * (b / 2 + s * (c / 3 + s * d / 4)))
        return total

    def _inside(self, x: Any) -> list[Any]:
        """For each interval, how much of it lies below x."""
        return [fmax(0.0, fmin(x - start, width)) for start, width in zip(self.x[:-1], np.diff(self.x), strict=True)]


@cache
def natural_spline(points: Sequence[tuple[float, float]]) -> NaturalSpline:
    """The curve through at least two points (x, y) with ascending x."""
    x, y = np.array(points, float).T
    spline = CubicSpline(x, y, bc_type="natural")
    d, c, b, _ = spline.c
    return NaturalSpline(x, y, np.column_stack([b, c, d]), (float(spline(x[0], 1)), float(spline(x[-1], 1))))

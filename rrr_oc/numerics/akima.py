"""Paths through equally spaced points by Akima's interpolation, for whole populations (numpy) and as expressions (casadi).

Akima, J. ACM 17(4), 1970, 589–602: the slope at a point weighs the secants beside it by how little the secants beyond bend,
t = (|m₊₁ − m₀| m₋₁ + |m₋₁ − m₋₂| m₀) / (|m₊₁ − m₀| + |m₋₁ − m₋₂|), and between points runs the cubic with these slopes. The path has
a continuous speed; its acceleration is linear between points and jumps at them. |·| has a kink, and where both weights vanish the
slope is 0/0: sqrt(·² + width²) stands in for it, `width` in the unit of the points.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

WIDTH = 1e-9  # [rad]; only decides 0/0, as the mean of the two secants


def slopes(points: Sequence[Any], rest: bool, width: float = WIDTH) -> list[Any]:
    """Slope at each point, in units of the points per distance between two of them.

    Args:
        points: At least three, equally spaced; numbers, arrays or casadi columns of one shape.
        rest: Whether the slope is zero at both ends, instead of Akima's, who goes on with parabolas.
        width: Of the smoothed weights, in the unit of the points.
    """
    inner = [b - a for a, b in pairwise(points)]
    first, last = 2 * inner[0] - inner[1], 2 * inner[-1] - inner[-2]
    secants = [2 * first - inner[0], first, *inner, last, 2 * last - inner[-1]]
    bends = [((b - a) ** 2 + width**2) ** 0.5 for a, b in pairwise(secants)]
    found = []
    for i in range(len(points)):
        before, beyond = bends[i], bends[i + 2]
        found.append((beyond * secants[i + 1] + before * secants[i + 2]) / (beyond + before))
    if rest:
        found[0], found[-1] = 0 * found[0], 0 * found[-1]
    return found


def cubics(points: Sequence[Any], rest: bool, width: float = WIDTH) -> list[tuple[Any, Any, Any, Any]]:
    """Coefficients (c0, c1, c2, c3) between each two points: c0 + c1 s + c2 s² + c3 s³, s from 0 to 1; arguments as of `slopes`."""
    ends = zip(pairwise(points), pairwise(slopes(points, rest, width)), strict=True)
    return [(p, t, 3 * (q - p) - 2 * t - u, t + u - 2 * (q - p)) for (p, q), (t, u) in ends]


def motion(cubic: tuple[Any, Any, Any, Any], s: Any, h: Any) -> tuple[Any, Any, Any]:
    """q [rad], dq [rad/s], ddq [rad/s²] at s in [0, 1] of an interval that lasts `h` [s]."""
    c0, c1, c2, c3 = cubic
    return c0 + s * (c1 + s * (c2 + s * c3)), (c1 + s * (2 * c2 + s * 3 * c3)) / h, (2 * c2 + s * 6 * c3) / h**2


def extremes(cubic: tuple[Any, Any, Any, Any], h: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What q, dq and ddq reach in an interval, exactly: candidates for the largest and least, (4, …), (3, …), (2, …) in numpy.

    q at the ends and where dq = 0, dq at the ends and where ddq = 0 (or at an end, where that lies outside), ddq at the ends.
    """
    _, c1, c2, c3 = cubic
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = -c2 / (3 * c3)
        root = np.sqrt(np.maximum(c2**2 - 3 * c1 * c3, 0.0))
        larger = -(c2 + np.where(c2 >= 0, root, -root))  # of the quadratic's two roots the one without cancellation
        stops = larger / (3 * c3), c1 / larger
    ends = [np.zeros_like(c1), np.ones_like(c1)]
    inside = [np.clip(np.nan_to_num(s), 0.0, 1.0) for s in (*stops, turn)]
    q = np.stack([motion(cubic, s, h)[0] for s in (*ends, *inside[:2])])
    dq = np.stack([motion(cubic, s, h)[1] for s in (*ends, inside[2])])
    return q, dq, np.stack([motion(cubic, s, h)[2] for s in ends])

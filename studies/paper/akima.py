"""Akima's interpolation of equally spaced points, for arrays of paths (numpy) and for expressions (casadi).

Akima, J. ACM 17(4), 1970, 589–602: with the secants m₋₂, m₋₁, m₀, m₊₁ around a point, the slope there is
t = (|m₊₁ − m₀| m₋₁ + |m₋₁ − m₋₂| m₀) / (|m₊₁ − m₀| + |m₋₁ − m₋₂|); between two points runs the cubic with these slopes. The path has
a continuous speed; its acceleration is linear between points and discontinuous at them. |x| is replaced by sqrt(x² + width²), `width`
in the unit of the points: |x| has a kink, and the slope is 0/0 where both weights vanish.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

WIDTH = 1e-9  # [rad]; makes the slope the mean of the two secants where it would be 0/0; doubled, nothing changes in 1e-8 rad


def slopes(points: Sequence[Any], rest: bool, width: float = WIDTH) -> list[Any]:
    """Slope at each point, in units of the points per distance between two of them.

    Args:
        points: At least three, equally spaced; numbers, arrays or casadi columns of one shape.
        rest: Whether the slope is zero at both ends. Otherwise, as in Akima's paper, the path is continued by parabolas.
        width: Smoothing width of the weights, in the unit of the points.
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
    """Exact extremes of q, dq and ddq in an interval: values among which the largest and the least are, (4, …), (3, …), (2, …).

    q at the ends and where dq = 0, dq at the ends and where ddq = 0 (at an end where that instant lies outside), ddq at the ends.
    """
    _, c1, c2, c3 = cubic
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = -c2 / (3 * c3)
        root = np.sqrt(np.maximum(c2**2 - 3 * c1 * c3, 0.0))
        larger = -(c2 + np.where(c2 >= 0, root, -root))  # the root of the quadratic that is computed without cancellation
        stops = larger / (3 * c3), c1 / larger
    ends = [np.zeros_like(c1), np.ones_like(c1)]
    inside = [np.clip(np.nan_to_num(s), 0.0, 1.0) for s in (*stops, turn)]
    q = np.stack([motion(cubic, s, h)[0] for s in (*ends, *inside[:2])])
    dq = np.stack([motion(cubic, s, h)[1] for s in (*ends, inside[2])])
    return q, dq, np.stack([motion(cubic, s, h)[2] for s in ends])

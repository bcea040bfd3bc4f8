"""Functions that laws are written with, for casadi expressions and for numpy arrays, which casadi would copy.

C2-smooth stand-ins for the non-smooth functions of springs among them, each with a named width and exact outside it.
"""

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np


def _either(symbolic: Callable[..., Any], numeric: Callable[..., Any]) -> Callable[..., Any]:
    def function(*arguments: Any) -> Any:
        if any(isinstance(a, SYMBOLIC) for a in arguments):
            return symbolic(*arguments)
        with np.errstate(over="ignore", under="ignore"):
            return numeric(*arguments)

    return function


SYMBOLIC = (ca.SX, ca.MX, ca.DM)
TURNS = ("tanh", "root", "arctan")  # ways from −1 to 1
cos, sin, exp, sqrt, tanh = (_either(getattr(ca, name), getattr(np, name)) for name in ("cos", "sin", "exp", "sqrt", "tanh"))
arctan = _either(ca.atan, np.arctan)
fabs, fmax, fmin = (_either(getattr(ca, name), getattr(np, name)) for name in ("fabs", "fmax", "fmin"))


def sign(x, width, turn="tanh"):
    """The smooth sign: tanh(x / w), x / √(x² + w²) for the turn "root", or 2/π arctan(x / w).

    `x` and `width` in the same unit; a width of 0 gives the exact sign.
    """
    with np.errstate(over="ignore"):
        if turn == "root":
            return x / sqrt(x * x + fmax(width * width, 1e-300))
        scaled = x / fmax(width, 1e-300)
        return tanh(scaled) if turn == "tanh" else 2 / np.pi * arctan(scaled)


def ramp(x, width):
    """max(x, 0), twice continuously differentiable: (x + w)³ (3 w − x) / (16 w³) for |x| < w, exact elsewhere.

    A width of 0 gives the exact ramp. `x` and `width` in the same unit; numpy or casadi.
    """
    inside = fmax(-width, fmin(x, width))
    safe = fmax(width, 1e-300)
    blend = ((inside + width) / safe) ** 3 * (3 * width - inside) / 16
    return blend + fmax(x - width, 0)


def ramp_integral(x, width):
    """Antiderivative of `ramp`, zero for x ≤ −w: (x + w)⁴ (4 w − x) / (80 w³) for |x| < w; for x > w it is x²/2 + w²/10."""
    inside = fmax(-width, fmin(x, width))
    safe = fmax(width, 1e-300)
    blend = ((inside + width) / safe) ** 3 * (inside + width) * (4 * width - inside) / 80
    beyond = fmax(x - width, 0)
    return blend + width * beyond + beyond**2 / 2

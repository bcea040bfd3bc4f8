"""Functions for physical laws, of casadi expressions and of numpy arrays (which casadi would copy).

Among them C2-smooth approximations of the sign and the ramp, each with a smoothing width outside which it is exact.
"""

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from scipy import special


def _either(symbolic: Callable[..., Any], numeric: Callable[..., Any]) -> Callable[..., Any]:
    def function(*arguments: Any) -> Any:
        if any(isinstance(a, SYMBOLIC) for a in arguments):
            return symbolic(*arguments)
        with np.errstate(over="ignore", under="ignore"):
            return numeric(*arguments)

    return function


SYMBOLIC = (ca.SX, ca.MX, ca.DM)
cos, sin, exp, log, sqrt, tanh = (
    _either(getattr(ca, name), getattr(np, name)) for name in ("cos", "sin", "exp", "log", "sqrt", "tanh")
)
arctan, erf = _either(ca.atan, np.arctan), _either(ca.erf, special.erf)
fabs, fmax, fmin = (_either(getattr(ca, name), getattr(np, name)) for name in ("fabs", "fmax", "fmin"))


TURNS: dict[str, Callable[[Any], Any]] = {  # approximations of the sign; the last two are not twice differentiable
    "tanh": tanh,
    "erf": erf,
    "arctan": lambda x: 2 / np.pi * arctan(x),
    "root": lambda x: x / sqrt(1 + x * x),
    "ratio": lambda x: x / (1 + fabs(x)),
    "clip": lambda x: fmax(-1.0, fmin(x, 1.0)),
}


def sign(x, width, turn="tanh"):
    """The smooth sign tanh(x / width), or another of `TURNS`; `x` and `width` in the same unit, a width of 0 gives the exact sign."""
    with np.errstate(over="ignore"):
        scaled = x / fmax(width, 1e-300)
    return TURNS[turn](scaled if turn == "tanh" else fmax(-1e100, fmin(scaled, 1e100)))


def ramp(x, width):
    """max(x, 0), twice continuously differentiable: (x + w)³ (3 w − x) / (16 w³) for |x| < w, exact elsewhere.

    A width of 0 gives the exact ramp. `x` and `width` in the same unit; numpy or casadi.
    """
    if isinstance(width, float) and width == 0.0:
        return fmax(x, 0.0)
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

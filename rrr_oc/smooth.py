"""C2-smooth stand-ins for the non-smooth functions of springs, each with a named width and exact outside it."""

import casadi as ca


def ramp(x, width):
    """max(x, 0), twice continuously differentiable: (x + w)³ (3 w − x) / (16 w³) for |x| < w, exact elsewhere.

    A width of 0 gives the exact ramp. `x` and `width` in the same unit; numpy or casadi.
    """
    inside = ca.fmax(-width, ca.fmin(x, width))
    safe = ca.fmax(width, 1e-300)
    blend = ((inside + width) / safe) ** 3 * (3 * width - inside) / 16
    return blend + ca.fmax(x - width, 0)


def ramp_integral(x, width):
    """Antiderivative of `ramp`, zero for x ≤ −w: (x + w)⁴ (4 w − x) / (80 w³) for |x| < w; for x > w it is x²/2 + w²/10."""
    inside = ca.fmax(-width, ca.fmin(x, width))
    safe = ca.fmax(width, 1e-300)
    blend = ((inside + width) / safe) ** 3 * (inside + width) * (4 * width - inside) / 80
    beyond = ca.fmax(x - width, 0)
    return blend + width * beyond + beyond**2 / 2

"""The springs that leave the least torque along motions that are held: a small problem of least squares, for any way to mount them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import casadi as ca
import numpy as np
from scipy.optimize import least_squares

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.proposals import sobol_points
from rrr_oc.codesign.springs import drawn_bounds, from_drawn
from rrr_oc.optimal_control.problem import PhaseGuess

DRAWN = 128  # springs whose torques are compared before a fit; doubled, slower and surer
EVALUATIONS = 20  # of a fit at most; doubled, those that creep along a valley take longer
TIMES = 21  # of a phase's motion; doubled, springs that are taut for a moment are fitted better
STEP = 1e-6  # of the differences that stand for derivatives, of variables in [0, 1]


@dataclass(frozen=True)
class HeldMotion:
    """The motion of one phase at some times.

    Attributes:
        q, dq, ddq: Of the moving joints (m, N) [rad, rad/s, rad/s²].
        weight: Of its mean squared torque, such as its duration.
    """

    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    weight: float = 1.0

    @classmethod
    def of(cls, design: CoDesign, phase: PhaseGuess) -> "HeldMotion":
        """A phase's motion, weighted by its duration. The arm must have no springs between drives and links."""
        shares, m = np.linspace(0, 1, TIMES), len(design.task.moving)
        x = phase.states(shares)
        return cls(x[:m], x[m : 2 * m], design.accelerations(x, phase.controls(shares)), phase.duration)

    @classmethod
    def at_rest(cls, q: np.ndarray) -> "HeldMotion":
        """Standing still in some postures (m, N) [rad]."""
        return cls(q, np.zeros_like(q), np.zeros_like(q))


def fitted_springs(
    design: CoDesign, phases: Sequence[HeldMotion], fits: int, width: float | None = None, evaluations: int | None = EVALUATIONS
) -> list[tuple[float, np.ndarray]]:
    """Springs fitted to a motion, the best first: mean squared torque that is left [N²m²], summed over the moving joints, and parameters
    (np,). Several fits may be the same.

    It is the load torque with the task's own payload that is fitted, whatever the design's cost and scenarios are.

    Args:
        design: The problem; none of its springs may stand between drives and links.
        fits: Number of fits, each from one of the best of the drawn springs.
        width: Smoothing width of the springs [rad]; each effect's own if none.
        evaluations: Of each fit at most; None where it goes on until it has converged.
    """
    low, high = drawn_bounds(design.springs)
    free, widths = low < high, design.widths(design.data(width))
    inputs = design.torques.sx_in()
    springs = ca.Function("springs", inputs, [design.torques(*inputs)[1]])  # without the arm it takes a fraction of the time
    weights = np.array([motion.weight for motion in phases])
    needed = [_needed(design, i, motion, widths) for i, motion in enumerate(phases)]

    def parameters(x: np.ndarray) -> np.ndarray:
        """Of variables in [0, 1] (free, count), as (np, count)."""
        drawn = np.tile(low[:, None], x.shape[1])
        drawn[free] += (high - low)[free, None] * x
        return from_drawn(design.springs, drawn)

    def residuals(x: np.ndarray) -> np.ndarray:
        """Torque that is left with variables (free, count), weighted for the mean of its square (·, count)."""
        theta, count, rows = parameters(x), x.shape[1], []
        for i, (motion, total, weight) in enumerate(zip(phases, needed, weights / weights.sum(), strict=True)):
            m, number = total.shape
            engaged = np.repeat(design.engaged(i, theta.T).T, number, axis=1)
            rates = (np.tile(v, count) for v in (motion.q, motion.dq, motion.ddq))
            own = np.array(springs(*rates, design.task.payloads[i], engaged, widths)).reshape(m, count, number)
            rows.append((total[:, None] - own).swapaxes(1, 2).reshape(-1, count) * np.sqrt(weight / number))
        return np.vstack(rows)

    def slopes(x: np.ndarray) -> np.ndarray:
        steps = np.where(x < 0.5, STEP, -STEP)
        found = residuals(np.column_stack([x, x[:, None] + np.diag(steps)]))
        return (found[:, 1:] - found[:, :1]) / steps

    drawn = sobol_points(int(free.sum()), max(DRAWN, fits), 0).T
    order = np.argsort(np.square(residuals(drawn)).sum(axis=0))[:fits]
    starts = 0.01 + 0.98 * drawn[:, order].T
    settings = {"jac": cast(Any, slopes), "bounds": (0, 1), "max_nfev": evaluations}
    found = [least_squares(lambda x: residuals(x[:, None])[:, 0], x, **settings) for x in starts]
    return [(2 * float(fit.cost), parameters(fit.x[:, None])[:, 0]) for fit in sorted(found, key=lambda fit: fit.cost)]


def _needed(design: CoDesign, phase: int, motion: HeldMotion, widths: np.ndarray) -> np.ndarray:
    """Torque that a phase's motion needs without springs (m, N) [Nm]."""
    theta = design.engaged(phase, design.problem.p_upper)
    load, springs = design.torques(motion.q, motion.dq, motion.ddq, design.task.payloads[phase], theta, widths)
    return np.array(load + springs)

"""The springs that leave the least torque along motions that are held: a small problem of least squares, for any way to mount them."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.optimize import least_squares

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.proposals import sobol_points
from rrr_oc.codesign.springs import drawn_bounds, from_drawn
from rrr_oc.optimal_control.problem import PhaseGuess

DRAWN = 128  # springs whose torques are compared before a fit; doubled, slower and surer
FITS = 2  # of the best of these; doubled, slower and surer
EVALUATIONS = 20  # of a fit; doubled, fits that creep along a valley take longer
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
    def of(cls, phase: PhaseGuess) -> "HeldMotion":
        """A phase's motion, weighted by its duration; of an arm without springs between drives and links."""
        shares = np.linspace(0, 1, TIMES)
        q, dq = np.split(phase.states(shares), 2)
        return cls(q, dq, phase.controls(shares), phase.duration)

    @classmethod
    def at_rest(cls, q: np.ndarray) -> "HeldMotion":
        """Standing still in some postures (m, N) [rad]."""
        return cls(q, np.zeros_like(q), np.zeros_like(q))


def fitted_springs(
    design: CoDesign, phases: Sequence[HeldMotion], width: float | None = None, fits: int = FITS
) -> tuple[float, np.ndarray]:
    """Mean squared torque that is left [N²m²], summed over the moving joints, and parameters (np,), of springs fitted to a motion.

    Args:
        design: The problem; none of its springs may stand between drives and links.
        width: Smoothing width of the springs [rad]; each effect's own if none.
        fits: Number of drawn springs from which a fit begins.
    """
    low, high = drawn_bounds(design.springs)
    free = low < high
    torques = [_SpringTorques(design, i, motion, design.widths(design.data(width))) for i, motion in enumerate(phases)]
    weights = np.array([motion.weight for motion in phases])
    factors = np.sqrt(weights / weights.sum())

    def parameters(x: np.ndarray) -> np.ndarray:
        """Of variables in [0, 1] (free, count), as (np, count)."""
        drawn = np.tile(low[:, None], x.shape[1])
        drawn[free] += (high - low)[free, None] * x
        return from_drawn(design.springs, drawn)

    def left(x: np.ndarray) -> np.ndarray:
        """Torque that is left with variables (free, count), weighted for the mean of its square (·, count)."""
        theta = parameters(x)
        return np.vstack([factor * each.left(theta) for factor, each in zip(factors, torques, strict=True)])

    def slopes(x: np.ndarray) -> np.ndarray:
        steps = np.where(x < 0.5, STEP, -STEP)
        found = left(np.column_stack([x, x[:, None] + np.diag(steps)]))
        return (found[:, 1:] - found[:, :1]) / steps

    drawn = sobol_points(int(free.sum()), max(DRAWN, fits), 0).T
    order = np.argsort(np.square(left(drawn)).sum(axis=0))[:fits]
    starts = 0.01 + 0.98 * drawn[:, order].T
    found = [least_squares(lambda x: left(x[:, None])[:, 0], x, slopes, (0, 1), max_nfev=EVALUATIONS) for x in starts]
    best = min(found, key=lambda fit: fit.cost)
    return 2 * float(best.cost), parameters(best.x[:, None])[:, 0]


class _SpringTorques:
    """Torques of a design's springs along a phase's motion."""

    def __init__(self, design: CoDesign, phase: int, motion: HeldMotion, widths: np.ndarray) -> None:
        self._design, self._phase, self._motion, self._widths = design, phase, motion, widths
        self._payload = design.task.payloads[phase]
        inputs = design.torques.sx_in()
        self._springs = ca.Function("springs", inputs, [design.torques(*inputs)[1]])
        theta = design.engaged(phase, design.problem.p_upper)
        load, springs = design.torques(motion.q, motion.dq, motion.ddq, self._payload, theta, widths)
        self._needed = np.array(load + springs)  # (m, N) [Nm]

    def left(self, theta: np.ndarray) -> np.ndarray:
        """Torque that springs of parameters (np, count) leave to the drives [Nm], over the root of the number of times (m N, count)."""
        count, motion, (m, number) = theta.shape[1], self._motion, self._needed.shape
        engaged = np.repeat(self._design.engaged(self._phase, theta.T).T, number, axis=1)
        rates = (np.tile(v, count) for v in (motion.q, motion.dq, motion.ddq))
        springs = np.array(self._springs(*rates, self._payload, engaged, self._widths)).reshape(m, count, number)
        return (self._needed[:, None] - springs).swapaxes(1, 2).reshape(m * number, count) / np.sqrt(number)

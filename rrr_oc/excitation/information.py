"""The information of a motion on chosen parameters.

A motion's information on parameters theta, from torques with noise of standard deviation sigma_i on joint i, is
S = mean over time of Yᵀ W Y with Y = d tau / d theta (n, p) and W = diag(1/sigma²).
A design of greatest log det S is called D-optimal: the volume of the confidence ellipsoid goes
with exp(−log det S / 2). The condition number of S says how unevenly the information is spread over the parameters
(Gautier & Khalil, Int. J. Robotics Research 11 (1992) 362–375; cited from memory).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.linalg

from rrr_oc.errors import UserError
from rrr_oc.excitation.limits import PLANNING_WIDTH, Rig, signals, states_within
from rrr_oc.model.motion import Motion

INERTIAL = ("mass", "mx", "my", "mz", "xx", "xy", "yy", "xz", "yz", "zz")  # the rows of `Robot.inertial`
SAMPLES = 400  # random states by which columns are scaled, and linear dependence is found
INDEPENDENT = 1e-7  # [1] of a column's RMS, from which it depends on no others; doubled, nothing changes


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """How torques depend on parameters: `function` is (q, dq, ddq) -> d tau / d theta (n, p), whose columns have `names`."""

    names: tuple[str, ...]
    function: ca.Function


def model_sensitivity(rig: Rig) -> Sensitivity:
    """Of the motor torque to the parameters of a rig's model, at the rig's values.

    Columns: `<link>.<one of INERTIAL>`, `payload`, and `<effect>[<joints>].<parameter>`. Laws with narrow transitions have
    `PLANNING_WIDTH`. Raises `UserError` for an effect whose torque depends on internal states or on the time.
    """
    model, n = rig.model, rig.model.robot.n
    inertial, payload, theta = ca.SX.sym("inertial", 10, n), ca.SX.sym("payload"), ca.SX.sym("theta", len(model.parameters))
    motion, widths, now = signals(n), np.maximum(model.widths, PLANNING_WIDTH), ca.SX.sym("time")
    mass = np.maximum(model.robot.inertial[0], 1e-3)  # the torque is linear in it, but its expression divides by the mass
    nominal = np.vstack([mass, model.robot.inertial[1:]])
    torque = model.motor_inverse(*motion, now, payload, theta, widths, inertial)[0]
    unknown = ca.vertcat(ca.vec(inertial), payload, theta)
    columns = ca.substitute(ca.jacobian(torque, unknown), unknown, ca.DM([*nominal.ravel("F"), rig.payload, *rig.theta]))
    if model.states or ca.depends_on(columns, now):
        raise UserError("planning needs effects without internal states whose torques do not depend on the time")
    links = [f"{link}.{name}" for link in model.robot.links for name in INERTIAL]
    effects = [f"{model.label(e)}.{p.name}" for e in model.effects for p in e.parameters]
    return Sensitivity((*links, "payload", *effects), ca.Function("sensitivity", [*motion], [ca.densify(columns)]))


@dataclass(frozen=True, eq=False)
class Information:
    """How motions of a rig determine parameters: columns of the torque's Jacobian, each scaled to a torque of RMS `noise`.

    The scale is the column's RMS over random states within the limits, so that all that follows is free of units. Of linearly
    dependent columns (the inertial ones always are), an independent choice is kept: base parameters.

    Attributes:
        rig: The arm that moves.
        interest: Names of the columns kept, in the order of `rows`.
        inseparable: Parameters of interest that depend linearly on the columns kept, whatever the motion.
        scale: Of the columns kept [Nm per unit of the parameter].
        rows: (q, dq, ddq) -> scaled columns (n, p).
    """

    rig: Rig
    interest: tuple[str, ...]
    inseparable: tuple[str, ...]
    scale: np.ndarray
    rows: ca.Function

    def matrix(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """S of a motion (n, K), one row and column a parameter of interest."""
        stacked = _stack(np.asarray(self.rows.map(q.shape[1])(q, dq, ddq)), len(self.scale))
        root = np.asarray(
            np.linalg.qr(stacked / math.sqrt(q.shape[1]), mode="r")
        )  # keeps the condition number from being squared
        return root.T @ root

    def log_det(self, motion: Motion) -> float:
        """log det S [nat]; −infinity where the motion leaves a parameter undetermined."""
        sign, value = np.linalg.slogdet(self.matrix(motion.q, motion.dq, motion.ddq))
        return float(value) if sign > 0 else -math.inf

    def deviations(self, motion: Motion) -> dict[str, float]:
        """Standard errors that least squares have for the parameters of interest after this motion, each in the parameter's unit.

        The diagonal of (K S)⁻¹ for K samples whose noise is independent; where it is not, they are larger by the same factor.
        Infinite where the motion leaves a parameter undetermined.
        """
        whole = self.matrix(motion.q, motion.dq, motion.ddq) * motion.q.shape[1]
        if np.linalg.matrix_rank(whole, hermitian=True) < len(whole):
            return dict.fromkeys(self.interest, math.inf)
        return dict(zip(self.interest, (np.sqrt(np.diag(np.linalg.inv(whole))) / self.scale).tolist(), strict=True))

    def condition(self, motion: Motion) -> float:
        """Condition number of S."""
        return float(np.linalg.cond(self.matrix(motion.q, motion.dq, motion.ddq)))


def information(
    rig: Rig,
    interest: Sequence[str],
    noise: float | np.ndarray = 1.0,
    sensitivity: Sensitivity | None = None,
) -> Information:
    """The information that motions of a rig contain on parameters of interest.

    Args:
        noise: Standard deviation of the torques [Nm], scalar or (n,).
        sensitivity: Default: `model_sensitivity(rig)`. Parameters that are not of interest are known.

    Raises:
        UserError: A parameter is unknown or named twice; noise is not above 0; no motion determines any parameter of interest.
    """
    sensitivity = model_sensitivity(rig) if sensitivity is None else sensitivity
    n, names = rig.model.robot.n, list(interest)
    if not set(names) <= set(sensitivity.names) or len(set(names)) < len(names) or not names:
        raise UserError(f"parameters of interest must be different ones of {', '.join(sensitivity.names)}; got {names}")
    if not (np.all(np.asarray(noise) > 0) and np.all(np.isfinite(noise))):
        raise UserError(f"noise must be above 0 and finite, got {noise} Nm")
    columns, weight = [sensitivity.names.index(name) for name in names], 1 / np.broadcast_to(np.asarray(noise, float), (n,))
    motion = signals(n)
    wanted = ca.diag(ca.DM(weight)) @ sensitivity.function(*motion)[:, columns]
    sampled = ca.Function("rows", [*motion], [wanted]).map(SAMPLES)(*states_within(rig.limits, SAMPLES, 0))
    values = _stack(np.asarray(sampled), len(names))
    size = np.sqrt(np.mean(values**2, axis=0) * n)
    scale = np.where(size > 1e-12 * np.max(size, initial=1e-300), size, np.inf)  # a column of zeros holds no information
    kept = _independent(values / scale).tolist()
    if not kept:
        raise UserError(f"no motion within the limits distinguishes {', '.join(names)} from a torque of zero")
    function = ca.Function("rows", [*motion], [ca.densify(wanted[:, kept] @ ca.diag(ca.DM(1 / scale[kept])))])
    lost = tuple(name for i, name in enumerate(names) if i not in kept)
    return Information(rig, tuple(names[i] for i in kept), lost, scale[kept], function)


def _independent(columns: np.ndarray) -> np.ndarray:
    """Indices of an independent choice of columns whose RMS is of order 1: QR with pivoting, as Gautier's base parameters."""
    factor, order = scipy.linalg.qr(columns, mode="r", pivoting=True)  # pyright: ignore[reportAssignmentType]
    rank = int(np.sum(np.abs(np.diag(factor)) > INDEPENDENT * math.sqrt(len(columns))))
    return np.sort(order[:rank])


def _stack(values: np.ndarray, p: int) -> np.ndarray:
    """(n, p K) of a mapped Function as rows (n K, p)."""
    return values.reshape(len(values), -1, p).reshape(-1, p)

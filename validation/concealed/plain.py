# pyright: reportAttributeAccessIssue=false
"""A small calibration of the plain model by least squares, to measure how large a concealed effect shows."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from scipy.signal import butter, sosfiltfilt

from validation.concealed.arms import Arm, reduced_model
from validation.concealed.effect import Signals
from validation.concealed.plant import Setup, bodies
from validation.concealed.springs import spring_torque


@dataclass(frozen=True)
class PlainFit:
    """Residual torque (B, n, N) [Nm] and, per joint, dry friction, viscous friction and armature (n, 3)."""

    residual: np.ndarray
    coefficients: np.ndarray
    regressor: np.ndarray  # (B, n, N, 3)
    inside: np.ndarray | None = (
        None  # samples that belong to their recording (B, N), bool; the others have no residual; None: all
    )

    def rms(self, recordings: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Root mean square over recordings and time, per joint (n,) [Nm]."""
        mean = np.mean(self.residual[recordings] ** 2, axis=(0, 2))
        return np.sqrt(mean if self.inside is None else mean / np.mean(self.inside[recordings]))


def thinned(x: Signals, rate: float) -> Signals:
    """The samples from t = 0 on at about `rate` [Hz]."""
    first, stride = int(np.searchsorted(x.t, -1e-9)), max(1, round(1 / rate / (x.t[1] - x.t[0])))
    pick = slice(first, None, stride)
    return Signals(x.t[pick], *(a[:, :, pick] for a in (x.q, x.dq, x.ddq, x.tau)))


def smoothed(x: Signals, cutoff: float = 15.0) -> Signals:
    """The same with accelerations low-passed forwards and backwards at `cutoff` [Hz].

    A transmission rings far above what a 100 Hz recording shows; its exact acceleration would swamp the residual.
    """
    sos = butter(2, cutoff, fs=1 / (x.t[1] - x.t[0]), output="sos")
    return Signals(x.t, x.q, x.dq, sosfiltfilt(sos, x.ddq, axis=2), x.tau)


def subset(x: Signals, recordings: slice) -> Signals:
    return Signals(x.t, *(a[recordings] for a in (x.q, x.dq, x.ddq, x.tau)))


def inverse_dynamics(model: pin.Model, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """M q'' + C q' + g along a recording, (n, N) [Nm]."""
    data = model.createData()
    return np.array([pin.rnea(model, data, *row).copy() for row in zip(q.T, dq.T, ddq.T, strict=True)]).T


def nominal_torque(arm: Arm, setup: Setup, x: Signals) -> np.ndarray:
    """Load torque that the listed payloads and springs ask for, (B, n, N) [Nm]."""
    models = bodies(arm, setup, [])
    return np.array(
        [
            inverse_dynamics(m, x.q[b], x.dq[b], x.ddq[b]) - spring_torque(setup.springs[b], arm, x.q[b])
            for b, m in enumerate(models)
        ]
    )


def friction_columns(width: float | np.ndarray, x: Signals) -> np.ndarray:
    """tanh(dq / width), dq and ddq, (B, n, N, 3)."""
    return np.stack([np.tanh(x.dq / width), x.dq, x.ddq], axis=-1)


def calibrate(
    arm: Arm, setup: Setup, x: Signals, width: np.ndarray | None = None, inside: np.ndarray | None = None
) -> PlainFit:
    """Per joint: τ − nominal ≈ f_c tanh(dq/width) + f_v dq + J ddq, over all recordings together.

    `width` (n,) [rad/s] replaces the arm's own; samples that are not `inside` (B, N) are left out.
    """
    columns = friction_columns(arm.width if width is None else width[:, None], x)
    gap = x.tau - nominal_torque(arm, setup, x)
    if inside is not None:
        columns, gap = columns * inside[:, None, :, None], gap * inside[:, None]
    theta = np.empty((arm.n, 3))
    residual = np.empty_like(gap)
    for j in range(arm.n):
        a, y = columns[:, j].reshape(-1, 3), gap[:, j].reshape(-1)
        theta[j] = np.linalg.lstsq(a, y)[0]
        residual[:, j] = (y - a @ theta[j]).reshape(gap[:, j].shape)
    return PlainFit(residual, theta, columns, inside)


def calibrate_inertials(arm: Arm, setup: Setup, x: Signals) -> PlainFit:
    """The same with the links' inertial parameters free too (`inertial: identify`)."""
    model = reduced_model(arm.stated_urdf or arm.urdf, arm.joints)
    model.gravity.linear = setup.gravity
    data = model.createData()
    batch, n, samples = x.q.shape
    rows = batch * samples
    q, dq, ddq = (np.moveaxis(v, 1, -1).reshape(rows, n) for v in (x.q, x.dq, x.ddq))
    bodies_part = np.array([pin.computeJointTorqueRegressor(model, data, *z).copy() for z in zip(q, dq, ddq, strict=True)])
    columns = friction_columns(arm.width, x)
    friction_part = np.zeros((rows, n, 3 * n))
    for j in range(n):
        friction_part[:, j, 3 * j : 3 * j + 3] = columns[:, j].reshape(rows, 3)
    massless = nominal_torque(arm, setup, x) - nominal_torque(arm, Setup(0 * setup.payload, [{}] * batch, setup.gravity), x)
    y = np.moveaxis(x.tau - massless, 1, -1).reshape(rows * n)
    a = np.concatenate([bodies_part, friction_part], axis=2).reshape(rows * n, -1)
    theta = np.linalg.lstsq(a, y)[0]
    residual = np.moveaxis((y - a @ theta).reshape(batch, samples, n), -1, 1)
    return PlainFit(residual, theta[-3 * n :].reshape(n, 3), columns)

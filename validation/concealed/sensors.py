"""From the plant's signals to the rows of a recording: sampling, jitter, lost samples, quantisation, noise."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from validation.concealed.effect import Signals


@dataclass(frozen=True)
class Sensing:
    """How the logger samples and how noisy it is."""

    torque_noise: np.ndarray  # standard deviation, (n,) [Nm]
    coloured: float = 0.0  # share of the noise's variance that is correlated over 50 ms [1]
    position_noise: float = 1e-5  # [rad]
    encoder_bits: int = 19  # per joint turn
    rate: float = 100.0  # [Hz]
    jitter: float = 0.0  # of sample times, uniform within ± this share of a sample [1]
    lost: float = 0.0  # share of rows lost one by one [1]; one burst of 0.2 s goes too
    speeds: bool = False  # record dq as well
    speed_noise: float = 2e-3  # [rad/s]
    accelerations: bool = False  # record ddq as well
    acceleration_noise: float = 0.05  # [rad/s²]


def sample(x: Signals, b: int, sensing: Sensing, rng: np.random.Generator, end: float | None = None) -> dict[str, np.ndarray]:
    """Recording b as arrays: t (N,), q, tau and perhaps dq and ddq (n, N); it ends at `end` [s], or with the simulation."""
    t = sample_times(x.t[-1] if end is None else end, sensing, rng)
    n = x.q.shape[1]
    q = np.array([CubicHermiteSpline(x.t, x.q[b, j], x.dq[b, j])(t) for j in range(n)])
    tau = np.array([np.interp(t, x.t, x.tau[b, j]) for j in range(n)])
    count = 2 * np.pi / 2**sensing.encoder_bits  # [rad]
    q = count * np.round((q + sensing.position_noise * rng.standard_normal(q.shape)) / count)
    out = {"t": t, "q": q, "tau": tau + torque_noise(tau.shape, sensing, rng)}
    if sensing.speeds:
        dq = np.array([np.interp(t, x.t, x.dq[b, j]) for j in range(n)])
        out["dq"] = dq + sensing.speed_noise * rng.standard_normal(dq.shape)
    if sensing.accelerations:
        ddq = np.array([np.interp(t, x.t, x.ddq[b, j]) for j in range(n)])
        out["ddq"] = ddq + sensing.acceleration_noise * rng.standard_normal(ddq.shape)
    return out


def sample_times(end: float, sensing: Sensing, rng: np.random.Generator) -> np.ndarray:
    """Strictly increasing times in [0, end] [s]; those that get lost are left out."""
    t = np.arange(round(end * sensing.rate) + 1) / sensing.rate
    if sensing.jitter > 0:
        t = t + rng.uniform(-1, 1, len(t)) * min(sensing.jitter, 0.45) / sensing.rate
    t = np.clip(t, 0.0, end)
    keep = np.append(True, np.diff(t) > 1e-4)
    if sensing.lost > 0:
        keep &= rng.random(len(t)) > sensing.lost
        burst = rng.uniform(0.1, 0.8) * end
        keep &= ~((t > burst) & (t < burst + 0.2))
    return np.round(t[keep], 6)


def torque_noise(shape: tuple[int, int], sensing: Sensing, rng: np.random.Generator) -> np.ndarray:
    """White noise plus a first-order coloured part of 50 ms; total standard deviation as stated [Nm], (n, N)."""
    white = rng.standard_normal(shape)
    if sensing.coloured > 0:
        keep = np.exp(-1 / (0.05 * sensing.rate))
        drive, slow = rng.standard_normal(shape), np.zeros(shape)
        slow[:, 0] = drive[:, 0]
        for k in range(1, shape[1]):
            slow[:, k] = keep * slow[:, k - 1] + np.sqrt(1 - keep**2) * drive[:, k]
        white = np.sqrt(1 - sensing.coloured) * white + np.sqrt(sensing.coloured) * slow
    return sensing.torque_noise[:, None] * white

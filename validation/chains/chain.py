"""The chain of measurement: what encoders, filters, drives, buses and clocks make of exact signals."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.signal import lfilter

from validation.chains.faults import FAULTS

FINE = 2000.0  # [Hz], rate of exact signals


@dataclass(frozen=True)
class Chain:
    """How an arm's signals are measured and written down. The defaults are ideal.

    Attributes:
        rate: Of the rows [Hz].
        bits: Of the encoders over one turn of the joint.
        position_noise: Standard deviation before the encoder rounds [rad].
        speed: Column of the speed: none; "filtered", the difference of the encoder at the fine rate through a causal filter;
            "observed", exact but late; "scaled", the difference of the rows times a number.
        speed_cutoff: Of the filter of the first order [Hz].
        speed_late: Of the observer [s].
        speed_scale: Of the scaled difference.
        torque_late: Pure delay [s].
        torque_cutoff: Of a causal filter of the first order [Hz]; 0 for none.
        torque_noise, torque_step, ripple, drift: Standard deviation of white noise, quantum, amplitude of a ripple, and standard
            deviation of a random walk after 1 s, as shares of the joint's usual torque.
        ripple_cycles: Of the ripple, per turn of the joint.
        jitter: Longest time by which a row is stamped late [s].
        dropped: Share of rows that are lost.
        batch: Rows that arrive, and are stamped, together.
        fault: Of the logger, a name of `faults.FAULTS`; none unless given. Then no speeds are written down.
        held: Time for which a controller holds a torque, which is written down when it begins [s]; only told, the plant does it.
    """

    rate: float = 200.0
    bits: int = 24
    position_noise: float = 0.0
    speed: Literal["none", "filtered", "observed", "scaled"] = "none"
    speed_cutoff: float = 40.0
    speed_late: float = 0.0
    speed_scale: float = 1.0
    torque_late: float = 0.0
    torque_cutoff: float = 0.0
    torque_noise: float = 0.0
    torque_step: float = 0.0
    ripple: float = 0.0
    ripple_cycles: float = 0.0
    drift: float = 0.0
    jitter: float = 0.0
    dropped: float = 0.0
    batch: int = 1
    held: float = 0.0
    fault: str = ""

    @property
    def torque_lag(self) -> float:
        """Time by which slow changes of torque are late against positions [s]; below 0 where a held torque is written down early."""
        return self.torque_late + (1 / (2 * np.pi * self.torque_cutoff) if self.torque_cutoff else 0.0) - self.held / 2

    @property
    def speed_lag(self) -> float | None:
        """Time by which the column of the speed is late [s]; None without one."""
        lags = {
            "none": None,
            "filtered": 1 / (2 * np.pi * self.speed_cutoff) + 0.5 / FINE,
            "observed": self.speed_late,
            "scaled": 0.5 / self.rate,
        }
        return lags[self.speed]


class Rows(NamedTuple):
    """What is written down: stamps t (K,), q, tau and, where there is a column, dq (n, K); `at` (K,) is when it was true [s]."""

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray | None
    tau: np.ndarray
    at: np.ndarray


def measure(
    chain: Chain, t: np.ndarray, signals: tuple[np.ndarray, np.ndarray, np.ndarray], usual: np.ndarray, rng: np.random.Generator
) -> Rows:
    """The rows of a recording.

    Args:
        t: Times of the exact signals (F,), at the fine rate [s].
        signals: Positions [rad], speeds [rad/s] and torques [Nm], (n, F) each.
        usual: Usual size of each joint's torque (n,) [Nm].
    """
    q, v, tau = signals
    seen = rounded(q + chain.position_noise * rng.standard_normal(q.shape), 2 * np.pi / 2**chain.bits)
    at = np.arange(t[0], t[-1], 1 / chain.rate)
    at = at[rng.random(at.size) >= chain.dropped]
    stamps = at + chain.jitter * rng.random(at.size)
    if chain.batch > 1:
        stamps = at[np.minimum((np.arange(at.size) // chain.batch + 1) * chain.batch, at.size) - 1]
        stamps = stamps + 1e-6 * np.arange(at.size)
    rows = held(t, seen, at)
    dq = {
        "none": lambda: None,
        "filtered": lambda: held(t, low_pass(np.diff(seen, prepend=seen[:, :1]) * FINE, chain.speed_cutoff), at),
        "observed": lambda: held(t, late(t, v, chain.speed_late), at),
        "scaled": lambda: chain.speed_scale * np.diff(rows, prepend=rows[:, :1]) / np.diff(at, prepend=at[0] - 1 / chain.rate),
    }[chain.speed]()
    size = usual[:, None]
    torque = tau + chain.ripple * size * np.sin(chain.ripple_cycles * q + np.arange(len(q))[:, None])
    torque = late(t, low_pass(torque, chain.torque_cutoff) if chain.torque_cutoff else torque, chain.torque_late)
    torque = held(t, torque, at) + chain.torque_noise * size * rng.standard_normal((len(q), at.size))
    walk = np.cumsum(rng.standard_normal((len(q), at.size)), axis=1) / np.sqrt(chain.rate)
    torque = torque + chain.drift * size * walk
    torque = rounded(torque, chain.torque_step * size) if chain.torque_step else torque
    for fault in FAULTS:
        if fault.__name__ == chain.fault:
            rows, torque = fault(at, rows, torque, rng)
            dq = None
    return Rows(stamps, rows, dq, torque, at)


def held(t: np.ndarray, x: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The last value at some times of signals (n, F) that are held over every fine step."""
    return x[:, np.clip(np.floor((at - t[0]) * FINE + 1e-6).astype(int), 0, t.size - 1)]


def late(t: np.ndarray, x: np.ndarray, delay: float) -> np.ndarray:
    """Signals (n, F) after a pure delay [s]."""
    return np.array([np.interp(t - delay, t, row) for row in x]) if delay else x


def low_pass(x: np.ndarray, cutoff: float) -> np.ndarray:
    """Signals (n, F) after a causal filter of the first order [Hz]."""
    c = 1 - np.exp(-2 * np.pi * cutoff / FINE)
    return lfilter([c], [1, c - 1], x, zi=(1 - c) * x[:, :1])[0]


def rounded(x: np.ndarray, step: float | np.ndarray) -> np.ndarray:
    """Multiples of a step."""
    return np.round(x / step) * step

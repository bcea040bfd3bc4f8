"""What loggers, sensors and programs that nobody documented make of rows that were measured well."""

from collections.abc import Callable

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import butter, sosfilt, sosfiltfilt

Fault = Callable[[np.ndarray, np.ndarray, np.ndarray, np.random.Generator], tuple[np.ndarray, np.ndarray]]


def repeated_positions(t, q, tau, rng):
    """Positions come at 40 to 80 Hz and are repeated until the next."""
    return q[:, _updates(t, rng.uniform(40, 80))], tau


def repeated_torques(t, q, tau, rng):
    """Torques do."""
    return q, tau[:, _updates(t, rng.uniform(40, 80))]


def cut_off(t, q, tau, rng):
    """Torques beyond 60 to 90 % of the largest are cut off."""
    limit = rng.uniform(0.6, 0.9) * np.max(np.abs(tau), axis=1, keepdims=True)
    return q, np.clip(tau, -limit, limit)


def dead_zone(t, q, tau, rng):
    """Small torques are 0."""
    return q, np.where(np.abs(tau) < rng.uniform(0.02, 0.08) * _size(tau), 0.0, tau)


def compressed(t, q, tau, rng):
    """The sensor is less sensitive to large torques."""
    limit = rng.uniform(2.5, 5) * _size(tau)
    return q, limit * np.tanh(tau / limit)


def crosstalk(t, q, tau, rng):
    """Each torque has some of the next joint's in it."""
    return q, tau + rng.uniform(0.005, 0.03) * np.roll(tau, 1, axis=0)


def two_clocks(t, q, tau, rng):
    """The torques' clock is slower: they are later from row to row, by 5 to 20 ms in all."""
    late = rng.uniform(0.005, 0.02) * (t - t[0]) / np.ptp(t)
    return q, np.array([np.interp(t - late, t, x) for x in tau])


def one_after_another(t, q, tau, rng):
    """Joints are asked one after the other."""
    return np.array([np.interp(t - 0.004 * j, t, x) for j, x in enumerate(q)]), tau


def smoothed(t, q, tau, rng):
    """Torques were smoothed at a desk, without a lag, at 4 to 10 Hz."""
    return q, sosfiltfilt(butter(2, rng.uniform(4, 10) * 2 * np.median(np.diff(t)), output="sos"), tau)


def filtered_positions(t, q, tau, rng):
    """Positions passed a causal filter of 8 to 20 Hz."""
    sections = butter(2, rng.uniform(8, 20) * 2 * np.median(np.diff(t)), output="sos")
    return np.asarray(sosfilt(sections, q - q[:, :1])) + q[:, :1], tau


def running_median(t, q, tau, rng):
    """Torques passed a running median over 0.1 s."""
    return q, median_filter(tau, (1, 2 * round(0.05 / np.median(np.diff(t))) + 1))


def mains(t, q, tau, rng):
    """Torques hum at 50 Hz."""
    return q, tau + rng.uniform(0.02, 0.08) * _size(tau) * np.sin(2 * np.pi * 50 * t)


def spikes(t, q, tau, rng):
    """Some positions are read wrongly."""
    wrong = rng.random(q.shape) < 0.002
    return q + wrong * rng.normal(0, 0.2, q.shape), tau


FAULTS: tuple[Fault, ...] = (
    repeated_positions, repeated_torques, cut_off, dead_zone, compressed, crosstalk, two_clocks, one_after_another, smoothed,
    filtered_positions, running_median, mains, spikes,
)  # fmt: skip


def _updates(t: np.ndarray, rate: float) -> np.ndarray:
    """Index (K,) of the row from which each row has its value."""
    number = np.floor((t - t[0]) * rate + 1e-9)
    return np.searchsorted(number, number, "left")


def _size(tau: np.ndarray) -> np.ndarray:
    return np.std(tau, axis=1, keepdims=True)

"""A mass that moves by itself between two ends, such as a link within the backlash of its gear."""

import numpy as np

import rrr_oc.numerics._stepping as extension

PARTS = 2  # integration steps per sample of a mass in the gap; twice as many halve the step and double the time


def across_gap(
    t: np.ndarray, load: np.ndarray, stiffness: np.ndarray, mass: np.ndarray, half: float, damping: float
) -> np.ndarray:
    """Position, speed and acceleration (3, K) of mass x'' + damping x' = −(load + stiffness x) between x = ±half.

    At an end, where it stays without a rebound, it rests as long as the load presses it there. It begins at rest at the end to which
    the first load presses it. Coefficients are constant over each step.

    Args:
        t: Times [s], strictly increasing, (K,), at least 2.
        load, stiffness: (K,).
        mass: Above 0, (K,).
        half: Half the gap, above 0.
        damping: The same at all times.
    """
    steps = np.append(np.diff(t), t[-1] - t[-2])
    arrays = [np.ascontiguousarray(x, float) for x in (load, stiffness, mass, steps)]
    result = np.empty((3, len(t)))
    extension.across_gap(len(t), *arrays, float(half), float(damping), PARTS, result)
    return result

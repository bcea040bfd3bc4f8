"""A state that relaxes: a differential equation of first order, affine in the state, along sampled signals."""

import numpy as np

import rrr_oc.numerics._stepping as extension


def relaxed(t: np.ndarray, constant: np.ndarray, slope: np.ndarray, start: float) -> np.ndarray:
    """x (K,) with x' = constant + slope x and x = `start` at first.

    Args:
        t: Times [s], strictly increasing, (K,).
        constant, slope: At the ends of equal substeps of the intervals between samples, (parts (K − 1) + 1,). Over each substep they
            are constant, the mean of the values at its ends.
    """
    result, arrays = np.empty(len(t)), [np.ascontiguousarray(x, float) for x in (t, constant, slope)]
    parts = max(1, (len(arrays[1]) - 1) // max(1, len(t) - 1))
    extension.relax(len(t), parts, *arrays, float(start), result)
    return result

"""A CasADi Function evaluated at many instants at once, on all cores."""

import os
from functools import lru_cache

import casadi as ca
import numpy as np

import rrr_oc.numerics._along as extension

WANTED = os.environ.get("OMP_NUM_THREADS", "")  # joblib sets it, too, so that processes share the cores
CORES = int(WANTED) if WANTED.isdigit() and int(WANTED) > 0 else os.cpu_count() or 1
SHARED = 1000  # fewest instants for one thread; doubled, short recordings are evaluated by fewer threads


def along(function: ca.Function, *arguments: np.ndarray) -> list[np.ndarray]:
    """Outputs of a Function of `casadi.SX` at K instants, each (rows, columns · K): the instants side by side.

    Args:
        arguments: (rows, columns · K) each, or (rows, columns) for an argument that is the same at all instants.

    Raises:
        ValueError: An argument has another size, or the Function is not made of `casadi.SX`.
    """
    arrays = [np.asarray(a, float) if np.ndim(a) > 1 else np.reshape(a, (len(a), 1)).astype(float) for a in arguments]
    counts = [a.shape[1] // max(function.size2_in(i), 1) for i, a in enumerate(arrays)]
    count = max(counts)
    given = [(a.reshape(-1, order="F"), c != count) for a, c in zip(arrays, counts, strict=True)]
    results = [np.empty((function.size1_out(i), function.size2_out(i) * count), order="F") for i in range(function.n_out())]
    threads = max(1, min(CORES, count // SHARED))
    extension.run(_program(function), given, [r.reshape(-1, order="F") for r in results], count, threads)
    return results


@lru_cache(maxsize=500)
def _program(function: ca.Function):
    return extension.program(function.serialize())

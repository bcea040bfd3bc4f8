"""Motions of the paper's task that are no optimum, for tests of what happens along a motion."""

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import SAVED, SampledMotion
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import load_task


def smooth_motion() -> tuple[CoDesign, SampledMotion, np.ndarray]:
    """Polynomials from start to release and back with springs of the paper's size; no optimum, but smooth and at rest at the ends."""
    task = load_task("paper")
    design = CoDesign(task, spring_bounds(task, "PEA"))
    theta = design.model.theta(
        {
            "parallel_spring[joint2]": {"stiffness": 8.0, "equilibrium": 2.0},
            "parallel_spring[joint3]": {"stiffness": 0.7, "equilibrium": 2.3},
        }
    )
    a, b = np.radians([[75.52], [-151.04]]), np.radians([[48.19], [-96.38]])
    parts = []
    for i, (one, two) in enumerate(((a, b), (b, a))):
        s, period = np.linspace(0, 1, 400), 2.0
        q = one + (two - one) * (10 * s**3 - 15 * s**4 + 6 * s**5)
        dq = (two - one) * (30 * s**2 - 60 * s**3 + 30 * s**4) / period
        ddq = (two - one) * (60 * s - 180 * s**2 + 120 * s**3) / period**2
        payload = task.payloads[i]
        tau, spring = (np.array(v) for v in design.torques(q, dq, ddq, payload, theta, design.model.widths))
        signals = (q, dq, ddq, tau, spring, np.full(400, i), np.full(400, payload), np.zeros((3, *q.shape)))
        parts.append((s * period + i * period, *signals))
    columns = [np.concatenate(c, axis=-1) for c in zip(*parts, strict=True)]
    return design, SampledMotion(**dict(zip(SAVED, columns, strict=True))), theta

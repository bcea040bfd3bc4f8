"""Searches of seconds, evolutionary and by gradients, that several tests run, and a motion that needs no search."""

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import SAVED, SampledMotion
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import Task, load_task
from rrr_oc.optimal_control.refinement import Refinement
from studies.paper.evolution import Protocol

TASK = load_task("paper")
SMALL = Protocol("analytic", generations=150, population=12, every=3)
TIMES = ("core_s", "wall_s")
LABELS = {"preset": "paper", "experiment": "BPEA", "ends": "rest", "way": "evolution", "model": "analytic"}
OPTIONS = SearchOptions(
    starts=6, coarse=8, fine=12, widths=(0.01,), refinement=Refinement(1e-3, rounds=2), within=0.02, motions=0
)


def numbers(found: dict) -> dict:
    """Everything but times, which differ from run to run."""
    return {k: v for k, v in found.items() if k not in TIMES}


def design_of(configuration: str, task: Task = TASK) -> CoDesign:
    return CoDesign(task, spring_bounds(task, configuration))


PEA = design_of("PEA")


def smooth_motion() -> tuple[CoDesign, SampledMotion, np.ndarray]:
    """Polynomials from start to release and back with springs of the paper's size; no optimum, but smooth and at rest at the ends."""
    theta = PEA.model.theta(
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
        payload = TASK.payloads[i]
        tau, spring = (np.array(v) for v in PEA.torques(q, dq, ddq, payload, theta, PEA.model.widths))
        signals = (q, dq, ddq, tau, spring, np.full(400, i), np.full(400, payload), np.zeros((3, *q.shape)))
        parts.append((s * period + i * period, *signals))
    columns = [np.concatenate(c, axis=-1) for c in zip(*parts, strict=True)]
    return PEA, SampledMotion(**dict(zip(SAVED, columns, strict=True))), theta

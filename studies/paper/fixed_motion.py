"""The best springs of a design for a given motion, as where the trajectory is fixed before springs are chosen."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.proposals import sobol_points
from rrr_oc.codesign.springs import drawn_bounds, from_drawn
from rrr_oc.codesign.task import PHASES
from rrr_oc.optimal_control.problem import PhaseGuess
from rrr_oc.optimal_control.solver import Options
from studies.paper.encoding import load_torque

SAMPLES = 400  # midpoints of the quadrature of a phase
WIDTHS = (0.3, 0.1, 0.03, 0.01, 0.003)  # smoothing widths of the springs [rad], one solve after the other


@dataclass(frozen=True)
class SpringsAlone:
    """The best springs for a motion: their parameters (p,) and E1 with exact springs [N²m²s], by the midpoint rule."""

    parameters: np.ndarray
    E1: float


def best_springs(design: CoDesign, phases: Sequence[PhaseGuess], starts: int = 8, seed: int = 0) -> SpringsAlone:
    """The best springs for the motion of `phases` that IPOPT finds from `starts` Sobol points."""
    motion, h = _sampled(design, phases)
    problem, n = design.problem, len(design.problem.parameters)
    if not n:
        return SpringsAlone(np.zeros(0), _exact(design, np.zeros(0), motion, h))
    theta, width = ca.MX.sym("theta", n), ca.MX.sym("width")
    cost = ca.MX(0)
    for i, payload in enumerate(design.task.payloads):
        q, dq, ddq = (ca.DM(x[:, i, :, 0]) for x in motion)
        widths = ca.repmat(width, design.model.widths.size, SAMPLES)
        tau = design.torques.map(SAMPLES)(
            q, dq, ddq, ca.repmat(ca.DM(payload), 1, SAMPLES), ca.repmat(theta, 1, SAMPLES), widths
        )[0]
        cost += h[i] * ca.sumsqr(tau)
    rows = ca.MX(0, 1) if problem.design is None else problem.design(theta, ca.DM(problem.data))
    nlp = {"x": theta, "p": width, "f": cost / problem.cost_scale, "g": rows}
    options: dict[str, Any] = {"ipopt": Options(iterations=200).ipopt(), "print_time": False, "expand": True}
    solver = ca.nlpsol("springs", "ipopt", nlp, options)
    lower, upper = drawn_bounds(design.springs)
    found = []
    for x in sobol_points(len(lower), starts, seed):
        at = from_drawn(design.springs, lower + (upper - lower) * x)
        for value in WIDTHS:
            at = solver(x0=at, p=value, lbx=problem.p_lower, ubx=problem.p_upper, lbg=-np.inf, ubg=0)["x"]
        at = np.clip(np.array(at).ravel(), problem.p_lower, problem.p_upper)
        found.append(SpringsAlone(at, _exact(design, at, motion, h)))
    return min(found, key=lambda s: s.E1)


def _sampled(design: CoDesign, phases: Sequence[PhaseGuess]) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """q, dq, ddq at the middles of equal steps, (m, phases, steps, 1) each, and the steps [s], (phases,)."""
    m, s = len(design.task.moving), (np.arange(SAMPLES) + 0.5) / SAMPLES
    x = np.stack([phase.states(s) for phase in phases], axis=1)
    ddq = np.stack([phase.controls(s) for phase in phases], axis=1)
    h = np.array([phase.duration for phase in phases]) / SAMPLES
    return (x[:m, :, :, None], x[m:, :, :, None], ddq[..., None]), h


def _exact(design: CoDesign, theta: np.ndarray, motion: tuple[np.ndarray, ...], h: np.ndarray) -> float:
    tau = load_torque(design, theta[:, None], *motion)
    return float(np.einsum("mpsk,p->", tau**2, h[: len(PHASES)]))

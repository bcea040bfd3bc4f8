"""The outcome of a co-design: the optimum's dense motion, its metrics, and its re-simulation in MuJoCo."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.task import PHASES
from rrr_oc.model.metrics import Metrics, measure
from rrr_oc.optimal_control.solver import Solution
from rrr_oc.simulation.engine_model import Form, Settings
from rrr_oc.simulation.tracking import ReferencePhase, Tracked, track


@dataclass(frozen=True, eq=False)
class Motion:
    """An optimum sampled densely, phase by phase; rows are the moving joints (m), time is the last axis (K).

    Attributes:
        t: Since the task's start [s]; the instant between the phases stands twice.
        q, dq, ddq: [rad], [rad/s], [rad/s²], (m, K).
        tau_load, tau_spring: [Nm], (m, K).
        phase: Index of the phase of each sample.
        payload: [kg].
    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau_load: np.ndarray
    tau_spring: np.ndarray
    phase: np.ndarray
    payload: np.ndarray

    def phases(self) -> list[np.ndarray]:
        """Indices of each phase's samples."""
        return [np.flatnonzero(self.phase == i) for i in range(len(PHASES))]

    def metrics(self) -> Metrics:
        """E1, RMS and peak of the load torque, by the trapezoid rule phase by phase."""
        return measure([(self.t[k], self.tau_load[:, k]) for k in self.phases()])


def sample_motion(design: CoDesign, solution: Solution, tolerance: float = 2e-5) -> Motion:
    """The optimum on so many points that the trapezoid rule gives its cost to a relative `tolerance`.

    (For costs other than load torque², the same density that 33 points an interval give.)
    """
    for points in (5, 9, 17, 33):
        motion = _sample(design, solution, points)
        if design.cost == "load" and abs(motion.metrics().E1_total - solution.cost) <= tolerance * solution.cost:
            break
    return motion


def _sample(design: CoDesign, solution: Solution, points: int) -> Motion:
    widths = solution.problem.data[1 : 1 + design.model.widths.size]
    m, start, parts = len(design.task.moving), 0.0, []
    for i, payload in enumerate(design.task.payloads):
        t, x, _, u = solution.sample(i, np.linspace(0, 1, points))
        keep = np.r_[np.flatnonzero(np.tile(np.arange(points) < points - 1, t.shape[0])), t.size - 1]
        q, dq, ddq = x[:m].reshape(m, -1)[:, keep], x[m:].reshape(m, -1)[:, keep], u.reshape(m, -1)[:, keep]
        tau, spring = (np.array(v) for v in design.torques(q, dq, ddq, payload, solution.parameters, widths))
        n = len(keep)
        parts.append((start + t.ravel()[keep], q, dq, ddq, tau, spring, np.full(n, i), np.full(n, payload)))
        start += solution.durations[i]
    return Motion(*[np.concatenate(column, axis=-1) for column in zip(*parts, strict=True)])


def resimulate(design: CoDesign, solution: Solution, motion: Motion, form: Form = "generated") -> Tracked:
    """Track the optimum in MuJoCo with its load torque as feed-forward and the paper's P-controllers, all joints simulated."""
    task, model = design.task, design.model
    theta, widths = solution.parameters, solution.problem.data[1 : 1 + model.widths.size]
    references = []
    for i, k in enumerate(motion.phases()):
        q, dq, ddq = (task.full(values[:, k]) for values in (motion.q, motion.dq, motion.ddq))
        payload = task.payloads[i]
        tau = np.array(model.inverse(q, dq, ddq, payload, theta, widths)[0])
        t = motion.t[k] - motion.t[k[0]]
        references.append(ReferencePhase(PHASES[i], t, q, dq, ddq, payload, tau))
    return track(model, references, theta, settings=Settings(effects=form), widths=widths)


def describe(design: CoDesign, metrics: Metrics, rows: tuple[int, ...] | None = None) -> dict[str, Any]:
    """E1 in total and by joint, RMS and peak load torque, as plain data; `rows` are the moving joints' rows in the metrics."""
    rows = tuple(range(len(design.task.moving))) if rows is None else rows
    by_joint = {
        key: {j: float(values[row]) for j, row in zip(design.task.joints, rows, strict=True)}
        for key, values in (("E1_joint", metrics.E1), ("rms", metrics.rms), ("peak", metrics.peak))
    }
    return {"E1": sum(by_joint["E1_joint"].values()), **by_joint}


def describe_simulation(design: CoDesign, solution: Solution, motion: Motion) -> dict[str, Any]:
    """The paper's simulation metrics from the engine's load torque, for the smoothed law (generated C) and the exact one."""
    described = {}
    for form in ("generated", "native"):
        tracked = resimulate(design, solution, motion, form)
        here = describe(design, tracked.metrics, design.task.moving)
        here["E1_relative_error"] = here["E1"] / solution.cost - 1 if design.cost == "load" else None
        here["energy_residual"] = float(tracked.energy_residual)
        here["tracking_error_rad"] = float(max(np.abs(p.error).max() for p in tracked.phases))
        described[form] = here
    return {**described["generated"], "exact_springs": described["native"]}

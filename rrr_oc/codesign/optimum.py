"""The outcome of a co-design: the optimum's dense motion, its metrics, and its re-simulation in MuJoCo."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.task import PHASES, Task
from rrr_oc.model.metrics import Metrics, measure
from rrr_oc.model.motion import Motion
from rrr_oc.optimal_control.solver import Solution
from rrr_oc.simulation.engine_model import Form, Settings
from rrr_oc.simulation.tracking import Reference, Tracked, track

SAVED = ("t", "q", "dq", "ddq", "tau_load", "tau_spring", "phase", "payload")  # arrays of a saved design's motion


@dataclass(frozen=True, eq=False, kw_only=True)
class SampledMotion(Motion):
    """A task's motion sampled densely; rows are the moving joints (m), time is the last axis (K).

    Times are counted from the task's start; the instant between two phases stands twice.

    Attributes:
        tau_load, tau_spring: [Nm], (m, K).
        phase: Index of the phase of each sample, not decreasing, (K,); the phases are the segments.
    """

    tau_load: np.ndarray
    tau_spring: np.ndarray
    phase: np.ndarray

    def __post_init__(self) -> None:
        ends = np.searchsorted(self.phase, np.arange(len(PHASES) + 1)).tolist()
        object.__setattr__(self, "segments", tuple(slice(a, b) for a, b in pairwise(ends)))

    def phases(self) -> list[np.ndarray]:
        """Indices of each phase's samples."""
        return [np.arange(s.start, s.stop) for s in self.segments]

    def metrics(self) -> Metrics:
        """E1, RMS and peak of the load torque, by the trapezoid rule phase by phase."""
        return measure([(self.t[k], self.tau_load[:, k]) for k in self.phases()])

    def by_phase(self, task: Task) -> list[Motion]:
        """The motion of all joints (n, K) in each phase, from time 0, with the task's payloads."""
        whole = [task.full(values) for values in (self.q, self.dq, self.ddq)]
        return [
            Motion(self.t[k] - self.t[k[0]], *(x[:, k] for x in whole), payload=np.full(len(k), payload))
            for k, payload in zip(self.phases(), task.payloads, strict=True)
        ]

    def references(self, task: Task, torque: Callable[[Motion], np.ndarray]) -> list[Reference]:
        """The phases to be followed, with the torque (n, K) [Nm] that is fed forward along each."""
        return [
            Reference(p.t, p.q, p.dq, p.ddq, p.payload, name=name, feed_forward=torque(p))
            for name, p in zip(PHASES, self.by_phase(task), strict=True)
        ]

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """What a saved design holds of its motion, by name; `SampledMotion(**arrays)` is the motion again."""
        return {name: getattr(self, name) for name in SAVED}


def sample_motion(design: CoDesign, solution: Solution, tolerance: float = 2e-5) -> SampledMotion:
    """The optimum on so many points that the trapezoid rule gives its cost to a relative `tolerance`.

    (For costs other than load torque², the same density that 33 points an interval give.)
    """
    for points in (5, 9, 17, 33):
        motion = _sample(design, solution, points)
        if design.cost == "load" and abs(motion.metrics().E1_total - solution.cost) <= tolerance * solution.cost:
            break
    return motion


def _sample(design: CoDesign, solution: Solution, points: int) -> SampledMotion:
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
    columns = [np.concatenate(column, axis=-1) for column in zip(*parts, strict=True)]
    return SampledMotion(**dict(zip(SAVED, columns, strict=True)))


def resimulate(design: CoDesign, solution: Solution, motion: SampledMotion, form: Form = "generated") -> Tracked:
    """Track the optimum in MuJoCo with its load torque as feed-forward and the paper's P-controllers, all joints simulated."""
    model = design.model
    theta, widths = solution.parameters, solution.problem.data[1 : 1 + model.widths.size]

    def load(phase: Motion) -> np.ndarray:
        return np.array(model.inverse(phase.q, phase.dq, phase.ddq, phase.payload[0], theta, widths)[0])

    return track(model, motion.references(design.task, load), theta, settings=Settings(effects=form), widths=widths)


def describe(design: CoDesign, metrics: Metrics, rows: tuple[int, ...] | None = None) -> dict[str, Any]:
    """E1 in total and by joint, RMS and peak load torque, as plain data; `rows` are the moving joints' rows in the metrics."""
    rows = tuple(range(len(design.task.moving))) if rows is None else rows
    by_joint = {
        key: {j: float(values[row]) for j, row in zip(design.task.joints, rows, strict=True)}
        for key, values in (("E1_joint", metrics.E1), ("rms", metrics.rms), ("peak", metrics.peak))
    }
    return {"E1": sum(by_joint["E1_joint"].values()), **by_joint}


def describe_simulation(design: CoDesign, solution: Solution, motion: SampledMotion) -> dict[str, Any]:
    """The paper's simulation metrics from the engine's load torque, for the smoothed law (generated C) and the exact one."""
    described = {}
    for form in ("generated", "native"):
        tracked = resimulate(design, solution, motion, form)
        here = describe(design, tracked.metrics, design.task.moving)
        here["E1_relative_error"] = here["E1"] / solution.cost - 1 if design.cost == "load" else None
        here["energy_residual"] = float(tracked.energy_residual)
        here["tracking_error_rad"] = tracked.tracking_error
        described[form] = here
    return {**described["generated"], "exact_springs": described["native"]}

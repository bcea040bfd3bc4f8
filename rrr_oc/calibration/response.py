"""Calibration on the simulated response: the engine follows the recorded motion, and its torque is compared with the recorded one.

The objective is the paper's: NRMSE of the torque, both smoothed by Savitzky–Golay and less 0.1 s at the ends, summed over joints
and recordings. With the actuators' coefficients it is that of the load torque, to which Eq. 10 turns simulated and recorded
motor torque alike; without them, of the motor torque. Two ways minimise it: the paper's CMA-ES, and Gauss–Newton from the
optimum on inverse dynamics. Inertial parameters are those of the inverse dynamics.

The controllers are helped by what each candidate itself predicts for the recorded motion, fed forward. Alone, P-controllers would
lag behind a reference that is the measured motion and so lags already; the parameters would make up for that (one joint, noise of
2 %: dry friction came out as 0.86 Nm instead of 2).
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cma
import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate
from rrr_oc.calibration.covariance import box_step, condition, covariance, intervals, normal_equations, undetermined
from rrr_oc.calibration.friction_width import with_widths
from rrr_oc.calibration.inverse_dynamics import (
    bounds,
    finished,
    fit_terms,
    identify,
    plain_model,
    with_estimates,
    with_parameter_values,
)
from rrr_oc.calibration.jacobian import derivatives
from rrr_oc.calibration.nrmse import DROPPED
from rrr_oc.calibration.regression import Rows
from rrr_oc.calibration.samples import STRIDE, Prepared, prepare
from rrr_oc.errors import UserError
from rrr_oc.numerics.savitzky_golay import smooth
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.robot.drives import Actuators
from rrr_oc.simulation.engine_model import Controller, twin
from rrr_oc.simulation.replay import SETTINGS, accelerations, follow, tracking_controller

POPULATION, SIGMA = 64, 0.15  # the paper's; sigma in units of the search box
PATIENCE = 1e-5  # of the objective: a Gauss–Newton step that gains less is the last; of its first spread: so is such a spread of CMA-ES
FRACTIONS = (1.0, 0.5, 0.2)  # of a Gauss–Newton step, tried in one batch


@dataclass(frozen=True)
class Response:
    """Recordings to be followed, and the model whose terms' parameters are varied.

    Attributes:
        drives: Actuators of the joints whose load torque by Eq. 10 is compared; None for the motor torque of all joints.
        window: Of the smoothing [s].
        timestep: Of the engine [s]; at 2 ms the torque is within 0.1 % of its spread of that at 0.5 ms.
    """

    recordings: RecordingSet
    model: CalibratedModel
    drives: Actuators | None = None
    window: float = 0.15
    timestep: float = 2e-3

    @cached_property
    def box(self) -> np.ndarray:
        """Upper ends of the search (p,): where one parameter alone would use up the spread of its joint's torque."""
        sizes = []
        for term in self.model.terms:
            j = term.effect.joints[0]
            spread = [
                np.concatenate([getattr(r, k)[j] for r in self.recordings.recordings]).std() for k in ("tau", "dq", "ddq")
            ]
            torque = spread[0] * (abs(self.model.torque_constant[j] or 1.0) if self.recordings.torque == "current" else 1.0)
            by = {"dry_friction": 1.0, "viscous_friction": spread[1], "armature": spread[2]}
            if term.effect.name not in by:
                raise UserError(f"calibration on the simulated response knows {', '.join(by)}; not {term.effect.name}")
            sizes.append(torque / max(by[term.effect.name], 1e-6))
        return np.array(sizes)

    @property
    def joints(self) -> list[int]:
        """Which joints' torques are compared."""
        names = self.model.joints if self.drives is None else self.drives.joints
        return [self.model.robot.index(name) for name in names]

    def residuals(self, candidates: Sequence[np.ndarray]) -> list[np.ndarray]:
        """(simulated − recorded torque) / spread of the recorded, smoothed and cut, by recording (candidates, joints, K)."""
        return [target.residuals(self, candidates) for target in self._targets]

    def slopes(self) -> list[np.ndarray]:
        """d residual / d parameters by recording (joints, K, p): of the torque that is fed forward, exact and smoothed."""
        return [target.slopes(self.window) for target in self._targets]

    def objective(self, residuals: Sequence[np.ndarray]) -> np.ndarray:
        """NRMSE summed over joints and recordings, by candidate; infinite where a simulation diverged."""
        with np.errstate(invalid="ignore"):
            total = sum(np.sqrt(np.mean(r**2, axis=2)).sum(axis=1) for r in residuals)
        return np.where(np.isfinite(total), total, np.inf)

    def compared(self, dq: np.ndarray, ddq: np.ndarray, motor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The torque that is compared (joints, K) [Nm] and its derivative by the motor torque, from what all joints (n, K) do."""
        j = self.joints
        if self.drives is None:
            return motor[j], np.ones_like(motor[j])
        load, slope = self.drives.load_from_motor(dq[j], ddq[j], motor[j])
        return np.array(load), np.array(slope)

    @cached_property
    def control(self) -> Controller:
        """The controllers of the simulation."""
        return tracking_controller(self.model, self.recordings)

    @cached_property
    def _targets(self) -> list["_Target"]:
        return [_Target.make(self, r) for r in self.recordings.recordings]


@dataclass(frozen=True)
class _Target:
    """A recording with what does not depend on the candidates.

    Attributes:
        base: Motor torque at the recorded motion with all parameters 0, (n, K) [Nm].
        by_theta: Its derivatives by them, which enter linearly, (n, K, p).
        gain: Derivative of the compared torque by the motor torque (joints, K).
        recorded: The compared torque, smoothed and cut (joints, K').
        kept: Samples that are not cut off, (K,).
    """

    recording: Recording
    base: np.ndarray
    by_theta: np.ndarray
    gain: np.ndarray
    recorded: np.ndarray
    kept: np.ndarray
    joints: list[int]

    @classmethod
    def make(cls, response: Response, r: Recording) -> "_Target":
        by_theta = derivatives(response.model, r)
        theta = response.model.values
        base = response.model.torques(r)[0] - by_theta @ theta
        recorded, gain = response.compared(r.dq, r.ddq, response.recordings.output_torque(r))
        kept = (r.t >= r.t[0] + DROPPED) & (r.t <= r.t[-1] - DROPPED)
        recorded = smooth(r.t, recorded, r.segments, response.window)[:, kept]
        return cls(r, base, by_theta, gain, recorded, kept, response.joints)

    @property
    def spread(self) -> np.ndarray:
        """Standard deviation of the recorded torque (joints, 1) [Nm]."""
        return np.maximum(self.recorded.std(axis=1), 1e-9)[:, None]

    def residuals(self, response: Response, candidates: Sequence[np.ndarray]) -> np.ndarray:
        r, engines, settings = self.recording, [], replace(SETTINGS, timestep=response.timestep)
        for theta in candidates:
            physics = replace(response.model, terms=with_parameter_values(response.model.terms, theta)).physics(r)
            engines.append(twin(physics.built, physics.theta, response.control, settings, physics.widths))
        expected = np.array([self.base + self.by_theta @ theta for theta in candidates])
        _, dq, motor = follow(engines, r, response.control, expected, expected, response.timestep)
        shape = (len(candidates), len(self.joints), r.t.size)
        if response.drives is None:
            torque = motor[:, self.joints]
        else:
            ddq = accelerations(r, dq)
            torque = np.array([response.compared(*x)[0] for x in zip(dq, ddq, motor, strict=True)])
        flat = smooth(r.t, torque.reshape(-1, r.t.size), r.segments, response.window).reshape(shape)
        return (flat[:, :, self.kept] - self.recorded) / self.spread

    def slopes(self, window: float) -> np.ndarray:
        r, found = self.recording, self.by_theta[self.joints] * self.gain[:, :, None]
        flat = np.moveaxis(found, 2, 1).reshape(-1, r.t.size)
        used = np.flatnonzero(np.any(flat != 0, axis=1))
        flat[used] = smooth(r.t, flat[used], r.segments, window)
        cut = flat.reshape(found.shape[0], found.shape[2], -1)[:, :, self.kept]
        return np.moveaxis(cut / self.spread[:, :, None], 1, 2)


def calibrate_evolution(
    recordings: RecordingSet,
    drives: Actuators | None = None,
    generations: int = 200,
    seed: int = 0,
    population: int = POPULATION,
    timestep: float = Response.timestep,
) -> CalibratedModel:
    """The paper's way: CMA-ES over the box [0, `Response.box`], from its middle.

    The report's `history` lists the time since the start [s] and the best objective of every generation. Raises `UserError` for
    load torques, which hold nothing that could be calibrated.
    """
    began, response = time.perf_counter(), _response(recordings, drives, timestep)
    options = {
        "bounds": [0, 1],
        "popsize": population,
        "seed": seed + 1,
        "verbose": -9,
        "maxiter": generations,
        "tolfunrel": PATIENCE,
    }
    theta = response.model.values
    varied = np.flatnonzero([t.effect.joints[0] in response.joints for t in response.model.terms for _ in t.estimates])

    def candidate(x: np.ndarray) -> np.ndarray:
        at = theta.copy()  # of joints that are not compared: as inverse dynamics left them
        at[varied] = response.box[varied] * x
        return at

    search: Any = cma.CMAEvolutionStrategy(np.full(len(varied), 0.5), SIGMA, options)
    history: list[tuple[float, float]] = []
    while not search.stop():
        asked = search.ask()
        costs = response.objective(response.residuals([candidate(x) for x in asked]))
        search.tell(asked, costs.tolist())
        history.append((time.perf_counter() - began, float(search.best.f)))
    report = {
        "way": "CMA-ES on the simulated response",
        "population": population,
        "sigma": SIGMA,
        "seed": seed,
        "evaluations": int(search.countevals),
        "history": history,
    }
    return _finished(response, candidate(np.asarray(search.best.x)), report, began)


def calibrate_response(
    recordings: RecordingSet, drives: Actuators | None = None, steps: int = 10, timestep: float = Response.timestep
) -> CalibratedModel:
    """Gauss–Newton on the simulated response, from the optimum on inverse dynamics.

    A sum of norms is minimised as a sum of squares weighted by one over the norms, step after step. The derivatives are those of
    the torque that is fed forward, exact; all fractions of a step are simulated in one batch. Report and errors are as those of
    `calibrate_evolution`.
    """
    began, response = time.perf_counter(), _response(recordings, drives, timestep)
    theta = response.model.values
    lower, upper = bounds(response.model.terms)
    here = response.residuals([theta])
    cost, evaluations = float(response.objective(here)[0]), 1
    history, jacobian = [(time.perf_counter() - began, cost)], response.slopes()
    for _ in range(steps):
        tried = [np.clip(theta + f * _step(here, jacobian, theta, lower, upper), lower, upper) for f in FRACTIONS]
        there = response.residuals(tried)
        costs = response.objective(there)
        evaluations += len(tried)
        best = int(np.argmin(costs))
        if not costs[best] < cost:
            break
        gained, cost, theta, here = cost - costs[best], float(costs[best]), tried[best], [r[best : best + 1] for r in there]
        history.append((time.perf_counter() - began, cost))
        if gained < PATIENCE * cost:
            break
    report = {"way": "Gauss–Newton on the simulated response", "evaluations": evaluations, "history": history}
    return _finished(response, theta, report, began)


def _response(recordings: RecordingSet, drives: Actuators | None, timestep: float) -> Response:
    if recordings.torque == "load":
        raise UserError(
            f"{recordings.path}: load torques hold no friction and no armature; only inverse dynamics calibrates on them"
        )
    prepared, start = prepare(recordings), plain_model(recordings)
    fit = identify if recordings.inertial == "identify" else fit_terms
    start = with_widths(prepared, start)
    return Response(recordings, fit(recordings, prepared, start).model, drives, timestep=timestep)


def _step(here: list[np.ndarray], jacobian: list[np.ndarray], theta, lower, upper) -> np.ndarray:
    matrix, right = np.zeros((len(theta), len(theta))), np.zeros(len(theta))
    for r, slopes in zip(here, jacobian, strict=True):
        for joint, derivative in zip(r[0], slopes, strict=True):
            weight = 1 / (len(joint) * max(float(np.sqrt(np.mean(joint**2))), 1e-9))
            matrix += weight * derivative.T @ derivative
            right -= weight * derivative.T @ joint
    return box_step(matrix, right, lower - theta, upper - theta)


def _finished(response: Response, theta: np.ndarray, report: dict[str, Any], began: float) -> CalibratedModel:
    """The model with estimates, their intervals from the response's own derivatives, and a report."""
    recordings, terms = response.recordings, response.model.terms
    here = response.residuals([theta])
    found = _rows(recordings, here, response.slopes())
    weights = found.deviation() ** -2
    matrix, _ = normal_equations(found, weights)
    (lower, upper), known = bounds(terms), ~undetermined(matrix)
    bread = np.zeros_like(matrix)
    bread[np.ix_(known, known)] = np.linalg.inv(matrix[np.ix_(known, known)])
    spread = covariance(found, weights, bread, bread)
    between = intervals(theta, spread.half_width, lower, upper)
    estimates = [
        Estimate(float(v), float(s), i, bool(v <= low or v >= high)) if k else Estimate(float(v))
        for v, s, i, low, high, k in zip(theta, spread.std, between, lower, upper, known, strict=True)
    ]
    model = replace(response.model, terms=with_estimates(terms, estimates))
    value = condition(matrix)
    report = report | {
        "objective": float(response.objective(here)[0]),
        "objective_of": "motor torque" if response.drives is None else "load torque by Eq. 10",
        "objective_window_s": response.window,
        "condition": value if np.isfinite(value) else None,
        "correlation": {"matrix": spread.correlation.tolist()},
        "wall_s": time.perf_counter() - began,
    }
    prepared: Sequence[Prepared] = prepare(recordings)
    return finished(recordings, prepared, model, report)


def _rows(recordings: RecordingSet, here: list[np.ndarray], jacobian: list[np.ndarray]) -> Rows:
    """Residuals as rows, one stretch per recording."""
    residual, slopes, stretches, durations, start = [], [], [], [], 0
    for r, e, j in zip(recordings.recordings, here, jacobian, strict=True):
        stride = max(1, round(STRIDE / float(np.median(np.diff(r.t)))))
        residual.append(-e[0][:, ::stride])
        slopes.append(j[:, ::stride])
        stretches.append(slice(start, start + residual[-1].shape[1]))
        durations.append(float(r.t[-1] - r.t[0] - 2 * DROPPED))
        start = stretches[-1].stop
    every = np.concatenate(residual, axis=1)
    return Rows(every, np.concatenate(slopes, axis=1), np.ones(every.shape, bool), tuple(stretches), tuple(durations))

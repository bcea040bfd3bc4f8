"""Calibration on the simulated response: the paper's CMA-ES, and Gauss–Newton from the optimum on inverse dynamics.

The engine follows the recorded motion, and its torque is compared with the recorded one. The objective is the paper's: NRMSE of
the torque, both smoothed by Savitzky–Golay and without 0.1 s at the ends, summed over joints and recordings. With the actuators'
coefficients it is that of the load torque by Eq. 10, from simulated and recorded motor torque alike; without them, that of the
motor torque. Inertial parameters are those of the inverse dynamics.

The torque that each candidate predicts for the recorded motion is fed forward. P-controllers alone would lag behind a reference
that is the measured motion, which lags already, and the parameters would make up for that (one joint, noise of 2 %: dry friction
of 2 Nm was estimated as 0.86).
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Any, NamedTuple

import cma
import numpy as np
from scipy.optimize import lsq_linear

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.estimator.data import EVERY, low_frequency
from rrr_oc.calibration.estimator.intervals import half_width, with_intervals
from rrr_oc.calibration.inverse_dynamics import finished
from rrr_oc.calibration.jacobian import Prediction
from rrr_oc.calibration.parameter_vector import bounds, with_parameter_values
from rrr_oc.calibration.prediction_error import DROPPED, recorded_controller
from rrr_oc.calibration.samples import STRIDE, prepare
from rrr_oc.effects import Signals, plain_effects
from rrr_oc.errors import UserError
from rrr_oc.numerics.rank import condition, undetermined
from rrr_oc.numerics.savitzky_golay import WINDOW, smooth
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.robot.drives import Actuators
from rrr_oc.simulation.engine_model import Controller, twin
from rrr_oc.simulation.replay import SETTINGS, accelerations, as_recorded, follow
from rrr_oc.storage import number

POPULATION, SIGMA = 64, 0.15  # the paper's; sigma in units of the search box
PATIENCE = 1e-5  # of the objective: a smaller gain ends Gauss–Newton, a smaller spread CMA-ES; doubled, no change
STEPS, SHARES = 10, (1.0, 0.5, 0.2)  # most steps of Gauss–Newton, and the shares of one that are simulated in a batch


@dataclass(frozen=True)
class Response:
    """Recordings to be followed, and the model whose terms' parameters are varied.

    Attributes:
        drives: Actuators of the joints whose load torque by Eq. 10 is compared; None for the motor torque of all joints.
        timestep: Of the engine [s]; at 2 ms the torque is within 0.1 % of its spread of that at 0.5 ms.
    """

    recordings: RecordingSet
    model: CalibratedModel
    drives: Actuators | None = None
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
            if term.effect.role != "plain":
                known = ", ".join(kind.name for kind in plain_effects())
                raise UserError(f"calibration on the simulated response knows {known}; not {term.effect.name}")
            one = np.ones(self.model.robot.n)
            at = Signals(0 * one, max(spread[1], 1e-6) * one, max(spread[2], 1e-6) * one)
            for p in term.effect.parameters:  # its torque per unit of each parameter, as of a joint with these deviations
                alone = {other.name: float(other is p) for other in term.effect.parameters}
                sizes.append(torque / max(abs(float(term.effect.torque(at, alone, 0.0)[0])), 1e-6))
        return np.array(sizes)

    @property
    def joints(self) -> list[int]:
        """Which joints' torques are compared."""
        names = self.model.joints if self.drives is None else self.drives.joints
        return [self.model.robot.index(name) for name in names]

    def residuals(self, candidates: Sequence[np.ndarray]) -> list[np.ndarray]:
        """(simulated − recorded torque) / spread of the recorded, smoothed and cut, by recording (candidates, joints, K)."""
        return [self._residuals(target, candidates) for target in self._targets]

    def slopes(self) -> list[np.ndarray]:
        """d residual / d parameters by recording (joints, K, p): of the torque that is fed forward, exact and smoothed."""
        return [target.slopes for target in self._targets]

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
        return recorded_controller(self.model, self.recordings)

    @cached_property
    def _targets(self) -> list["_Target"]:
        return [self._target(r) for r in self.recordings.recordings]

    def _target(self, r: Recording) -> "_Target":
        by_theta = Prediction(self.model, r).by_parameters()
        recorded, gain = self.compared(r.dq, r.ddq, self.recordings.output_torque(r))
        kept = (r.t >= r.t[0] + DROPPED) & (r.t <= r.t[-1] - DROPPED)
        recorded = smooth(r.t, recorded, r.segments)[:, kept]
        spread = np.maximum(recorded.std(axis=1), 1e-9)[:, None]
        slopes = np.moveaxis(by_theta[self.joints] * gain[:, :, None], 2, 1)
        used = np.any(slopes != 0, axis=2)
        slopes[used] = smooth(r.t, slopes[used], r.segments)
        slopes = np.moveaxis(slopes[:, :, kept] / spread[:, :, None], 1, 2)
        base = self.model.torques(r)[0] - by_theta @ self.model.values
        return _Target(r, base, by_theta, recorded, spread, kept, slopes)

    def _residuals(self, target: "_Target", candidates: Sequence[np.ndarray]) -> np.ndarray:
        r, engines, settings = target.recording, [], replace(SETTINGS, timestep=self.timestep)
        for theta in candidates:
            physics = replace(self.model, terms=with_parameter_values(self.model.terms, theta)).physics(r).arm
            engines.append(twin(physics.built, physics.theta, self.control, settings, physics.widths))
        expected = np.array([target.base + target.by_theta @ theta for theta in candidates])
        _, dq, motor = follow(engines, r, expected, as_recorded(self.control, self.timestep))
        ddq = dq if self.drives is None else accelerations(r, dq)
        torque = np.array([self.compared(*x)[0] for x in zip(dq, ddq, motor, strict=True)])
        flat = smooth(r.t, torque.reshape(-1, r.t.size), r.segments).reshape(torque.shape)
        return (flat[:, :, target.kept] - target.recorded) / target.spread


class _Target(NamedTuple):
    """A recording with what does not depend on the candidates.

    Attributes:
        base: Motor torque at the recorded motion with all parameters 0, (n, K) [Nm].
        by_theta: Its derivatives by them, which enter linearly, (n, K, p).
        recorded: The compared torque, smoothed and cut (joints, K').
        spread: Its standard deviation (joints, 1) [Nm].
        kept: Samples that are not cut off, (K,).
        slopes: As `Response.slopes` has them, (joints, K', p).
    """

    recording: Recording
    base: np.ndarray
    by_theta: np.ndarray
    recorded: np.ndarray
    spread: np.ndarray
    kept: np.ndarray
    slopes: np.ndarray


def calibrate_evolution(
    recordings: RecordingSet,
    drives: Actuators | None = None,
    generations: int = 200,
    seed: int = 0,
    population: int = POPULATION,
    timestep: float = Response.timestep,
) -> CalibratedModel:
    """The paper's method: CMA-ES over the box [0, `Response.box`], from its middle.

    The report's `history` lists the time since the start [s] and the best objective of every generation. Raises `UserError` for
    load torques, which hold nothing that could be calibrated.
    """
    began, response = time.perf_counter(), _response(recordings, drives, timestep)
    options = {"bounds": [0, 1], "popsize": population, "seed": seed + 1, "maxiter": generations}
    options |= {"verbose": -9, "tolfunrel": PATIENCE}
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
    report = {"way": "CMA-ES on the simulated response", "population": population, "sigma": SIGMA, "seed": seed}
    report |= {"evaluations": int(search.countevals), "history": history}
    return _finished(response, candidate(np.asarray(search.best.x)), report, began)


def calibrate_response(
    recordings: RecordingSet, drives: Actuators | None = None, steps: int = STEPS, timestep: float = Response.timestep
) -> CalibratedModel:
    """Gauss–Newton on the simulated response, from the optimum on inverse dynamics; report and errors as `calibrate_evolution`.

    The objective, a sum of norms, is a sum of squares weighted by one over the norms at the point. Derivatives are exact ones of
    the torque that is fed forward. All fractions of a step are simulated in one batch, and the best is kept.
    """
    began, response = time.perf_counter(), _response(recordings, drives, timestep)
    slopes, (lower, upper) = response.slopes(), bounds(response.model.terms)
    history: list[tuple[float, float]] = []
    evaluations = 0

    def simulated(candidates: Sequence[np.ndarray]) -> _Point:
        """The best of some candidates."""
        nonlocal evaluations
        evaluations += len(candidates)
        residuals = response.residuals(candidates)
        costs = response.objective(residuals)
        best = int(np.argmin(costs))
        return _Point(candidates[best], [r[best] for r in residuals], float(costs[best]))

    at = simulated([response.model.values])
    history.append((time.perf_counter() - began, at.cost))
    for _ in range(steps):
        step = _step(at, slopes, lower - at.theta, upper - at.theta)
        there = simulated([np.clip(at.theta + share * step, lower, upper) for share in SHARES])
        if there.cost > at.cost:
            break
        gained, at = at.cost - there.cost, there
        history.append((time.perf_counter() - began, at.cost))
        if gained < PATIENCE * at.cost:
            break
    report = {"way": "Gauss–Newton on the simulated response", "evaluations": evaluations, "history": history}
    return _finished(response, at.theta, report, began)


def _step(at: "_Point", slopes: Sequence[np.ndarray], lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The step of Gauss and Newton within bounds (p,), for norms as squares weighted by one over the norms."""
    rows, target, free = [], [], lower < upper
    for residual, slope in zip(chain(*at.residuals), chain(*slopes), strict=True):
        weight = (len(residual) * max(float(np.sqrt(np.mean(residual**2))), 1e-9)) ** -0.5
        rows.append(weight * slope)
        target.append(-weight * residual)
    matrix, step = np.concatenate(rows), np.zeros(len(lower))
    scale = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)[free]
    found = lsq_linear(
        matrix[:, free] / scale, np.concatenate(target), (lower[free] * scale, upper[free] * scale), method="bvls"
    )
    step[free] = found.x / scale
    return step


class _Point(NamedTuple):
    """Parameters (p,), residuals of the response there (joints, K) by recording, and the objective."""

    theta: np.ndarray
    residuals: list[np.ndarray]
    cost: float


def _response(recordings: RecordingSet, drives: Actuators | None, timestep: float) -> Response:
    if recordings.torque == "load":
        raise UserError(
            f"{recordings.path}: load torques hold no friction and no armature; only inverse dynamics calibrates on them"
        )
    model = calibrate(recordings)  # the engine's torques are compared as they are
    return Response(recordings, replace(model, terms=model.prompt_terms), drives, timestep=timestep)


def _finished(response: Response, theta: np.ndarray, report: dict[str, Any], began: float) -> CalibratedModel:
    """The model with estimates, their intervals from the response's own derivatives, and a report.

    Noise is that of `PlainFitter.closest`: white, as strong at frequency 0 as what the response leaves.
    """
    recordings, model = response.recordings, response.model
    model = replace(model, terms=with_parameter_values(model.terms, theta))
    here = response.residuals([theta])
    strides = [max(1, round(EVERY * STRIDE / float(np.median(np.diff(r.t))))) for r in recordings.recordings]
    left = np.concatenate([x[0][:, ::k] for x, k in zip(here, strides, strict=True)], axis=1)
    columns = np.concatenate([x[:, ::k] for x, k in zip(response.slopes(), strides, strict=True)], axis=1)
    place = np.concatenate([np.arange(x[0][:, ::k].shape[1]) for x, k in zip(here, strides, strict=True)])
    sigma = np.array([low_frequency(row, place, np.zeros(len(place), bool)) for row in left])
    matrix = np.einsum("jkp,jkq,j->pq", columns, columns, sigma**-2.0, optimize=True)
    known = ~undetermined(matrix)
    covariance = np.zeros_like(matrix)
    covariance[np.ix_(known, known)] = np.linalg.inv(matrix[np.ix_(known, known)])
    std = np.sqrt(np.diag(covariance))
    report = report | {
        "objective": float(response.objective(here)[0]),
        "objective_of": "motor torque" if response.drives is None else "load torque by Eq. 10",
        "objective_window_s": WINDOW,
        "condition": number(condition(matrix)),
        "correlation": {"matrix": (covariance / np.outer(*[np.where(known, std, 1.0)] * 2)).tolist()},
    }
    model = with_intervals(model, std, half_width(len(place)) * std, known)
    return finished(recordings, prepare(recordings), model, report, began)

"""Calibration on the simulated response: the paper's CMA-ES, and Gauss–Newton from the optimum on inverse dynamics.

Inertial parameters are those of the inverse dynamics.
"""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import cma
import numpy as np

from rrr_oc.calibration.calibrate import fit
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.covariance import covariance
from rrr_oc.calibration.friction_width import with_widths
from rrr_oc.calibration.inverse_dynamics import described, finished, plain_model
from rrr_oc.calibration.least_squares import GaussNewton, Problem, Quadratic, minimise, normal_equations
from rrr_oc.calibration.prediction_error import DROPPED
from rrr_oc.calibration.regression import Rows
from rrr_oc.calibration.response.simulated_response import Response
from rrr_oc.calibration.samples import STRIDE, prepare
from rrr_oc.calibration.term_fit import bounds, with_estimates, with_parameter_values
from rrr_oc.errors import UserError
from rrr_oc.numerics.rank import condition, undetermined
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.robot.drives import Actuators
from rrr_oc.storage import number

POPULATION, SIGMA = 64, 0.15  # the paper's; sigma in units of the search box
PATIENCE = (
    1e-5  # of the objective: Gauss–Newton ends at a smaller gain, CMA-ES at a smaller spread over the first; doubled, no change
)
OPTIONS = GaussNewton(steps=10, gain=PATIENCE, fractions=(1.0, 0.5, 0.2))


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


@dataclass(frozen=True)
class _Point:
    """Parameters (p,), residuals of the response there (1, joints, K) by recording, and the objective."""

    theta: np.ndarray
    residuals: list[np.ndarray]
    cost: float


@dataclass
class _ResponseFit(Problem[_Point]):
    """The objective, a sum of norms, as a sum of squares weighted by one over the norms at the point.

    Derivatives are those of the torque that is fed forward, exact. All fractions of a step are simulated in one batch, and the best
    is kept.

    Attributes:
        response: The response.
        began: As of `time.perf_counter`.
        history: Time since the start [s] and objective of every point accepted.
        evaluations: Number of simulations.
    """

    response: Response
    began: float
    history: list[tuple[float, float]] = field(default_factory=list)
    evaluations: int = 1

    def start(self, theta: np.ndarray) -> _Point:
        here = self.response.residuals([theta])
        return self._noted(_Point(theta, here, float(self.response.objective(here)[0])))

    def quadratic(self, at: _Point) -> Quadratic:
        size = len(at.theta)
        matrix, right = np.zeros((size, size)), np.zeros(size)
        for r, slopes in zip(at.residuals, self._slopes, strict=True):
            for joint, derivative in zip(r[0], slopes, strict=True):
                weight = 1 / (len(joint) * max(float(np.sqrt(np.mean(joint**2))), 1e-9))
                matrix += weight * derivative.T @ derivative
                right -= weight * derivative.T @ joint
        lower, upper = bounds(self.response.model.terms)
        return Quadratic(at.cost, matrix, right, lower - at.theta, upper - at.theta)

    def tried(self, at: _Point, steps: Sequence[np.ndarray]) -> Iterable[tuple[_Point, float]]:
        candidates = [np.clip(at.theta + step, *bounds(self.response.model.terms)) for step in steps]
        there = self.response.residuals(candidates)
        costs = self.response.objective(there)
        self.evaluations += len(candidates)
        best = int(np.argmin(costs))
        yield _Point(candidates[best], [r[best : best + 1] for r in there], float(costs[best])), float(costs[best])

    def accepted(self, before: _Point, there: _Point) -> _Point:
        return self._noted(there)

    def _noted(self, at: _Point) -> _Point:
        self.history.append((time.perf_counter() - self.began, at.cost))
        return at

    @cached_property
    def _slopes(self) -> list[np.ndarray]:
        return self.response.slopes()


def calibrate_response(
    recordings: RecordingSet, drives: Actuators | None = None, steps: int = OPTIONS.steps, timestep: float = Response.timestep
) -> CalibratedModel:
    """Gauss–Newton on the simulated response, from the optimum on inverse dynamics; report and errors as `calibrate_evolution`."""
    began, response = time.perf_counter(), _response(recordings, drives, timestep)
    problem = _ResponseFit(response, began)
    at = minimise(problem, problem.start(response.model.values), replace(OPTIONS, steps=steps))
    report = {"way": "Gauss–Newton on the simulated response", "evaluations": problem.evaluations, "history": problem.history}
    return _finished(response, at.theta, report, began)


def _response(recordings: RecordingSet, drives: Actuators | None, timestep: float) -> Response:
    if recordings.torque == "load":
        raise UserError(
            f"{recordings.path}: load torques hold no friction and no armature; only inverse dynamics calibrates on them"
        )
    prepared = prepare(recordings)
    start = with_widths(prepared, plain_model(recordings))
    return Response(recordings, fit(recordings, prepared, start).model, drives, timestep=timestep)


def _finished(response: Response, theta: np.ndarray, report: dict[str, Any], began: float) -> CalibratedModel:
    """The model with estimates, their intervals from the response's own derivatives, and a report."""
    recordings, terms = response.recordings, with_parameter_values(response.model.terms, theta)
    here = response.residuals([theta])
    found = _rows(recordings, here, response.slopes())
    weights = found.deviation() ** -2
    matrix, _ = normal_equations(found, weights)
    known = ~undetermined(matrix)
    bread = np.zeros_like(matrix)
    bread[np.ix_(known, known)] = np.linalg.inv(matrix[np.ix_(known, known)])
    spread = covariance(found, weights, bread, bread)
    model = replace(response.model, terms=terms)
    model = replace(model, terms=with_estimates(terms, described(model, theta, spread, known)))
    report = report | {
        "objective": float(response.objective(here)[0]),
        "objective_of": "motor torque" if response.drives is None else "load torque by Eq. 10",
        "objective_window_s": response.window,
        "condition": number(condition(matrix)),
        "correlation": {"matrix": spread.correlation.tolist()},
    }
    return finished(recordings, prepare(recordings), model, report, began)


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

"""Calibration on the simulated response: the engine follows the recorded motion, and its torque is compared with the recorded one.

The objective is the paper's: NRMSE of the torque, both smoothed by Savitzky–Golay and less 0.1 s at the ends, summed over joints
and recordings. Two ways minimise it: the paper's CMA-ES, and Gauss–Newton from the optimum on inverse dynamics. The controllers
work alone, as in the paper: nothing is fed forward. Inertial parameters are those of the inverse dynamics.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cma
import numpy as np

from rrr_oc.calibrate import bounds, finished, fit_terms, identify, plain_model
from rrr_oc.calibrated import CalibratedModel, Estimate, Term
from rrr_oc.errors import UserError
from rrr_oc.inference import condition, covariance, intervals, normal_equations, undetermined
from rrr_oc.nrmse import DROPPED
from rrr_oc.recordings import Recording, RecordingSet
from rrr_oc.regression import STRIDE, Prepared, Rows, prepare
from rrr_oc.replay import SETTINGS, follow, tracking_controller
from rrr_oc.savitzky_golay import smooth
from rrr_oc.simulate import Twin, twin

POPULATION, SIGMA = 64, 0.15  # the paper's; sigma in units of the search box
PATIENCE = 1e-5  # relative gain over ten generations, or of a Gauss–Newton step, that is not worth another
FRACTIONS = (1.0, 0.5, 0.25, 0.1, 0.03)  # of a Gauss–Newton step, tried in one batch
DIFFERENCE = 1e-2  # step of finite differences, as a part of the search box


@dataclass(frozen=True)
class Response:
    """Recordings to be followed, and the model whose terms' parameters are varied.

    Attributes:
        window: Of the smoothing [s].
    """

    recordings: RecordingSet
    model: CalibratedModel
    window: float = 0.15

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

    def residuals(self, candidates: Sequence[np.ndarray]) -> list[np.ndarray]:
        """(simulated − recorded torque) / spread of the recorded, smoothed and cut, by recording (candidates, n, K)."""
        return [self._one(r, candidates) for r in self.recordings.recordings]

    def objective(self, residuals: Sequence[np.ndarray]) -> np.ndarray:
        """NRMSE summed over joints and recordings, by candidate; infinite where a simulation diverged."""
        with np.errstate(invalid="ignore"):
            total = sum(np.sqrt(np.mean(r**2, axis=2)).sum(axis=1) for r in residuals)
        return np.where(np.isfinite(total), total, np.inf)

    def _one(self, r: Recording, candidates: Sequence[np.ndarray]) -> np.ndarray:
        engines, expected = [], []
        for theta in candidates:
            physics = replace(self.model, terms=with_values(self.model.terms, theta)).physics(r)
            engines.append(self._engine(physics))
            expected.append(physics.torques(r)[0])
        simulated = follow(engines, r, self._control, np.zeros((len(engines), *r.q.shape)), np.array(expected))[2]
        recorded, kept = self.recordings.output_torque(r), (r.t >= r.t[0] + DROPPED) & (r.t <= r.t[-1] - DROPPED)
        recorded = smooth(r.t, recorded, r.segments, self.window)[:, kept]
        spread = np.maximum(recorded.std(axis=1), 1e-9)[:, None]
        flat = smooth(r.t, simulated.reshape(-1, r.t.size), r.segments, self.window)
        return (flat.reshape(simulated.shape)[:, :, kept] - recorded) / spread

    def _engine(self, physics) -> Twin:
        return twin(physics.model, physics.theta, self._control, SETTINGS, physics.widths)

    @cached_property
    def _control(self):
        return tracking_controller(self.model)


def calibrate_evolution(
    recordings: RecordingSet, generations: int = 200, seed: int = 0, population: int = POPULATION, sigma: float = SIGMA
) -> CalibratedModel:
    """The paper's way: CMA-ES over the box [0, `Response.box`], from its middle.

    Raises `UserError` for load torques, which hold nothing that could be calibrated.
    """
    began, response = time.perf_counter(), _response(recordings)
    options = {"bounds": [0, 1], "popsize": population, "seed": seed + 1, "verbose": -9, "maxiter": generations}
    search: Any = cma.CMAEvolutionStrategy(np.full(len(response.box), 0.5), sigma, options)
    history = []
    while not search.stop():
        asked = search.ask()
        costs = response.objective(response.residuals([response.box * x for x in asked]))
        search.tell(asked, costs.tolist())
        history.append(float(search.best.f))
        if len(history) > 10 and history[-11] - history[-1] < PATIENCE * history[-1]:
            break
    report = {
        "way": "CMA-ES on the simulated response",
        "population": population,
        "sigma": sigma,
        "seed": seed,
        "evaluations": int(search.countevals),
        "history": history,
    }
    return _finished(response, response.box * np.asarray(search.best.x), report, began)


def calibrate_response(recordings: RecordingSet, steps: int = 20) -> CalibratedModel:
    """Gauss–Newton on the simulated response, from the optimum on inverse dynamics.

    A sum of norms is minimised as a sum of squares weighted by one over the norms, step after step. Derivatives are finite
    differences, all of them and all fractions of a step in one batch each. Raises as `calibrate_evolution`.
    """
    began, response = time.perf_counter(), _response(recordings)
    theta = np.concatenate([term.values for term in response.model.terms])
    lower, upper = bounds(response.model.terms)
    history, evaluations = [], 0
    for _ in range(steps):
        here, jacobian = _differences(response, theta)
        cost = float(response.objective(here)[0])
        history.append(cost)
        tried = [np.clip(theta + f * _step(here, jacobian, theta, lower, upper), lower, upper) for f in FRACTIONS]
        costs = response.objective(response.residuals(tried))
        evaluations += 1 + len(theta) + len(tried)
        best = int(np.argmin(costs))
        if not costs[best] < cost:
            break
        theta = tried[best]
        if cost - costs[best] < PATIENCE * cost:
            break
    report = {"way": "Gauss–Newton on the simulated response", "evaluations": evaluations, "history": history}
    return _finished(response, theta, report, began)


def with_values(terms: Sequence[Term], values: np.ndarray) -> tuple[Term, ...]:
    """The terms with these values, in the order of their parameters."""
    ends = np.cumsum([len(term.estimates) for term in terms])[:-1]
    return tuple(term.with_values(part) for term, part in zip(terms, np.split(values, ends), strict=True))


def _response(recordings: RecordingSet) -> Response:
    if recordings.torque == "load":
        raise UserError(
            f"{recordings.path}: load torques hold no friction and no armature; only inverse dynamics calibrates on them"
        )
    prepared, start = prepare(recordings), plain_model(recordings)
    fit = identify if recordings.inertial == "identify" else fit_terms
    return Response(recordings, fit(recordings, prepared, start).model)


def _differences(response: Response, theta: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Residuals at theta (1, n, K) and their derivatives (n, K, p), by recording; one-sided, away from 0."""
    step = DIFFERENCE * response.box
    found = response.residuals([theta, *(theta + step[i] * np.eye(len(theta))[i] for i in range(len(theta)))])
    slopes = [np.moveaxis((r[1:] - r[:1]) / step[:, None, None], 0, 2) for r in found]
    return [r[:1] for r in found], slopes


def _step(here: list[np.ndarray], jacobian: list[np.ndarray], theta, lower, upper) -> np.ndarray:
    from rrr_oc.inference import box_step

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
    here, jacobian = _differences(response, theta)
    found = _rows(recordings, here, jacobian)
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
    numbers = iter(estimates)
    model = replace(
        response.model, terms=tuple(replace(term, estimates=tuple(next(numbers) for _ in term.estimates)) for term in terms)
    )
    value = condition(matrix)
    report = report | {
        "objective": float(response.objective(here)[0]),
        "objective_window_s": response.window,
        "condition": value if np.isfinite(value) else None,
        "correlation": {"matrix": spread.correlation.tolist()},
        "wall_s": time.perf_counter() - began,
    }
    prepared: Sequence[Prepared] = prepare(recordings)
    return finished(recordings, prepared, model, report)


def _rows(recordings: RecordingSet, here: list[np.ndarray], jacobian: list[np.ndarray]) -> Rows:
    """Residuals in Nm as rows, one stretch per recording."""
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

"""Calibration of a recording set: the parameters of the plain model, and of the links where they are to be identified.

Inertial parameters are identified together with the terms' parameters, and the links stay physically consistent: least squares in
log-Cholesky coordinates of the pseudo-inertias (Rucker & Wensing 2022), with a wide prior about the URDF's links (`Prior`), which
determines what the recordings do not.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.covariance import Covariance, covariance, intervals
from rrr_oc.calibration.friction_width import with_widths, with_widths_free
from rrr_oc.calibration.inverse_dynamics import Fit, checked_rows, described, finished, fit_report, fit_terms, plain_model
from rrr_oc.calibration.least_squares import Quadratic, levenberg_marquardt, normal_equations
from rrr_oc.calibration.regression import Rows, rows
from rrr_oc.calibration.samples import CORRELATION, STRIDE, Prepared, prepare, without_spikes
from rrr_oc.calibration.term_fit import bounds, with_estimates, with_parameter_values
from rrr_oc.numerics.rank import condition, pseudo_inverse
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.robot.inertial_parameters import Prior, base_parameters, links_from_log_cholesky, prior, pseudo_inertia
from rrr_oc.storage import number

STEPS, GAIN = 200, 2e-6  # most steps, and least fall of the squared residual over its variance; doubled, no change
ROUNDS = 4  # of fit and rows, since weights and spikes depend on the residual, and some effects on the load; doubled, no change
SHARE_LEFT = 1e-7  # of a column's square that the others do not explain: less, and its parameter is fixed; doubled, no change
FIXED = 1e12  # precision of a fixed parameter in the covariance; that of the prior is about 1


def calibrate(recordings: RecordingSet) -> CalibratedModel:
    """The plain model, calibrated on inverse dynamics.

    Raises:
        UserError: The recordings are too short for the filter.
    """
    prepared = prepare(recordings)
    return fit(recordings, prepared, with_widths(prepared, plain_model(recordings))).model


def fit(recordings: RecordingSet, prepared: Sequence[Prepared], start: CalibratedModel) -> Fit:
    """A model fitted to the recordings; inertial parameters are estimated too where the set says "identify"."""
    return (identify if recordings.inertial == "identify" else fit_terms)(recordings, prepared, start)


def identify(recordings: RecordingSet, prepared: Sequence[Prepared], start: CalibratedModel) -> Fit:
    """The parameters of a model's terms together with all inertial parameters of the links.

    A parameter whose effect no motion tells from that of its link's inertia, such as an armature, is fixed at 0; the link's inertia
    then holds it.

    Raises:
        UserError: The recordings are too short for the filter.
    """
    began, robot, guess = time.perf_counter(), start.robot, prior(start.robot)
    xi, model = guess.centre.copy(), start
    found = checked_rows(recordings, prepared, start, inertial=True)
    fixed = np.zeros(len(start.values), bool)
    for done in range(ROUNDS):
        fixed = _explained(normal_equations(found, np.ones(robot.n))[0], len(fixed))
        at = _minimum(found, model, xi, guess, fixed)
        values, xi = at[: len(fixed)], at[len(fixed) :]
        links = replace(robot, inertial=links_from_log_cholesky(xi)[0])
        model = replace(start, terms=with_parameter_values(start.terms, values), robot=links)
        prepared = without_spikes(prepared, model) if done == 1 else prepared
        found = rows(prepared, model, inertial=True)
    size, weights = len(fixed), _weights(found)
    turn = _turn(links_from_log_cholesky(xi)[1], size)
    known = with_widths_free(found, prepared, model, weights)
    matrix, _ = normal_equations(known, weights)
    precision = np.concatenate([np.where(fixed, FIXED, 0.0), guess.std**-2])
    bread = np.linalg.pinv(turn.T @ matrix @ turn + np.diag(precision), hermitian=True)
    whole = covariance(known, weights, bread @ turn.T, turn @ bread @ turn.T)
    whole = replace(whole, matrix=whole.matrix + bread @ np.diag(precision) @ bread)
    spread = Covariance(whole.matrix[:size, :size], whole.freedom[:size])
    model = replace(model, terms=with_estimates(model.terms, described(model, model.values, spread, ~fixed)))
    report = {"way": "inverse dynamics, inertial parameters identified"}
    report |= fit_report(model, prepared, found, matrix[:size, :size], spread)
    report |= _inertial_report(
        model, matrix[size:, size:], turn[size:, size:], replace(whole, matrix=whole.matrix[size:, size:])
    )
    return Fit(finished(recordings, prepared, model, report, began), found, weights, spread)


def _minimum(found: Rows, model: CalibratedModel, xi: np.ndarray, guess: Prior, fixed: np.ndarray) -> np.ndarray:
    """Terms' parameters and log-Cholesky coordinates of least squares, (size + 10 n,), for the rows of a model with xi.

    The rows are linear in the terms' and the inertial parameters, so their normal equations hold everywhere.
    """
    whole, target = normal_equations(found, _weights(found))
    origin, size = np.concatenate([model.values, links_from_log_cholesky(xi)[0].T.ravel()]), len(fixed)
    free, (low, high) = np.full(len(xi), np.inf), bounds(model.terms)
    lower = np.concatenate([np.where(fixed, 0.0, low), -free])
    upper = np.concatenate([np.where(fixed, 0.0, high), free])

    def moved(at: np.ndarray) -> np.ndarray:
        return np.concatenate([at[:size], links_from_log_cholesky(at[size:])[0].T.ravel()]) - origin

    def cost(at: np.ndarray) -> float:
        step, distance = moved(at), np.sum(((at[size:] - guess.centre) / guess.std) ** 2)
        return float(step @ whole @ step - 2 * target @ step + distance)

    def near(at: np.ndarray) -> Quadratic:
        turn = _turn(links_from_log_cholesky(at[size:])[1], size)
        matrix, right = turn.T @ whole @ turn, turn.T @ (target - whole @ moved(at))
        matrix[range(size, len(at)), range(size, len(at))] += guess.std**-2
        right[size:] -= (at[size:] - guess.centre) / guess.std**2
        return Quadratic(cost(at), matrix, right, lower - at, upper - at)

    return levenberg_marquardt(np.clip(np.concatenate([model.values, xi]), lower, upper), near, cost, STEPS, GAIN)


def _weights(found: Rows) -> np.ndarray:
    """Of the joints, 1/variance of the residual, times the share of rows that are independent, (n,)."""
    return found.deviation() ** -2 * STRIDE / CORRELATION


def _explained(matrix: np.ndarray, size: int) -> np.ndarray:
    """Which of the first `size` columns of a normal matrix's rows the others explain, among them those after `size`, (size,)."""
    result = np.zeros(size, bool)
    for i in range(size):
        others = np.flatnonzero((np.arange(len(matrix)) != i) & (np.diag(matrix) > 0))
        rest = matrix[i, i] - matrix[i, others] @ pseudo_inverse(matrix[np.ix_(others, others)]) @ matrix[others, i]
        result[i] = matrix[i, i] <= 0 or rest < SHARE_LEFT * matrix[i, i]
    return result


def _turn(jacobians: Sequence[np.ndarray], size: int) -> np.ndarray:
    """d (terms' and inertial parameters) / d (terms' parameters, log-Cholesky coordinates)."""
    turn = np.eye(size + 10 * len(jacobians))
    for i, jacobian in enumerate(jacobians):
        at = slice(size + 10 * i, size + 10 * i + 10)
        turn[at, at] = jacobian
    return turn


def _inertial_report(model: CalibratedModel, matrix: np.ndarray, turn: np.ndarray, spread: Covariance) -> dict[str, Any]:
    """Base parameters with intervals, their conditioning, and the least eigenvalue of the pseudo-inertias.

    Args:
        matrix: Normal matrix of the inertial parameters (10 n, 10 n).
        turn: Their derivatives by the log-Cholesky coordinates.
        spread: Covariance of these coordinates.
    """
    base = base_parameters(model.robot)
    project = base.projection @ turn
    values = base.projection @ model.robot.inertial.T.ravel()
    freedom = np.full(len(base.names), float(np.min(spread.freedom)))
    spread = Covariance(project @ spread.matrix @ project.T, freedom)
    infinite = np.full(len(values), np.inf)
    between = intervals(values, spread.half_width, -infinite, infinite)
    parameters = zip(base.names, base.units, values, spread.std, between, strict=True)
    return {
        "base_parameters": [
            {"name": name, "unit": unit, "value": float(v), "std": float(s), "interval": list(i)}
            for name, unit, v, s, i in parameters
        ],
        "base_condition": number(condition(matrix[np.ix_(base.independent, base.independent)])),
        "smallest_pseudo_inertia": float(min(np.linalg.eigvalsh(pseudo_inertia(x))[0] for x in model.robot.inertial.T)),
    }

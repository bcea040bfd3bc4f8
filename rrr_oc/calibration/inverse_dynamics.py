"""Calibration on inverse dynamics: the parameters of a model's terms, and the links' inertial ones where the URDF lacks them.

The plain model has dry friction, viscous friction and armature in every joint. Its residuals (`regression`) are linear in the
parameters, so that one Gauss–Newton step solves them; other effects take more. Standard errors are those of `inference`.
How abruptly dry friction changes sign is a property of the joint too, and is chosen first (`with_widths`).
"""

import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any

import numpy as np

from rrr_oc import __version__
from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term, nominal_term
from rrr_oc.calibration.covariance import (
    Covariance,
    box_step,
    condition,
    covariance,
    intervals,
    normal_equations,
    undetermined,
)
from rrr_oc.calibration.friction_width import DOUBT, clear_of_widths, sharpened, with_widths
from rrr_oc.calibration.nrmse import error
from rrr_oc.calibration.regression import Rows, is_linear, noise, rows, with_residuals, without_spikes
from rrr_oc.calibration.samples import CORRELATION, FILTER, STRIDE, Prepared, prepare
from rrr_oc.effects.friction.dry_friction import DryFriction
from rrr_oc.effects.friction.viscous_friction import ViscousFriction
from rrr_oc.effects.transmission.armature import Armature
from rrr_oc.errors import UserError
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.robot.inertial_parameters import BaseParameters, Prior, base_parameters, from_log_cholesky, prior, pseudo_inertia
from rrr_oc.robot.robot import BUNDLED, urdf_text

PLAIN = (DryFriction, ViscousFriction, Armature)
PACKAGES = ("casadi", "mujoco", "numpy", "pin", "scipy")
SHARPENED = 2  # times that widths are moved together with all else
STEPS = 30  # of Gauss–Newton, at most
TOLERANCE = 1e-9  # of the squared residual: a step that promises less is not taken


@dataclass(frozen=True)
class Fit:
    """A calibrated model and the rows that it was found from.

    Attributes:
        model: With estimates and report.
        rows: Residuals and derivatives at the estimate; derivatives by inertial parameters follow if those were estimated.
        weights: Of the joints, 1/variance of the filtered residual [1/(Nm)²], (n,).
        covariance: Of the terms' parameters, in their order, with rows of NaN for what is not decided.
    """

    model: CalibratedModel
    rows: Rows
    weights: np.ndarray
    covariance: Covariance


def plain_model(recordings: RecordingSet) -> CalibratedModel:
    """The model that calibration starts from, its parameters at their nominal 0.

    Links that are to be identified start from the prior's bodies, for a URDF may give them no mass.
    Recorded load torque does not hold what happens in the drives, so it has no terms then.
    """
    robot, n = recordings.robot, recordings.robot.n
    if recordings.inertial == "identify":
        robot = replace(robot, inertial=_inertial(prior(robot).centre)[0])
    kinds = () if recordings.torque == "load" else PLAIN
    return CalibratedModel(
        robot=robot,
        source=str(recordings.source) if str(recordings.source) in BUNDLED else "urdf",
        urdf=urdf_text(recordings.source),
        tool=recordings.tool,
        torque=recordings.torque,
        torque_constant=recordings.torque_constant,
        inertial=recordings.inertial,
        terms=tuple(nominal_term(kind((j,))) for j in range(n) for kind in kinds),
        noise=np.full(n, np.nan),
        nrmse=np.full(n, np.nan),
        versions={"rrr_oc": __version__, "python": platform.python_version()} | {p: version(p) for p in PACKAGES},
    )


def calibrate(recordings: RecordingSet) -> CalibratedModel:
    """The plain model, calibrated; inertial parameters are estimated where the set says "identify".

    Raises:
        UserError: The recordings are too short for the filter.
    """
    start = plain_model(recordings)
    prepared = prepare(recordings)
    start = with_widths(prepared, start)
    fit = identify(recordings, prepared, start) if recordings.inertial == "identify" else fit_terms(recordings, prepared, start)
    return fit.model


def fit_terms(recordings: RecordingSet, prepared: Sequence[Prepared], start: CalibratedModel) -> Fit:
    """The parameters of a model's terms, all together, within their bounds, with trusted inertial parameters.

    Found once, spikes taken out of the residual, found again. Raises `UserError` where no row is left.
    """
    began = time.perf_counter()
    values, found = _minimised(prepared, start, _checked_rows(recordings, prepared, start))
    model = replace(start, terms=with_parameter_values(start.terms, values))
    prepared = without_spikes(prepared, model)
    values, found = _minimised(prepared, model, with_residuals(found, prepared, model))
    model = replace(model, terms=with_parameter_values(model.terms, values))
    model, found = _in_sharper_forms(prepared, model, found)
    for _ in range(SHARPENED):
        sharp = sharpened(found, prepared, model)
        if sharp is model or (better := _better(prepared, found, sharp)) is None:
            break
        model, found = better
    weights = found.deviation() ** -2
    known = clear_of_widths(found, prepared, model, weights)
    matrix, right = normal_equations(known, weights)
    estimates, spread = _estimates(known, weights, matrix, right, model.values, bounds(start.terms))
    model = replace(model, terms=with_estimates(model.terms, estimates))
    report = {"way": "inverse dynamics"} | _report(model, prepared, found, matrix, spread, began)
    return Fit(finished(recordings, prepared, model, report), found, weights, spread)


def _in_sharper_forms(prepared: Sequence[Prepared], model: CalibratedModel, found: Rows) -> tuple[CalibratedModel, Rows]:
    """The model with each law as sharp as leaves least, where that is better than as it is beyond doubt; and its rows."""
    for i, term in enumerate(model.terms):
        best, effect = (model, found), term.effect.sharper()
        while effect is not None:
            sharp = replace(model, terms=(*model.terms[:i], replace(best[0].terms[i], effect=effect), *model.terms[i + 1 :]))
            if (better := _better(prepared, best[1], sharp)) is None:
                break
            best, effect = better, effect.sharper()
        counts = found.moving.sum(axis=1) * STRIDE / CORRELATION
        if 2 * counts @ np.log(found.deviation() / best[1].deviation()) > DOUBT:
            model, found = best
    return model, found


def _better(prepared: Sequence[Prepared], found: Rows, tried: CalibratedModel) -> tuple[CalibratedModel, Rows] | None:
    """Another model, fitted, and its rows; None where it leaves no less than was found."""
    values, there = _minimised(prepared, tried, rows(prepared, tried))
    if np.prod(there.deviation()) >= np.prod(found.deviation()):
        return None
    return replace(tried, terms=with_parameter_values(tried.terms, values)), there


def _minimised(prepared: Sequence[Prepared], model: CalibratedModel, found: Rows) -> tuple[np.ndarray, Rows]:
    """Parameters that minimise the weighted squares of the residuals within bounds, and the rows there; Gauss–Newton."""
    values, linear = model.values, is_linear(prepared, model)
    for _ in range(STEPS):
        lower, upper = reach(model.terms)
        weights = found.deviation() ** -2
        matrix, right = normal_equations(found, weights)
        known = ~undetermined(matrix)
        step = box_step(matrix, right, np.where(known, lower - values, 0.0), np.where(known, upper - values, 0.0))
        if weights @ (np.sum(found.residual**2, axis=1)) * TOLERANCE > step @ (2 * right - matrix @ step):
            break  # what is to be gained is nothing beside what is left
        if linear:  # the rows after the step are known
            model = replace(model, terms=with_parameter_values(model.terms, values + step))
            found, taken = replace(found, residual=found.residual - found.jacobian @ step), step
        else:
            model, found, taken = _descend(prepared, model, found, values, step)
        values = values + taken
        if not np.any(taken):
            break
    return values, found


def identify(recordings: RecordingSet, prepared: Sequence[Prepared], start: CalibratedModel) -> Fit:
    """The parameters of a model's terms together with all inertial parameters of the links, which stay physically consistent.

    Least squares in log-Cholesky coordinates of the pseudo-inertias, each with a wide prior about the URDF's link (`prior`);
    it decides what the recordings leave open. An armature that no motion tells from its own link's inertia is set to 0: the
    link's inertia then holds it.

    Raises `UserError` where no row is left.
    """
    began, robot, size = time.perf_counter(), start.robot, len(start.values)
    guess, base = prior(robot), base_parameters(robot)
    xi = guess.centre.copy()
    found = _checked_rows(recordings, prepared, start, inertial=True)
    values, model, open_ = start.values, start, np.zeros(size, bool)
    for cleaned in range(4):  # weights and spikes depend on the residual, and what a law acts on depends on the load
        open_ = _not_in_span(normal_equations(found, np.ones(robot.n))[0], size)
        weights = found.deviation() ** -2 * STRIDE / CORRELATION
        values, xi = _consistent(found, weights, values, xi, guess, start.terms, open_)
        model = replace(
            start, terms=with_parameter_values(start.terms, values), robot=replace(robot, inertial=_inertial(xi)[0])
        )
        prepared = without_spikes(prepared, model) if cleaned == 1 else prepared
        found = rows(prepared, model, inertial=True)
    weights = found.deviation() ** -2 * STRIDE / CORRELATION
    return _identified(recordings, prepared, model, found, weights, xi, guess, base, open_, began)


def _identified(recordings, prepared, model, found: Rows, weights, xi, guess: Prior, base, open_, began) -> Fit:
    """The model with its estimates and report, at the optimum."""
    size = len(model.values)
    turn, known = _turn(_inertial(xi)[1], size), clear_of_widths(found, prepared, model, weights)
    matrix, _ = normal_equations(known, weights)
    precision = np.concatenate([np.where(open_, 1e12, 0.0), guess.std**-2])
    bread = np.linalg.pinv(turn.T @ matrix @ turn + np.diag(precision), hermitian=True)
    whole = covariance(known, weights, bread @ turn.T, turn @ bread @ turn.T)
    whole = Covariance(whole.matrix + bread @ np.diag(precision) @ bread, whole.freedom)
    spread = Covariance(whole.matrix[:size, :size], whole.freedom[:size])
    lower, upper = bounds(model.terms)
    values = model.values
    estimates = _described(values, values, spread, (lower, upper), ~open_)
    model = replace(model, terms=with_estimates(model.terms, estimates))
    report = {"way": "inverse dynamics, inertial parameters identified"} | _report(
        model, prepared, found, matrix[:size, :size], spread, began
    )
    project = base.projection @ turn[size:, size:]
    report["base_parameters"] = _base_report(
        base,
        base.projection @ model.robot.inertial.T.ravel(),
        Covariance(project @ whole.matrix[size:, size:] @ project.T, np.full(len(base.names), float(np.min(whole.freedom)))),
    )
    report["base_condition"] = _finite(condition(matrix[size:, size:][np.ix_(base.independent, base.independent)]))
    report["smallest_pseudo_inertia"] = float(
        min(np.linalg.eigvalsh(pseudo_inertia(link))[0] for link in model.robot.inertial.T)
    )
    return Fit(finished(recordings, prepared, model, report), found, weights, spread)


def finished(
    recordings: RecordingSet, prepared: Sequence[Prepared], model: CalibratedModel, report: dict[str, Any]
) -> CalibratedModel:
    """The model with its noise, its NRMSE on the recordings calibrated on, and a report."""
    errors = [
        error(r.t, recordings.output_torque(r), model.predicted_torque(r), r.segments)["nrmse"] for r in recordings.recordings
    ]
    with np.errstate(all="ignore"):
        nrmse = np.array([np.mean(e[np.isfinite(e)]) if np.isfinite(e).any() else np.nan for e in np.array(errors).T])
    files = [r.file for r in recordings.recordings]
    return replace(model, noise=noise(prepared, model), nrmse=nrmse, report=report | {"recordings": files})


def bounds(terms: Sequence[Term]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of the terms' parameters, in their order."""
    parameters = [p for term in terms for p in term.effect.parameters]
    return np.array([p.lower for p in parameters], float), np.array([p.upper for p in parameters], float)


def reach(terms: Sequence[Term]) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the terms' parameters within which one step of a fit ends, in their order."""
    (lower, upper), values = bounds(terms), np.concatenate([np.zeros(0), *(term.values for term in terms)])
    factor = np.array([p.factor for term in terms for p in term.effect.parameters], float)
    k = np.flatnonzero(np.isfinite(factor))
    lower[k], upper[k] = np.maximum(lower[k], values[k] / factor[k]), np.minimum(upper[k], values[k] * factor[k])
    return lower, upper


def labels(model: CalibratedModel) -> list[str]:
    """Names of the terms' parameters in their order, such as "dry_friction[joint2].level"."""
    return [
        f"{term.effect.name}[{','.join(model.joints[j] for j in term.effect.joints)}].{p.name}"
        for term in model.terms
        for p in term.effect.parameters
    ]


def _checked_rows(recordings: RecordingSet, prepared: Sequence[Prepared], model: CalibratedModel, inertial=False) -> Rows:
    found = rows(prepared, model, inertial)
    if found.residual.shape[1] < 10:
        raise UserError(
            f"{recordings.path}: {found.residual.shape[1]} rows are left after the filter; pieces of 0.5 s and more are needed"
        )
    return found


def with_parameter_values(terms: Sequence[Term], values: np.ndarray) -> tuple[Term, ...]:
    """The terms with other values of their parameters, which rounding may have carried over a bound."""
    return with_estimates(terms, [Estimate(float(v)) for v in np.clip(values, *bounds(terms))])


def with_estimates(terms: Sequence[Term], estimates: Sequence[Estimate]) -> tuple[Term, ...]:
    """The terms with these estimates, in the order of their parameters."""
    numbers = iter(estimates)
    return tuple(replace(term, estimates=tuple(next(numbers) for _ in term.estimates)) for term in terms)


def _descend(prepared, model: CalibratedModel, found: Rows, values: np.ndarray, step: np.ndarray):
    """Model and rows after the step, or after the first of its halves that lowers the cost, and what of it was taken."""
    weights = found.deviation() ** -2
    cost = _cost(found, weights)
    for fraction in (1.0, 0.5, 0.25, 0.1, 0.02):
        tried = replace(model, terms=with_parameter_values(model.terms, values + fraction * step))
        there = rows(prepared, tried)
        if _cost(there, weights) <= cost * (1 + 1e-9):
            return tried, there, fraction * step
    return model, found, np.zeros_like(step)


def _cost(found: Rows, weights: np.ndarray) -> float:
    return float(weights @ np.sum(found.residual**2, axis=1))


def _estimates(found: Rows, weights, matrix, right, values, limits) -> tuple[list[Estimate], Covariance]:
    """Estimates with intervals: of what lies inside its bounds, given that the rest is held by them; of the rest, freely."""
    (lower, upper), known = limits, ~undetermined(matrix)
    held = known & ((values <= lower) | (values >= upper))
    free = known & ~held
    inside, everywhere = (_spread(found, weights, matrix, which) for which in (free, known))
    step = np.zeros_like(values)
    step[known] = np.linalg.solve(matrix[np.ix_(known, known)], right[known]) if known.any() else 0.0
    std = np.where(held, everywhere.std, inside.std)
    freedom = np.where(held, everywhere.freedom, inside.freedom)
    shown = Covariance(inside.matrix + np.diag(np.where(held, std**2, 0.0)), freedom)
    return _described(values, np.where(held, values + step, values), shown, limits, known), inside


def _spread(found: Rows, weights: np.ndarray, matrix: np.ndarray, which: np.ndarray) -> Covariance:
    """Covariance with the parameters outside `which` held; zeros there."""
    bread = np.zeros_like(matrix)
    if which.any():
        bread[np.ix_(which, which)] = np.linalg.inv(matrix[np.ix_(which, which)])
    return covariance(found, weights, bread, bread)


def _described(values, centres, spread: Covariance, limits, known: np.ndarray) -> list[Estimate]:
    lower, upper = limits
    between = intervals(centres, spread.half_width, lower, upper)
    held = (values <= lower) | (values >= upper)
    return [
        Estimate(float(v), float(s), i, bool(h)) if k else Estimate(float(v), at_bound=bool(h))
        for v, s, i, h, k in zip(values, spread.std, between, held, known, strict=True)
    ]


def _report(
    model: CalibratedModel, prepared: Sequence[Prepared], found: Rows, matrix: np.ndarray, spread: Covariance, began: float
) -> dict[str, Any]:
    names, correlation = labels(model), spread.correlation
    pairs = [
        {"parameters": [names[i], names[j]], "correlation": float(correlation[i, j])}
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) > 0.9
    ]
    estimates = [e for term in model.terms for e in term.estimates]
    return {
        "filter_s": [FILTER, FILTER],
        "condition": _finite(condition(matrix)) if len(matrix) else None,
        "correlated": pairs,
        "correlation": {"parameters": names, "matrix": correlation.tolist()},
        "at_bound": [name for name, e in zip(names, estimates, strict=True) if e.at_bound],
        "undetermined": [name for name, e in zip(names, estimates, strict=True) if e.std is None],
        "residual_Nm": dict(zip(model.joints, found.deviation().tolist(), strict=True)),
        "rows": int(found.residual.shape[1]),
        "resting_share": dict(zip(model.joints, (1 - found.moving.mean(axis=1)).tolist(), strict=True)),
        "spikes": dict(zip(model.joints, np.sum([p.spikes for p in prepared], axis=0).tolist(), strict=True)),
        "wall_s": time.perf_counter() - began,
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _base_report(base: BaseParameters, values: np.ndarray, spread: Covariance) -> list[dict[str, Any]]:
    infinite = np.full(len(values), np.inf)
    between = intervals(values, spread.half_width, -infinite, infinite)
    return [
        {"name": name, "unit": unit, "value": float(v), "std": float(s), "interval": list(i)}
        for name, unit, v, s, i in zip(base.names, base.units, values, spread.std, between, strict=True)
    ]


def _not_in_span(matrix: np.ndarray, size: int) -> np.ndarray:
    """Which of the first `size` parameters no row tells from the others, among them those after `size`, (size,)."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix / np.outer(scale, scale)
    result = np.zeros(size, bool)
    for i in range(size):
        others = np.flatnonzero((np.arange(len(matrix)) != i) & (np.diag(matrix) > 0))
        inverse = np.linalg.pinv(scaled[np.ix_(others, others)], rcond=1e-10, hermitian=True)
        rest = scaled[i, i] - scaled[i, others] @ inverse @ scaled[others, i]
        result[i] = matrix[i, i] <= 0 or rest < 1e-7
    return result


def _inertial(xi: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """(10, n) parameters of log-Cholesky coordinates, and each link's derivatives (10, 10)."""
    parts = [from_log_cholesky()(link) for link in xi.reshape(-1, 10)]
    return np.stack([p for p, _ in parts], axis=1), [j for _, j in parts]


def _turn(jacobians: Sequence[np.ndarray], size: int) -> np.ndarray:
    """d (parameters, inertial) / d (parameters, log-Cholesky coordinates)."""
    turn = np.eye(size + 10 * len(jacobians))
    for i, jacobian in enumerate(jacobians):
        at = slice(size + 10 * i, size + 10 * i + 10)
        turn[at, at] = jacobian
    return turn


def _consistent(found: Rows, weights, values, xi, guess: Prior, terms, open_) -> tuple[np.ndarray, np.ndarray]:
    """Parameters and log-Cholesky coordinates that minimise the rows' cost and the prior's; Levenberg–Marquardt.

    The rows are linear in parameters and inertial parameters, so their normal equations hold everywhere.
    """
    matrix, right = normal_equations(found, weights)
    lower, upper = bounds(terms)
    size, origin = len(values), np.concatenate([values, _inertial(xi)[0].T.ravel()])
    low, high = np.concatenate([lower, np.full(len(xi), -np.inf)]), np.concatenate([upper, np.full(len(xi), np.inf)])
    low[:size][open_], high[:size][open_] = 0.0, 0.0

    def cost(at: np.ndarray) -> float:
        moved = np.concatenate([at[:size], _inertial(at[size:])[0].T.ravel()]) - origin
        return float(moved @ matrix @ moved / 2 - right @ moved + np.sum(((at[size:] - guess.centre) / guess.std) ** 2) / 2)

    at = np.clip(np.concatenate([values, xi]), low, high)
    best, damping = cost(at), 1e-3
    for _ in range(200):
        inertial, jacobians = _inertial(at[size:])
        turn, moved = _turn(jacobians, size), np.concatenate([at[:size], inertial.T.ravel()]) - origin
        hessian = turn.T @ matrix @ turn
        hessian[range(size, len(at)), range(size, len(at))] += guess.std**-2
        gradient = turn.T @ (right - matrix @ moved)
        gradient[size:] -= (at[size:] - guess.centre) / guess.std**2
        while True:
            damped = hessian + damping * np.diag(np.maximum(np.diag(hessian), 1e-9))
            there = at + _within(damped, gradient, low - at, high - at)
            tried = cost(there)
            if tried < best or damping > 1e8:
                break
            damping *= 5
        gained = best - tried
        if not gained > 1e-6:  # of a deviation²
            break
        best, at, damping = tried, there, max(damping / 10, 1e-12)
    return at[:size], at[size:]


def _within(matrix: np.ndarray, right: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """As `box_step`, for a positive definite matrix."""
    free = lower < upper
    step = np.zeros_like(right)
    step[free] = np.linalg.solve(matrix[np.ix_(free, free)], right[free])
    return step if np.all((step >= lower) & (step <= upper)) else box_step(matrix, right, lower, upper)

"""Calibration on inverse dynamics: the parameters of a model's terms, with trusted inertial parameters.

The plain model has the effects of the role "plain" in every joint: dry friction, viscous friction and armature. Its residuals
(`regression`) are linear in the parameters, so that one step solves for them; other effects need more steps. Standard errors are those of
`covariance`.
"""

import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any

import numpy as np

from rrr_oc import __version__
from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, nominal_term
from rrr_oc.calibration.covariance import Covariance, covariance_of_some, intervals
from rrr_oc.calibration.friction_width import LEAST_GAIN, with_step_of_widths, with_widths_free
from rrr_oc.calibration.least_squares import GaussNewton, normal_equations
from rrr_oc.calibration.prediction_error import error
from rrr_oc.calibration.regression import Rows, rows, with_residuals
from rrr_oc.calibration.samples import CORRELATION, FILTER, STRIDE, Prepared, noise, without_spikes
from rrr_oc.calibration.term_fit import TermPoint, bounds, labels, minimum, with_estimates
from rrr_oc.effects import MovesLink, plain_effects
from rrr_oc.errors import UserError
from rrr_oc.numerics.rank import condition, undetermined
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.robot.inertial_parameters import links_from_log_cholesky, prior
from rrr_oc.robot.robot import BUNDLED, urdf_text
from rrr_oc.robot.urdf import posed
from rrr_oc.storage import number

PACKAGES = ("casadi", "mujoco", "numpy", "pin", "scipy")
OPTIONS = GaussNewton(steps=30, promise=1e-9, rise=1e-9)
WIDTH_STEPS = 2  # of the fitted widths together with all other parameters; doubled, no change within the standard errors
LEAST_ROWS = 10  # with which a fit is tried


@dataclass(frozen=True)
class Fit:
    """A calibrated model and the rows that it was fitted to.

    Attributes:
        model: With estimates and report.
        rows: Residuals and derivatives at the estimate; derivatives by inertial parameters follow if those were estimated.
        weights: Of the joints, 1/variance of the filtered residual [1/(Nm)²], (n,).
        covariance: Of the terms' parameters, in their order, with rows of NaN for those that are not determined.
    """

    model: CalibratedModel
    rows: Rows
    weights: np.ndarray
    covariance: Covariance


def plain_model(recordings: RecordingSet) -> CalibratedModel:
    """The model that calibration starts from, its parameters at their nominal 0.

    Links that are to be identified start from the bodies of the prior, since a URDF may give them no mass. Recorded load torque
    does not depend on the drives, so the model then has no terms.
    """
    robot, n = recordings.robot, recordings.robot.n
    if recordings.inertial == "identify":
        robot = replace(robot, inertial=links_from_log_cholesky(prior(robot).centre)[0])
    kinds = () if recordings.torque == "load" else plain_effects()
    return CalibratedModel(
        robot=robot,
        source=str(recordings.source) if str(recordings.source) in BUNDLED else "urdf",
        urdf=posed(urdf_text(recordings.source), robot.held),
        tool=recordings.tool,
        torque=recordings.torque,
        torque_constant=recordings.torque_constant,
        inertial=recordings.inertial,
        terms=tuple(nominal_term(kind((j,))) for j in range(n) for kind in kinds),
        noise=np.full(n, np.nan),
        nrmse=np.full(n, np.nan),
        versions={"rrr_oc": __version__, "python": platform.python_version()} | {p: version(p) for p in PACKAGES},
    )


def fit_terms(recordings: RecordingSet, prepared: Sequence[Prepared], start: CalibratedModel) -> Fit:
    """All parameters of a model's terms, within their bounds, with trusted inertial parameters.

    A fit, removal of spikes, a second fit; then the best smoothing widths and forms of the smooth sign are chosen.

    Raises:
        UserError: Fewer than `LEAST_ROWS` rows are left.
    """
    began = time.perf_counter()
    at = _minimum(prepared, TermPoint(start, checked_rows(recordings, prepared, start)))
    prepared = without_spikes(prepared, at.model)
    at = _minimum(prepared, TermPoint(at.model, with_residuals(at.rows, prepared, at.model)))
    at = _in_other_forms(prepared, at)
    for _ in range(WIDTH_STEPS):
        model = with_step_of_widths(at.rows, prepared, at.model)
        if model is at.model or (better := _better(prepared, at, model)) is None:
            break
        at = better
    model, found, weights = at.model, at.rows, at.rows.deviation() ** -2
    known = with_widths_free(found, prepared, model, weights)
    matrix, right = normal_equations(known, weights)
    estimates, spread = _estimates(known, weights, matrix, right, model)
    model = replace(model, terms=with_estimates(model.terms, estimates))
    report = {"way": "inverse dynamics"} | fit_report(model, prepared, found, matrix, spread)
    return Fit(finished(recordings, prepared, model, report, began), found, weights, spread)


def _minimum(prepared: Sequence[Prepared], at: TermPoint) -> TermPoint:
    """The point with the least weighted squares of the residuals within the parameters' bounds."""
    return minimum(prepared, at, OPTIONS)


def _in_other_forms(prepared: Sequence[Prepared], at: TermPoint) -> TermPoint:
    """The point with each effect in the form of least residual, where that is significantly better than its own."""
    for i, term in enumerate(at.model.terms):
        best, model, own = at, at.model, term.effect
        for effect, theta in own.starts(term.named) if isinstance(own, MovesLink) else ():
            other = replace(term, effect=effect).with_values(np.array([theta[p.name] for p in effect.parameters]))
            there = (*model.terms[:i], other, *model.terms[i + 1 :])
            best = _better(prepared, best, replace(model, terms=there)) or best
        counts = at.rows.moving.sum(axis=1) * STRIDE / CORRELATION
        if 2 * counts @ np.log(at.rows.deviation() / best.rows.deviation()) > LEAST_GAIN:
            at = best
    return at


def _better(prepared: Sequence[Prepared], at: TermPoint, tried: CalibratedModel) -> TermPoint | None:
    """Another model, fitted; None if its residual is no smaller than that of the point."""
    there = _minimum(prepared, TermPoint(tried, rows(prepared, tried)))
    return there if np.prod(there.rows.deviation()) < np.prod(at.rows.deviation()) else None


def checked_rows(recordings: RecordingSet, prepared: Sequence[Prepared], model: CalibratedModel, inertial=False) -> Rows:
    """`regression.rows`; raises `UserError` where they are fewer than `LEAST_ROWS`."""
    found = rows(prepared, model, inertial)
    if found.residual.shape[1] < LEAST_ROWS:
        raise UserError(
            f"{recordings.path}: {found.residual.shape[1]} rows are left after the filter; pieces of 0.5 s and more are needed"
        )
    return found


def finished(
    recordings: RecordingSet, prepared: Sequence[Prepared], model: CalibratedModel, report: dict[str, Any], began: float
) -> CalibratedModel:
    """The model with its noise, its NRMSE on the recordings calibrated on, and a report; `began` as of `time.perf_counter`."""
    errors = [
        error(r.t, recordings.output_torque(r), model.predicted_torque(r), r.segments)["nrmse"] for r in recordings.recordings
    ]
    with np.errstate(all="ignore"):
        nrmse = np.array([np.mean(e[np.isfinite(e)]) if np.isfinite(e).any() else np.nan for e in np.array(errors).T])
    more = {"wall_s": time.perf_counter() - began, "recordings": [r.file for r in recordings.recordings]}
    return replace(model, noise=noise(prepared, model), nrmse=nrmse, report=report | more)


def _estimates(
    found: Rows, weights: np.ndarray, matrix: np.ndarray, right: np.ndarray, model: CalibratedModel
) -> tuple[list[Estimate], Covariance]:
    """Estimates with intervals: of parameters inside their bounds, given those at their bounds; of the latter, without bounds."""
    values, (lower, upper), known = model.values, bounds(model.terms), ~undetermined(matrix)
    held = known & ((values <= lower) | (values >= upper))
    inside, everywhere = (covariance_of_some(found, weights, matrix, which) for which in (known & ~held, known))
    step = np.zeros_like(values)
    step[known] = np.linalg.solve(matrix[np.ix_(known, known)], right[known]) if known.any() else 0.0
    std = np.where(held, everywhere.std, inside.std)
    freedom = np.where(held, everywhere.freedom, inside.freedom)
    shown = Covariance(inside.matrix + np.diag(np.where(held, std**2, 0.0)), freedom)
    return described(model, np.where(held, values + step, values), shown, known), inside


def described(model: CalibratedModel, centres: np.ndarray, spread: Covariance, known: np.ndarray) -> list[Estimate]:
    """Estimates of a model's parameters (p,), with standard errors and intervals about `centres` where they are known."""
    values, (lower, upper) = model.values, bounds(model.terms)
    between = intervals(centres, spread.half_width, lower, upper)
    held = (values <= lower) | (values >= upper)
    return [
        Estimate(float(v), float(s), i, bool(h)) if k else Estimate(float(v), at_bound=bool(h))
        for v, s, i, h, k in zip(values, spread.std, between, held, known, strict=True)
    ]


def fit_report(
    model: CalibratedModel, prepared: Sequence[Prepared], found: Rows, matrix: np.ndarray, spread: Covariance
) -> dict[str, Any]:
    """What `CalibratedModel.report` says of a fit: conditioning, correlations, bounds, residuals and rows."""
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
        "condition": number(condition(matrix)) if len(matrix) else None,
        "correlated": pairs,
        "correlation": {"parameters": names, "matrix": correlation.tolist()},
        "at_bound": [name for name, e in zip(names, estimates, strict=True) if e.at_bound],
        "undetermined": [name for name, e in zip(names, estimates, strict=True) if e.std is None],
        "residual_Nm": dict(zip(model.joints, found.deviation().tolist(), strict=True)),
        "rows": int(found.residual.shape[1]),
        "resting_share": dict(zip(model.joints, (1 - found.moving.mean(axis=1)).tolist(), strict=True)),
        "spikes": dict(zip(model.joints, np.sum([p.spikes for p in prepared], axis=0).tolist(), strict=True)),
    }

"""How abruptly the friction of each joint changes sign: its smoothing width, estimated as a property of the joint."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import cast

import numpy as np
from scipy.linalg import orth
from scipy.optimize import minimize_scalar

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term, nominal_term
from rrr_oc.calibration.jacobian import changes_sign
from rrr_oc.calibration.least_squares import box_step, normal_equations
from rrr_oc.calibration.regression import Rows, filtered, rows, width_columns
from rrr_oc.calibration.samples import CORRELATION, STRIDE, Prepared
from rrr_oc.effects import Signals
from rrr_oc.numerics.rank import lengths, pseudo_inverse
from rrr_oc.recordings.recording import Recording

WIDTHS = (0.0025, 0.005, 0.01, 0.02, 0.05, 0.1)  # [rad/s], grid whose best point is refined; its ends bound the width
FINE = 0.005  # of a width, to which the best is found; doubled, the error looks like friction that varies at low speed
LEAST_GAIN = 12.0  # of twice the log-likelihood: below 0.1 % by chance; doubled, more joints keep the nominal width
MOST_CHANGE = 1.2  # factor by which one step may change a width; doubled, steps leave the range where derivatives hold


def with_widths(prepared: Sequence[Prepared], model: CalibratedModel) -> CalibratedModel:
    """The model with the width of each joint's dry friction, between the ends of `WIDTHS`, of the least residual.

    The model's own width stays unless another raises twice the log-likelihood, counted in independent samples, by more than
    `LEAST_GAIN`. Unknown inertial parameters are free in the comparison. The other friction of a joint gets the same width.
    """
    columns = np.cumsum([0, *(len(term.estimates) for term in model.terms)])
    chosen = [i for i, t in enumerate(model.terms) if t.effect.sign_forms and t.width is not None]
    if not chosen:
        return model
    found = rows(prepared, model, inertial=model.inertial == "identify")
    widths = {model.terms[i].effect.joints: _best_width(prepared, found, model.terms[i], int(columns[i])) for i in chosen}
    return replace(model, terms=tuple(widened(term, widths) for term in model.terms))


def widened(term: Term, widths: Mapping[tuple[int, ...], float]) -> Term:
    """The term with its joint's width [rad/s], if its effect changes sign with the speed over a width above 0."""
    known = changes_sign(term.effect) and bool(term.width)
    return replace(term, width=widths.get(term.effect.joints, term.width)) if known else term


def _best_width(prepared: Sequence[Prepared], found: Rows, term: Term, column: int) -> float:
    """The best width of a joint's dry friction, beside all other columns; the term's own unless another is significantly better."""
    (j,), own = term.effect.joints, cast(float, term.width)
    others = found.jacobian[j][:, np.any(found.jacobian[j] != 0, axis=0) & (np.arange(found.jacobian.shape[2]) != column)]
    span = orth(others / lengths(others.T @ others))
    target = found.residual[j] + found.jacobian[j][:, column] * term.values[0]  # the residual without dry friction
    target = target - span @ (span.T @ target)

    def left(width: float) -> float:
        law = filtered(prepared, lambda r: _unit_law(term, r, width), [j]).T
        law = law - span @ (span.T @ law)
        return float(np.sum((target - law @ np.linalg.lstsq(law, target, rcond=1e-9)[0]) ** 2))

    best, count = best_width(left), found.moving[j].sum() * STRIDE / CORRELATION
    return best if count * (left(own) / max(left(best), 1e-300) - 1) > LEAST_GAIN else own


def best_width(cost: Callable[[float], float], fine: float = FINE) -> float:
    """The width between the ends of `WIDTHS` with the least cost, to a share `fine` of it."""
    costs = [cost(width) for width in WIDTHS]
    k = int(np.argmin(costs))
    ends = WIDTHS[max(k - 1, 0)], WIDTHS[min(k + 1, len(WIDTHS) - 1)]
    between = minimize_scalar(lambda x: cost(float(np.exp(x))), bounds=np.log(ends), method="bounded", options={"xatol": fine})
    return min((costs[k], WIDTHS[k]), (float(between.fun), float(np.exp(between.x))))[1]


def _unit_law(term: Term, recording: Recording, width: float) -> np.ndarray:
    """Dry friction of level 1, (1, K)."""
    (parameter,) = term.effect.parameters
    (torque,) = term.effect.torque(Signals(recording.q, recording.dq), {parameter.name: 1.0}, width)
    return np.array(torque).reshape(1, -1)


def with_step_of_widths(found: Rows, prepared: Sequence[Prepared], model: CalibratedModel) -> CalibratedModel:
    """The model after one Gauss–Newton step of its fitted widths, in which all other parameters vary too."""
    widths, whole = _by_widths(found, prepared, model)
    if not widths:
        return model
    matrix, right = normal_equations(whole, found.deviation() ** -2)
    most = np.full(len(right), np.inf)
    most[-len(widths) :] = np.log(MOST_CHANGE)
    steps = box_step(matrix, right, -most, most)[-len(widths) :]
    moved = {at: float(np.clip(w * np.exp(s), WIDTHS[0], WIDTHS[-1])) for (at, w), s in zip(widths.items(), steps, strict=True)}
    return replace(model, terms=tuple(widened(t, moved) for t in model.terms))


def with_widths_free(found: Rows, prepared: Sequence[Prepared], model: CalibratedModel, weights: np.ndarray) -> Rows:
    """The rows with derivatives less their projection on those by the fitted widths, which are estimates, too."""
    widths, whole = _by_widths(found, prepared, model)
    if not widths:
        return found
    matrix, size = normal_equations(whole, weights)[0], found.jacobian.shape[2]
    share = pseudo_inverse(matrix[size:, size:]) @ matrix[size:, :size]
    return replace(found, jacobian=found.jacobian - whole.jacobian[:, :, size:] @ share)


def _by_widths(found: Rows, prepared: Sequence[Prepared], model: CalibratedModel) -> tuple[dict[tuple[int, ...], float], Rows]:
    """Fitted widths of friction, by joint, and the rows with derivatives by their logarithms after all others."""
    friction = [t for t in model.terms if t.effect.sign_forms]
    widths = {t.effect.joints: cast(float, t.width) for t in friction if t.width not in (None, nominal_term(t.effect).width)}
    columns = width_columns(prepared, model, list(widths)) if widths else np.zeros((*found.residual.shape, 0))
    return widths, replace(found, jacobian=np.concatenate([found.jacobian, columns], axis=2))

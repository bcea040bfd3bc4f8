"""The fit of a model's terms to rows: their parameters as one vector, and the least-squares problem for it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.least_squares import GaussNewton, Quadratic, gauss_newton, normal_equations
from rrr_oc.calibration.regression import Rows, is_linear, rows
from rrr_oc.calibration.samples import Prepared
from rrr_oc.numerics.rank import undetermined


def bounds(terms: Sequence[Term]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of the terms' parameters, in their order, (p,) each."""
    parameters = [p for term in terms for p in term.effect.parameters]
    return np.array([p.lower for p in parameters], float), np.array([p.upper for p in parameters], float)


def labels(model: CalibratedModel) -> list[str]:
    """Names of the terms' parameters in their order, such as "dry_friction[joint2].level"."""
    return [
        f"{term.effect.name}[{','.join(model.joints[j] for j in term.effect.joints)}].{p.name}"
        for term in model.terms
        for p in term.effect.parameters
    ]


def with_estimates(terms: Sequence[Term], estimates: Sequence[Estimate]) -> tuple[Term, ...]:
    """The terms with these estimates, in the order of their parameters."""
    numbers = iter(estimates)
    return tuple(replace(term, estimates=tuple(next(numbers) for _ in term.estimates)) for term in terms)


def with_parameter_values(terms: Sequence[Term], values: np.ndarray) -> tuple[Term, ...]:
    """The terms with other values of their parameters, clipped to their bounds, which rounding may have crossed."""
    return with_estimates(terms, [Estimate(float(v)) for v in np.clip(values, *bounds(terms))])


@dataclass(frozen=True)
class TermPoint:
    """A model, and its rows: residuals and derivatives at the model."""

    model: CalibratedModel
    rows: Rows


def minimum(prepared: Sequence[Prepared], at: TermPoint, how: GaussNewton) -> TermPoint:
    """The point with the least weighted squares of the residuals within the parameters' bounds, from a start.

    The weight of a joint's residuals is the inverse of their variance at the point that a step starts from. Parameters that the
    rows do not determine keep their values.
    """
    linear = is_linear(prepared, at.model)

    def tried(at: TermPoint, steps: Sequence[np.ndarray]) -> Iterable[tuple[TermPoint, float]]:
        weights = at.rows.deviation() ** -2
        for step in steps:
            model = replace(at.model, terms=with_parameter_values(at.model.terms, at.model.values + step))
            there = replace(at.rows, residual=at.rows.residual - at.rows.jacobian @ step) if linear else rows(prepared, model)
            yield TermPoint(model, there), there.cost(weights)

    return gauss_newton(at, _near, tried, how)


def _near(at: TermPoint) -> Quadratic:
    weights, values = at.rows.deviation() ** -2, at.model.values
    matrix, right = normal_equations(at.rows, weights)
    factor = np.array([p.factor for term in at.model.terms for p in term.effect.parameters], float)
    k = np.flatnonzero(np.isfinite(factor))  # parameters that one step may change by a factor at most
    low, high = bounds(at.model.terms)
    low[k], high[k] = np.maximum(low[k], values[k] / factor[k]), np.minimum(high[k], values[k] * factor[k])
    lower, upper = low - values, high - values
    lower[undetermined(matrix)] = upper[undetermined(matrix)] = 0.0
    return Quadratic(at.rows.cost(weights), matrix, right, lower, upper)

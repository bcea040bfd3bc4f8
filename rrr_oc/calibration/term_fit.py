"""The fit of a model's terms to rows: their parameters as one vector, and the least-squares problem for it."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.least_squares import Problem, Quadratic, normal_equations
from rrr_oc.calibration.regression import Rows, rows, with_residuals
from rrr_oc.calibration.samples import Prepared
from rrr_oc.numerics.rank import undetermined


def bounds(terms: Sequence[Term]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of the terms' parameters, in their order, (p,) each."""
    parameters = [p for term in terms for p in term.effect.parameters]
    return np.array([p.lower for p in parameters], float), np.array([p.upper for p in parameters], float)


def step_limits(terms: Sequence[Term]) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the terms' parameters after one step of a fit, which may change some by a factor at most, (p,) each."""
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


def with_estimates(terms: Sequence[Term], estimates: Sequence[Estimate]) -> tuple[Term, ...]:
    """The terms with these estimates, in the order of their parameters."""
    numbers = iter(estimates)
    return tuple(replace(term, estimates=tuple(next(numbers) for _ in term.estimates)) for term in terms)


def with_parameter_values(terms: Sequence[Term], values: np.ndarray) -> tuple[Term, ...]:
    """The terms with other values of their parameters, clipped to their bounds, which rounding may have crossed."""
    return with_estimates(terms, [Estimate(float(v)) for v in np.clip(values, *bounds(terms))])


@dataclass(frozen=True)
class TermPoint:
    """A model and its rows.

    Attributes:
        model: With the parameters of the point.
        rows: Residuals at the model, and derivatives at it or at an earlier one.
        fresh: Whether the derivatives are those at the model.
        foreseen: Residuals (n, M) [Nm] that the derivatives of the point before predicted.
        fixed: Numbers of parameters that the next step does not change.
    """

    model: CalibratedModel
    rows: Rows
    fresh: bool = True
    foreseen: np.ndarray | None = None
    fixed: tuple[int, ...] = ()


@dataclass(frozen=True)
class TermFit(Problem[TermPoint]):
    """Least squares in the parameters of a model's terms and, if they are unknown, the links' inertial parameters.

    Residuals of a joint count by their variance at the point that a step starts from.

    Attributes:
        prepared: The recordings.
        linear: Whether the prediction is linear in all parameters.
        inertial: Whether the inertial parameters (10, n) vary too, without bounds.
        prior: From inertial parameters (10, n) to normal equations of what is believed of them, (10 n + 1, 10 n + 1), residual last.
        bend: Share of the squared change over a step by which residuals may miss the linear prediction before derivatives are
            renewed; None: they are renewed after every step.
        without_last: Rows of the model without its last term, from which all but the last term's derivatives are taken.
        fix_undetermined: Whether parameters that the rows do not determine keep their values.
    """

    prepared: Sequence[Prepared]
    linear: bool
    inertial: bool = False
    prior: Callable[[np.ndarray], np.ndarray] | None = None
    bend: float | None = None
    without_last: Rows | None = None
    fix_undetermined: bool = False

    def start(self, model: CalibratedModel, fixed: tuple[int, ...] = ()) -> TermPoint:
        """The point of a model."""
        return TermPoint(model, rows(self.prepared, model, self.inertial, self.without_last), fixed=fixed)

    def quadratic(self, at: TermPoint) -> Quadratic:
        weights, values = at.rows.deviation() ** -2, at.model.values
        matrix, right = normal_equations(at.rows, weights)
        size, value = len(values), at.rows.cost(weights)
        if self.prior is not None:
            believed = self.prior(at.model.robot.inertial)
            matrix[size:, size:] += believed[:-1, :-1]
            right[size:] += believed[:-1, -1]
            value += believed[-1, -1]
        lower, upper = np.full(len(right), -np.inf), np.full(len(right), np.inf)
        low, high = step_limits(at.model.terms)
        lower[:size], upper[:size] = low - values, high - values
        lower[list(at.fixed)] = upper[list(at.fixed)] = 0.0
        if self.fix_undetermined:
            unknown = undetermined(matrix)
            lower[unknown] = upper[unknown] = 0.0
        return Quadratic(value, matrix, right, lower, upper)

    def tried(self, at: TermPoint, steps: Sequence[np.ndarray]) -> Iterable[tuple[TermPoint, float]]:
        weights = at.rows.deviation() ** -2
        for step in steps:
            model = _moved(at.model, step)
            foreseen = at.rows.residual - at.rows.jacobian @ step
            if self.linear:
                there = TermPoint(model, replace(at.rows, residual=foreseen), at.fresh, foreseen)
            elif self.bend is None:
                there = self.start(model)
            else:
                there = TermPoint(model, with_residuals(at.rows, self.prepared, model), False, foreseen)
            cost = there.rows.cost(weights)
            yield there, cost if self.prior is None else cost + self.prior(model.robot.inertial)[-1, -1]

    def accepted(self, before: TermPoint, there: TermPoint) -> TermPoint:
        if self.linear or self.bend is None or there.foreseen is None:
            return there
        weights = before.rows.deviation() ** -2
        missed, change = there.rows.residual - there.foreseen, before.rows.residual - there.foreseen
        missed, change = (float(weights @ np.sum(x**2, axis=1)) for x in (missed, change))
        return self.start(there.model) if missed > self.bend * change else there

    def freed(self, at: TermPoint) -> TermPoint | None:
        return replace(at, fixed=()) if at.fixed else None

    def renewed(self, at: TermPoint) -> TermPoint | None:
        return None if at.fresh else self.start(at.model)


def _moved(model: CalibratedModel, step: np.ndarray) -> CalibratedModel:
    """The model after a step of the terms' parameters and, if there are more numbers, of the inertial ones."""
    values = model.values
    terms = with_parameter_values(model.terms, values + step[: len(values)])
    if len(step) == len(values):
        return replace(model, terms=terms)
    inertial = model.robot.inertial + step[len(values) :].reshape(model.robot.n, 10).T
    return replace(model, terms=terms, robot=replace(model.robot, inertial=inertial))

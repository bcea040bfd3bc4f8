"""The fit of a model's terms to rows: their parameters as one vector, and the least-squares problem for it."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.least_squares import GaussNewton, Quadratic, gauss_newton, normal_equations
from rrr_oc.calibration.regression import Rows, rows, with_residuals
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
    """A model and its rows.

    Attributes:
        model: With the parameters of the point.
        rows: Residuals and derivatives at the model.
        predicted: If the derivatives are those of an earlier point: the residuals (n, M) [Nm] that they predicted.
        fixed: Numbers of parameters that the next step does not change.
    """

    model: CalibratedModel
    rows: Rows
    predicted: np.ndarray | None = None
    fixed: tuple[int, ...] = ()


@dataclass(frozen=True)
class TermFit:
    """Least squares in the parameters of a model's terms and, if they are unknown, the links' inertial parameters.

    The weight of a joint's residuals is the inverse of their variance at the point that a step starts from.

    Attributes:
        prepared: The recordings.
        linear: Whether the prediction is linear in all parameters.
        inertial: Whether the inertial parameters (10, n) vary too, without bounds.
        prior: From inertial parameters (10, n) to the normal equations of their prior, (10 n + 1, 10 n + 1), residual last.
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

    def minimum(self, at: TermPoint, how: GaussNewton) -> TermPoint:
        """The point with the least weighted squares of the residuals within the parameters' bounds, from a start."""
        return gauss_newton(at, self._near, self._tried, how, self._accepted, self._again)

    def _near(self, at: TermPoint) -> Quadratic:
        weights, values = at.rows.deviation() ** -2, at.model.values
        matrix, right = normal_equations(at.rows, weights)
        size, value = len(values), at.rows.cost(weights)
        if self.prior is not None:
            prior = self.prior(at.model.robot.inertial)
            matrix[size:, size:] += prior[:-1, :-1]
            right[size:] += prior[:-1, -1]
            value += prior[-1, -1]
        lower, upper = np.full(len(right), -np.inf), np.full(len(right), np.inf)
        factor = np.array([p.factor for term in at.model.terms for p in term.effect.parameters], float)
        k = np.flatnonzero(np.isfinite(factor))  # parameters that one step may change by a factor at most
        low, high = bounds(at.model.terms)
        low[k], high[k] = np.maximum(low[k], values[k] / factor[k]), np.minimum(high[k], values[k] * factor[k])
        lower[:size], upper[:size] = low - values, high - values
        held = list(at.fixed) + (np.flatnonzero(undetermined(matrix)).tolist() if self.fix_undetermined else [])
        lower[held] = upper[held] = 0.0
        return Quadratic(value, matrix, right, lower, upper)

    def _tried(self, at: TermPoint, steps: Sequence[np.ndarray]) -> Iterable[tuple[TermPoint, float]]:
        weights, size = at.rows.deviation() ** -2, len(at.model.values)
        for step in steps:
            robot = at.model.robot
            if self.inertial:
                robot = replace(robot, inertial=robot.inertial + step[size:].reshape(robot.n, 10).T)
            terms = with_parameter_values(at.model.terms, at.model.values + step[:size])
            model, predicted = replace(at.model, terms=terms, robot=robot), at.rows.residual - at.rows.jacobian @ step
            if self.linear:
                there = TermPoint(model, replace(at.rows, residual=predicted))
            elif self.bend is None:
                there = self.start(model)
            else:
                there = TermPoint(model, with_residuals(at.rows, self.prepared, model), predicted)
            yield there, there.rows.cost(weights) + (0.0 if self.prior is None else self.prior(robot.inertial)[-1, -1])

    def _accepted(self, before: TermPoint, there: TermPoint) -> TermPoint:
        """The point, with derivatives renewed where the residuals missed the linear prediction by too much."""
        if there.predicted is None or self.bend is None:
            return there
        weights = before.rows.deviation() ** -2
        missed, change = (weights @ np.sum((x.rows.residual - there.predicted) ** 2, axis=1) for x in (there, before))
        return self.start(there.model) if missed > self.bend * change else there

    def _again(self, at: TermPoint, promising: bool) -> TermPoint | None:
        """The point with fixed parameters set free where no step promises enough, or with old derivatives renewed."""
        if promising:
            return None if at.predicted is None else self.start(at.model)
        return replace(at, fixed=()) if at.fixed else None

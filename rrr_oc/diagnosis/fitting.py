"""A model fitted to a bench: Gauss–Newton within bounds on filtered residuals, made for comparing many models."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.calibration.covariance import box_step, normal_equations
from rrr_oc.calibration.friction_width import with_widths
from rrr_oc.calibration.inverse_dynamics import reach, with_parameter_values
from rrr_oc.calibration.regression import Rows, rows, with_residuals
from rrr_oc.diagnosis.evidence import Bench, independent
from rrr_oc.effects import Effect

STEADY, SELDOM = 3.0, 2.0  # standard errors by which a fit must be better; of what acts only as a joint reverses, and so seldom
STEPS, TOLERANCE = 12, 1e-5  # of Gauss–Newton; of the squared residual
BEND = 0.01  # of the squared change in a step, by which the residual may miss what was foreseen before derivatives are renewed


@dataclass(frozen=True)
class Fitted:
    """A model fitted to a bench.

    Attributes:
        model: With the parameters found.
        rows: There.
    """

    model: CalibratedModel
    rows: Rows

    @property
    def squares(self) -> np.ndarray:
        """Sum of squared residuals of each joint (n,)."""
        return np.maximum(np.sum(self.rows.residual**2, axis=1), 1e-300)

    @property
    def misfit(self) -> float:
        """Sum of the logarithms of the joints' squared residuals; less is better."""
        return float(np.sum(np.log(self.squares)))

    @cached_property
    def counts(self) -> np.ndarray:
        """Independent rows of each joint (n,)."""
        return independent(self.rows)

    def better_than(self, other: "Fitted") -> float:
        """Growth of twice the log-likelihood over another fit of the same rows.

        Of each joint as many rows count as the fit that leaves less makes independent: what the other leaves may be correlated.
        """
        ratio = np.log(other.squares / self.squares)
        return float(np.where(ratio > 0, self.counts, other.counts) @ ratio)


def refit(bench: Bench, model: CalibratedModel, steps: int = STEPS, without_last: Rows | None = None) -> Fitted:
    """All parameters of a model, fitted to a bench within their bounds; inertial ones freely where they are unknown.

    Args:
        without_last: Rows of the model without its last term, which is new: first all that is linear in it is fitted, from where
            its shape is not led astray. The other terms' derivatives then serve all along, which is nearly as good.
    """
    found, fresh = rows(bench.prepared, model, bench.identify, without_last), True
    straight = not bench.identify and all(_straight(term.effect) for term in model.terms)
    shape = _shape_of_last(model) if without_last is not None else []
    for _ in range(steps + bool(shape)):
        weights = found.deviation() ** -2
        matrix, right = normal_equations(found, weights)
        values = model.values
        believed = bench.believed(model.robot.inertial)
        matrix[len(values) :, len(values) :] += believed[:-1, :-1]
        right[len(values) :] += believed[:-1, -1]
        low, high = reach(model.terms)
        low[shape] = high[shape] = values[shape]
        size = len(values)
        free = np.full(matrix.shape[0] - size, np.inf)
        step = box_step(matrix, right, np.concatenate([low - values, -free]), np.concatenate([high - values, free]))
        cost = float(weights @ np.sum(found.residual**2, axis=1)) + believed[-1, -1]
        if step @ (2 * right - matrix @ step) < TOLERANCE * cost:
            if not shape:
                break  # what is to be gained is nothing beside what is left
            shape = []
            continue
        shape = []
        for share in (1.0, 0.4, 0.1):
            there = _moved(model, values + share * step[:size], share * step[size:])
            change = share * (found.jacobian @ step)
            foreseen = replace(found, residual=found.residual - change)
            tried = foreseen if straight else with_residuals(found, bench.prepared, there)
            after = float(weights @ np.sum(tried.residual**2, axis=1)) + bench.believed(there.robot.inertial)[-1, -1]
            if after < cost:
                break
        else:
            if fresh:
                break
            found, fresh = rows(bench.prepared, model, bench.identify, without_last), True
            continue
        bend, way = (float(weights @ np.sum(x**2, axis=1)) for x in (tried.residual - foreseen.residual, change))
        fresh = bend > BEND * way  # else the derivatives are still good
        model, found = there, rows(bench.prepared, there, bench.identify, without_last) if fresh else tried
        if after > cost * (1 - TOLERANCE):
            break
    return Fitted(model, found)


def _shape_of_last(model: CalibratedModel) -> list[int]:
    """Numbers of those parameters of the last term in which it is not linear."""
    effect = model.terms[-1].effect
    start = sum(len(t.estimates) for t in model.terms[:-1])
    return [start + k for k, p in enumerate(effect.parameters) if p.name not in effect.amplitudes]


def _straight(effect: Effect) -> bool:
    """Whether the prediction stays linear in all parameters with this effect; gain and load multiply what others do."""
    return effect.role == "plain" or (effect.linear and effect.side != "sensor" and "load" not in effect.inputs)


def steadily_better(bench: Bench, one: Fitted, other: Fitted, scope: Sequence[str] | None = None) -> bool:
    """Whether the fit is better all along, not by luck in a few places: differences of squares by block of time.

    Args:
        one: A fit with a new effect, its last term.
        scope: Groups of the recordings that have what is new; None for all.
    """
    weights = one.rows.deviation() ** -2
    fall = weights @ (other.rows.residual**2 - one.rows.residual**2)
    blocks = bench.by_block(fall)
    if scope is not None:
        inside = np.repeat([float(g in scope) for g in bench.groups], np.diff(bench.edges))
        blocks = blocks[bench.by_block(inside) > 0]
    errors = SELDOM if one.model.terms[-1].effect.dynamics == "impact" else STEADY
    return bool(blocks.sum() > errors * np.sqrt(np.sum((blocks - blocks.mean()) ** 2) + 1e-300))


def as_abrupt(bench: Bench, model: CalibratedModel) -> Fitted:
    """The fit with the widths that are best, beyond doubt or not, since ways to change sign are compared each at its best."""
    return refit(bench, with_widths(bench.prepared, model, doubt=0.0))


def with_turn(terms: Sequence[Term], number: int, turn: int) -> tuple[Term, ...]:
    """The terms with the dry friction of that number changing sign in another way, numbered as its `sign_forms`."""
    term = terms[number]
    return (*terms[:number], replace(term, effect=term.effect.sign_forms[turn]), *terms[number + 1 :])


def _moved(model: CalibratedModel, values: np.ndarray, inertial: np.ndarray) -> CalibratedModel:
    terms = with_parameter_values(model.terms, values)
    if not len(inertial):
        return replace(model, terms=terms)
    robot = replace(model.robot, inertial=model.robot.inertial + inertial.reshape(model.robot.n, 10).T)
    return replace(model, terms=terms, robot=robot)

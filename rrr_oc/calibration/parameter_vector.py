"""The parameters of a model's terms as one vector: names, bounds and values; and the widths over which friction changes sign."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.jacobian import changes_sign

WIDTHS = (0.0025, 0.005, 0.01, 0.02, 0.05, 0.1)  # [rad/s] that are tried for the sign of dry friction; the ends bound the width


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


def with_parameter_values(terms: Sequence[Term], values: np.ndarray) -> tuple[Term, ...]:
    """The terms with other values of their parameters, clipped to their bounds, which rounding may have crossed."""
    return with_estimates(terms, [Estimate(float(v)) for v in np.clip(values, *bounds(terms))])


def with_estimates(terms: Sequence[Term], estimates: Sequence[Estimate]) -> tuple[Term, ...]:
    """The terms with these estimates, in the order of their parameters."""
    numbers = iter(estimates)
    return tuple(replace(term, estimates=tuple(next(numbers) for _ in term.estimates)) for term in terms)


def widened(term: Term, widths: Mapping[tuple[int, ...], float]) -> Term:
    """The term with its joint's width [rad/s], if its effect changes sign with the speed over a width above 0."""
    known = changes_sign(term.effect) and bool(term.width)
    return replace(term, width=widths.get(term.effect.joints, term.width)) if known else term

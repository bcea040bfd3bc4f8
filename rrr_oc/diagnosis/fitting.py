"""A model fitted to a bench: bounded least squares on filtered residuals, made for comparing many models."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.calibration.friction_width import best_width, widened, with_widths
from rrr_oc.calibration.least_squares import GaussNewton, minimise
from rrr_oc.calibration.regression import Rows
from rrr_oc.calibration.term_fit import TermFit
from rrr_oc.diagnosis.evidence import Bench, independent
from rrr_oc.effects import Effect

STEADY, SELDOM = 3.0, 2.0  # standard errors by which a fit must be better; of effects that act at reversals only, which are few
OPTIONS = GaussNewton(steps=12, promise=1e-5, gain=1e-5, fractions=(1.0, 0.4, 0.1))
SAME = 9.0  # difference in twice the log-likelihood within which two models count as equal; twice as much lists more rivals
ROUGH = 0.05  # relative tolerance of a smoothing width that several laws share; twice as much saves a little time
BEND = 0.01  # of the squared change over a step, by which residuals may miss the prediction; doubled, fewer derivatives, more steps


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

        Of each joint as many rows count as are independent in the fit with the smaller residual, since the larger one may be
        correlated.
        """
        ratio = np.log(other.squares / self.squares)
        return float(np.where(ratio > 0, self.counts, other.counts) @ ratio)


def refit(bench: Bench, model: CalibratedModel, steps: int = OPTIONS.steps, without_last: Rows | None = None) -> Fitted:
    """All parameters of a model, fitted to a bench within their bounds; the inertial ones freely where they are unknown.

    Args:
        steps: Most steps of Gauss–Newton.
        without_last: Rows of the model without its last term, which is new. The first step then changes only parameters in which
            that term is linear, so that its shape is not led astray; the other terms' derivatives stay as they are.
    """
    fit = TermFit(
        bench.prepared,
        linear=not bench.identify and all(_keeps_linear(term.effect) for term in model.terms),
        inertial=bench.identify,
        prior=bench.believed,
        bend=BEND,
        without_last=without_last,
    )
    shape = _shape_of_last(model) if without_last is not None else ()
    at = minimise(fit, fit.start(model, shape), replace(OPTIONS, steps=steps + bool(shape)))
    return Fitted(at.model, at.rows)


def _shape_of_last(model: CalibratedModel) -> tuple[int, ...]:
    """Numbers of the parameters of the last term in which it is not linear."""
    effect = model.terms[-1].effect
    start = sum(len(t.estimates) for t in model.terms[:-1])
    return tuple(start + k for k, p in enumerate(effect.parameters) if p.name not in effect.amplitudes)


def _keeps_linear(effect: Effect) -> bool:
    """Whether the prediction stays linear in all parameters with this effect; a gain, or friction by load, multiplies others."""
    return effect.role == "plain" or (effect.linear and effect.side != "sensor" and "load" not in effect.inputs)


def steadily_better(bench: Bench, one: Fitted, other: Fitted, scope: Sequence[str] | None = None) -> bool:
    """Whether the fit is better throughout, not by chance in a few places: a t-test of the squares' differences by block of time.

    Args:
        one: A fit with a new effect as its last term.
        scope: Groups of the recordings that have the effect; None for all.
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
    """The fit with the best widths, significant or not: ways of friction to change sign are compared each at its best."""
    return refit(bench, with_widths(bench.prepared, model, least_gain=0.0))


def with_turn(model: CalibratedModel, number: int, turn: int) -> CalibratedModel:
    """The model whose term of that number, a dry friction, changes sign in another way, numbered as its `sign_forms`."""
    term = model.terms[number]
    return with_term(model, number, replace(term, effect=term.effect.sign_forms[turn]))


def rewidened(bench: Bench, fitted: Fitted) -> Fitted:
    """The fit with the width of each friction's change of sign estimated again; missing effects had biased it.

    It is estimated with the dependence of friction on speed left free and with the model's own; the better fit is returned.
    """
    tried = {tuple(t.width for t in fitted.model.terms): fitted}
    for free in (True, False):
        model = with_widths(bench.prepared, fitted.model, free)
        widths = tuple(t.width for t in model.terms)
        if widths not in tried:
            tried[widths] = refit(bench, model)
    return _widened_together(bench, min(tried.values(), key=lambda f: f.misfit))


def _widened_together(bench: Bench, fitted: Fitted) -> Fitted:
    """The fit in which the newest law and all other friction of its joint share one width, if it is significantly better.

    A wide dry friction beside an abrupt newer law, or the reverse, may be a worse local optimum. A law with bristles may also change
    sign with a width of 0.
    """
    *others, newest = fitted.model.terms
    if newest.effect.width is None or newest.effect.width.unit != "rad/s":
        return fitted
    joints = newest.effect.joints

    @cache
    def at(width: float) -> Fitted:
        together = (*(widened(t, {joints: width}) for t in others), replace(newest, width=width))
        return refit(bench, replace(fitted.model, terms=together if width else (*others, replace(newest, width=width))))

    tried = [at(best_width(lambda width: at(width).misfit, ROUGH))] + ([at(0.0)] if newest.effect.states else [])
    best = min(tried, key=lambda f: f.misfit)
    return best if best.better_than(fitted) > SAME else fitted


def refit_with_widths(bench: Bench, model: CalibratedModel) -> Fitted:
    """The model fitted, with the width of each friction's change of sign estimated again."""
    return rewidened(bench, refit(bench, model))


def best_start(bench: Bench, model: CalibratedModel, shares: Sequence[float], without_last: Rows | None = None) -> Fitted:
    """The best fit from several starts of the last term, whose prediction is not smooth: its amplitudes times each of `shares`."""
    last, fits = model.terms[-1], []
    for share in shares:
        sized = {name: share * value if name in last.effect.amplitudes else value for name, value in last.named.items()}
        for effect, theta in last.effect.starts(sized):
            start = replace(last, effect=effect).with_values(np.array(list(theta.values())))
            fits.append(refit(bench, replace(model, terms=(*model.terms[:-1], start)), 3, without_last))
    return min(fits, key=lambda f: f.misfit)


def extended(model: CalibratedModel, *terms: Term) -> CalibratedModel:
    """The model with further terms at the end."""
    return replace(model, terms=(*model.terms, *terms))


def without(model: CalibratedModel, *terms: Term) -> CalibratedModel:
    """The model without these of its terms."""
    return replace(model, terms=tuple(t for t in model.terms if not any(t is out for out in terms)))


def with_term(model: CalibratedModel, i: int, term: Term) -> CalibratedModel:
    """The model with another term in place of its term number i."""
    return replace(model, terms=(*model.terms[:i], term, *model.terms[i + 1 :]))

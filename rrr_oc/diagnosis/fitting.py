"""Recordings prepared for comparing models (`Bench`), and models fitted to them by bounded least squares on filtered residuals."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.calibration.friction_width import best_width, widened, with_widths
from rrr_oc.calibration.least_squares import GaussNewton
from rrr_oc.calibration.regression import Rows
from rrr_oc.calibration.samples import CORRELATION, STRIDE, Prepared, kept_rows
from rrr_oc.calibration.term_fit import TermFit
from rrr_oc.diagnosis.signatures import SignatureCache
from rrr_oc.effects import Effect

STEADY = 3.0  # standard errors by which a fit must be better in the t-test by block; doubled, faint effects are missed
SELDOM = 2.0  # the same for impacts, which occur at reversals only and so in few blocks
OPTIONS = GaussNewton(steps=12, promise=1e-5, gain=1e-5, fractions=(1.0, 0.4, 0.1))
SAME = 9.0  # difference in twice the log-likelihood within which two models count as equal; twice as much lists more rivals
ROUGH = 0.05  # relative tolerance of a smoothing width that several laws share; twice as much saves a little time
BEND = 0.01  # of the squared change over a step, by which residuals may miss the prediction; doubled, fewer derivatives, more steps
LONGEST = 2.0  # largest lag of the autocorrelation of residuals [s]; doubled, slow residuals count for fewer samples
WHITE = 0.11  # correlation time of white noise after the common filter [s]; doubled, all evidence is halved
BLOCK = 1.0  # length of the blocks of time that count as independent [s]; doubled, tests by block have fewer degrees of freedom


@dataclass(frozen=True)
class Bench:
    """Recordings made ready for comparing models.

    Attributes:
        prepared: The recordings.
        identify: Whether the links' inertial parameters are unknown.
        belief: Prior of these parameters: mean (10, n) and precision matrix (10 n, 10 n), as `inertial_parameters.precision` gives
            it. A few recordings determine only some of them.
        of: All recordings, if these are a part of them; otherwise empty.
        signatures: Cache of filtered signatures.
    """

    prepared: tuple[Prepared, ...]
    identify: bool
    belief: tuple[np.ndarray, np.ndarray] | None = None
    of: tuple[Prepared, ...] = ()
    signatures: SignatureCache = field(default_factory=SignatureCache, compare=False, repr=False)

    def on(self, prepared: tuple[Prepared, ...]) -> "Bench":
        """The bench of other recordings, with an empty cache."""
        return replace(self, prepared=prepared, signatures=SignatureCache())

    def part(self, keep: Sequence[int]) -> "Bench":
        """The bench of some of the recordings."""
        return replace(self, prepared=tuple(self.prepared[i] for i in keep), of=self.whole)

    @property
    def whole(self) -> tuple[Prepared, ...]:
        """All recordings; their motions determine which trials are made."""
        return self.of or self.prepared

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.prepared[0].measured)

    @property
    def groups(self) -> tuple[str, ...]:
        """Physical set-up of each recording, in their order."""
        return tuple(p.recording.group for p in self.prepared)

    @property
    def labels(self) -> tuple[str, ...]:
        """The distinct groups."""
        return tuple(dict.fromkeys(self.groups))

    @cached_property
    def edges(self) -> np.ndarray:
        """First row of each recording, and the number of rows, (R + 1,)."""
        return np.cumsum([0, *(len(kept_rows(p.recording)[0]) for p in self.prepared)]).astype(int)

    @cached_property
    def torque(self) -> np.ndarray:
        """Standard deviation of each joint's recorded torque, (n,) [Nm]."""
        return np.concatenate([p.measured for p in self.prepared], axis=1).std(axis=1)

    def believed(self, inertial: np.ndarray) -> np.ndarray:
        """The prior of inertial parameters as normal equations of (derivatives, residual), linearised at `inertial` (10, n).

        (10 n + 1, 10 n + 1); (1, 1) where they are known. It is weighted like correlated rows, of which each counts for less than one.
        """
        size = inertial.size if self.identify else 0
        result = np.zeros((size + 1, size + 1))
        if self.belief is not None:
            mean, precision = self.belief
            off = (mean - inertial).T.ravel()
            result[:-1, :-1], result[-1, -1] = precision, off @ precision @ off
            result[:-1, -1] = result[-1, :-1] = precision @ off
        return result * CORRELATION / STRIDE

    def within(self, scope: Sequence[str] | None) -> np.ndarray:
        """1 for each recording of these groups (None: all groups), else 0; (R,)."""
        return np.array([1.0 if scope is None or g in scope else 0.0 for g in self.groups])

    def least_payload(self, scope: Sequence[str] | None) -> float:
        """The smallest listed payload in recordings of these groups (None: all groups) [kg]."""
        inside = zip(self.prepared, self.within(scope), strict=True)
        return min((float(p.recording.payload.min()) for p, there in inside if there), default=0.0)

    def by_block(self, values: np.ndarray) -> np.ndarray:
        """Sums of values (M, …) over blocks of `BLOCK` seconds, none of which contains rows of two recordings."""
        step = max(1, round(BLOCK / STRIDE))
        starts = np.concatenate([np.arange(a, b, step) for a, b in itertools.pairwise(self.edges)])
        return np.add.reduceat(values, starts, axis=0)


def independent(found: Rows) -> np.ndarray:
    """Effective sample size of each joint's residuals (n,)."""
    return found.moving.sum(axis=1) * STRIDE / correlation_time(found)


def correlation_time(found: Rows) -> np.ndarray:
    """Integral of each joint's autocorrelation of residuals, (n,) [s]; at least that of filtered white noise."""
    lags, result = int(LONGEST / STRIDE), []
    for r in found.residual:
        pieces = [r[s] for s in found.stretches]
        power = sum(float(p @ p) for p in pieces) or 1.0
        rho = (sum(float(p[k:] @ p[:-k]) for p in pieces if len(p) > k) / power for k in range(1, lags))
        signal = itertools.takewhile(lambda x: x > 0.05, rho)  # the rest is noise
        result.append(max(WHITE, STRIDE * (1 + 2 * sum(signal))))
    return np.array(result)


@dataclass(frozen=True)
class Fitted:
    """A model fitted to a bench.

    Attributes:
        model: The model at its estimates.
        rows: Its residuals and derivatives.
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
        """Effective sample size of each joint (n,)."""
        return independent(self.rows)

    def better_than(self, other: "Fitted") -> float:
        """Growth of twice the log-likelihood over another fit of the same rows.

        Each joint has the effective sample size of the fit with the smaller residual, since the larger one may be autocorrelated.
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
    at = fit.minimum(fit.start(model, shape), replace(OPTIONS, steps=steps + bool(shape)))
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
        inside = np.repeat(bench.within(scope), np.diff(bench.edges))
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

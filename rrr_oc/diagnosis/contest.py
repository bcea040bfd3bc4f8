"""Comparison of each selected effect with all alternatives in its place: better ones replace it, equal ones are its rivals."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term, nominal_term
from rrr_oc.diagnosis.candidate_fits import (
    EXACT_FITS,
    FEWER_LEFT,
    Choice,
    black_box_evidence,
    fit_of,
    gathered,
    noisy,
    present,
    rarity,
)
from rrr_oc.diagnosis.evidence import Candidate, Evidence, Key, scope_cost
from rrr_oc.diagnosis.fitting import SAME, Bench, Fitted, extended, refit, refit_with_widths, rewidened, with_term, without
from rrr_oc.diagnosis.selection import Found, least
from rrr_oc.diagnosis.signatures import view
from rrr_oc.effects import CATALOGUE, Effect

EXACT_WITHIN = 10.0  # multiple of `SAME` within which two models are compared by exact fits; twice as much costs time
MANY_PARAMETERS = 3  # number above which an effect may be replaced by two simpler ones; doubled: seldom
NEAR = 0.6  # share of the present likelihood that an alternative needs for a fit; a larger share tries fewer
PAIRS = 6  # pairs of effects that are fitted; more cost time
RIPPLES = 4  # ripples of one joint above which a series over position describes them; twice as many lists more ripples
AT_REST = 0.5  # ratio of squared errors at rest below which a model is preferred to its equal; a smaller one decides less often


@dataclass(frozen=True)
class Finding:
    """An effect that the plain model lacks.

    Attributes:
        term: The effect as a term of the extended model.
        likelihood: Fall of twice the log-likelihood when the term is removed.
        dimensions: Number of its linear coefficients.
        tests: Number of effects at their joints that competed.
        rivals: Names and joints of effects that explain the recordings as well in its place.
    """

    term: Term
    likelihood: float
    dimensions: int
    tests: int
    rivals: tuple[Key, ...] = ()

    @property
    def p_value(self) -> float:
        """P-value of the likelihood ratio, corrected for all tests (Bonferroni)."""
        return float(min(1.0, self.tests * chi2.sf(self.likelihood, self.dimensions)))


@dataclass(frozen=True)
class _Place:
    """The place of one selected effect in a model, where alternatives are compared with it.

    Attributes:
        bench: The recordings.
        fitted: The model with the effect, fitted.
        less: The model without it, fitted.
        i: Index of its term.
        evidence: Evidence at `less`, under the noise of `fitted`.
        far_above_noise: Whether the selection ended far above the noise, where small effects absorb the errors of others.
    """

    bench: Bench
    fitted: Fitted
    less: Fitted
    i: int
    evidence: Evidence
    far_above_noise: bool

    @property
    def own(self) -> Term:
        """The effect's term."""
        return self.fitted.model.terms[self.i]

    def fit(self, candidate: Candidate) -> Fitted:
        """The model with an alternative in place of the effect; fitted exactly where the comparison is close."""
        tried = fit_of(self.bench, self.evidence, self.less, candidate)
        if tried.better_than(self.fitted) > -EXACT_WITHIN * SAME:
            tried = refit(self.bench, tried.model)
            if self.own.effect.width is not None or candidate.trial.effect.width is not None:
                tried = rewidened(self.bench, tried)  # it may imply another width of dry friction
        return tried

    def lead(self, candidate: Candidate, tried: Fitted) -> float:
        """By how much an alternative is preferred: twice the log-likelihood ratio, fewer parameters, prior, error at rest."""
        own, effect = self.own, candidate.trial.effect
        better, simpler = tried.better_than(self.fitted), self.simpler(candidate)
        mounted = 0 if candidate.scope is None or self.far_above_noise else _mountable(effect) - _mountable(own.effect)
        lead = better + (simpler + 2 * mounted) * SAME
        if simpler <= 0:  # an effect with fewer parameters keeps its full evidence
            lead -= rarity(self.bench, tried, effect, candidate.scope is None) * tried.better_than(self.less)
        lead += rarity(self.bench, self.fitted, own.effect, own.recordings == "all") * self.fitted.better_than(self.less)
        if abs(better) < SAME:
            lead += 2 * SAME * _nearer_at_rest(self.bench, tried.model, self.fitted.model)
        return lead

    def simpler(self, candidate: Candidate) -> int:
        """Number of parameters that an alternative saves."""
        return len(self.own.estimates) - len(candidate.trial.effect.parameters)

    def alternatives(self) -> tuple[Choice | None, list[Key]]:
        """The best alternative that is preferred to the effect, with its lead as score, and the effects that fit as well."""
        preferred, rivals = [], []
        for candidate in (*_rivals(self), *_sparse(self)):
            tried, simpler = self.fit(candidate), self.simpler(candidate)
            better, lead = tried.better_than(self.fitted), self.lead(candidate, tried)
            worse = SAME * max(simpler, 1) if self.own.effect.black_box else _by_noise(simpler)
            if lead > (0 if simpler > 0 else SAME) and better > -worse:
                preferred.append(Choice(lead, tried, candidate))
            if better > -SAME:
                rivals.append(candidate.key)
        return max(preferred, key=lambda c: c.score, default=None), rivals


def contested(bench: Bench, found: Found, report: Callable[[str], None] = lambda _: None) -> tuple[Fitted, list[Finding]]:
    """The model after each effect was compared with all alternatives in its place, and the findings, largest likelihood first.

    An effect may be replaced by one or two simpler ones, and many ripples by a series.
    """
    fitted, base = found.fitted, len(found.plain.model.terms)
    findings, i, far_above_noise = [], base, bool(noisy(bench, fitted))
    while i < len(fitted.model.terms):
        fitted, rivals = _widened(bench, fitted, i, report), []
        if (equivalent := _equivalent(bench, fitted, i)) is not None:
            own, name = fitted.model.terms[i], equivalent.model.terms[i].effect.name
            if own.groups:
                report(f"{name} takes the place of {own.effect.name}")
                fitted = equivalent
            else:
                rivals = [(name, own.effect.joints)]
        fitted, finding = _settled_in_place(_place(bench, found, fitted, i, far_above_noise), rivals, report)
        if finding is not None:
            findings.append(finding)
            i += 1
    for shortened in (_as_series, _as_fewer):
        shorter = shortened(bench, fitted, base, report)
        if shorter is not fitted:
            return contested(bench, replace(found, fitted=shorter), report)
    order = sorted(range(len(findings)), key=lambda k: -findings[k].likelihood)
    return fitted, [replace(findings[k], term=fitted.model.terms[base + k]) for k in order]


def _place(bench: Bench, found: Found, fitted: Fitted, i: int, far_above_noise: bool) -> _Place:
    """The place of term i, with the fit and the evidence without it."""
    rest = without(fitted.model, fitted.model.terms[i])
    alone = [t.width for t in rest.terms] == [t.width for t in found.plain.model.terms]
    less = found.plain if alone else refit(bench, rest)
    evidence = (found.first if alone else gathered(bench, less.model)).under(fitted.rows)
    return _Place(bench, fitted, less, i, evidence, far_above_noise)


def _settled_in_place(place: _Place, rivals: list[Key], report: Callable[[str], None]) -> tuple[Fitted, Finding | None]:
    """The model with the best of an effect and its alternatives in place, and the finding.

    The finding is None where several effects took the place, which are compared in turn, or where none is needed.
    """
    bench, fitted, less, own, i = place.bench, place.fitted, place.less, place.own, place.i
    best, equals = place.alternatives()
    rivals = [*rivals, *equals]
    several = None if best is not None else _in_ripples(place) or _in_two(place)
    if several is not None:
        count = len(several.model.terms) - len(less.model.terms)
        names = " and ".join(t.effect.name for t in several.model.terms[-count:])
        report(f"{names} take the place of {own.effect.name}")
        return _in_place(bench, i, several.model, count), None
    if best is not None:
        equal = fitted.better_than(best.fitted) > -SAME and not own.effect.black_box
        rivals = [r for r in rivals if r != best.candidate.key] + ([(own.effect.name, own.effect.joints)] if equal else [])
        report(f"{best.candidate.trial.effect.name} takes the place of {own.effect.name}")
        fitted = _in_place(bench, i, best.fitted.model, 1)
    term, likelihood, tests = fitted.model.terms[i], fitted.better_than(less), place.evidence.tests
    if likelihood < least(fitted, i, tests):  # with the present estimates of the others
        report(f"{term.effect.name} is superfluous")
        return less, None
    return fitted, Finding(term, likelihood, len(term.effect.amplitudes), tests, tuple(dict.fromkeys(rivals)))


def _nearer_at_rest(bench: Bench, one: CalibratedModel, other: CalibratedModel) -> int:
    """1 if the first of two equal models has a much smaller squared error at rest, -1 if the second has, else 0.

    Fits ignore samples at rest, where dry friction may take any value below its level; they can still separate equal models.
    """
    squares = [np.full(bench.n, 1e-300), np.full(bench.n, 1e-300)]
    for p in bench.prepared:
        for left, model in zip(squares, (one, other), strict=True):
            left += np.sum(np.where(p.moving, 0.0, p.measured - model.output_torque(p.recording)) ** 2, axis=1)
    fall = float(np.sum(np.log(squares[0] / squares[1])))
    return int(fall < np.log(AT_REST)) - int(-fall < np.log(AT_REST))


def _by_noise(parameters: int) -> float:
    """Gain in twice the log-likelihood that so many parameters (at least one) reach by noise as rarely as one reaches `SAME`."""
    return float(chi2.isf(chi2.sf(SAME, 1), max(parameters, 1)))


def _mountable(effect: Effect) -> bool:
    """Whether the effect is, or belongs to, something that is mounted and taken off between recordings."""
    return effect.scope == "mounted" or "springs" in effect.inputs


def _widened(bench: Bench, fitted: Fitted, i: int, report: Callable[[str], None]) -> Fitted:
    """The model with an effect of some groups extended to all, unless that makes the fit significantly worse."""
    own = fitted.model.terms[i]
    if not own.groups or own.effect.scope in ("mounted", "some"):
        return fitted
    tried = refit(bench, with_term(fitted.model, i, replace(own, recordings="all", groups=())))
    if tried.better_than(fitted) < -scope_cost(len(bench.labels), len(own.groups)):
        return fitted
    report(f"{own.effect.name} is in all recordings")
    return tried


def _equivalent(bench: Bench, fitted: Fitted, i: int) -> Fitted | None:
    """The model with the best of an effect's equivalents in its place, where that explains as much; None without such."""
    own, tried = fitted.model.terms[i], []
    for effect, theta in own.effect.equivalents(own.named):
        other = nominal_term(effect).with_values(np.array(list(theta.values())))
        other = replace(other, recordings=own.recordings, groups=own.groups)
        tried.append(refit(bench, with_term(fitted.model, i, other)))
    best = min(tried, key=lambda f: f.misfit, default=None)
    return best if best is not None and best.better_than(fitted) > -SAME else None


def _sparse(place: _Place) -> list[Candidate]:
    """The best law of which recordings show little, such as a ripple of few cycles, in place of a series over position."""
    bench, less, own = place.bench, place.less, place.own
    if not _over_position(own.effect):
        return []
    seen, j = view(bench.whole, less.model), own.effect.joints[0]
    sparse = [trial for kind in CATALOGUE.values() for trial in kind.sparse_trials(seen, j)]
    return Evidence.gather(bench, less.model, sparse).candidates()[:1]


def _as_series(bench: Bench, fitted: Fitted, base: int, report: Callable[[str], None]) -> Fitted:
    """The model with one series over a joint's position in place of more than `RIPPLES` ripples, which can describe any shape."""
    for j in range(bench.n):
        own = [t for t in fitted.model.terms[base:] if t.effect.joints == (j,)]
        shapes = [t for t in own if t.effect.resembles == "position_harmonic" or _over_position(t.effect)]
        if len(shapes) <= RIPPLES:
            continue
        less = refit(bench, without(fitted.model, *shapes))
        evidence = black_box_evidence(bench, less.model, j)
        every = [c for c in evidence.candidates() if _over_position(c.trial.effect)][:EXACT_FITS]
        best = min((refit(bench, fit_of(bench, evidence, less, c).model) for c in every), key=lambda f: f.misfit, default=less)
        if best.misfit < fitted.misfit + np.log(FEWER_LEFT):
            report("a series over position takes the place of ripples")
            fitted = best
    return fitted


def _as_fewer(bench: Bench, fitted: Fitted, base: int, report: Callable[[str], None]) -> Fitted:
    """The model with one or two laws in place of several effects of a joint that have more parameters, if they fit as well.

    An effect selected first because it resembles the sum of two leaves a residual that resembles further effects.
    """
    for j in range(bench.n):
        own = [t for t in fitted.model.terms[base:] if t.effect.joints == (j,) and not t.groups]
        number = sum(len(t.estimates) for t in own)
        if len(own) < 2:
            continue
        less = refit(bench, without(fitted.model, *own))
        evidence, found = gathered(bench, less.model).under(fitted.rows), []
        alone = [(c,) for c in evidence.candidates() if c.trial.effect.joints == (j,) and c.scope is None]
        simpler = [laws for laws in alone if len(laws[0].trial.effect.parameters) < number]
        for laws in (*simpler[:EXACT_FITS], *evidence.pairs(number, PAIRS, j)):
            if any(present(c, less.model) for c in laws):
                continue
            tried = refit_with_widths(bench, extended(less.model, *(law.term for law in laws)))
            fewer = len(fitted.model.values) - len(tried.model.values)
            better = tried.better_than(fitted)
            if better > -_by_noise(fewer):
                found.append((better + fewer * SAME, tried, laws))
        if found:
            _, shorter, laws = max(found, key=lambda f: f[0])
            report(f"{' and '.join(law.trial.effect.name for law in laws)} instead of {len(own)} effects")
            return shorter
    return fitted


def _over_position(effect: Effect) -> bool:
    """Whether it is a black-box term over the joint's own position."""
    return effect.black_box and effect.depends_on == (("q", effect.joints[0]),)


def _in_ripples(place: _Place) -> Fitted | None:
    """The model with a few ripples and an offset in place of a series over position, if they fit as well; None otherwise."""
    bench, less, fitted, own = place.bench, place.less, place.fitted, place.own
    if not _over_position(own.effect):
        return None
    j, seen, there = own.effect.joints[0], view(bench.whole, less.model), less
    kinds = [kind for part in ("position_harmonic", "constant") for kind in CATALOGUE.values() if kind.resembles == part]
    every = [trial for kind in kinds for trial in kind.trials(seen) if trial.effect.joints == (j,)]
    ripples = sum(t.effect.resembles == "position_harmonic" and t.effect.joints == (j,) for t in less.model.terms)
    for _ in range(RIPPLES + 1):
        evidence = Evidence.gather(bench, there.model, every)
        best = next(iter(evidence.candidates()), None)
        ripples += best is not None and best.trial.effect.resembles == "position_harmonic"
        if best is None or ripples > RIPPLES:
            return None
        there = refit(bench, fit_of(bench, evidence, there, best).model)
        simpler = len(fitted.model.values) - len(there.model.values)
        if simpler > 0 and there.better_than(fitted) > -SAME - simpler:  # each coefficient fits noise by 1 on average
            return there
    return None


def _in_two(place: _Place) -> Fitted | None:
    """The model with two effects in place of one that has more parameters and explains no more; None without such a pair.

    In place of a black-box term, two laws may have more parameters but must explain significantly more.
    """
    bench, less, fitted, own, evidence = place.bench, place.less, place.fitted, place.own, place.evidence
    number, black_box = len(own.estimates), own.effect.black_box
    if number <= MANY_PARAMETERS and not black_box:
        return None
    tried = []
    for pair in evidence.pairs(max(number, 2 * MANY_PARAMETERS + 1) if black_box else number, PAIRS):
        foreseen = Fitted(less.model, replace(less.rows, residual=evidence.left_by(*pair)))
        if foreseen.better_than(less) > NEAR * fitted.better_than(less):
            tried.append(refit(bench, extended(less.model, *(law.term for law in pair))))
    found = min(tried, key=lambda f: f.misfit, default=None)
    if found is None:
        return None
    more = sum(len(t.estimates) for t in found.model.terms[-2:]) - number
    return found if found.better_than(fitted) > (SAME * (1 + max(more, 0)) if black_box else -_by_noise(-more)) else None


def _in_place(bench: Bench, i: int, model: CalibratedModel, count: int) -> Fitted:
    """The model with its last `count` terms moved to place i, fitted."""
    terms = list(model.terms)
    terms[i:i] = terms[-count:]
    return refit(bench, replace(model, terms=tuple(terms[: len(model.terms)])))


def _rivals(place: _Place) -> list[Candidate]:
    """The best alternatives in an effect's place, one for each effect at its joints."""
    model, own = place.less.model, place.own
    result: list[Candidate] = []
    every, itself = place.evidence.candidates(), (own.effect.name, own.effect.joints)
    # the linear prediction is too low for a nonlinear effect and its alternatives alike
    most = max([c.likelihood for c in every if c.key == itself] or [c.likelihood for c in every], default=0.0)
    for candidate in every:
        if candidate.key in (itself, *(c.key for c in result)) or present(candidate, model):
            continue
        if candidate.likelihood < NEAR * most or len(result) >= EXACT_FITS:
            break
        result.append(candidate)
    return result

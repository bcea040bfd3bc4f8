"""Each effect that was found against all others in its place: the better ones take it, the equal ones are named."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term, nominal_term
from rrr_oc.diagnosis.evidence import Bench, Candidate, Evidence, scope_cost
from rrr_oc.diagnosis.fitting import Fitted, refit
from rrr_oc.diagnosis.selection import (
    FEWER_LEFT,
    SAME,
    TRIED,
    Found,
    extended,
    fit_of,
    gathered,
    key,
    least,
    noisy,
    present,
    rarity,
    rewidened,
    unnamed,
    without,
)
from rrr_oc.diagnosis.signatures import view
from rrr_oc.effects import CATALOGUE, Effect

CALL = 10.0  # times `SAME`, within which it takes an exact fit to say which of two models does better
MANY = 3  # parameters, beyond which two effects may be the simpler explanation
NEAR = 0.6  # of the likelihood of what is in place, for others to be fitted there
PAIRS = 6  # of them that are tried
RIPPLES = 4  # at one joint, that may explain what a series over its position does
STILL = 0.5  # of the squared error while a joint stands, that a model must leave to be preferred to its equal


@dataclass(frozen=True)
class Finding:
    """An effect that the model lacked.

    Attributes:
        term: In the model.
        likelihood: What twice the log-likelihood falls by without it.
        dimensions: Coefficients.
        tests: Effects at their joints that competed.
        rivals: Names and joints of effects that do as well in its place.
    """

    term: Term
    likelihood: float
    dimensions: int
    tests: int
    rivals: tuple[tuple[str, tuple[int, ...]], ...] = ()

    @property
    def p_value(self) -> float:
        """Of the likelihood, all trials together."""
        return float(min(1.0, self.tests * chi2.sf(self.likelihood, self.dimensions)))


def contested(bench: Bench, found: Found, report: Callable[[str], None] = lambda _: None) -> tuple[Fitted, list[Finding]]:
    """The model in which each effect holds against all others in its place, and what speaks for each, most important first.

    Simpler effects may take the place of one, too, and a series that of many ripples.
    """
    plain, fitted = found.plain, found.fitted
    base = len(plain.model.terms)
    findings, i, muddled = [], base, bool(noisy(bench, fitted))  # far from the noise, small effects take up what others lack
    while i < len(fitted.model.terms):
        fitted = _widened(bench, fitted, i, report)
        equal = _equivalent(bench, fitted, i)
        if equal is not None and fitted.model.terms[i].groups:
            report(f"{equal.model.terms[i].effect.name} takes the place of {fitted.model.terms[i].effect.name}")
            fitted = equal
        alone = [t.width for t in without(fitted.model, i).terms] == [t.width for t in plain.model.terms]
        less = plain if alone else refit(bench, without(fitted.model, i))
        evidence = (found.first if alone else gathered(bench, less.model)).under(fitted.rows)
        own = fitted.model.terms[i]
        rivals, best = [] if equal is None or own.groups else [(equal.model.terms[i].effect.name, own.effect.joints)], None
        for candidate in (*_rivals(evidence, less.model, own), *_sparse(bench, less, own)):
            tried = fit_of(bench, evidence, less, candidate)
            if tried.better_than(fitted) > -CALL * SAME:
                tried = refit(bench, tried.model)
                if own.effect.width is not None or candidate.trial.effect.width is not None:
                    tried = rewidened(bench, tried)  # it may show another width of dry friction
            better = tried.better_than(fitted)
            simpler = len(own.estimates) - len(candidate.trial.effect.parameters)
            likelier = 0 if candidate.scope is None or muddled else _put_on(candidate.trial.effect) - _put_on(own.effect)
            lead = better + (simpler + 2 * likelier) * SAME
            if simpler <= 0:  # the simplest of equals needs no excuse
                lead -= rarity(bench, tried, candidate.trial.effect, candidate.scope is None) * tried.better_than(less)
            lead += rarity(bench, fitted, own.effect, own.recordings == "all") * fitted.better_than(less)
            if abs(better) < SAME:
                lead += 2 * SAME * _nearer_at_rest(bench, tried.model, fitted.model)
            worse = SAME * max(simpler, 1) if own.effect.black_box else _by_noise(simpler)
            if lead > (0 if simpler > 0 else SAME) and better > -worse and (best is None or lead > best[0]):
                best = (lead, tried, candidate)
            if better > -SAME:
                rivals.append((candidate.trial.effect.name, candidate.trial.effect.joints))
        several = None
        if best is None:
            several = _in_ripples(bench, less, fitted, own) or _in_two(bench, less, fitted, own, evidence)
        if several is not None:
            count = len(several.model.terms) - len(less.model.terms)
            names = " and ".join(t.effect.name for t in several.model.terms[-count:])
            report(f"{names} take the place of {own.effect.name}")
            fitted = _in_place(bench, i, several.model, count)
            continue  # with these in its place
        if best is not None:
            ousted = (own.effect.name, own.effect.joints)
            taker = (best[2].trial.effect.name, best[2].trial.effect.joints)
            equal = fitted.better_than(best[1]) > -SAME and not own.effect.black_box
            rivals = [r for r in rivals if r != taker] + ([ousted] if equal else [])
            report(f"{best[1].model.terms[-1].effect.name} takes the place of {own.effect.name}")
            fitted = _in_place(bench, i, best[1].model, 1)
        if fitted.better_than(less) < least(fitted, i, evidence.tests):  # beside what the others have become
            report(f"{fitted.model.terms[i].effect.name} is superfluous")
            fitted = less
            continue
        dimensions = len(fitted.model.terms[i].effect.amplitudes)
        findings.append(
            Finding(
                fitted.model.terms[i],
                fitted.better_than(less),
                dimensions,
                evidence.tests,
                tuple(dict.fromkeys(rivals)),
            )
        )
        i += 1
    for shortened in (_as_series, _as_fewer):
        shorter = shortened(bench, fitted, base, report)
        if shorter is not fitted:
            return contested(bench, replace(found, fitted=shorter), report)
    order = sorted(range(len(findings)), key=lambda k: -findings[k].likelihood)
    return fitted, [replace(findings[k], term=fitted.model.terms[base + k]) for k in order]


def _nearer_at_rest(bench: Bench, one: CalibratedModel, other: CalibratedModel) -> int:
    """1 where one of two equal models errs much less while a joint stands, -1 where the other does, else 0.

    Those samples count for nothing in a fit, as dry friction is anything below its level there; but it may well be none.
    """
    squares = [np.full(bench.n, 1e-300), np.full(bench.n, 1e-300)]
    for p in bench.prepared:
        for left, model in zip(squares, (one, other), strict=True):
            left += np.sum(np.where(p.moving, 0.0, p.measured - model.output_torque(p.recording)) ** 2, axis=1)
    fall = float(np.sum(np.log(squares[0] / squares[1])))
    return int(fall < np.log(STILL)) - int(-fall < np.log(STILL))


def _by_noise(parameters: int) -> float:
    """What so many parameters more, as one if none, gain where there is but noise, as seldom as one gains `SAME`."""
    return float(chi2.isf(chi2.sf(SAME, 1), max(parameters, 1)))


def _put_on(effect: Effect) -> bool:
    """Whether it is, or comes with, what is put on and taken off between recordings."""
    return effect.scope == "mounted" or "springs" in effect.inputs


def _widened(bench: Bench, fitted: Fitted, i: int, report: Callable[[str], None]) -> Fitted:
    """The model with an effect of some groups in all of them, where the effects that were found later leave no reason for less."""
    own = fitted.model.terms[i]
    if not own.groups or own.effect.scope in ("mounted", "some"):
        return fitted
    everywhere = replace(own, recordings="all", groups=())
    terms = (*fitted.model.terms[:i], everywhere, *fitted.model.terms[i + 1 :])
    tried = refit(bench, replace(fitted.model, terms=terms))
    if tried.better_than(fitted) < -scope_cost(len(bench.labels), len(own.groups)):
        return fitted
    report(f"{own.effect.name} is everywhere")
    return tried


def _equivalent(bench: Bench, fitted: Fitted, i: int) -> Fitted | None:
    """The model with the best of an effect's equivalents in its place, where that explains as much; None without such."""
    own, tried = fitted.model.terms[i], []
    for effect, theta in own.effect.equivalents(own.named):
        other = nominal_term(effect).with_values(np.array(list(theta.values())))
        other = replace(other, recordings=own.recordings, groups=own.groups)
        terms = (*fitted.model.terms[:i], other, *fitted.model.terms[i + 1 :])
        tried.append(refit(bench, replace(fitted.model, terms=terms)))
    best = min(tried, key=lambda f: f.misfit, default=None)
    return best if best is not None and best.better_than(fitted) > -SAME else None


def _sparse(bench: Bench, less: Fitted, own: Term) -> list[Candidate]:
    """The best law of which recordings see little, such as a ripple of few cycles, in the place of a series over position."""
    if not _over_position(own.effect):
        return []
    seen, j = view(bench.whole, less.model), own.effect.joints[0]
    sparse = [trial for kind in CATALOGUE.values() for trial in kind.sparse_trials(seen, j)]
    return Evidence.gather(bench, less.model, sparse).candidates()[:1]


def _as_series(bench: Bench, fitted: Fitted, base: int, report: Callable[[str], None]) -> Fitted:
    """The model with one series over a joint's position where there are more than a few ripples: any shape is a sum of these."""
    for j in range(bench.n):
        own = [t for t in fitted.model.terms[base:] if t.effect.joints == (j,)]
        shapes = [t for t in own if t.effect.resembles == "position_harmonic" or _over_position(t.effect)]
        if len(shapes) <= RIPPLES:
            continue
        less = refit(bench, replace(fitted.model, terms=tuple(t for t in fitted.model.terms if t not in shapes)))
        evidence = unnamed(bench, less.model, j)
        every = [c for c in evidence.candidates() if _over_position(c.trial.effect)][:TRIED]
        best = min((refit(bench, fit_of(bench, evidence, less, c).model) for c in every), key=lambda f: f.misfit, default=less)
        if best.misfit < fitted.misfit + np.log(FEWER_LEFT):
            report("a series over position takes the place of ripples")
            fitted = best
    return fitted


def _as_fewer(bench: Bench, fitted: Fitted, base: int, report: Callable[[str], None]) -> Fitted:
    """The model with one or two laws in the place of several effects of a joint that have more parameters, if they do as well.

    One that was found first, as it looks most like the sum of two, leaves a rest that looks like others.
    """
    for j in range(bench.n):
        own = [t for t in fitted.model.terms[base:] if t.effect.joints == (j,) and not t.groups]
        number = sum(len(t.estimates) for t in own)
        if len(own) < 2:
            continue
        less = refit(bench, replace(fitted.model, terms=tuple(t for t in fitted.model.terms if t not in own)))
        evidence, best = gathered(bench, less.model).under(fitted.rows), None
        alone = [(c,) for c in evidence.candidates() if c.trial.effect.joints == (j,) and c.scope is None]
        simpler = [laws for laws in alone if len(laws[0].trial.effect.parameters) < number]
        for laws in (*simpler[:TRIED], *evidence.pairs(number, PAIRS, j)):
            if any(present(c, less.model) for c in laws):
                continue
            model = less.model
            for law in laws:
                model = extended(model, law)
            tried = rewidened(bench, refit(bench, model))
            fewer = len(fitted.model.values) - len(tried.model.values)
            better = tried.better_than(fitted)
            if better > -_by_noise(fewer) and (best is None or better + fewer * SAME > best[0]):
                best = better + fewer * SAME, tried, laws
        if best is not None:
            names = " and ".join(law.trial.effect.name for law in best[2])
            report(f"{names} instead of {len(own)} effects")
            return best[1]
    return fitted


def _over_position(effect: Effect) -> bool:
    """Whether it is a torque of a joint's own position that no law stands behind."""
    return effect.black_box and effect.depends_on == (("q", effect.joints[0]),)


def _in_ripples(bench: Bench, less: Fitted, fitted: Fitted, own: Term) -> Fitted | None:
    """The model with a few ripples about some mean in the place of a series over a joint's own position, if they do as well."""
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
        if simpler > 0 and there.better_than(fitted) > -SAME - simpler:  # each coefficient fits noise, too
            return there
    return None


def _in_two(bench: Bench, less: Fitted, fitted: Fitted, own: Term, evidence: Evidence) -> Fitted | None:
    """The model with two effects in the place of one with more parameters that explains no more; None without such.

    Two laws of the catalogue must explain more than a term that is none, if need be with more parameters.
    """
    number, unnamed_ = len(own.estimates), own.effect.black_box
    if number <= MANY and not unnamed_:
        return None
    tried = []
    for pair in evidence.pairs(max(number, 2 * MANY + 1) if unnamed_ else number, PAIRS):
        foreseen = Fitted(less.model, replace(less.rows, residual=evidence.left_by(*pair)))
        if foreseen.better_than(less) > NEAR * fitted.better_than(less):
            tried.append(refit(bench, extended(extended(less.model, pair[0]), pair[1])))
    found = min(tried, key=lambda f: f.misfit, default=None)
    if found is None:
        return None
    more = sum(len(t.estimates) for t in found.model.terms[-2:]) - number
    return found if found.better_than(fitted) > (SAME * (1 + max(more, 0)) if unnamed_ else -_by_noise(-more)) else None


def _in_place(bench: Bench, i: int, model: CalibratedModel, count: int) -> Fitted:
    """The model with its last terms moved to number i, fitted."""
    terms = list(model.terms)
    terms[i:i] = terms[-count:]
    return refit(bench, replace(model, terms=tuple(terms[: len(model.terms)])))


def _rivals(evidence: Evidence, model: CalibratedModel, own: Term) -> list[Candidate]:
    """The best candidates in an effect's place other than itself, one for each effect at its joints."""
    result: list[Candidate] = []
    every = evidence.candidates()
    itself = [key(c) == (own.effect.name, own.effect.joints) for c in every]
    most = max((c.likelihood for c in every), default=0.0)  # what is not linear is foreseen too low, as its rivals are
    most = max((c.likelihood for c, own_ in zip(every, itself, strict=True) if own_), default=most)
    for candidate, own_ in zip(every, itself, strict=True):
        if own_ or any(key(c) == key(candidate) for c in result) or present(candidate, model):
            continue
        if candidate.likelihood < NEAR * most or len(result) >= TRIED:
            break
        result.append(candidate)
    return result

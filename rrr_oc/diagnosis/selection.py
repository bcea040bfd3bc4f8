"""Which physics a calibrated model lacks: candidates compete after all parameters are estimated anew with each of them.

Forward: the trial with the most evidence joins the model, is fitted with everything else on the exact equations, and what it made
superfluous leaves again, until nothing is left beyond chance.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.friction_width import best_width, widened, with_widths
from rrr_oc.calibration.least_squares import normal_equations
from rrr_oc.calibration.regression import Rows
from rrr_oc.calibration.samples import noise
from rrr_oc.diagnosis.evidence import Bench, Candidate, Evidence, chance, robust_p, significant
from rrr_oc.diagnosis.fitting import Fitted, as_abrupt, refit, steadily_better, with_turn
from rrr_oc.diagnosis.signatures import trials, view
from rrr_oc.effects import CATALOGUE, Effect
from rrr_oc.effects.black_box.empirical import Empirical
from rrr_oc.effects.friction.dry_friction import DryFriction
from rrr_oc.effects.friction.load_dependent_friction import LoadDependentFriction
from rrr_oc.effects.friction.position_dependent_friction import PositionDependentFriction
from rrr_oc.numerics.rank import pseudo_inverse
from rrr_oc.numerics.smooth import TURNS

MOST = 12  # effects
TRIED = 5  # candidates that are fitted exactly in each round
CLOSE = 0.4  # of the best score, for a candidate to be tried
DOUBT = 0.05  # p-value of the robust test, all effects together
CONFIRMED = 0.3  # of the fall of the squared residual in the fit, that recordings left out of it must show
LEAST_SHARE = 0.007  # of a joint's squared residual, for an effect to be named
APART = 0.1  # of a parameter, by which it must differ between recordings to be another in each
LESS_LEFT = 0.8  # of the squared residual: what that must leave far from the noise, where it takes up what else is missing
FEWER_LEFT = 2.0  # times less of the squared residual: better, however few independent rows that leaves
HALF = 0.5  # of what a joint lacks
EXACT = 3e-4  # of a joint's torque (deviation): no law, and no simulation, is more exact than that
FLOOR = 1.1  # of the deviation that the noise accounts for
MARGIN = 1.1  # by which an empirical term must do better than a law of the catalogue
RARE = 0.25  # of the evidence for what is mounted in all recordings and listed in none
BY_LOAD = (
    0.7  # of the evidence for friction over position: beyond it that over load, in slow motion all but the same, goes first
)
TOGETHER = 4  # effects that may explain what an empirical term does
HOPELESS = 0.25  # of what it explains, that two of them must
NEARLY = 0.8  # of the best score, for a torque that begins at an edge to be looked at more closely
EDGES_APART, LEAST_STEP = 0.05, 0.002  # of a range: first step towards where a torque begins, and below which there is none
ROUGH = 0.05  # of a width that several laws share, until that of dry friction alone is looked for again
SAME = 9.0  # twice the log-likelihood within which two models do equally well
DOUBTFUL = 3.0  # times what an effect must be worth, as foreseen, below which it is tried without it
Lawless = Literal["beside", "after", "never"]
Key = tuple[str, tuple[int, ...]]  # name and joints of an effect
Best = tuple[float, Fitted, Candidate]  # score, fit with it, candidate


@dataclass(frozen=True)
class Found:
    """What a search ended with.

    Attributes:
        plain: The model that it began with, fitted.
        fitted: With the effects, its last terms.
        first: The evidence at the plain model.
    """

    plain: Fitted
    fitted: Fitted
    first: Evidence


def search(
    bench: Bench, model: CalibratedModel, report: Callable[[str], None] = lambda _: None, lawless: Lawless = "beside"
) -> Found:
    """The model with the effects that the recordings hold beyond chance.

    Args:
        report: Is told what happens, a line at a time.
        lawless: Whether torques that no law of the catalogue describes are looked for beside those of the catalogue, after them,
            or never.
    """
    base = len(model.terms)
    plain = fitted = refit(bench, model)
    first = evidence = gathered(bench, fitted.model)
    planned: list[Key] = []
    seen: set[frozenset] = set()
    while len(fitted.model.terms) - base < MOST:
        chosen, planned = _next(bench, evidence, plain, fitted, lawless, planned, report)
        if chosen is None:
            break
        chosen = _each_its_own(bench, chosen, report)
        fitted = rewidened(bench, _pruned(bench, plain, chosen, base, evidence.tests, report))
        terms = frozenset(Counter((_whatever_range(t.effect), t.groups) for t in fitted.model.terms[base:]).items())
        if terms in seen:
            break  # two ways to say the same would oust each other for ever
        seen.add(terms)
        evidence = gathered(bench, fitted.model)
    return Found(plain, fitted, first)


def _each_its_own(bench: Bench, fitted: Fitted, report: Callable[[str], None]) -> Fitted:
    """The fit with the newest effect, of some groups, with parameters of its own in each, where these are others beyond doubt.

    Of what is put on and taken off, of sensors, which are set anew, and of what no law stands behind; a law of the drives stays
    what it is.
    """
    *others, newest = fitted.model.terms
    if len(newest.groups) < 2 or not (newest.effect.mounted or newest.effect.side == "sensor" or newest.effect.lawless):
        return fitted
    each = [replace(newest, groups=(g,)) for g in newest.groups]
    tried = refit(bench, replace(fitted.model, terms=(*others, *each)))
    values = np.array([t.values for t in tried.model.terms[len(others) :]])
    apart = np.any(np.ptp(values, axis=0) > APART * np.abs(values).max(axis=0))
    if noisy(bench, tried):
        apart &= tried.misfit < fitted.misfit + np.log(LESS_LEFT)
    if not apart or tried.better_than(fitted) < chance(values.size - values.shape[1], fitted.counts, len(each)):
        return fitted
    report(f"{newest.effect.name} is another in each")
    return tried


def _whatever_range(effect: Effect) -> Effect:
    """The effect, of a series without its range, which changes a little with all else that a model has."""
    return replace(effect, low=(), high=(), largest=0.0) if isinstance(effect, Empirical) else effect


def rewidened(bench: Bench, fitted: Fitted) -> Fitted:
    """The fit with dry friction as abrupt as the new model shows it; what was missing had distorted it.

    With its course over speed left open and as it is: which is right depends on what is still missing.
    """
    tried = {tuple(t.width for t in fitted.model.terms): fitted}
    for free in (True, False):
        model = with_widths(bench.prepared, fitted.model, free)
        widths = tuple(t.width for t in model.terms)
        if widths not in tried:
            tried[widths] = refit(bench, model)
    return _widened_together(bench, min(tried.values(), key=lambda f: f.misfit))


def _widened_together(bench: Bench, fitted: Fitted) -> Fitted:
    """The fit with the newest law and all other friction of its joint as abrupt as each other, where that is better beyond doubt.

    A wide dry friction beside an abrupt newer law, or the reverse, may do worse than both as they are. Bristles may also turn at
    once.
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


def _best_unnamed(bench: Bench, j: int, plain: Fitted, fitted: Fitted) -> Best | None:
    evidence = unnamed(bench, fitted.model, j)
    every = [e for e in (evidence, _at_its_edge(evidence)) if e is not None]
    found = [_best(bench, e, contenders(e, fitted.model), plain, fitted) for e in every]
    return max((b for b in found if b is not None), key=lambda b: b[0], default=None)


def _at_its_edge(evidence: Evidence) -> Evidence | None:
    """The evidence for the best torque that begins at an edge, from where it explains most and not only from one of a few places."""
    every, step, there = evidence.candidates(), EDGES_APART, None
    best = next((c for c in every if isinstance(c.trial.effect, Empirical) and c.trial.effect.edges), None)
    if best is None or best.score < NEARLY * every[0].score:
        return None
    effect, seen = best.trial.effect, view(evidence.bench.whole, evidence.model)
    while step > LEAST_STEP and isinstance(effect, Empirical):
        there = Evidence.gather(evidence.bench, evidence.model, [e.trial(seen) for e in (effect, *effect.near(step))])
        scores = {c.trial.effect: c.score for c in there.candidates()}
        nearest = max(scores, key=lambda e: (scores[e], e == effect), default=effect)  # of equals, where it is
        effect, step = nearest, step / 2 if nearest == effect else step
    return there


def _exactly(bench: Bench, fitted: Fitted, best: Best) -> Best:
    """The same with the fit and the score that all parameters together reach."""
    there = rewidened(bench, refit(bench, best[1].model))
    return max(best[0], there.better_than(fitted) - best[2].penalty), there, best[2]


def _size(*candidates: Candidate) -> int:
    return sum(len(c.trial.effect.parameters) for c in candidates)


def unnamed(bench: Bench, model: CalibratedModel, j: int) -> Evidence:
    """The evidence for torques on a joint that no law of the catalogue describes."""
    seen, ranges = view(bench.whole, model), _ranges(bench, model)
    every = [trial for kind in CATALOGUE.values() if kind.lawless for trial in kind.unnamed(seen, j, ranges, model.torque)]
    return Evidence.gather(bench, model, every)


def _ranges(bench: Bench, model: CalibratedModel) -> dict[tuple[str, int], tuple[float, float]]:
    """Least and greatest of what a torque may depend on, as the recordings show it, by name and joint."""
    seen, torques = view(bench.prepared, model), [model.torques(p.recording) for p in bench.prepared]
    motor, load = (np.concatenate(parts, axis=1) for parts in zip(*torques, strict=True))
    acceleration = np.quantile(np.concatenate([np.abs(p.recording.ddq) for p in bench.prepared], axis=1), 0.99, axis=1)
    found = {("time", -1): (0.0, float(seen.duration))}
    for i in range(bench.n):
        for name, size in (("dq", float(seen.speed[i])), ("ddq", max(float(acceleration[i]), 1e-3))):
            found[name, i] = (-size, size)
        for name, low, high in (
            ("q", seen.low[i], seen.high[i]),
            ("load", load[i].min(), load[i].max()),
            ("motor", motor[i].min(), motor[i].max()),
        ):
            found[name, i] = (float(low), max(float(high), float(low) + 1e-6))
    return found


def as_seen(bench: Bench, model: CalibratedModel, terms: Sequence[Term]) -> tuple[Term, ...]:
    """The terms for a fit to other recordings: series begin anew, over the ranges that these show and beyond which nothing is known."""
    series = [isinstance(t.effect, Empirical) and not t.effect.edges for t in terms]
    if not any(series):
        return tuple(terms)
    result, ranges = [], _ranges(bench, model)
    for term, anew in zip(terms, series, strict=True):
        if anew and isinstance(term.effect, Empirical):
            low, high = np.array([ranges[v] for v in term.effect.variables]).T
            low, high = np.maximum(low, term.effect.low), np.minimum(high, term.effect.high)
            effect = replace(term.effect, low=tuple(low.tolist()), high=tuple(np.maximum(high, low + 1e-6).tolist()))
            term = replace(term, effect=effect).with_values(0 * term.values)
        result.append(term)
    return tuple(result)


def gathered(bench: Bench, model: CalibratedModel) -> Evidence:
    """The evidence for every trial at a model."""
    seen = view(bench.whole, model)
    return Evidence.gather(bench, model, trials(seen, model.torque))


def _next(
    bench: Bench, evidence: Evidence, plain: Fitted, fitted: Fitted, lawless: Lawless, planned: list[Key], report
) -> tuple[Fitted | None, list[Key]]:
    """The model with the best further effect, or empirical term where no effects come near it; None where all is chance.

    And the effects that are then to come before any empirical term; `planned` are those to come now.
    """
    named = _best(bench, evidence, contenders(evidence, fitted.model), plain, fitted)
    joints = noisy(bench, fitted) if named is None else [_joint(evidence, named[2])]
    as_planned = named is not None and key(named[2]) in planned[:1]
    if lawless == "never" or (lawless == "after" and named is not None) or as_planned:
        joints = []
    others = [_best_unnamed(bench, j, plain, fitted) for j in joints]
    other = max((o for o in others if o is not None), key=lambda o: o[0], default=None)
    chosen, planned = named or other, planned[1:] if as_planned else []
    if chosen is None:
        return None, []
    if named is not None and other is not None and other[0] > _bar(named, other):
        other = _exactly(bench, fitted, other)
        everywhere = other[2].scope is None  # several laws at once, in some recordings only, are no likelier
        laws = _as_good(bench, plain, fitted, named, other) if everywhere else None
        if laws is None and not _beside(bench, joints[0], plain, named, other):
            chosen = other
        planned = laws or []
    report(f"{described(chosen[2], fitted.model)}: evidence {chosen[0]:.0f}")
    if chosen[2].trial.effect.abrupt:
        return _best_start(bench, chosen[1].model, (0.8, 1.0, 1.2)), planned
    return refit(bench, chosen[1].model), planned


def _bar(named: Best, other: Best) -> float:
    """Score that an empirical term must reach to be preferred to a law; friction changes in some recordings, but not its law.

    A law that explains as much is the likelier one, however few parameters the term has.
    """
    changed = named[2].scope is not None and other[2].scope is not None and named[2].trial.effect.side == "drive"
    as_much = named[0] + named[2].penalty - other[2].penalty + SAME
    return named[0] if changed else max(MARGIN * named[0] + SAME, as_much)


def _as_good(bench: Bench, plain: Fitted, fitted: Fitted, named: Best, other: Best) -> list[Key] | None:
    """The further effects that together with one explain as much as an empirical term; None without such."""
    best, found, cost, goal, series = named, [], 0.0, other[0], other[2].trial.effect
    while best is not None and len(found) < TOGETHER:
        found.append(key(best[2]))
        cost += best[2].penalty
        there = rewidened(bench, refit(bench, best[1].model))
        reached = there.better_than(fitted) - cost
        if reached < goal and len(found) == 1 and series.of_speed:  # it may also say how friction changes sign
            reached = max(reached, _turned(bench, there, series.joints[0]).better_than(fitted) - cost)
        if reached >= goal:
            return found[1:]
        if len(found) > 1 and reached < HOPELESS * goal:
            return None
        evidence = gathered(bench, there.model)
        best = _best(bench, evidence, contenders(evidence, there.model), plain, there)
    return None


def _turned(bench: Bench, fitted: Fitted, j: int) -> Fitted:
    """The fit with a joint's dry friction changing sign in the way that leaves least; a series over its speed may say no more."""
    terms, tanh = fitted.model.terms, DryFriction((j,))
    number = next((i for i, t in enumerate(terms) if t.effect == tanh), None)
    if number is None:
        return fitted
    tried = [as_abrupt(bench, replace(fitted.model, terms=with_turn(terms, number, turn))) for turn in TURNS if turn != "tanh"]
    return min([fitted, *tried], key=lambda f: f.misfit)


def _beside(bench: Bench, j: int, plain: Fitted, named: Best, other: Best) -> bool:
    """Whether an effect and a simpler empirical term explain more than an empirical term."""
    both = _best_unnamed(bench, j, plain, refit(bench, named[1].model))
    return both is not None and named[0] + both[0] >= MARGIN * other[0] + SAME and _size(both[2], named[2]) < _size(other[2])


def fit_of(bench: Bench, evidence: Evidence, fitted: Fitted, candidate: Candidate) -> Fitted:
    """The model with a candidate, fitted; where all is linear, as the evidence has it already."""
    model, effect = extended(fitted.model, candidate), candidate.trial.effect
    if effect.abrupt:
        return _best_start(bench, model, (1.0,), fitted.rows)
    if not effect.linear:
        return refit(bench, model, without_last=fitted.rows)
    return Fitted(model, replace(fitted.rows, residual=evidence.left_by(candidate)))


def _best(bench: Bench, evidence: Evidence, candidates: Sequence[Candidate], plain: Fitted, fitted: Fitted) -> Best | None:
    """Score, fit and candidate of the best that is beyond chance and explains a share of the error worth a name."""
    found: list[Best] = []
    for candidate in candidates:
        tried = fit_of(bench, evidence, fitted, candidate)
        gain = tried.better_than(fitted)
        score = gain - candidate.penalty
        share = _share(bench, plain, fitted, tried)
        steady = (
            _by_amplitude(candidate.trial.effect)
            or steadily_better(bench, tried, fitted, candidate.scope)
            or ((_most_of_some(candidate, share) or not noisy(bench, tried)) and _settled(evidence, candidate))
        )
        last = tried.model.terms[-1]
        possible = last.effect.possible(last.named, bench.least_payload(candidate.scope))
        if gain > candidate.least and share > LEAST_SHARE and steady and possible:
            score -= rarity(bench, tried, candidate.trial.effect, candidate.scope is None) * gain
            found.append((score, tried, candidate))
    best = max(found, key=lambda b: b[0], default=None)
    equal = [b for b in found if best is not None and b[0] > best[0] - SAME]
    if len(equal) > 1:  # as things are; but each may show another width of dry friction
        there = [rewidened(bench, refit(bench, tried.model)) for _, tried, _ in equal]
        equal = [(b[0] + f.better_than(b[1]), f, b[2]) for b, f in zip(equal, there, strict=True)]
        best = max(equal, key=lambda b: b[0])
    if best is not None and isinstance(best[2].trial.effect, PositionDependentFriction) and noisy(bench, best[1]):
        by_load = [b for b in found if b[2].trial.effect == LoadDependentFriction(best[2].trial.effect.joints)]
        best = max((b for b in by_load if b[0] > BY_LOAD * best[0]), key=lambda b: b[0], default=best)
    if best is not None:  # what leaves another effect's torque, to be found next, leaves few rows that are independent
        fewer = [b for b in found if _size(b[2]) <= _size(best[2]) and b[1].misfit < best[1].misfit - np.log(FEWER_LEFT)]
        best = min(fewer, key=lambda b: b[1].misfit, default=best)
    return best


def _share(bench: Bench, plain: Fitted, less: Fitted, more: Fitted) -> float:
    """What an effect is worth on the joint where that is most, of those whose torque it changes by more than `EXACT`."""
    felt = less.squares - more.squares > plain.rows.moving.sum(axis=1) * (EXACT * bench.torque) ** 2
    return float(np.max(np.where(felt, worth(plain.squares, less.squares, more.squares), 0.0)))


def worth(plain, less, more):
    """Fall of squared residuals, `less` without and `more` with an effect, as a share.

    Of the geometric mean of what the plain model leaves and what is left without the effect: of the first alone, nothing would
    be worth a name beside an effect a hundred times as strong, and of the second, neither law of the plant nor of the catalogue
    is as exact as the noise is small beside such an effect.
    """
    return (less - more) / np.sqrt(plain * less)


def _by_amplitude(effect: Effect) -> bool:
    """Whether its signature holds for any size of it, so that the robust test of that says all."""
    return effect.linear or effect.lawless


def _bent(effect: Effect) -> bool:
    """Whether it has a shape that its signature holds as it is."""
    return not effect.lawless and len(effect.parameters) > len(effect.amplitudes)


def _most_of_some(candidate: Candidate, share: float) -> bool:
    """Whether a candidate of some recordings explains most of what is missing, whatever else is."""
    return candidate.scope is not None and share > HALF


def _settled(evidence: Evidence, candidate: Candidate) -> bool:
    """Whether a candidate that acts in a few places only is beyond chance there; it must leave little of what is missing."""
    return not candidate.trial.effect.abrupt and robust_p(evidence, candidate) * evidence.tests < DOUBT


def rarity(bench: Bench, fitted: Fitted, effect: Effect, everywhere: bool) -> float:
    """Share of its evidence that an effect loses for being unlikely.

    That somebody mounted something for all recordings and listed it for none. While a model is far from the noise, all laws are
    wrong, and likelihoods alone compare what else they happen to take up.
    """
    return RARE if effect.mounted and everywhere and noisy(bench, fitted) else 0.0


def noisy(bench: Bench, fitted: Fitted) -> list[int]:
    """The joints with more residual than the noise of single samples accounts for."""
    return np.flatnonzero(above_noise(bench, fitted) > FLOOR).tolist()


def above_noise(bench: Bench, fitted: Fitted) -> np.ndarray:
    """Deviation of each joint's filtered residual over what the noise of single samples accounts for, (n,)."""
    passed = np.sqrt(
        np.mean(np.concatenate([np.asarray(p.matrix.multiply(p.matrix).sum(axis=1)).ravel() for p in bench.prepared]))
    )
    return fitted.rows.deviation() / np.maximum(noise(bench.prepared, fitted.model) * passed, 1e-9)


def _joint(evidence: Evidence, candidate: Candidate) -> int:
    """The joint on which a candidate explains most."""
    change = evidence.signature(candidate.number, candidate.scope) @ candidate.coefficients
    return int(np.argmax(evidence.weights * np.sum(change**2, axis=1)))


def contenders(evidence: Evidence, model: CalibratedModel) -> list[Candidate]:
    """The candidates worth an exact fit: beyond chance, robustly so, near the best; of each effect at its joints the best."""
    others = len(evidence.bench.prepared) > 1
    result: list[Candidate] = []
    every = evidence.candidates()
    most = max((c.compared for c in every), default=0.0)
    for candidate in every:
        far = bool(result) and (len(result) >= TRIED or candidate.score < min(CLOSE * result[0].score, result[0].score - SAME))
        if far and candidate.compared < most:
            continue
        if candidate.likelihood < candidate.least:
            continue
        same = any(key(c) == key(candidate) for c in result)
        if same or present(candidate, model):
            continue
        beyond_chance = not _by_amplitude(candidate.trial.effect) or robust_p(evidence, candidate) * evidence.tests < DOUBT
        foremost, bent = candidate is every[0], _bent(candidate.trial.effect)
        # what is not linear may be another for a shape little off that of its trial: the foremost is fitted in any case
        held = not others or (foremost and bent) or evidence.confirmed(candidate) > CONFIRMED
        if beyond_chance and (held or (foremost and _confirmed_as_abrupt(evidence, candidate, model))):
            result.append(candidate)
    return result


def _confirmed_as_abrupt(evidence: Evidence, candidate: Candidate, model: CalibratedModel) -> bool:
    """Whether a law of speed is confirmed where friction is as abrupt as it is beside that law, whose part a width had taken."""
    if not candidate.trial.effect.of_speed:
        return False
    bench = evidence.bench
    beside = rewidened(bench, refit(bench, extended(model, candidate))).model.terms[: len(model.terms)]
    widths = {t.effect.joints: t.width for t in beside if isinstance(t.effect, DryFriction) and t.width}
    there = refit(bench, replace(model, terms=tuple(widened(t, widths) for t in model.terms))).model
    anew = Evidence.gather(bench, there, [candidate.trial])
    return any(anew.confirmed(c) > CONFIRMED for c in anew.candidates() if c.scope == candidate.scope)


def _best_start(bench: Bench, model: CalibratedModel, shares: Sequence[float], without_last: Rows | None = None) -> Fitted:
    """The best fit from several starts of the last term, of which the prediction is no smooth function; these shares of its size."""
    last, fits = model.terms[-1], []
    for share in shares:
        sized = {name: share * value if name in last.effect.amplitudes else value for name, value in last.named.items()}
        for effect, theta in last.effect.starts(sized):
            start = replace(last, effect=effect).with_values(np.array(list(theta.values())))
            fits.append(refit(bench, replace(model, terms=(*model.terms[:-1], start)), 3, without_last))
    return min(fits, key=lambda f: f.misfit)


def key(candidate: Candidate) -> Key:
    """Name and joints of a candidate's effect."""
    effect = candidate.trial.effect
    return effect.name, effect.joints


def present(candidate: Candidate, model: CalibratedModel) -> bool:
    """Whether the model has the effect there already."""
    effect, scope = candidate.trial.effect, candidate.scope
    return not effect.many and any(
        t.effect.name == effect.name
        and t.effect.joints == effect.joints
        and (not t.groups or scope is None or set(scope) & set(t.groups))
        for t in model.terms
    )


def extended(model: CalibratedModel, candidate: Candidate) -> CalibratedModel:
    """The model with a candidate's effect."""
    return replace(model, terms=(*model.terms, term(candidate)))


def term(candidate: Candidate) -> Term:
    """A candidate as a term."""
    trial = candidate.trial
    theta = trial.effect.combined(trial.points, candidate.coefficients)
    estimates = tuple(Estimate(float(theta[p.name])) for p in trial.effect.parameters)
    if candidate.scope is None:
        return Term(trial.effect, estimates, trial.width)
    return Term(trial.effect, estimates, trial.width, recordings=(), groups=candidate.scope)


def described(candidate: Candidate, model: CalibratedModel) -> str:
    """Name, joints and groups, for people."""
    joints = ", ".join(model.joints[j] for j in candidate.trial.effect.joints)
    return (
        candidate.trial.effect.name
        + (f" of {joints}" if joints else "")
        + ("" if candidate.scope is None else f" in {candidate.scope}")
    )


def without(model: CalibratedModel, i: int) -> CalibratedModel:
    """The model less one term."""
    return replace(model, terms=(*model.terms[:i], *model.terms[i + 1 :]))


def _pruned(bench: Bench, plain: Fitted, fitted: Fitted, base: int, tests: int, report) -> Fitted:
    """The model without those earlier effects that the newest made superfluous."""

    def superfluous(less: Fitted, i: int, by: float = 1.0) -> bool:
        return _share(bench, plain, less, fitted) < by * LEAST_SHARE or fitted.better_than(less) < by * least(fitted, i, tests)

    i = base
    while i < len(fitted.model.terms) - 1:
        foreseen = _foreseen(fitted, i)
        doubtful = foreseen is None or superfluous(foreseen, i, DOUBTFUL)
        less = refit(bench, without(fitted.model, i)) if doubtful else fitted
        if doubtful and superfluous(less, i):
            report(f"{fitted.model.terms[i].effect.name} is superfluous")
            fitted = less
        else:
            i += 1
    return fitted


def _foreseen(fitted: Fitted, i: int) -> Fitted | None:
    """What the fit without one term would leave if all were linear: its amplitudes at 0, all else where that is best.

    None where the effect does not vanish there.
    """
    model, found = fitted.model, fitted.rows
    start = sum(len(t.estimates) for t in model.terms[:i])
    term = model.terms[i]
    amplitudes = [(start + k, p.nominal) for k, p in enumerate(term.effect.parameters) if p.name in term.effect.amplitudes]
    if any(nominal for _, nominal in amplitudes):
        return None
    own = [k for k, _ in amplitudes]
    inverse = pseudo_inverse(normal_equations(found, found.deviation() ** -2)[0])
    step = -inverse[:, own] @ np.linalg.pinv(inverse[np.ix_(own, own)]) @ model.values[own]
    return Fitted(model, replace(found, residual=found.residual - found.jacobian @ step))


def least(fitted: Fitted, i: int, tests: int) -> float:
    """Likelihood that a term must add to stay."""
    number = len(fitted.model.terms[i].estimates)
    return min(chance(number, fitted.counts, tests), significant(number, tests))

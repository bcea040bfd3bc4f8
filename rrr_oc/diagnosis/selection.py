"""Forward selection with pruning: which effects a calibrated model lacks.

In each round the candidate with the most evidence joins the model, all parameters are estimated again, and effects that have become
superfluous are removed. The rounds end when no candidate explains more than chance.
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
from rrr_oc.numerics.rank import pseudo_inverse

MOST_EFFECTS = 12  # at which the selection stops; more would only cost time
EXACT_FITS = 5  # candidates fitted on the exact equations in each round; twice as many cost twice the time
CLOSE = 0.4  # share of the best score that a candidate needs for an exact fit; twice as much leaves fewer candidates
ROBUST_P = 0.05  # largest p-value of the robust score test, corrected for all tests; twice as much doubles its false alarms
CONFIRMED = (
    0.3  # share of the fitted fall of the squared residual that left-out recordings must show; twice as much rejects more
)
LEAST_SHARE = 0.007  # share of a joint's squared residual that an effect must explain; twice as much drops the faintest effects
APART = (
    0.1  # relative difference between groups from which a parameter gets one value per group; twice as much splits less often
)
LESS_LEFT = 0.8  # far above the noise, values per group must reduce the squared residual to this share; a larger share splits more often
FEWER_LEFT = (
    2.0  # factor in the squared residual by which a fit is better whatever its effective sample size; twice as much: seldom
)
HALF = 0.5  # share of the residual above which an effect of some recordings explains most of it
EXACT = 3e-4  # share of a joint's torque (standard deviation) below which a change counts for nothing: no law is more exact
NOISE_RATIO = 1.1  # residual over noise above which a joint still lacks something; twice as much calls more fits complete
MARGIN = 1.1  # factor in the score by which a black-box term must beat a law of the catalogue; twice as much: hardly ever
UNLISTED = 0.25  # share of its evidence that a mounted effect loses if all recordings have it and none lists it
PRECEDENCE = 0.7  # of the evidence for an effect: a law of its `precedence` with more goes before it where there is noise
TOGETHER = 4  # effects tried in place of one black-box term; more cost time
HOPELESS = 0.25  # share of its score that two effects must reach for a third to be tried
NEARLY = 0.8  # share of the best score from which the edge of a piecewise torque is refined
EDGE_STEP, LEAST_STEP = 0.05, 0.002  # first and last step of that refinement, as shares of the range
ROUGH = 0.05  # relative tolerance of a smoothing width that several laws share
SAME = 9.0  # difference in twice the log-likelihood within which two models count as equal; twice as much lists more rivals
DOUBTFUL = 3.0  # multiple of the required worth below which, as predicted linearly, the fit without an effect is computed
Lawless = Literal["beside", "after", "never"]
Key = tuple[str, tuple[int, ...]]  # name and joints of an effect
Best = tuple[float, Fitted, Candidate]  # score, fit with it, candidate


@dataclass(frozen=True)
class Found:
    """The outcome of a selection.

    Attributes:
        plain: The plain model, fitted.
        fitted: The model with the selected effects as its last terms, fitted.
        first: Evidence at the plain model.
    """

    plain: Fitted
    fitted: Fitted
    first: Evidence


def select_effects(
    bench: Bench, model: CalibratedModel, report: Callable[[str], None] = lambda _: None, lawless: Lawless = "beside"
) -> Found:
    """The model with all effects for which the recordings hold evidence beyond chance.

    Args:
        report: Receives one line of progress at a time.
        lawless: Whether black-box terms compete with the laws of the catalogue, only come after them, or are not used.
    """
    base = len(model.terms)
    plain = fitted = refit(bench, model)
    first = evidence = gathered(bench, fitted.model)
    planned: list[Key] = []
    seen: set[frozenset] = set()
    while len(fitted.model.terms) - base < MOST_EFFECTS:
        best, planned = _next(bench, evidence, (plain, fitted), lawless, planned)
        if best is None:
            break
        report(f"{described(best[2], fitted.model)}: evidence {best[0]:.0f}")
        chosen = _each_its_own(bench, _exactly_fitted(bench, best), report)
        fitted = rewidened(bench, _pruned(bench, plain, chosen, base, evidence.tests, report))
        terms = frozenset(Counter((t.effect.without_range(), t.groups) for t in fitted.model.terms[base:]).items())
        if terms in seen:
            break  # two equivalent sets of effects would replace each other for ever
        seen.add(terms)
        evidence = gathered(bench, fitted.model)
    return Found(plain, fitted, first)


def _each_its_own(bench: Bench, fitted: Fitted, report: Callable[[str], None]) -> Fitted:
    """The fit in which the newest effect has separate parameters in each of its groups, if they differ significantly.

    This holds for what is mounted and taken off, for sensors and for black-box terms; the friction of a drive does not change with
    the set-up.
    """
    *others, newest = fitted.model.terms
    if len(newest.groups) < 2 or not (
        newest.effect.scope == "mounted" or newest.effect.side == "sensor" or newest.effect.black_box
    ):
        return fitted
    each = [replace(newest, groups=(g,)) for g in newest.groups]
    tried = refit(bench, replace(fitted.model, terms=(*others, *each)))
    values = np.array([t.values for t in tried.model.terms[len(others) :]])
    apart = np.any(np.ptp(values, axis=0) > APART * np.abs(values).max(axis=0))
    if noisy(bench, tried):
        apart &= tried.misfit < fitted.misfit + np.log(LESS_LEFT)
    if not apart or tried.better_than(fitted) < chance(values.size - values.shape[1], fitted.counts, len(each)):
        return fitted
    report(f"{newest.effect.name} has its own parameters in each group")
    return tried


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


def _best_unnamed(bench: Bench, j: int, plain: Fitted, fitted: Fitted) -> Best | None:
    evidence = unnamed(bench, fitted.model, j)
    every = [e for e in (evidence, _at_its_edge(evidence)) if e is not None]
    found = [_best(bench, e, contenders(e, fitted.model), plain, fitted) for e in every]
    return max((b for b in found if b is not None), key=lambda b: b[0], default=None)


def _at_its_edge(evidence: Evidence) -> Evidence | None:
    """Evidence for the best piecewise torque with its edge refined from the coarse grid to where it explains most."""
    every, step, there = evidence.candidates(), EDGE_STEP, None
    best = next((c for c in every if c.trial.effect.has_edges), None)
    if best is None or best.score < NEARLY * every[0].score:
        return None
    effect, seen = best.trial.effect, view(evidence.bench.whole, evidence.model)
    while step > LEAST_STEP:
        there = Evidence.gather(evidence.bench, evidence.model, [e.trial(seen) for e in (effect, *effect.near(step))])
        scores = {c.trial.effect: c.score for c in there.candidates()}
        nearest = max(scores, key=lambda e: (scores[e], e == effect), default=effect)  # of equal scores, the present edge
        effect, step = nearest, step / 2 if nearest == effect else step
    return there


def _exactly(bench: Bench, fitted: Fitted, best: Best) -> Best:
    """The same choice with all parameters fitted on the exact equations, and the score of that fit."""
    there = rewidened(bench, refit(bench, best[1].model))
    return max(best[0], there.better_than(fitted) - best[2].penalty), there, best[2]


def _size(*candidates: Candidate) -> int:
    return sum(len(c.trial.effect.parameters) for c in candidates)


def unnamed(bench: Bench, model: CalibratedModel, j: int) -> Evidence:
    """Evidence for black-box terms on a joint."""
    seen, ranges = view(bench.whole, model), _ranges(bench, model)
    every = [
        trial
        for kind in CATALOGUE.values()
        if kind.role == "black_box"
        for trial in kind.black_box_trials(seen, j, ranges, model.torque)
    ]
    return Evidence.gather(bench, model, every)


def _ranges(bench: Bench, model: CalibratedModel) -> dict[tuple[str, int], tuple[float, float]]:
    """Smallest and largest recorded value of each variable that a torque may depend on, by name and joint."""
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
    """The terms for a fit to other recordings: series start at 0, over the part of their range that these recordings cover."""
    if all(t.effect.has_edges or not t.effect.validity for t in terms):
        return tuple(terms)
    result, ranges = [], _ranges(bench, model)
    for term in terms:
        effect = term.effect.renewed(ranges)
        result.append(term if effect is None else replace(term, effect=effect).with_values(0 * term.values))
    return tuple(result)


def gathered(bench: Bench, model: CalibratedModel) -> Evidence:
    """Evidence for every trial of the catalogue at a model."""
    seen = view(bench.whole, model)
    return Evidence.gather(bench, model, trials(seen, model.torque))


def _next(
    bench: Bench, evidence: Evidence, fits: tuple[Fitted, Fitted], lawless: Lawless, planned: list[Key]
) -> tuple[Best | None, list[Key]]:
    """The best further effect, or a black-box term where no law comes near it; None where all is chance.

    `fits` are the plain model and the present one. The second result lists the effects that must precede any black-box term in later
    rounds; `planned` is that list for this round.
    """
    plain, fitted = fits
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
        everywhere = other[2].scope is None  # several laws that all act in some recordings only are no more probable
        laws = _as_good(bench, plain, fitted, named, other) if everywhere else None
        if laws is None and not _beside(bench, joints[0], plain, named, other):
            chosen = other
        planned = laws or []
    return chosen, planned


def _exactly_fitted(bench: Bench, best: Best) -> Fitted:
    """The fit of a choice on the exact equations, from several starts where the prediction is not smooth."""
    if best[2].trial.effect.dynamics == "impact":
        return _best_start(bench, best[1].model, (0.8, 1.0, 1.2))
    return refit(bench, best[1].model)


def _bar(named: Best, other: Best) -> float:
    """Score that a black-box term must reach to be preferred to a law.

    A law that explains as much has the higher prior, however few parameters the term has. Where both act in some recordings only and
    the law is one of friction, the prior is equal: friction changes between recordings more easily than its law does.
    """
    changed = named[2].scope is not None and other[2].scope is not None and named[2].trial.effect.side == "drive"
    as_much = named[0] + named[2].penalty - other[2].penalty + SAME
    return named[0] if changed else max(MARGIN * named[0] + SAME, as_much)


def _as_good(bench: Bench, plain: Fitted, fitted: Fitted, named: Best, other: Best) -> list[Key] | None:
    """Further effects that, together with the named one, explain as much as a black-box term; None if there are none."""
    best, found, cost, goal, series = named, [], 0.0, other[0], other[2].trial.effect
    while best is not None and len(found) < TOGETHER:
        found.append(key(best[2]))
        cost += best[2].penalty
        there = rewidened(bench, refit(bench, best[1].model))
        reached = there.better_than(fitted) - cost
        if reached < goal and len(found) == 1 and series.resembles == "friction_over_speed":  # or say how its sign changes
            reached = max(reached, _turned(bench, there, series.joints[0]).better_than(fitted) - cost)
        if reached >= goal:
            return found[1:]
        if len(found) > 1 and reached < HOPELESS * goal:
            return None
        evidence = gathered(bench, there.model)
        best = _best(bench, evidence, contenders(evidence, there.model), plain, there)
    return None


def _turned(bench: Bench, fitted: Fitted, j: int) -> Fitted:
    """The fit with that smoothed sign of a joint's dry friction which gives the smallest residual."""
    terms = fitted.model.terms
    number = next((i for i, t in enumerate(terms) if t.effect in t.effect.sign_forms[:1] and t.effect.joints == (j,)), None)
    if number is None:
        return fitted
    others = range(1, len(terms[number].effect.sign_forms))
    tried = [as_abrupt(bench, replace(fitted.model, terms=with_turn(terms, number, turn))) for turn in others]
    return min([fitted, *tried], key=lambda f: f.misfit)


def _beside(bench: Bench, j: int, plain: Fitted, named: Best, other: Best) -> bool:
    """Whether an effect and a simpler black-box term together explain more than the black-box term alone."""
    both = _best_unnamed(bench, j, plain, refit(bench, named[1].model))
    return both is not None and named[0] + both[0] >= MARGIN * other[0] + SAME and _size(both[2], named[2]) < _size(other[2])


def fit_of(bench: Bench, evidence: Evidence, fitted: Fitted, candidate: Candidate) -> Fitted:
    """The model with a candidate, fitted; for a linear effect the fit that the evidence holds already."""
    model, effect = extended(fitted.model, candidate), candidate.trial.effect
    if effect.dynamics == "impact":
        return _best_start(bench, model, (1.0,), fitted.rows)
    if not effect.linear:
        return refit(bench, model, without_last=fitted.rows)
    return Fitted(model, replace(fitted.rows, residual=evidence.left_by(candidate)))


def _best(bench: Bench, evidence: Evidence, candidates: Sequence[Candidate], plain: Fitted, fitted: Fitted) -> Best | None:
    """Score, fit and candidate of the best effect that is significant and explains enough of the residual; None without one."""
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
    if len(equal) > 1:  # equal at the present widths; each may imply other widths of friction
        there = [rewidened(bench, refit(bench, tried.model)) for _, tried, _ in equal]
        equal = [(b[0] + f.better_than(b[1]), f, b[2]) for b, f in zip(equal, there, strict=True)]
        best = max(equal, key=lambda b: b[0])
    if best is not None and best[2].trial.effect.precedence and noisy(bench, best[1]):
        first = [b for b in found if b[2].trial.effect in best[2].trial.effect.precedence]
        best = max((b for b in first if b[0] > PRECEDENCE * best[0]), key=lambda b: b[0], default=best)
    if best is not None:  # a residual that still holds another effect is correlated, so its effective sample size is small
        fewer = [b for b in found if _size(b[2]) <= _size(best[2]) and b[1].misfit < best[1].misfit - np.log(FEWER_LEFT)]
        best = min(fewer, key=lambda b: b[1].misfit, default=best)
    return best


def _share(bench: Bench, plain: Fitted, less: Fitted, more: Fitted) -> float:
    """Largest `worth` of an effect over the joints whose torque it changes by more than `EXACT`."""
    felt = less.squares - more.squares > plain.rows.moving.sum(axis=1) * (EXACT * bench.torque) ** 2
    return float(np.max(np.where(felt, worth(plain.squares, less.squares, more.squares), 0.0)))


def worth(plain, less, more):
    """Relative fall of the squared residual from `less` (without the effect) to `more` (with it).

    It is relative to the geometric mean of the plain model's squared residual and of `less`. Relative to the first alone, no effect
    would count beside one that is a hundred times as strong; relative to the second alone, small errors of the strong law would
    count as effects.
    """
    return (less - more) / np.sqrt(plain * less)


def _by_amplitude(effect: Effect) -> bool:
    """Whether its signature is proportional to its amplitude, so that the score test is exact."""
    return effect.linear or effect.black_box


def _bent(effect: Effect) -> bool:
    """Whether it has parameters of shape, which its signature keeps at the values of the trial."""
    return not effect.black_box and len(effect.parameters) > len(effect.amplitudes)


def _most_of_some(candidate: Candidate, share: float) -> bool:
    """Whether a candidate of some recordings explains most of the residual."""
    return candidate.scope is not None and share > HALF


def _settled(evidence: Evidence, candidate: Candidate) -> bool:
    """Whether a candidate that acts in few places passes the robust score test."""
    return candidate.trial.effect.dynamics != "impact" and robust_p(evidence, candidate) * evidence.tests < ROBUST_P


def rarity(bench: Bench, fitted: Fitted, effect: Effect, everywhere: bool) -> float:
    """Share of its evidence that an effect loses for a low prior: something mounted in all recordings and listed in none.

    It applies while the residual is far above the noise: all models are wrong there, and the likelihood also rewards what a law
    absorbs of other effects.
    """
    return UNLISTED if effect.scope == "mounted" and everywhere and noisy(bench, fitted) else 0.0


def noisy(bench: Bench, fitted: Fitted) -> list[int]:
    """Joints whose residual exceeds what the noise of single samples explains."""
    return np.flatnonzero(above_noise(bench, fitted) > NOISE_RATIO).tolist()


def above_noise(bench: Bench, fitted: Fitted) -> np.ndarray:
    """Standard deviation of each joint's filtered residual over that of filtered sample noise, (n,)."""
    passed = np.sqrt(
        np.mean(np.concatenate([np.asarray(p.matrix.multiply(p.matrix).sum(axis=1)).ravel() for p in bench.prepared]))
    )
    return fitted.rows.deviation() / np.maximum(noise(bench.prepared, fitted.model) * passed, 1e-9)


def _joint(evidence: Evidence, candidate: Candidate) -> int:
    """The joint on which a candidate explains most."""
    change = evidence.signature(candidate.number, candidate.scope) @ candidate.coefficients
    return int(np.argmax(evidence.weights * np.sum(change**2, axis=1)))


def contenders(evidence: Evidence, model: CalibratedModel) -> list[Candidate]:
    """Candidates for an exact fit: significant, also by the robust test, and near the best; one per effect and joints."""
    others = len(evidence.bench.prepared) > 1
    result: list[Candidate] = []
    every = evidence.candidates()
    most = max((c.compared for c in every), default=0.0)
    for candidate in every:
        far = bool(result) and (
            len(result) >= EXACT_FITS or candidate.score < min(CLOSE * result[0].score, result[0].score - SAME)
        )
        if far and candidate.compared < most:
            continue
        if candidate.likelihood < candidate.least:
            continue
        same = any(key(c) == key(candidate) for c in result)
        if same or present(candidate, model):
            continue
        beyond_chance = not _by_amplitude(candidate.trial.effect) or robust_p(evidence, candidate) * evidence.tests < ROBUST_P
        foremost, bent = candidate is every[0], _bent(candidate.trial.effect)
        # a nonlinear effect may fit well at a shape near its trial: the first candidate is fitted in any case
        held = not others or (foremost and bent) or evidence.confirmed(candidate) > CONFIRMED
        if beyond_chance and (held or (foremost and _confirmed_as_abrupt(evidence, candidate, model))):
            result.append(candidate)
    return result


def _confirmed_as_abrupt(evidence: Evidence, candidate: Candidate, model: CalibratedModel) -> bool:
    """Whether a law of speed is confirmed once the width of friction is the one estimated beside that law."""
    if candidate.trial.effect.resembles != "friction_over_speed":
        return False
    bench = evidence.bench
    beside = rewidened(bench, refit(bench, extended(model, candidate))).model.terms[: len(model.terms)]
    widths = {t.effect.joints: t.width for t in beside if t.effect.sign_forms and t.width}
    there = refit(bench, replace(model, terms=tuple(widened(t, widths) for t in model.terms))).model
    anew = Evidence.gather(bench, there, [candidate.trial])
    return any(anew.confirmed(c) > CONFIRMED for c in anew.candidates() if c.scope == candidate.scope)


def _best_start(bench: Bench, model: CalibratedModel, shares: Sequence[float], without_last: Rows | None = None) -> Fitted:
    """The best fit from several starts of the last term, whose prediction is not smooth: its amplitudes times each of `shares`."""
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
    return effect.placement != "many" and any(
        t.effect.name == effect.name
        and t.effect.joints == effect.joints
        and (not t.groups or scope is None or set(scope) & set(t.groups))
        for t in model.terms
    )


def extended(model: CalibratedModel, candidate: Candidate) -> CalibratedModel:
    """The model with the candidate's effect as its last term."""
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
    """The model without its term number i."""
    return replace(model, terms=(*model.terms[:i], *model.terms[i + 1 :]))


def _pruned(bench: Bench, plain: Fitted, fitted: Fitted, base: int, tests: int, report) -> Fitted:
    """The model without earlier effects that are superfluous beside the newest."""

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
    """The fit without one term as linearisation predicts it: its amplitudes at 0, all other parameters at their optimum.

    None for an effect that does not vanish at amplitudes of 0.
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
    """Growth of twice the log-likelihood that a term must contribute to be kept."""
    number = len(fitted.model.terms[i].estimates)
    return min(chance(number, fitted.counts, tests), significant(number, tests))

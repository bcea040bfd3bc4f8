"""Forward selection with pruning: which effects a calibrated model lacks.

In each round the candidate with the most evidence joins the model, all parameters are estimated again, and effects that have become
superfluous are removed. The rounds end when no candidate explains more than chance.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.least_squares import normal_equations
from rrr_oc.diagnosis.candidate_fits import (
    LEAST_SHARE,
    Choice,
    best_black_box,
    best_choice,
    contenders,
    explained,
    gathered,
    noisy,
    size,
)
from rrr_oc.diagnosis.evidence import Candidate, Evidence, Key, chance, significant
from rrr_oc.diagnosis.fitting import (
    SAME,
    Bench,
    Fitted,
    as_abrupt,
    best_start,
    refit,
    refit_with_widths,
    rewidened,
    with_turn,
    without,
)
from rrr_oc.numerics.rank import pseudo_inverse

MOST_EFFECTS = 12  # at which the selection stops; more would only cost time
APART = 0.1  # relative difference between groups from which a parameter gets one value per group; doubled: seldom
LESS_LEFT = 0.8  # far above the noise, values per group must reduce the squared residual to this share; a larger share splits more often
MARGIN = 1.1  # factor in the score by which a black-box term must beat a law of the catalogue; twice as much: hardly ever
TOGETHER = 4  # effects tried in place of one black-box term; more cost time
HOPELESS = 0.25  # share of its score that two effects must reach for a third to be tried; twice as much saves time
DOUBTFUL = 3.0  # multiple of the required worth below which, as predicted linearly, the fit without an effect is computed; doubled: slower
BlackBoxUse = Literal["beside", "after", "never"]


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
    bench: Bench, model: CalibratedModel, report: Callable[[str], None] = lambda _: None, black_box: BlackBoxUse = "beside"
) -> Found:
    """The model with all effects for which the recordings hold evidence beyond chance.

    Args:
        report: Receives one line of progress at a time.
        black_box: Whether black-box terms compete with the laws of the catalogue, only come after them, or are not used.
    """
    base = len(model.terms)
    plain = fitted = refit(bench, model)
    first = evidence = gathered(bench, fitted.model)
    planned: list[Key] = []
    seen: set[frozenset] = set()
    while len(fitted.model.terms) - base < MOST_EFFECTS:
        best, planned = _next(bench, evidence, (plain, fitted), black_box, planned)
        if best is None:
            break
        report(f"{described(best.candidate, fitted.model)}: evidence {best.score:.0f}")
        chosen = _split_by_group(bench, _exact(bench, best), report)
        fitted = rewidened(bench, _pruned(bench, plain, chosen, base, evidence.tests, report))
        terms = frozenset(Counter((t.effect.without_range(), t.groups) for t in fitted.model.terms[base:]).items())
        if terms in seen:
            break  # two equivalent sets of effects would replace each other for ever
        seen.add(terms)
        evidence = gathered(bench, fitted.model)
    return Found(plain, fitted, first)


def _next(
    bench: Bench, evidence: Evidence, fits: tuple[Fitted, Fitted], black_box: BlackBoxUse, planned: list[Key]
) -> tuple[Choice | None, list[Key]]:
    """The best further effect, or a black-box term where no law comes near it; None where all is chance.

    `fits` are the plain model and the present one. The second result lists the effects that must precede any black-box term in later
    rounds; `planned` is that list for this round.
    """
    plain, fitted = fits
    named = best_choice(bench, evidence, contenders(evidence, fitted.model), plain, fitted)
    joints = noisy(bench, fitted) if named is None else [evidence.joint(named.candidate)]
    as_planned = named is not None and named.candidate.key in planned[:1]
    if black_box == "never" or (black_box == "after" and named is not None) or as_planned:
        joints = []
    others = [best_black_box(bench, j, plain, fitted) for j in joints]
    other = max((o for o in others if o is not None), key=lambda o: o.score, default=None)
    chosen, planned = named or other, planned[1:] if as_planned else []
    if chosen is None:
        return None, []
    if named is not None and other is not None and other.score > _score_to_beat(named, other):
        exact = refit_with_widths(bench, other.fitted.model)  # its score may grow
        other = Choice(max(other.score, exact.better_than(fitted) - other.candidate.penalty), exact, other.candidate)
        everywhere = other.candidate.scope is None  # several laws that all act in some recordings only are no more probable
        laws = _laws_as_good(bench, plain, fitted, named, other) if everywhere else None
        if laws is None and not _better_with_simpler_term(bench, joints[0], plain, named, other):
            chosen = other
        planned = laws or []
    return chosen, planned


def _exact(bench: Bench, best: Choice) -> Fitted:
    """The fit of a choice on the exact equations, from several starts where the prediction is not smooth."""
    if best.candidate.trial.effect.dynamics == "impact":
        return best_start(bench, best.fitted.model, (0.8, 1.0, 1.2))
    return refit(bench, best.fitted.model)


def _score_to_beat(named: Choice, other: Choice) -> float:
    """Score that a black-box term must reach to be preferred to a law.

    A law that explains as much has the higher prior, however few parameters the term has. Where both act in some recordings only and
    the law is one of friction, the prior is equal: friction changes between recordings more easily than its law does.
    """
    changed = (
        named.candidate.scope is not None and other.candidate.scope is not None and named.candidate.trial.effect.side == "drive"
    )
    as_much = named.score + named.candidate.penalty - other.candidate.penalty + SAME
    return named.score if changed else max(MARGIN * named.score + SAME, as_much)


def _laws_as_good(bench: Bench, plain: Fitted, fitted: Fitted, named: Choice, other: Choice) -> list[Key] | None:
    """Further effects that, together with the named one, explain as much as a black-box term; None if there are none."""
    best, found, cost, goal, series = named, [], 0.0, other.score, other.candidate.trial.effect
    while best is not None and len(found) < TOGETHER:
        found.append(best.candidate.key)
        cost += best.candidate.penalty
        there = refit_with_widths(bench, best.fitted.model)
        reached = there.better_than(fitted) - cost
        if reached < goal and len(found) == 1 and series.resembles == "friction_over_speed":  # or say how its sign changes
            reached = max(reached, _turned(bench, there, series.joints[0]).better_than(fitted) - cost)
        if reached >= goal:
            return found[1:]
        if len(found) > 1 and reached < HOPELESS * goal:
            return None
        evidence = gathered(bench, there.model)
        best = best_choice(bench, evidence, contenders(evidence, there.model), plain, there)
    return None


def _turned(bench: Bench, fitted: Fitted, j: int) -> Fitted:
    """The fit with that smoothed sign of a joint's dry friction which gives the smallest residual."""
    terms = fitted.model.terms
    number = next((i for i, t in enumerate(terms) if t.effect in t.effect.sign_forms[:1] and t.effect.joints == (j,)), None)
    if number is None:
        return fitted
    others = range(1, len(terms[number].effect.sign_forms))
    tried = [as_abrupt(bench, with_turn(fitted.model, number, turn)) for turn in others]
    return min([fitted, *tried], key=lambda f: f.misfit)


def _better_with_simpler_term(bench: Bench, j: int, plain: Fitted, named: Choice, other: Choice) -> bool:
    """Whether an effect and a simpler black-box term together explain more than the black-box term alone."""
    both = best_black_box(bench, j, plain, refit(bench, named.fitted.model))
    if both is None or named.score + both.score < MARGIN * other.score + SAME:
        return False
    return size(both.candidate) + size(named.candidate) < size(other.candidate)


def _split_by_group(bench: Bench, fitted: Fitted, report: Callable[[str], None]) -> Fitted:
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


def _pruned(bench: Bench, plain: Fitted, fitted: Fitted, base: int, tests: int, report) -> Fitted:
    """The model without earlier effects that are superfluous beside the newest."""

    def superfluous(less: Fitted, i: int, by: float = 1.0) -> bool:
        return explained(bench, plain, less, fitted) < by * LEAST_SHARE or fitted.better_than(less) < by * least(
            fitted, i, tests
        )

    i = base
    while i < len(fitted.model.terms) - 1:
        foreseen = _foreseen(fitted, i)
        doubtful = foreseen is None or superfluous(foreseen, i, DOUBTFUL)
        less = refit(bench, without(fitted.model, fitted.model.terms[i])) if doubtful else fitted
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


def described(candidate: Candidate, model: CalibratedModel) -> str:
    """Name, joints and groups, for people."""
    joints = ", ".join(model.joints[j] for j in candidate.trial.effect.joints)
    return (
        candidate.trial.effect.name
        + (f" of {joints}" if joints else "")
        + ("" if candidate.scope is None else f" in {candidate.scope}")
    )

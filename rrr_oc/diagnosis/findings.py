"""What a search found: the probability of each effect over all structures that were visited, and what competes with it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import expit
from scipy.stats import chi2

from rrr_oc.calibration.calibrated_model import Estimate, Term, nominal_term
from rrr_oc.calibration.estimator.data import Data
from rrr_oc.calibration.estimator.fitting import Fitted
from rrr_oc.calibration.estimator.knobs import DISCREPANCY
from rrr_oc.calibration.estimator.left_out import Fall
from rrr_oc.diagnosis.knobs import CLAIM, MATTERS, NEGLIGIBLE
from rrr_oc.diagnosis.structures.neighbours import Identity, identity, kind
from rrr_oc.diagnosis.structures.search import Search, State
from rrr_oc.effects import Effect, OfEach
from rrr_oc.effects.base import Prior
from rrr_oc.numerics.rank import pseudo_inverse

LESS_PROBABLE = 10.0  # times that an effect may be less probable beforehand before its claim is said to rest on that
Key = tuple[str, tuple[int, ...]]  # name and joints of an effect, by which it is shown
LINK_ERRORS: Key = ("link_errors", ())  # as the links stand among what an effect cannot be told from


def shown_as(term: Term) -> Key:
    """Name and joints of a term's effect."""
    return term.effect.name, term.effect.joints


@dataclass(frozen=True)
class Like:
    """A law that a torque is most like.

    Attributes:
        term: The law.
        reach: Share of what the best function of the same variables explains that it explains.
    """

    term: Term
    reach: float


@dataclass(frozen=True)
class Finding:
    """An effect that the plain model lacks.

    Attributes:
        term: The effect as a term of the extended model.
        probability: That it or one of its rivals is present.
        alone: That it itself is.
        worth: Fall of the log posterior probability without it [nats].
        p_value: Of its amplitudes being 0 (Wald's test).
        rivals: Names and joints of effects that may be present in its place.
        prior: What was believed of it before: its declared or given prior with the probability that it has on this arm.
        fall: By how much it lowers the error of a joint on data that it was not fitted to.
        innovations: The same of the error's innovations, which a slow disturbance does not hide.
        like: Of a black-box term: the law that it is most like.
        reach: Of a law: share of what the best flexible function in its place explains that it explains; None where that was not asked.
        with_function: Whether it is not named, but told with a function beside it, whose torque is most like it.
    """

    term: Term
    probability: float
    alone: float
    worth: float
    p_value: float
    rivals: tuple[Key, ...] = ()
    prior: Prior | None = None
    fall: Fall | None = None
    innovations: Fall | None = None
    like: Like | None = None
    reach: float | None = None
    with_function: bool = False

    @property
    def joint(self) -> int:
        """Where it is surest."""
        assert self.fall is not None
        return self.fall.joint

    @property
    def of_torque(self) -> float:
        """By how much the error or its innovations fall, over the joint's torque."""
        return max((f.of_torque for f in (self.fall, self.innovations) if f), default=0.0)

    @property
    def matters(self) -> bool:
        """Whether it lowers the error of a joint, or the error's innovations, by a share that matters; a function by more than the best law
        may be wrong."""
        least = DISCREPANCY if self.term.effect.black_box else 0.0
        return any(f.share >= MATTERS and f.explained >= least for f in (self.fall, self.innovations) if f)

    @property
    def of_each(self) -> bool:
        """Whether it has another value in each recording."""
        return isinstance(self.term.effect, OfEach) and bool(self.term.effect.each)

    @property
    def key(self) -> Key:
        """Name and joints."""
        return shown_as(self.term)

    def met_by(self, term: Term) -> bool:
        """Whether a term is this effect, one that may be in its place, or black-box as it is."""
        return kind(term.effect) == kind(self.term.effect) or shown_as(term) in self.rivals

    @property
    def rests_on_prior(self) -> bool:
        """Whether it would not be claimed, had its odds beforehand been `LESS_PROBABLE` times lower.

        Posterior odds are prior odds times the Bayes factor, so that they would be lower by as much.
        """
        return self.probability * (1 - CLAIM) < LESS_PROBABLE * CLAIM * (1 - self.probability)


@dataclass(frozen=True)
class Undecided:
    """Effects of which one, or else errors of the links, explains a mismatch; they say different things of the arm.

    Attributes:
        terms: The effects, the most probable first.
        probability: That one of all these is there.
    """

    terms: tuple[Term, ...]
    probability: float

    @property
    def contested(self) -> Finding:
        """The first effect with the others as its rivals."""
        rivals = (*map(shown_as, self.terms[1:]), LINK_ERRORS)
        return Finding(self.terms[0], self.probability, self.probability, 0.0, 1.0, rivals)


@dataclass(frozen=True)
class Possible:
    """An effect that may be present but is not claimed."""

    key: Key
    groups: tuple[str, ...]
    probability: float


def probabilities(search: Search) -> list[tuple[frozenset, float]]:
    """Structures that were visited, by their effects, with their posterior probabilities."""
    scores = {**search.predicted, **search.visited}
    total = np.logaddexp.reduce(list(scores.values()))
    return [(key, float(np.exp(score - total))) for key, score in scores.items()]


def identities(structure: frozenset) -> set[Identity]:
    """Those of a structure's effects."""
    return {identity(effect) for effect, *_ in structure}


def found(search: Search, at: State) -> tuple[list[Finding], list[Possible]]:
    """The findings of a search, most important first, and what is possible beside them."""
    every, worths = probabilities(search), search.worths(at)
    share: dict[Identity, float] = {}
    for structure, p in every:
        for key in identities(structure):
            share[key] = min(share.get(key, 0.0) + p, 1.0)  # which rounding may exceed
    own = [identity(t.effect) for t in at.fitted.extra]
    findings, named = [], set(own)
    for i, term in enumerate(at.fitted.extra):
        others = _rivals(own[i], every, set(own))
        both = sum(p for structure, p in every if identities(structure) & {own[i], *others})
        rivals = (*(other[:2] for other in others), *map(shown_as, equal_terms(search.fitter.data, at.fitted, i)))
        shown = tuple(dict.fromkeys(rival for rival in rivals if rival != own[i][:2]))
        alone = share.get(own[i], 1.0)
        findings.append(
            Finding(term, min(both, 1.0), alone, worths[i], wald(at.fitted, i), shown, _before(search, term.effect))
        )
        named |= set(others)
    sizes = [contribution(search.fitter.data, at.fitted, i) for i in range(len(findings))]
    claimed = [f for f, size in zip(findings, sizes, strict=True) if f.probability >= CLAIM and size >= NEGLIGIBLE]
    rest = [Possible(f.key, f.term.groups, f.probability) for f in findings if f not in claimed]
    rest += [Possible(key[:2], (), p) for key, p in share.items() if p > 1 - CLAIM and key not in named]
    return sorted(claimed, key=lambda f: -f.worth), sorted(rest, key=lambda p: (-p.probability, p.key))


def further(search: Search, fitted: Fitted, first: int) -> list[Finding]:
    """The effects of a fit from this number on that do something there, each as sure as its removal says."""
    worths, result = search.worths(State(fitted, 0.0)), []
    for i, term in enumerate(fitted.extra):
        if i >= first and contribution(search.fitter.data, fitted, i) >= NEGLIGIBLE:
            p = float(expit(worths[i]))
            result.append(Finding(term, p, p, worths[i], wald(fitted, i), prior=_before(search, term.effect)))
    return result


def moved(findings: Sequence[Finding], at: Fitted, to: Fitted) -> list[Finding]:
    """Findings of a fit with the terms of another, which has these effects first and in this order."""
    numbers = {id(t): i for i, t in enumerate(at.extra)}
    return [replace(f, term=to.extra[numbers[id(f.term)]]) for f in findings]


def _before(search: Search, effect: Effect) -> Prior:
    """The prior of an effect, with its probability on this arm."""
    priors, view = search.fitter.priors, search.fitter.view
    return replace(priors.of(type(effect)), probability=priors.chance(effect, view))


def _rivals(own: Identity, every: Sequence[tuple[frozenset, float]], present: set[Identity]) -> list[Identity]:
    """Effects in whose structures an effect is absent, with odds above 1 − `CLAIM`, most probable first.

    Args:
        present: The effects of the best structure, which are nobody's rivals.
    """
    odds: dict[Identity, float] = {}
    with_it = 1e-300
    for structure, p in every:
        keys = identities(structure)
        if own in keys:
            with_it += p
        else:
            for other in keys - present:
                odds[other] = odds.get(other, 0.0) + p
    return [other for other, p in sorted(odds.items(), key=lambda o: (-o[1], repr(o[0]))) if p > (1 - CLAIM) * with_it]


def contribution(data: Data, fitted: Fitted, i: int) -> float:
    """What an added effect changes of the fitted torque (rms where it holds) over the joint's torque; the largest over joints.

    Below `NEGLIGIBLE` it is as good as absent (a region of practical equivalence, Kruschke 2018).
    """
    term = fitted.extra[i]
    less = replace(fitted.model, terms=tuple(t for t in fitted.model.terms if t is not term))
    change = data.residual(less) - fitted.residual
    rows = data.counted & np.isin(np.array(data.labels)[data.label], term.groups or data.labels)
    rms = np.sqrt(np.sum((change * rows) ** 2, axis=1) / np.maximum(rows.sum(axis=1), 1))
    return float(np.max(rms / data.torque))


def equal_terms(data: Data, fitted: Fitted, i: int) -> list[Term]:
    """Effects that, in the place of an added one, predict the same over these recordings, so that nothing can tell them apart."""
    term, result = fitted.extra[i], []
    for effect, theta in term.effect.equivalents(term.named):
        estimates = tuple(Estimate(float(theta[p.name])) for p in effect.parameters)
        other = replace(term, effect=effect, estimates=estimates, width=nominal_term(effect).width)
        if any((t.effect, t.groups) == (effect, term.groups) for t in fitted.model.terms):
            continue  # it would count twice
        model = replace(fitted.model, terms=tuple(other if t is term else t for t in fitted.model.terms))
        if negligible(data, (data.residual(model) - fitted.residual) * data.counted):
            result.append(other)
    return result


def negligible(data: Data, change: np.ndarray) -> bool:
    """Whether a change of the predictions (n, M) is too small to count on any joint."""
    return bool(np.all(np.sqrt(np.mean(change**2, axis=1)) < NEGLIGIBLE * data.torque))


def wald(fitted: Fitted, i: int) -> float:
    """P-value of the amplitudes of an effect, of those added to the plain model, being where it vanishes."""
    post, model = fitted.posterior, fitted.model
    start = sum(len(t.estimates) for t in model.terms[: fitted.base + i])
    effect = fitted.extra[i].effect
    own = [start + k for k, p in enumerate(effect.parameters) if p.name in effect.amplitudes]
    off = post.prior.mean[own] - post.step[own]
    block = pseudo_inverse(post.matrix)[np.ix_(own, own)]
    return float(chi2.sf(off @ pseudo_inverse(block) @ off, len(own)))


def named(key: Key, joints: Sequence[str]) -> dict[str, Any]:
    """A key as in files."""
    names = [joints[j] for j in key[1]]
    return {"effect": key[0], "joint": None if not names else names[0] if len(names) == 1 else names}

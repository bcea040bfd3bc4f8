"""What a search found: the probability of each effect over all structures that were visited, and what competes with it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import expit
from scipy.stats import chi2

from rrr_oc.calibration.calibrated_model import Estimate, Term, nominal_term
from rrr_oc.calibration.estimator.data import Data
from rrr_oc.calibration.estimator.fitting import Fitted
from rrr_oc.diagnosis.knobs import CLAIM, NEGLIGIBLE
from rrr_oc.diagnosis.result import Finding, Key, Possible, shown_as
from rrr_oc.diagnosis.structures.neighbours import Identity, identity
from rrr_oc.diagnosis.structures.search import FittedStructure, StructureSearch
from rrr_oc.effects import Effect
from rrr_oc.effects.base import Prior
from rrr_oc.numerics.rank import pseudo_inverse


def probabilities(search: StructureSearch) -> list[tuple[frozenset, float]]:
    """Structures that were visited, by their effects, with their posterior probabilities."""
    scores = {**search.predicted, **search.visited}
    total = np.logaddexp.reduce(list(scores.values()))
    return [(key, float(np.exp(score - total))) for key, score in scores.items()]


def identities(structure: frozenset) -> set[Identity]:
    """Those of a structure's effects."""
    return {identity(effect) for effect, *_ in structure}


def found(search: StructureSearch, at: FittedStructure) -> tuple[list[Finding], list[Possible]]:
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
        findings.append(Finding(term, min(both, 1.0), worths[i], wald(at.fitted, i), shown, _before(search, term.effect)))
        named |= set(others)
    sizes = [contribution(search.fitter.data, at.fitted, i) for i in range(len(findings))]
    claimed = [f for f, size in zip(findings, sizes, strict=True) if f.probability >= CLAIM and size >= NEGLIGIBLE]
    rest = [Possible(f.key, f.term.groups, f.probability) for f in findings if f not in claimed]
    rest += [Possible(key[:2], (), p) for key, p in share.items() if p > 1 - CLAIM and key not in named]
    return sorted(claimed, key=lambda f: -f.worth), sorted(rest, key=lambda p: (-p.probability, p.key))


def further(search: StructureSearch, fitted: Fitted, first: int) -> list[Finding]:
    """The effects of a fit from this number on that do something there, each as sure as its removal says."""
    worths, result = search.worths(FittedStructure(fitted, 0.0)), []
    for i, term in enumerate(fitted.extra):
        if i >= first and contribution(search.fitter.data, fitted, i) >= NEGLIGIBLE:
            p = float(expit(worths[i]))
            result.append(Finding(term, p, worths[i], wald(fitted, i), prior=_before(search, term.effect)))
    return result


def moved(findings: Sequence[Finding], at: Fitted, to: Fitted) -> list[Finding]:
    """Findings of a fit with the terms of another, which has these effects first and in this order."""
    numbers = {t: i for i, t in enumerate(at.extra)}
    return [replace(f, term=to.extra[numbers[f.term]]) for f in findings]


def _before(search: StructureSearch, effect: Effect) -> Prior:
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
    start = model.offsets[fitted.base + i]
    effect = fitted.extra[i].effect
    own = [start + k for k, p in enumerate(effect.parameters) if p.name in effect.amplitudes]
    off = post.prior.mean[own] - post.step[own]
    block = pseudo_inverse(post.matrix)[np.ix_(own, own)]
    return float(chi2.sf(off @ pseudo_inverse(block) @ off, len(own)))


def named(key: Key, joints: Sequence[str]) -> dict[str, Any]:
    """A key as in files."""
    names = [joints[j] for j in key[1]]
    return {"effect": key[0], "joint": None if not names else names[0] if len(names) == 1 else names}

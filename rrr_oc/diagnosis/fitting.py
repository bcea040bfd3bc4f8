"""Fits of models with effects of the catalogue, each with its declared prior."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import comb
from typing import Any, cast

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.calibration.estimator.evidence import Hyperparameters
from rrr_oc.calibration.estimator.fitting import Fitted, PlainFitter
from rrr_oc.diagnosis.knobs import EXCESS
from rrr_oc.effects import Effect, OfEach, Trial, View
from rrr_oc.effects.priors import Priors

BEYOND = 0.15  # share of the range of a shape's trials by which a fit may leave it
MIXTURES = 2  # directions in which ways of changing sign are mixed
EXACT = 0.01  # size of a discrepancy that exact laws have, and of errors of links that are as described


@dataclass(frozen=True)
class Span:
    """Prior of one parameter of an effect: normal about `centre`, or uniform from `low` to `high`, in its logarithm if `log`.

    `std` is the standard deviation of either.
    """

    std: float
    normal: bool
    centre: float = 0.0
    low: float = -np.inf
    high: float = np.inf
    log: bool = False

    def of_change(self, value: float, wide: float) -> tuple[float, float, float]:
        """Mean, precision and flat precision (of `ParameterPrior`) of a change from a value; a normal prior is `wide` times as wide."""
        std = max(self.std * (abs(value) if self.log else wide if self.normal else 1.0), 1e-12)
        return (self.centre - value, std**-2, 0.0) if self.normal else (0.0, 0.0, std**-2)


def spans(family: Sequence[Trial], effect: Effect, view: View, priors: Priors) -> list[Span]:
    """The priors of an effect's parameters, from its declared prior and the values that its trials take."""
    own = [t for t in family if type(t.effect) is type(effect)] or [effect.trial(view)]
    same = next((t for t in own if t.effect == effect), own[0])
    sizes, typical = priors.scales(view, same), priors.of(type(effect)).typical
    scales = dict(zip(effect.amplitudes, sizes, strict=False)) if len(sizes) >= len(effect.amplitudes) else {}
    if len(set(effect.amplitudes)) == 1 and len(sizes) > 1:
        scales = {effect.amplitudes[0]: float(np.max(sizes))}
    zero, result = effect.combined(same.points, np.zeros(len(same.points))), []
    for p in effect.parameters:
        each = isinstance(effect, OfEach) and effect.each
        if p.name in scales and (p.name in typical or effect.black_box or each or not typical):
            result.append(Span(float(scales[p.name]), True, zero[p.name]))
            continue
        values = np.array([point[p.name] for t in own for point in t.points], float)
        log = p.lower >= 0 and bool(np.all(values > 0))
        values = np.log(values) if log else values
        reach = max(float(np.ptp(values)), 1.0 if log else 0.3)
        low, high = float(values.min()) - BEYOND * reach, float(values.max()) + BEYOND * reach
        if p.unit == "rad" and p.name == "phase":
            low, high, reach = -np.inf, np.inf, 2 * np.pi
        low, high = (float(np.exp(low)), float(np.exp(high))) if log else (low, high)
        result.append(Span(reach / np.sqrt(12), False, 0.0, low, high, log))
    return result


def exact(hyper: Hyperparameters) -> Hyperparameters | None:
    """Hyperparameters of exact laws, and of links as described; None where laws are exact and no link is far off."""
    if np.all(hyper.links == 1) and np.all(hyper.discrepancy < EXACT):
        return None
    return replace(hyper, links=np.full_like(hyper.links, EXACT), discrepancy=np.minimum(hyper.discrepancy, EXACT))


@dataclass(frozen=True)
class Fitter(PlainFitter):
    """Fits of models with effects beyond the plain terms.

    Attributes:
        view: What the recordings show.
        families: Trials by name and joints of their effect.
        priors: What is believed of effects.
    """

    view: View
    families: dict[tuple, list[Trial]]
    priors: Priors
    _spans: dict[Effect, list[Span]] = field(default_factory=dict, repr=False, compare=False)
    _scales: dict[Trial, np.ndarray] = field(default_factory=dict, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """Without what is computed again where it is needed: numbers of objects are others in another process."""
        return {**self.__dict__, "_spans": {}, "_scales": {}}

    def widths_of_priors(self, terms: Sequence[Term]) -> tuple[float, ...]:
        return tuple(self.excess(term)[0] for term in terms)

    def of_effects(self, terms: Sequence[Term]) -> np.ndarray:
        """Mean, precision and flat precision of changes, and bounds, of the parameters of effects, (5, m)."""
        result = []
        for term, wide in zip(terms, self.wide or self.widths_of_priors(terms), strict=True):
            for span, value in zip(self.spans(term.effect), term.values, strict=True):
                result.append((*span.of_change(value, wide), span.low, span.high))
        return np.array(result).reshape(-1, 5).T

    def restarted(self, fitted: Fitted, i: int) -> Fitted:
        """The most probable of a fit and of those from other starts of one of the added effects, by its number."""
        k, best, (effect, named) = fitted.base + i, fitted, (fitted.extra[i].effect, fitted.extra[i].named)
        for other, theta in effect.starts(named):
            term = replace(fitted.extra[i], effect=other).with_values(np.array([theta[p.name] for p in other.parameters]))
            terms = (*fitted.model.terms[:k], term, *fitted.model.terms[k + 1 :])
            model = replace(fitted.model, terms=terms)
            new = self.fit(model, fitted.links, fitted.posterior, wanted=best.log_evidence)
            best = max(best, new, key=lambda f: f.log_evidence)
        return best

    def mixtures(self, model: CalibratedModel) -> np.ndarray:
        """Changes of the prediction with which dry friction changes sign in mixtures of its ways, (n, M, q), of size 1."""
        data, columns = self.data, [np.zeros((self.data.n, len(self.data.label), 0))]
        for term in model.terms[: len(data.start.terms)]:
            if others := [form for form in term.effect.sign_forms if form != term.effect and term.width]:
                forms = np.array([data.friction(form, cast(float, term.width)) for form in (term.effect, *others)])
                u, s, _ = np.linalg.svd(term.values[0] * (forms[1:] - forms[0]).T, full_matrices=False)
                own = np.zeros((data.n, len(u), MIXTURES))
                own[term.effect.joints[0]] = u[:, :MIXTURES] * s[:MIXTURES]
                columns.append(own)
        return np.concatenate(columns, axis=2)

    def believed(self, trial: Trial, theta: Mapping[str, float]) -> bool:
        """Whether an effect's parameters are where their prior is not 0."""
        if (trial.effect.name, trial.effect.joints) not in self.families:
            return True  # a black-box term has the shape of its trial
        every = zip(trial.effect.parameters, self.spans(trial.effect), strict=True)
        return all(span.low <= theta[p.name] <= span.high for p, span in every)

    def spans(self, effect: Effect) -> list[Span]:
        """The priors of an effect's parameters."""
        if effect not in self._spans:
            family = self.families.get((effect.name, effect.joints), [])
            self._spans[effect] = spans(family, effect, self.view, self.priors)
        return self._spans[effect]

    def scales(self, trial: Trial) -> np.ndarray:
        """Prior standard deviations of a trial's coefficients, (m,)."""
        if trial not in self._scales:
            self._scales[trial] = self.priors.scales(self.view, trial)
        return self._scales[trial]

    def excess(self, term: Term) -> tuple[float, float]:
        """Of the widths that the prior of its amplitudes may have the likeliest, and the logarithm of what it is believed by."""
        pairs = zip(self.spans(term.effect), term.values, strict=True)
        off = np.array([(value - span.centre) / span.std for span, value in pairs if span.normal])
        score = [np.log(w) - len(off) * np.log(k) - 0.5 * float(off @ off) / k**2 for k, w in EXCESS.items()]
        wide = list(EXCESS)[int(np.argmax(score))]
        return wide, float(np.log(EXCESS[wide]))

    def log_prior(self, effect, scope) -> float:
        """Logarithm of the prior odds that an effect is present, in all groups or in these."""
        groups = len(self.data.labels)
        chance, partly = self.priors.chance(effect, self.view), effect.partly
        odds = float(np.log(chance / (1 - chance)))
        if groups == 1 or partly == 0.0:
            return odds
        if scope is None:
            return odds + float(np.log(1 - partly))
        choices = comb(groups, len(scope)) * max(groups - 1, 1)
        return odds + float(np.log(partly) - np.log(choices))

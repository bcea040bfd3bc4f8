"""Models fitted under their evidence: Gauss–Newton on the exact equations, with priors, noise and discrepancy estimated on the way."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import comb
from typing import Any, cast

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.calibration.friction_width import WIDTHS, widened
from rrr_oc.calibration.regression import Rows
from rrr_oc.calibration.term_fit import bounds, with_parameter_values
from rrr_oc.diagnosis.data import Data
from rrr_oc.diagnosis.evidence import Posterior, Prior, Sizes, Start, solve
from rrr_oc.diagnosis.knobs import EXCESS
from rrr_oc.effects import Effect, MovesLink, OfEach, Trial, View
from rrr_oc.effects.priors import Priors

STEPS = 10  # most steps of Gauss–Newton
GAIN = 0.05  # fall of the cost, in nats, below which no further step follows
IDLE = 0.5  # nats: after two steps that raise the evidence by less, with hardly less to gain, no further one follows
BEND = 0.01  # of the squared change over a step, by which residuals may miss the prediction without new derivatives
DAMPINGS = (0.0, 0.03, 0.3, 3.0, 30.0, 300.0)  # of a step, tried until the cost falls
BEYOND = 0.15  # share of the range of a shape's trials by which a fit may leave it
WIDE = 30.0  # prior standard deviation of plain friction and armature, as a multiple of the joint's torque
MIXTURES = 2  # directions in which ways of changing sign are mixed
EXACT_LINKS, EXACT_LAWS = 0.01, 0.01  # sizes of the errors of links, and of a discrepancy, that an exact arm has
OTHER_SIGN = 3.0  # nats from which another way in which friction changes sign is fitted


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
        """Mean, precision and flat precision (see `evidence.Prior`) of a change from a value; a normal prior is `wide` times as wide."""
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


def exact(sizes: Sizes, free: bool) -> Sizes | None:
    """Sizes of an exact arm, where errors of the links are of unknown size (`free`); None where they are as small."""
    if sizes.links < EXACT_LINKS and np.all(sizes.discrepancy < EXACT_LAWS):
        return None
    links = min(EXACT_LINKS, sizes.links) if free else sizes.links
    return replace(sizes, links=links, discrepancy=np.minimum(sizes.discrepancy, EXACT_LAWS))


@dataclass(frozen=True)
class Fitted:
    """A model fitted to data.

    Attributes:
        model: At the estimates.
        links: Errors of the links in standard deviations of their prior, (k,).
        posterior: Of the parameters, from which the model was reached.
        residual: Of the model, (n, M) [Nm].
        extra: Number of terms beyond the plain ones.
    """

    model: CalibratedModel
    links: np.ndarray
    posterior: Posterior
    residual: np.ndarray
    base: int

    @property
    def log_evidence(self) -> float:
        return self.posterior.log_evidence

    @property
    def extra(self) -> tuple[Term, ...]:
        """The effects that were added to the plain model."""
        return self.model.terms[self.base :]


@dataclass(frozen=True)
class Fitter:
    """Fits of models to data.

    Attributes:
        data: The data.
        view: What the recordings show.
        families: Trials by name and joints of their effect.
        plain_std: Prior standard deviations of the plain model's parameters.
        priors: What is believed of effects.
    """

    data: Data
    view: View
    families: dict[tuple, list[Trial]]
    plain_std: np.ndarray
    priors: Priors
    _spans: dict[Effect, list[Span]] = field(default_factory=dict, repr=False, compare=False)
    _scales: dict[int, tuple[Trial, np.ndarray]] = field(default_factory=dict, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """Without what is computed again where it is needed: numbers of objects are others in another process."""
        return {**self.__dict__, "_spans": {}, "_scales": {}}

    def fit(
        self, model: CalibratedModel, links: np.ndarray, start: Posterior | Start | None = None, fixed: bool = False
    ) -> Fitted:
        """All parameters of a model fitted, with sizes that begin with those of `start`, or stay `fixed` there."""
        data = self.data
        found = data.rows(model)
        columns, residual = self.columns(model, links, found), found.residual
        best, highest, last, idle = None, -np.inf, np.inf, 0
        for _ in range(STEPS):
            post = solve(data, residual, columns, self.prior(model, links), start, fixed)
            start = post
            before = post.misfit + post.prior_cost(0 * post.step)
            expected = before - post.predicted(post.step)
            best = Fitted(model, links, post, residual, len(data.start.terms))
            idle = idle + 1 if post.log_evidence < highest + IDLE and expected > last / 2 else 0
            highest, last = max(highest, post.log_evidence), expected
            if expected < GAIN or idle == 2:
                break
            for damping in DAMPINGS:
                step = post.damped(damping)
                there, errors = self.moved(model, links, step)
                after = data.residual(found, there)
                cost = post.cost(after) + post.prior_cost(step)
                if cost < before:
                    break
            else:
                break
            missed = np.sum((after - (residual - columns @ step)) ** 2)
            linear = missed <= BEND**2 * np.sum((after - residual) ** 2)
            model, links, residual = there, errors, after
            if linear and not damping:
                best = Fitted(model, links, post, residual, len(data.start.terms))
                break
            if missed > BEND * np.sum((found.residual - after) ** 2):
                found = data.rows(model)
                columns = self.columns(model, links, found)
        assert best is not None
        return best

    def restarted(self, fitted: Fitted, i: int) -> Fitted:
        """The most probable of a fit and of those from other starts of one of the added effects, by its number."""
        k, best, (effect, named) = fitted.base + i, fitted, (fitted.extra[i].effect, fitted.extra[i].named)
        for other, theta in effect.starts(named) if isinstance(effect, MovesLink) else ():
            term = replace(fitted.extra[i], effect=other).with_values(np.array([theta[p.name] for p in other.parameters]))
            terms = (*fitted.model.terms[:k], term, *fitted.model.terms[k + 1 :])
            new = self.fit(replace(fitted.model, terms=terms), fitted.links, fitted.posterior)
            best = max(best, new, key=lambda f: f.log_evidence)
        return best

    def with_signs(self, fitted: Fitted) -> Fitted:
        """The fit whose dry friction changes sign in the most probable of its ways, one of `Effect.sign_forms` at each joint."""
        tried: set = set()
        while True:
            found = [(i, form, width) for i, gain, form, width in self._other_signs(fitted) if gain > OTHER_SIGN]
            better = {i: (form, width) for i, form, width in found if (i, form) not in tried}
            if not better:
                return fitted
            tried |= {(i, form) for i, (form, _) in better.items()}
            terms = list(fitted.model.terms)
            for i, (form, width) in better.items():
                at = {form.joints: width}
                terms = [widened(replace(t, effect=form) if k == i else t, at) for k, t in enumerate(terms)]
            new = self.fit(replace(fitted.model, terms=tuple(terms)), fitted.links, fitted.posterior)
            if new.log_evidence > fitted.log_evidence:
                fitted = new

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

    def _other_signs(self, fitted: Fitted) -> Iterator[tuple[int, float, Effect, float]]:
        """For each term of dry friction its number, the largest gain of another form and width, all else linear, and these two."""
        post, data = fitted.posterior, self.data
        inverse = np.linalg.pinv(post.matrix, hermitian=True)
        for i, term in enumerate(fitted.model.terms[: fitted.base]):
            others = [(f, w) for f in term.effect.sign_forms if f != term.effect for w in WIDTHS]
            if not others or not term.width:
                continue
            (j,), own = term.effect.joints, data.friction(term.effect, term.width)
            changes = term.values[0] * np.array([data.friction(*other) - own for other in others]).T
            one, sigma = post.joints[j], post.sizes.sigma[j]
            d, y, x = one.white @ changes, one.white @ fitted.residual[j], one.white @ post.columns[j]
            left = one.beyond_discrepancy(d, (sigma / post.sizes.discrepancy[j]) ** 2) / sigma**2
            slope = x.T @ left
            gains = y @ left - 0.5 * np.sum(d * left, axis=0) + 0.5 * np.sum(slope * (inverse @ slope), axis=0)
            best = int(np.argmax(gains))
            yield i, float(gains[best]), *others[best]

    def believed(self, trial: Trial, theta: Mapping[str, float]) -> bool:
        """Whether an effect's parameters are where their prior is not 0."""
        if (trial.effect.name, trial.effect.joints) not in self.families:
            return True  # a black-box term has the shape of its trial
        every = zip(trial.effect.parameters, self.spans(trial.effect), strict=True)
        return all(span.low <= theta[p.name] <= span.high for p, span in every)

    def columns(self, model: CalibratedModel, links: np.ndarray, found: Rows) -> np.ndarray:
        """Derivatives by the terms' parameters, the links' errors and the logarithms of the widths of dry friction, (n, M, p)."""
        size = len(model.values)
        by_links = found.jacobian[:, :, size:] @ self.data.links.at(links)[1]
        return np.concatenate(
            [found.jacobian[:, :, :size], by_links, self.data.by_widths(model, list(self.widths(model)))], axis=2
        )

    def widths(self, model: CalibratedModel) -> dict[tuple[int, ...], float]:
        """Width of the sign of each joint's dry friction [rad/s]."""
        return {t.effect.joints: float(t.width) for t in model.terms if t.effect.sign_forms and t.width}

    def moved(self, model: CalibratedModel, links: np.ndarray, step: np.ndarray) -> tuple[CalibratedModel, np.ndarray]:
        """The model after a change of its parameters, and the links' errors."""
        size, k = len(model.values), len(links)
        terms = with_parameter_values(model.terms, model.values + step[:size])
        errors = links + step[size : size + k]
        there = replace(model, terms=terms, robot=replace(model.robot, inertial=self.data.links.at(errors)[0]))
        new = {
            joints: float(np.clip(w * np.exp(s), WIDTHS[0], WIDTHS[-1]))
            for (joints, w), s in zip(self.widths(model).items(), step[size + k :], strict=True)
        }
        return replace(there, terms=tuple(widened(t, new) for t in there.terms)), errors

    def prior(self, model: CalibratedModel, links: np.ndarray) -> Prior:
        """The prior of changes of a model's parameters."""
        base, precision, mean, flat, proper = len(self.data.start.terms), [], [], [], []
        plain = sum(len(t.estimates) for t in model.terms[:base])
        precision += list(self.plain_std[:plain] ** -2.0)
        mean += [0.0] * plain  # so wide that it draws nothing
        flat += [0.0] * plain
        proper += [False] * plain
        low, high = bounds(model.terms)
        at = plain
        for term in model.terms[base:]:
            wide = self.excess(term)[0]
            for span, value in zip(self.spans(term.effect), term.values, strict=True):
                for to, number in zip((mean, precision, flat), span.of_change(value, wide), strict=True):
                    to.append(number)
                proper.append(True)
                low[at], high[at] = max(low[at], span.low), min(high[at], span.high)
                at += 1
        k = len(links)
        precision += [1.0] * k
        mean += list(-links)
        flat += [0.0] * k
        proper += [True] * k
        widths = self.widths(model)
        precision += [1.0] * len(widths)
        mean += [0.0] * len(widths)
        flat += [0.0] * len(widths)
        proper += [False] * len(widths)
        lower, upper = np.full(len(mean), -np.inf), np.full(len(mean), np.inf)
        values = model.values
        factor = np.array([p.factor for t in model.terms for p in t.effect.parameters], float)
        f = np.flatnonzero(np.isfinite(factor))
        low[f], high[f] = np.maximum(low[f], values[f] / factor[f]), np.minimum(high[f], values[f] * factor[f])
        lower[: len(low)], upper[: len(high)] = np.minimum(low - values, 0), np.maximum(high - values, 0)
        at = np.array(list(widths.values()))
        lower[len(mean) - len(at) :], upper[len(mean) - len(at) :] = np.log(WIDTHS[0] / at), np.log(WIDTHS[-1] / at)
        which = np.zeros(len(mean), bool)
        which[len(mean) - len(at) - k : len(mean) - len(at)] = self.data.free
        return Prior(np.array(mean), np.array(precision), np.array(proper), which, lower, upper, np.array(flat))

    def spans(self, effect: Effect) -> list[Span]:
        """The priors of an effect's parameters."""
        if effect not in self._spans:
            family = self.families.get((effect.name, effect.joints), [])
            self._spans[effect] = spans(family, effect, self.view, self.priors)
        return self._spans[effect]

    def scales(self, trial: Trial) -> np.ndarray:
        """Prior standard deviations of a trial's coefficients, (m,)."""
        if id(trial) not in self._scales:  # that trial is kept, so that no other is given its number
            self._scales[id(trial)] = trial, self.priors.scales(self.view, trial)
        return self._scales[id(trial)][1]

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

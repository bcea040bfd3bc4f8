"""Models that recordings do not tell from the reported one, as whole models: whoever designs for the arm has to reckon with each."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import fminbound

from rrr_oc.calibration.calibrated_model import Alternative, CalibratedModel, Term
from rrr_oc.calibration.estimator.data import Data
from rrr_oc.calibration.estimator.fitting import Fitted
from rrr_oc.calibration.estimator.intervals import described
from rrr_oc.calibration.model_file import alternative_entry, alternative_of
from rrr_oc.diagnosis.findings import contribution, equal_terms, negligible
from rrr_oc.diagnosis.fitting import Fitter
from rrr_oc.diagnosis.knobs import NEGLIGIBLE
from rrr_oc.diagnosis.result import LINK_ERRORS, Finding, Key, Suggestion, shown_as
from rrr_oc.effects import LinkSpring
from rrr_oc.effects.words import listed
from rrr_oc.errors import noted

STEP = 0.25  # [rad] between moves of an equilibrium that are tried first; doubled, a spring that is hardly taut may be missed
CLOSE = 1e-7  # [rad] to which the move is found
MOVES = np.arange(-24, 25) * STEP


@dataclass(frozen=True)
class Exchange:
    """A fit that is as good as another one.

    Attributes:
        fitted: The fit.
        has: What it has that the other has not.
        lacks: What the other has in the place of these.
    """

    fitted: Fitted
    has: tuple[Key, ...]
    lacks: tuple[Key, ...]


def beside(
    fitter: Fitter, complete: Fitted, claimed: Sequence[Finding], worse: Sequence[Finding], undecided: bool
) -> list[Exchange]:
    """The fit of all effects of a complete one that are not refuted, if the reported model lacks one of them.

    Args:
        claimed, worse: What is in the reported model, and what does not lower the error.
        undecided: Whether links stand for one of these effects there.
    """
    (known, gone) = ({f.term for f in some} for some in (claimed, worse))
    more = tuple(shown_as(t) for t in complete.extra if t not in known | gone)
    if not more:
        return []
    terms = tuple(t for t in complete.model.terms if t not in gone)
    model = replace(complete.model, terms=terms)
    fitted = fitter.fit(model, complete.links, complete.posterior) if gone else complete
    return [Exchange(fitted, more, (LINK_ERRORS,) if undecided else ())]


def alternatives(
    fitter: Fitter, exchanges: Sequence[Exchange], told: CalibratedModel, closest: Fitted, failed: dict[str, str]
) -> tuple[Alternative, ...]:
    """Each exchange as the model that predicts best, laws that are equal where the recordings went, in the place of claimed ones, and
    springs with other equilibria; as they are read back.

    Args:
        told: The reported model, as `described` gives it.
        closest: The fit that it is of.
        failed: Takes why there is none.
    """
    data, result = fitter.data, []
    for one in exchanges:
        with noted(failed, f"alternative: {_says(one.has, one.lacks, told.joints)}"):
            result += _exchanged(fitter, one)
    for i, term in enumerate(told.terms[closest.base :]):
        with noted(failed, f"alternatives to {_named(shown_as(term), told.joints)}"):
            others = equal_terms(data, closest, i)
            result += [_alternative(_with(told, term, other), (shown_as(other),), (shown_as(term),)) for other in others]
    for spring, other in itertools.permutations(told.terms, 2):
        one, (own, gone) = _Turned(told, spring, other), (_named(shown_as(t), told.joints) for t in (spring, other))
        says = f"{own} with another equilibrium in the place of {gone}"
        with noted(failed, f"alternative: {says}"):
            if one.may_be and (model := one.as_good(data)) is not None:
                result.append(replace(_alternative(model, (shown_as(spring),), (shown_as(other),)), says=says))
    return tuple(result)


@dataclass(frozen=True)
class _Turned:
    """A model without one term, in the place of which the equilibrium of a spring is moved: one that is taut in all recordings gives
    the torque of an offset of the torque sensor as well."""

    told: CalibratedModel
    spring: Term
    other: Term

    @property
    def may_be(self) -> bool:
        """Whether the spring, beside an effect of drives or sensors with one parameter, is on its joints in all recordings."""
        spring, other = self.spring, self.other
        everywhere = (
            spring.recordings == other.recordings == "all" and other.effect.side != "link" and other.effect.role == "law"
        )
        inside = bool(other.effect.joints) and set(other.effect.joints) <= set(spring.effect.joints)
        return isinstance(spring.effect, LinkSpring) and everywhere and inside and len(other.estimates) == 1

    def as_good(self, data: Data) -> CalibratedModel | None:
        """The model with the equilibrium that stands for the other term best, if none of its predictions differs by what counts.

        A term without which that is so already, such as one whose size is at a bound of 0, needs nothing in its place.
        """
        residual = data.residual(self.told)

        def change(x: float) -> np.ndarray:
            return (data.residual(self.at(x)) - residual) * data.counted

        def missed(x: float) -> float:
            return float(np.sum(change(x) ** 2))

        if negligible(data, change(0.0)):
            return None
        start = min(MOVES, key=missed)
        x = float(np.ravel(fminbound(missed, start - STEP, start + STEP, xtol=CLOSE))[0])
        return replace(self.at(x), spread=self.spread(x)) if negligible(data, change(x)) else None

    def moved(self, x: float) -> np.ndarray:
        """The spring's parameters with its equilibrium moved by x [rad]."""
        effect = self.spring.effect
        assert isinstance(effect, LinkSpring)
        values = effect.moved(self.spring.named, x)
        return np.array([values[p.name] for p in effect.parameters])

    def at(self, x: float) -> CalibratedModel:
        """The model at such a move [rad]."""
        turned = self.spring.with_values(self.moved(x))
        terms = tuple(turned if t is self.spring else t for t in self.told.terms if t is not self.other)
        return replace(self.told, terms=terms)

    def spread(self, x: float) -> np.ndarray | None:
        """Its spread, where x = − (size of the other term) / stiffness."""
        if self.told.spread is None:
            return None
        at, gone = (_first(self.told, one) for one in (self.spring, self.other))
        effect = self.spring.effect
        stiff = at + [p.name for p in effect.parameters].index(effect.amplitudes[0])
        k, size = self.told.values[[stiff, gone]]
        spread, by_x = self.told.spread.copy(), self.moved(1.0) - self.spring.values
        spread[at : at + len(by_x)] += np.outer(by_x, x * (spread[gone] / size - spread[stiff] / k))
        return np.delete(spread, gone, axis=0)


def decided(found: Sequence[Alternative], suggestions: Sequence[Suggestion]) -> tuple[Alternative, ...]:
    """Alternatives with the file of the suggested motion that tells them from the model."""
    named = {f"suggested_{k}.csv": set(s.separates) for k, s in enumerate(suggestions, 1)}
    files = [next((file for file, names in named.items() if len(names & set(a.effects)) > 1), None) for a in found]
    return tuple(replace(a, decided_by=file) for a, file in zip(found, files, strict=True))


def _exchanged(fitter: Fitter, one: Exchange) -> list[Alternative]:
    """An exchange as the model that predicts best. What does nothing there, such as a gear that has become rigid, is not in it; none where
    that is all that it has."""
    closest = fitter.closest(one.fitted)
    does = [
        shown_as(t) not in one.has or contribution(fitter.data, closest, i) >= NEGLIGIBLE for i, t in enumerate(closest.extra)
    ]
    if not all(does):
        terms = (*one.fitted.model.terms[: one.fitted.base], *itertools.compress(one.fitted.extra, does))
        closest = fitter.closest(replace(one.fitted, model=replace(one.fitted.model, terms=terms)))
    has = tuple(dict.fromkeys(key for key in map(shown_as, closest.extra) if key in one.has))
    return [_alternative(described(closest), has, one.lacks)] if has else []


def _alternative(model: CalibratedModel, has: Sequence[Key], lacks: Sequence[Key]) -> Alternative:
    """As it is read back, so that one that no file can hold fails here."""
    names = tuple(dict.fromkeys(name for name, _ in (*has, *lacks)))
    return alternative_of(alternative_entry(Alternative(model, _says(has, lacks, model.joints), names)), model)


def _says(has: Sequence[Key], lacks: Sequence[Key], joints: Sequence[str]) -> str:
    own, other = ([_named(key, joints) for key in keys] for keys in (has, lacks))
    says = " in the place of ".join(listed(names) for names in (own, other) if names)
    return says if own else f"without {says}"


def _named(key: Key, joints: Sequence[str]) -> str:
    if key == LINK_ERRORS:
        return "other links"
    return key[0] + (f" of {' and '.join(joints[j] for j in key[1])}" if key[1] else "")


def _first(model: CalibratedModel, term: Term) -> int:
    """Number of a term's first parameter."""
    return model.offsets[model.terms.index(term)]


def _with(model: CalibratedModel, term: Term, other: Term) -> CalibratedModel:
    """A model with another term of as many parameters in the place of one; what is not known of these is as much as before."""
    spread, at = model.spread, _first(model, term)
    if spread is not None:
        spread = spread.copy()
        spread[at : at + len(term.estimates)] *= np.where(other.values == -term.values, -1.0, 1.0)[:, None]
    terms = tuple(other if t is term else t for t in model.terms)
    return replace(model, terms=terms, spread=spread)

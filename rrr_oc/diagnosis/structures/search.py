"""The search over structures: effects are added, removed and exchanged until no move raises the posterior probability.

Each fit is a linear problem, in which all neighbours of its structure are predicted (`neighbours`); the most probable ones are
fitted exactly, and the best goes on.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.calibration.estimator.evidence import Hyperparameters, Joint, NoiseStart, Posterior, gain_of_other_noise
from rrr_oc.calibration.estimator.fitting import STEPS_ON, Fitted
from rrr_oc.calibration.link_findings import FAR
from rrr_oc.diagnosis.fitting import Fitter, exact
from rrr_oc.diagnosis.signatures import Signatures, Tables
from rrr_oc.diagnosis.structures.linear import Key, Level, Linear, Structure, key_of, numbered
from rrr_oc.diagnosis.structures.neighbours import LEAST_GAIN, Neighbours, Predicted, Repetitions, beside, identity, overlapping
from rrr_oc.effects import MovesLink, Trial

RENEWED = 16  # neighbours by one kind of move whose noise is estimated anew
UNCHANGED = 0.03  # of a joint's residual, by which it may change with the same noise
FITTED = 2  # neighbours of a structure by one kind of move that are fitted exactly
NEAR_ENOUGH = 4  # steps of a fit that is only a place to linearise at
LINK_SHARES = (1.0, 0.3, 0.0)  # of the predicted change of the links' errors, with one of which a fit begins
CLOSE, SLACK = 5.0, 0.2  # nats, and share of its gain, by which a neighbour may be better than predicted


@dataclass
class FittedStructure:
    """A structure that was fitted.

    Attributes:
        fitted: Its fit.
        score: Logarithm of its posterior probability, up to a constant.
    """

    fitted: Fitted
    score: float


@dataclass(frozen=True)
class Memory:
    """What a search remembers, without its data.

    Attributes:
        path: Of each structure that was accepted: its model, the errors of its links, its score, what is estimated beside the parameters,
            and of each joint the degrees of freedom of its noise, the weights of its rows and the logarithm of W's determinant.
        visited, predicted: See `StructureSearch`.
    """

    path: tuple[tuple[CalibratedModel, np.ndarray, float, Hyperparameters, tuple[tuple[float, np.ndarray, float], ...]], ...]
    visited: dict[Key, float]
    predicted: dict[Key, float]


def name_of(term: Term) -> tuple:
    """What a structure is compared by: effect without its range, joints, groups."""
    return term.effect.without_range(), term.groups


@dataclass
class StructureSearch:
    """One search.

    Attributes:
        fitter: Fits models.
        few: Fits models to a part of the recordings, from which fits to all of them go on; `fitter` where they are short.
        tables: Signatures of what is sought.
        report: Receives what has just happened and the number of structures that were fitted.
        visited: Log posterior of each structure that was fitted, by its effects.
        predicted: The same of the neighbours of the last one.
        path: The structures that were accepted, one after the other.
    """

    fitter: Fitter
    few: Fitter
    tables: Tables
    report: Callable[[str, int], None] = lambda *_: None
    visited: dict[Key, float] = field(default_factory=dict)
    predicted: dict[Key, float] = field(default_factory=dict)
    path: list[FittedStructure] = field(default_factory=list)
    _missed: dict[Key, float] = field(default_factory=dict, repr=False)
    _waiting: dict[Key, float] = field(default_factory=dict, repr=False)
    _near: list[Neighbours] = field(default_factory=list, repr=False)

    @classmethod
    def of(
        cls, fitter: Fitter, trials: Sequence[Trial], report: Callable[[str, int], None] = lambda *_: None
    ) -> "StructureSearch":
        """A search among trials of the catalogue, and black-box terms."""
        return cls(fitter, fitter.few(), Tables(fitter.data.prepared, fitter.data.kept, trials, fitter.view), report)

    @property
    def memory(self) -> Memory:
        """What it remembers."""

        def of(at: FittedStructure) -> tuple[Any, ...]:
            post = at.fitted.posterior
            joints = tuple((one.freedom, one.weights(post.data, j), one.log_det) for j, one in enumerate(post.joints))
            return at.fitted.model, at.fitted.links, at.score, post.hyper, joints

        return Memory(tuple(map(of, self.path)), dict(self.visited), dict(self.predicted))

    def restored(self, memory: Memory) -> "StructureSearch":
        """The search with what it remembers, its structures fitted again under the hyperparameters that were estimated."""
        data, path = self.fitter.data, []
        for model, links, score, hyper, kept in memory.path:
            joints = tuple(Joint.weighted(data, j, hyper.noise[j], *one) for j, one in enumerate(kept))
            path.append(FittedStructure(self.fitter.fit(model, links, NoiseStart(hyper, joints), fixed=True), score))
        return replace(self, visited=dict(memory.visited), predicted=dict(memory.predicted), path=path)

    def scored(self, fitted: Fitted) -> FittedStructure:
        """A fit with the prior probability of its structure."""
        score = fitted.log_evidence + self._log_prior(fitted.extra)
        key = key_of(name_of(t) for t in fitted.extra)
        self.visited[key] = max(score, self.visited.get(key, -np.inf))
        return FittedStructure(fitted, score)

    def _log_prior(self, terms: Sequence[Term]) -> float:
        each = (self.fitter.log_prior(t.effect, t.groups or None) + self.fitter.excess(t)[1] for t in terms)
        return float(sum(each))

    def run(self, start: Fitted) -> FittedStructure:
        """The best structure that the moves reach from a fitted model.

        Of long recordings, effects are added on a part of them first, which tells most from others.
        """
        self._missed.clear()
        self._waiting.clear()
        self.path[:] = [self.scored(start)]
        if self.few is not self.fitter:
            part = StructureSearch.of(self.few, self.tables.trials, self.report)
            part.path[:] = [part.scored(self.few.fit(start.model, start.links))]
            while (better := part._better(part.path[-1], additions=True)) is not None:
                part.path.append(better)
            there = self.scored(self._on_all(part.path[-1].fitted, start.posterior))
            self.path += [there] if there.score > self.path[0].score else []
        while (better := self._better(at := self.path[-1]) or self._reformed(at) or self._in_all(at)) is not None:
            self.path.append(better)
        return self.path[-1]

    def completed(self, at: FittedStructure) -> Fitted:
        """The fit of a structure with all further effects that are sure, however small."""
        near = self.neighbours(at.fitted)
        here = near.at(near.linear.own, at.fitted.posterior.hyper)
        refused = {key - here.key for key, score in self.visited.items() if key > here.key and score < at.score}
        best = near.completed(here, refused)
        if best is here:
            return at.fitted
        found = self._fitted(at, best)
        return found.fitted if found.score > at.score else at.fitted

    def worths(self, at: FittedStructure) -> list[float]:
        """By how much the log posterior falls without each effect; as fitted where that is known, else as predicted."""
        near, result = self.neighbours(at.fitted), []
        here = near.at(near.linear.own, at.fitted.posterior.hyper)
        for i, own in enumerate(here.structure):
            less = near.at((*here.structure[:i], *here.structure[i + 1 :]), here.solution.hyper)
            alone = sum(a.name == own.name for a in here.structure) == 1  # else the key does not say which is left out
            known = self.visited.get(less.key) if alone else None
            result.append(here.score - less.score if known is None else at.score - known)
        return result

    def neighbours(self, fitted: Fitted) -> Neighbours:
        """What may be in the place of a fit; that of the last fit that was asked for is kept."""
        if not self._near or self._near[0].linear.fitted is not fitted:
            self._near[:] = [self._neighbours(fitted)]
        return self._near[0]

    def _neighbours(self, fitted: Fitted) -> Neighbours:
        linear = Linear.of(self.fitter, fitted)
        level = Level(linear)

        @cache
        def exact_arm() -> Neighbours | None:
            post = fitted.posterior
            hyper = exact(post.hyper)
            if hyper is None:
                return None
            start = replace(post, hyper=hyper)
            near = self._on_few(fitted.model, fitted.links, start, fixed=True, steps=NEAR_ENOUGH)
            return self._neighbours(self._on_all(near, start, fixed=True, steps=1))

        return Neighbours(linear, self._tables_of(fitted), level.whole, level, exact_arm)

    @property
    def repetitions(self) -> Repetitions:
        """Searches on parts of the recordings, from the last structure on."""
        some = [at.fitted for at in self.path]
        keys = [key_of(name_of(t) for t in fitted.extra) for fitted in some]
        return Repetitions(keys, self.neighbours(some[-1]), lambda number, trials: self.tables.of(some[number].model, trials))

    def _tables_of(self, fitted: Fitted) -> Callable[[int | None], Signatures]:
        """The tables at a fit, each made when it is first asked for."""
        return cache(lambda joint: self.tables.at(fitted.model, joint))

    def _better(self, at: FittedStructure, additions: bool = False) -> FittedStructure | None:
        """The best neighbour by the first kind of move that has a better one; only `additions` are made if so asked for."""
        near = self.neighbours(at.fitted)
        here = near.at(near.linear.own, at.fitted.posterior.hyper)
        self.predicted.clear()
        exchanged = partial(near.exchanged, score=at.score, waiting=self._waiting)
        moves = (near.removed, near.several_added, exchanged, near.unexplained)
        for move in moves[:2] if additions else moves:
            every = self._renewed(here, move(here))
            self.predicted |= {p.key: at.score + p.score - here.score for p in every}
            better = self._best(at, here, every)
            if better is not None:
                return better
        return None

    def _renewed(self, here: Predicted, every: Sequence[Predicted]) -> list[Predicted]:
        """Neighbours with the noise of those that are most probable estimated anew, the most probable first.

        Products of whitened columns hold for one noise. What explains much of a residual leaves another, in which it explains more.
        """
        if not every:
            return []
        data, rows = self.fitter.data, np.arange(self.fitter.data.edges[-1])
        present = here.linear.left(here.structure, here.solution.step, rows)
        now = np.array([self._gain_of_noise(here, j, present[j]) for j in range(data.n)])

        def more(p: Predicted) -> float:
            left = p.linear.left(p.structure, p.solution.step, rows)
            changed = np.linalg.norm(left - present, axis=1) > UNCHANGED * np.linalg.norm(present, axis=1)
            return sum(self._gain_of_noise(p, j, left[j]) - now[j] for j in np.flatnonzero(changed).tolist())

        some = [replace(p, score=p.score + more(p)) for p in every[:RENEWED]]
        return sorted([*some, *every[RENEWED:]], key=lambda p: -p.score)

    def _gain_of_noise(self, p: Predicted, j: int, left: np.ndarray) -> float:
        one, hyper = p.linear.fitted.posterior.joints[j], p.solution.hyper
        return gain_of_other_noise(self.fitter.data, j, one, hyper.sigma[j], hyper.discrepancy[j], left)

    def _best(self, at: FittedStructure, here: Predicted, every: Sequence[Predicted]) -> FittedStructure | None:
        """The best of some neighbours that is better than where the search is, fitted exactly.

        A shape may be better than it is predicted on the grid of its trials. By as much as a change of a structure missed its
        prediction when it was fitted last, it is expected to miss it again.
        """
        best, chosen, more, tried = None, None, 0.0, list[tuple[FittedStructure, Predicted]]()
        hopeful = [p for p in every if p.score - self._missed.get(here.key ^ p.key, 0.0) > here.score - CLOSE * p.is_nonlinear]
        for p in hopeful[:FITTED]:
            gain = p.score - here.score
            rival = chosen is None or any(beside(a.effect, b.effect) for a in p.new for b in chosen.new)
            most = at.score + ((1 + SLACK) * gain + CLOSE + more if rival else gain)  # what is no rival remains to be added
            several = len({a.name for a in p.structure}) < len(p.structure)  # then the key does not say of which shape
            if (p.key in self.visited and not several and p.key != here.key) or (best is not None and most < best.score):
                continue
            more_or_same = (
                len(p.structure) > len(here.structure) or p.key == here.key
            )  # else one shape may follow the other without end
            gained = at.score + LEAST_GAIN * more_or_same
            least = (gained if best is None else best.score) - CLOSE
            found = self._fitted(at, p, least)
            tried.append((found, p))
            beyond = found.score - at.score - gain
            self._missed[here.key ^ p.key] = max(-beyond, 0.0)
            more = max(more, beyond)  # by as much as one exceeds its prediction, another may
            if found.score > least + CLOSE:
                best, chosen = found, p
        for found, p in tried:
            gain = p.score - here.score
            # far from linear there may be other optima, of what is best, comes close to it, or was to do so
            wanted = at.score + LEAST_GAIN if best is None else best.score
            if max(found.score, at.score + gain) > wanted - CLOSE and abs(found.score - at.score - gain) > SLACK * gain:
                other = self._restarted(found, p)
                best = other if other.score > wanted else best
        if best is None:
            return None
        self.report(_said(at.fitted, best.fitted), len(self.visited))
        return best

    def _fitted(self, at: FittedStructure, p: Predicted, wanted: float = -np.inf) -> FittedStructure:
        """A predicted structure, fitted from where it is predicted on, with its score; not to the end if that is less than `wanted`."""
        return self.scored(self.fit(at.fitted, p, wanted))

    def fit(self, at: Fitted, p: Predicted, wanted: float = -np.inf) -> Fitted:
        """A predicted structure, fitted from where it is predicted on, with hyperparameters that begin with those of a fit.

        Errors of links begin with that share of what is predicted with which the residual is smallest: bodies are exponential in them.
        """
        about, start = p.linear.fitted, NoiseStart(p.solution.hyper, p.linear.fitted.posterior.joints)
        model = replace(about.model, terms=terms_of(about, p.structure, self.fitter.data.labels))
        step = np.zeros(len(self.fitter.prior(model, about.links).mean))
        plain = about.model.offsets[about.base]
        rest = len(about.links) + len(self.fitter.widths(model))
        step[:plain], step[len(step) - rest :] = p.solution.step[:plain], p.solution.step[plain : plain + rest]
        own, most = slice(len(step) - rest, len(step) - rest + len(about.links)), np.maximum(np.abs(about.links), FAR)
        ahead, begin = np.clip(about.links + step[own], -most, most) - about.links, self._start_of_few(start)

        def at_share(share: float) -> tuple[float, CalibratedModel, np.ndarray]:
            step[own] = share * ahead
            there, links = self.fitter.moved(model, about.links, step)
            return begin.cost(self.few.data.residual(there)), there, links

        _, model, links = min((at_share(share) for share in (LINK_SHARES if ahead.any() else (1.0,))), key=lambda one: one[0])
        wanted -= self._log_prior(model.terms[about.base :])
        near = self._on_few(model, links, start, wanted=wanted if self.few is self.fitter else -np.inf)
        if self.few is not self.fitter or near.log_evidence > wanted:
            near = self.few.with_signs(near)
        return self._on_all(near, start, wanted=wanted)

    def _start_of_few(self, start: Posterior | NoiseStart) -> Posterior | NoiseStart:
        return start if self.few is self.fitter else NoiseStart.of(self.few.data, start.hyper)

    def _on_few(self, model: CalibratedModel, links: np.ndarray, start: Posterior | NoiseStart, **options: Any) -> Fitted:
        """A fit to the part of the recordings; `start` is of all of them."""
        return self.few.fit(model, links, self._start_of_few(start), **options)

    def _on_all(self, near: Fitted, start: Posterior | NoiseStart, **options: Any) -> Fitted:
        """The fit to all recordings that goes on from one to the part of them."""
        options = {"steps": STEPS_ON} | options
        return near if self.few is self.fitter else self.fitter.fit(near.model, near.links, start, **options)

    def _restarted(self, found: FittedStructure, p: Predicted) -> FittedStructure:
        """The most probable of a fit and of those from other starts of its new effects."""
        return self._from_other_starts(found, [i for i, a in enumerate(p.structure) if a in p.new])

    def _reformed(self, at: FittedStructure) -> FittedStructure | None:
        """A better fit of the last structure from other starts of its effects, but for gears, fits of which take long."""
        some = [i for i, t in enumerate(at.fitted.extra) if not isinstance(t.effect, MovesLink)]
        better = self._from_other_starts(at, some)
        return better if better.score > at.score + LEAST_GAIN else None

    def _in_all(self, at: FittedStructure) -> FittedStructure | None:
        """The best fit with an effect of some groups in all of them, if it is more probable; it replaces what the other groups have.

        The trial that led to it may have ruled out groups in which the law changes nothing once it is fitted.
        """
        best, model, base = at, at.fitted.model, at.fitted.base
        for term in at.fitted.extra:
            if not term.groups or term.effect.partly == 1:  # such an effect never holds for all
                continue
            others = [t for t in at.fitted.extra if identity(t.effect) != identity(term.effect)]
            terms = (*model.terms[:base], *others, replace(term, recordings="all", groups=()))
            near = self._on_few(replace(model, terms=terms), at.fitted.links, at.fitted.posterior)
            other = self.scored(self._on_all(near, at.fitted.posterior, wanted=best.fitted.log_evidence - CLOSE))
            best = other if other.score > best.score else best
        if best is at:
            return None
        self.report(_said(at.fitted, best.fitted), len(self.visited))
        return best

    def _from_other_starts(self, at: FittedStructure, some: Sequence[int]) -> FittedStructure:
        post, alike = at.fitted.posterior, self.few is self.fitter
        first = best = at.fitted if alike or not some else self._on_few(at.fitted.model, at.fitted.links, post)
        for i in some:
            best = self.few.restarted(best, i)
        return at if best is first else self.scored(self._on_all(best, post, wanted=at.fitted.log_evidence))


def terms_of(fitted: Fitted, structure: Structure, labels: Sequence[str]) -> tuple[Term, ...]:
    """A model's terms with the effects of a structure.

    An effect of some groups beside the same of more has values of its own there.
    """
    plain, terms = fitted.model.terms[: fitted.base], list[Term]()
    for i, a in enumerate(structure):
        if isinstance(a.source, Term):
            terms.append(a.source)
            continue
        earlier = structure[:i]
        same = [] if a.effect.placement == "many" else overlapping(a.effect, a.scope, earlier)
        if not same:
            terms.append(a.source.term)
            continue
        k = earlier.index(same[0])
        other, some = terms[k], a.scope or ()
        terms[k] = replace(other, recordings=(), groups=tuple(g for g in other.groups or labels if g not in some))
        terms.append(replace(other, recordings=(), groups=some))
    return (*plain, *terms)


def _said(before: Fitted, after: Fitted) -> str:
    """The difference of two structures, for a line of progress."""
    old, new = (dict(zip(numbered(map(name_of, f.extra)), f.extra, strict=True)) for f in (before, after))
    gone = [described(t, before) for name, t in old.items() if name not in new]
    more = [described(t, after) for name, t in new.items() if name not in old]
    said = " and ".join(more) or "without"
    return said + (" in place of " * bool(more) or " ") + " and ".join(gone) if gone else said


def described(term: Term, fitted: Fitted) -> str:
    """An effect with its joints and groups, for a line of progress."""
    joints = ", ".join(fitted.model.joints[j] for j in term.effect.joints)
    return term.effect.name + (f" of {joints}" if joints else "") + (f" in {term.groups}" if term.groups else "")

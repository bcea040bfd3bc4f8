"""The search over structures: effects are added, removed, exchanged and merged until no move raises the posterior probability."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rrr_oc.calibration.calibrated_model import Term
from rrr_oc.diagnosis.candidates import Candidate, Screen, signatures
from rrr_oc.diagnosis.evidence import Posterior
from rrr_oc.diagnosis.fitting import Fitted, Fitter
from rrr_oc.diagnosis.knobs import EXCESS
from rrr_oc.diagnosis.signatures import black_box_trials
from rrr_oc.effects import Effect, Trial

EXACT, FITTED = 4, 3  # candidates of a round whose sizes are estimated anew, and those fitted exactly
KEPT = 12  # candidates of a round that count in the posterior
NEAR = 12.0  # nats below the best within which a candidate is followed
SLACK = 0.15  # share of the nats to be made good by which a candidate's gain may be underestimated
SETTLED = 30.0  # nats by which the best alternative in an effect's place falls short, from which it is not sought again
MOST = 14  # effects at which a search ends


Identity = tuple[str, tuple[int, ...], Effect | None]  # name and joints of an effect, and which, of black-box terms
Kind = tuple[str, tuple[int, ...]]  # name and joints of an effect; of black-box terms no name, since one stands for another


@dataclass
class State:
    """A structure that was visited.

    Attributes:
        fitted: Its fit.
        score: Logarithm of its posterior probability, up to a constant.
    """

    fitted: Fitted
    score: float


def name_of(term: Term) -> tuple:
    """What a structure is compared by: effect without its range, joints, groups."""
    return term.effect.without_range(), term.groups


def identity(effect: Effect) -> Identity:
    """What tells an effect from others."""
    return effect.name, effect.joints, effect.without_range() if effect.black_box else None


def kind(effect: Effect) -> Kind:
    """What an effect has to share with another to be the same finding."""
    return "" if effect.black_box else effect.name, effect.joints


@dataclass
class Search:
    """One search.

    Attributes:
        fitter: Fits models.
        trials: All trials of the catalogue.
        report: Receives what has just happened and the number of structures that were fitted.
        most: Kinds of effects that are sought, and how many of each; all if None.
        visited: Log posterior of each structure that was scored, by its effects.
    """

    fitter: Fitter
    trials: tuple[Trial, ...]
    report: Callable[[str, int], None] = lambda *_: None
    most: Mapping[Kind, int] | None = None
    visited: dict[frozenset, float] = field(default_factory=dict)
    foreseen: dict[frozenset, float] = field(default_factory=dict)
    settled: dict[frozenset, float] = field(default_factory=dict)
    nearest: float = -np.inf

    def scored(self, fitted: Fitted) -> State:
        """A fit with the prior probability of its structure."""
        prior = 0.0
        for term in fitted.extra:
            prior += self.fitter.log_prior(term.effect, term.groups or None) + self.fitter.excess(term)[1]
        score = fitted.log_evidence + prior
        key = frozenset(name_of(t) for t in fitted.extra)
        self.visited[key] = max(score, self.visited.get(key, -np.inf))
        return State(fitted, score)

    def run(self, start: Fitted) -> State:
        """The best structure that the moves reach from a fitted model."""
        at = self.scored(start)
        while len(at.fitted.extra) < MOST:
            better = self._added(at)
            if better is None:
                better = self._exchanged(at)
            if better is None:
                better = self._unexplained(at)
            if better is None:
                break
            at = self._pruned(better)
        return at

    def within(self, most: Mapping[Kind, int], out: Sequence[Term]) -> "Search":
        """The search among some kinds of effects, of each so many; it remembers the structures without those that are `out`."""
        gone = {kind(t.effect) for t in out}

        def allowed(structure: frozenset) -> bool:
            present = [kind(effect) for effect, _ in structure]
            return all(present.count(one) <= most.get(one, 0) for one in gone)

        visited, foreseen = ({k: score for k, score in known.items() if allowed(k)} for known in (self.visited, self.foreseen))
        return replace(self, most=most, visited=visited, foreseen=foreseen, settled=dict(self.settled))

    # moves

    def _added(
        self,
        at: State,
        every: Sequence[Trial] | None = None,
        under: Posterior | None = None,
        out: Sequence[Term] = (),
        goal: float | None = None,
    ) -> State | None:
        """A further effect, by its gain at the present sizes, or at those of an exact arm, where discrepancy and links absorb nothing.

        In the place of others (`out`), sizes are those with them (`under`). A black-box term explains whatever these sizes do not.
        """
        self.nearest = -np.inf
        sought = [t for t in (self.trials if every is None else every) if self.most is None or self.most.get(kind(t.effect))]
        if not sought:
            return None
        goal, kept = at.score if goal is None else goal, at.fitted.extra
        start, black_box = at.fitted.posterior, sought[0].effect.black_box
        level = at.score - self.fitter.freed(at.fitted, start).log_evidence  # from a freed evidence to a score
        table = signatures(self.fitter.data, at.fitted.model, sought)
        hopeful: list[tuple[Screen, Candidate]] = []
        every_score: list[tuple[float, Candidate]] = []
        exact = None if under or black_box else self.fitter.exact(start)
        for post, count in ((under or start, EXACT), (exact, EXACT // 2)):
            if post is None:
                continue
            # linearised at the fit under these sizes, since predictions are far from linear in large errors of the links
            there = at.fitted if post is start else self.fitter.fit(at.fitted.model, at.fitted.links, post, fixed=True)
            post = self.fitter.freed(there, post)
            screen = Screen.of(self.fitter, there, table, post)
            candidates = [c for c in screen.candidates() if self._open(c, kept) and not _same(c, out)]
            # of the structure without the candidate, under the sizes of the screen
            base = level + post.log_evidence
            if count == EXACT:
                for c in candidates[:KEPT]:
                    key = frozenset([*(name_of(t) for t in kept), name_of(c.term)])
                    self.foreseen[key] = max(base + c.gain, self.foreseen.get(key, -np.inf))
            every_score += [(base + c.gain, c) for c in candidates]
            least = [goal - base - max(NEAR if _bent(c) else NEAR / 3, SLACK * (goal - base)) for c in candidates]
            hopeful += [(screen, c) for c, low in zip(candidates, least, strict=True) if c.gain > low][:count]
        self.nearest = max((score for score, _ in every_score), default=-np.inf)
        best = self._best(at, hopeful, level, goal)
        if best is not None:
            added, foreseen = best.fitted.extra[-1], {}
            for score, c in every_score:
                foreseen[c.key] = max(score, foreseen.get(c.key, -np.inf))
            own = foreseen.pop(
                (added.effect.name, added.effect.joints)
            )  # not its fitted score: a fit finds more than is foreseen
            self.settled[frozenset([name_of(added)])] = own - max(foreseen.values(), default=-np.inf)
        return best

    def _best(self, at: State, hopeful: Sequence[tuple[Screen, Candidate]], level: float, goal: float) -> State | None:
        """The best of some candidates beyond `goal`, fitted exactly; `level` is what turns a freed evidence into a score."""
        judged: dict[tuple, tuple[float, Screen, Candidate, Posterior]] = {}
        for screen, c in hopeful:
            post = screen.evaluated(c)
            score = level + post.log_evidence + c.log_prior + float(np.log(EXCESS[c.excess]))
            if (c.key, c.scope) not in judged or score > judged[c.key, c.scope][0]:
                judged[c.key, c.scope] = score, screen, c, post
        order = sorted(judged.values(), key=lambda x: -x[0])
        found: list[State] = []
        for k, (score, screen, c, post) in enumerate(order[:FITTED]):
            best = max((s.score for s in found), default=goal)
            if score < best - (NEAR if _bent(c) else 1.0) and not (k == 0 and _bent(c)):
                continue
            model = replace(screen.fitted.model, terms=self._extended(screen.fitted, c))
            found.append(self.scored(self.fitter.with_signs(self.fitter.drawn(model, screen.fitted.links, post, _bent(c)))))
        result = max(found, key=lambda s: s.score, default=None)
        if result is None or result.score <= goal:
            return None
        self.report(f"{described(result.fitted.extra[-1], result.fitted)}: {result.score - goal:+.1f}", len(self.visited))
        return result

    def _overlapping(self, c: Candidate, extra: Sequence[Term]) -> list[Term]:
        """The terms of a candidate's effect on its joints, in some of its groups."""
        effect = c.trial.effect
        return [
            t
            for t in extra
            if (t.effect.name, t.effect.joints) == c.key
            and (not effect.black_box or t.effect.without_range() == effect.without_range())
            and (not t.groups or c.scope is None or set(c.scope) & set(t.groups))
        ]

    def _open(self, c: Candidate, extra: Sequence[Term]) -> bool:
        """Whether a candidate is new and sought; where its effect is there, it may say that some groups differ from the rest."""
        labels = self.fitter.data.labels
        own = kind(c.trial.effect)
        if self.most is not None and sum(kind(t.effect) == own for t in extra) >= self.most.get(own, 0):
            return False
        return c.trial.effect.placement == "many" or all(
            c.scope is not None and c.trial.effect.partly > 0 and set(c.scope) < set(t.groups or labels)
            for t in self._overlapping(c, extra)
        )

    def _extended(self, fitted: Fitted, c: Candidate) -> tuple[Term, ...]:
        """A model's terms with a candidate, which has values of its own where its effect is there already."""
        same = [] if c.trial.effect.placement == "many" else self._overlapping(c, fitted.extra)
        if not same:
            return (*fitted.model.terms, c.term)
        (other,), some = same[:1], c.scope or ()
        rest = tuple(g for g in other.groups or self.fitter.data.labels if g not in some)
        terms = [replace(t, recordings=(), groups=rest) if t is other else t for t in fitted.model.terms]
        return (*terms, replace(other, recordings=(), groups=some))

    def _pruned(self, at: State) -> State:
        """Without effects that lower the posterior probability."""
        while True:
            options = []
            for i, term in enumerate(at.fitted.extra):
                if self._worth(at, i) > NEAR:
                    continue
                options.append(self.without(at, [term]))
            best = max(options, key=lambda s: s.score, default=None)
            if best is None or best.score <= at.score:
                return at
            self.report("an effect is superfluous", len(self.visited))
            at = best

    def worths(self, at: State) -> list[float]:
        """By how much the log posterior falls without each effect."""
        return [at.score - self.without(at, [t]).score for t in at.fitted.extra]

    def without(self, at: State, out: Sequence[Term]) -> State:
        """The structure without some of its effects."""
        terms = tuple(t for t in at.fitted.model.terms if not any(t is o for o in out))
        less = self.fitter.fit(replace(at.fitted.model, terms=terms), at.fitted.links, at.fitted.posterior)
        return self.scored(self.fitter.with_signs(less))

    def _worth(self, at: State, i: int) -> float:
        """By how much the posterior falls without an effect, predicted linearly."""
        fitted, post = at.fitted, at.fitted.posterior
        model = fitted.model
        start = sum(len(t.estimates) for t in model.terms[: fitted.base + i])
        term = fitted.extra[i]
        if not term.effect.amplitudes or term.effect.moves_link or not set(post.prior.proper):
            return 0.0
        names = [p.name for p in term.effect.parameters]
        own = [start + names.index(a) for a in term.effect.amplitudes]
        inverse = np.linalg.pinv(post.matrix, hermitian=True)
        value = model.values[own]
        return 0.5 * float(value @ np.linalg.pinv(inverse[np.ix_(own, own)]) @ value) - 8.0 * len(own)

    def _exchanged(self, at: State) -> State | None:
        """One or two effects in place of one or two others.

        Not of two whose first was far better than any other when it was added: one that stands for both would have been as good.
        """
        extra = at.fitted.extra
        groups = [[t] for t in extra] + [[b, a] for k, a in enumerate(extra) for b in extra[:k] if beside(a.effect, b.effect)]
        best = None
        for out in groups:
            name = frozenset(name_of(t) for t in out)
            if self._settled(out) or self._settled(out[:1]):
                continue
            less = self.without(at, out)
            if less.score > at.score:
                return less
            near = [t for t in self.trials if any(beside(t.effect, o.effect) for o in out)]
            found = self._added(less, near, at.fitted.posterior, out, at.score)
            self.settled[name] = at.score - self.nearest
            if found is not None and (best is None or found.score > best.score):
                best = found
        return best

    def _settled(self, out: Sequence[Term]) -> bool:
        """Whether what might be in the place of some effects falls far short."""
        return self.settled.get(frozenset(name_of(t) for t in out), 0.0) > len(out) * SETTLED

    def _unexplained(self, at: State) -> State | None:
        """A black-box term on the joint where one explains most."""
        data, best = self.fitter.data, None
        for j in range(data.n) if self.most is None else [joints[0] for name, joints in self.most if not name]:
            every = black_box_trials(data.prepared, self.fitter.view, at.fitted.model, j)
            found = self._added(at, every)
            if found is not None and (best is None or found.score > best.score):
                best = found
        return best


def _bent(c: Candidate) -> bool:
    """Whether a shape of the candidate may still be far from its best."""
    effect = c.trial.effect
    return len(effect.parameters) > len(effect.amplitudes) or effect.side in ("motion", "body")


def beside(a: Effect, b: Effect) -> bool:
    """Whether two effects change the torque of a common joint; what moves links or alters bodies changes that of many."""
    return any(not x.joints or x.side in ("motion", "body") for x in (a, b)) or bool(set(a.joints) & set(b.joints))


def _same(c: Candidate, out: Sequence[Term]) -> bool:
    return len(out) == 1 and c.key == (out[0].effect.name, out[0].effect.joints) and (c.scope or ()) == out[0].groups


def described(term: Term, fitted: Fitted) -> str:
    """An effect with its joints and groups, for a line of progress."""
    joints = ", ".join(fitted.model.joints[j] for j in term.effect.joints)
    return term.effect.name + (f" of {joints}" if joints else "") + (f" in {term.groups}" if term.groups else "")

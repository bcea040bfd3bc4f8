"""The neighbours of a structure, with an effect more, fewer or another, and their posterior probabilities as linearity predicts them."""

from collections.abc import Callable, Container, Hashable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from rrr_oc.calibration.estimator.evidence import Hyperparameters, LinearSolution
from rrr_oc.diagnosis.fitting import exact
from rrr_oc.diagnosis.knobs import CLAIM, MATTERS
from rrr_oc.diagnosis.signatures import Signatures
from rrr_oc.diagnosis.structures.candidates import Screen
from rrr_oc.diagnosis.structures.linear import (
    Addition,
    Blocks,
    Candidate,
    Key,
    Level,
    Linear,
    Links,
    Structure,
    key_of,
    numbered,
)
from rrr_oc.effects import Effect, Trial

# Of the share that matters, by how much an effect must lower a joint's error on the data it is fitted to, to be sought
SOUGHT = 0.25
RETOLD = 2  # neighbours by one kind of move that are predicted again with signatures of their own, where nothing is fitted
TRIED = 8  # candidates of a screen whose hyperparameters are estimated anew
SURE = float(np.log(CLAIM / (1 - CLAIM)))  # nats by which an effect raises the posterior that is as probable as a claim
LEAST_GAIN = SURE - float(np.log(TRIED))  # nats that an addition must gain: with less it is no claim, nor with that many rivals
RESHAPED = 5.0  # nats by which an effect must be better in another shape than where it was fitted, to be fitted anew from there
MOST = 8  # effects with which nothing is added: further gains are as small as the errors of a noise model
ALIKE = 0.3  # share of the largest gain from which additions on different joints are made at once
HOPELESS = 10.0  # nats below which an exchange that is predicted at the present hyperparameters is not looked at closer

Identity = tuple[str, tuple[int, ...], Effect | None]  # name and joints of an effect, and which, of black-box terms
Kind = tuple[str, tuple[int, ...]]  # name and joints of an effect; of black-box terms no name, since one stands for another


def identity(effect: Effect) -> Identity:
    """What tells an effect from others."""
    return effect.name, effect.joints, effect.without_range() if effect.black_box else None


def kind(effect: Effect) -> Kind:
    """What an effect has to share with another to be the same finding."""
    return "" if effect.black_box else effect.name, effect.joints


def sought_as(effect: Effect) -> Hashable:
    """By what effects are chosen to be sought: a law on its joints in all its shapes, a black-box term as it is."""
    return effect.without_range() if effect.black_box else (effect.name, effect.joints)


def beside(a: Effect, b: Effect) -> bool:
    """Whether two effects change the torque of a common joint; what moves links or alters bodies changes that of many."""
    return any(not x.joints or x.side in ("motion", "body") for x in (a, b)) or bool(set(a.joints) & set(b.joints))


@dataclass(frozen=True, eq=False)
class Predicted:
    """A structure with its posterior in a linear problem, and the logarithm of its probability up to a constant."""

    structure: Structure
    solution: LinearSolution
    score: float
    linear: Linear

    @property
    def key(self) -> Key:
        """By what structures are compared."""
        return key_of(a.name for a in self.structure)

    @property
    def new(self) -> list[Addition]:
        """Effects that the fit does not have at the shape at which they are predicted."""
        return [a for a in self.structure if isinstance(a.source, Candidate)]

    @property
    def is_nonlinear(self) -> bool:
        """Whether a shape of an effect may still be far from its best."""
        return any(not a.effect.linear for a in self.new)


@dataclass
class Neighbours:
    """The neighbours of structures in one linear problem.

    Attributes:
        linear: The problem.
        tables: The table of the catalogue (None) or of a joint's black-box terms.
        blocks: What the probabilities are conditional on.
        level: The products.
        exact: The neighbours about the fit of an exact arm; None where it has no other.
        least: Share by which an addition must lower the error of a joint.
    """

    linear: Linear
    tables: Callable[[int | None], Signatures]
    blocks: Blocks
    level: Level
    exact: Callable[[], "Neighbours | None"]
    least: float = SOUGHT * MATTERS

    def at(self, structure: Structure, hyper: Hyperparameters, fixed: bool = False) -> Predicted:
        """A structure."""
        post = self.level.solved(structure, self.blocks, hyper, fixed)
        return Predicted(structure, post, post.log_evidence + sum(a.log_prior for a in structure), self.linear)

    def removed(self, here: Predicted) -> list[Predicted]:
        """Without one of its effects, the most probable first."""
        every = [
            self.at((*here.structure[:i], *here.structure[i + 1 :]), here.solution.hyper) for i in range(len(here.structure))
        ]
        return sorted(every, key=lambda p: -p.score)

    def added(self, here: Predicted) -> list[Predicted]:
        """With a further effect of the catalogue, the most probable first.

        Candidates are chosen at the present hyperparameters and at those of exact laws and links as described, which absorb nothing:
        if errors of the links are larger than declared, in the linear problem about the fit of such an arm, since predictions are far
        from linear in them.
        """
        if len(here.structure) >= MOST:
            return []
        own, hyper = here.structure, here.solution.hyper
        every = self._own(own, here) + self._judged(own, self._screen(own, here, None).candidates(), here, None)
        at, near = exact(hyper), self.exact() if np.any(hyper.links > 1) else None
        if at is not None:
            near = self if near is None else replace(near, blocks=self.blocks)
            own = near.adopted(own)
            base = near.at(own, at, True)
            every += near._judged(own, near._screen(own, base, None).candidates(), here, None)
        return _distinct(every)

    def several_added(self, here: Predicted) -> list[Predicted]:
        """As `added`; before these with the best effects of all joints at once, each of which gains about as much as the best."""
        every = self.added(here)
        own = [
            p for p in every if p.linear is self.linear and p.score > here.score + LEAST_GAIN and p.structure[-1].effect.joints
        ]
        some: Structure = ()
        for p in own:
            new = p.structure[-1]
            if p.score - here.score > ALIKE * (own[0].score - here.score) and not any(
                beside(new.effect, a.effect) for a in some
            ):
                some = (*some, new)
        some = some[: MOST - len(here.structure)]
        return [self.at((*here.structure, *some), here.solution.hyper), *every] if len(some) > 1 else every

    def exchanged(self, here: Predicted, score: float = 0.0, waiting: dict[Key, float] | None = None) -> list[Predicted]:
        """With one effect in the place of one or two others, the most probable first.

        Args:
            score: Of the structure, as it is known elsewhere.
            waiting: Of effects that were sought to be exchanged before, the score from which they are sought again; it is kept up.
        """
        own, every, waiting = here.structure, [], {} if waiting is None else waiting
        names = numbered(a.name for a in own)
        pairs = [(i,) for i in range(len(own))]
        pairs += [(i, k) for k in range(len(own)) for i in range(k) if beside(own[i].effect, own[k].effect)]
        screen, table = None, self.tables(None)
        for out in pairs:
            key = frozenset(names[i] for i in out)
            if waiting.get(key, -np.inf) > score:
                continue
            screen = screen or self._screen(own, here, None)
            gone = [own[i] for i in out]
            near = np.array([any(beside(t.effect, a.effect) for a in gone) for t in table.trials])
            less = tuple(a for i, a in enumerate(own) if i not in out)
            without = self.at(less, here.solution.hyper, True)
            ends = self.level.p + np.cumsum([0, *(a.size for a in own)])
            numbers = [k for i in out for k in range(ends[i], ends[i + 1])]
            every_candidate = screen.candidates(numbers, near)
            if len(gone) == 1 and not gone[0].effect.linear:
                every += self._reshaped(less, [c for c in every_candidate if _is(c, gone[0])], here)
            candidates = [c for c in every_candidate if not any(_is(c, a) for a in gone)]
            hopeful = [c for c in candidates if without.score + c.gain > here.score - HOPELESS]
            judged = self._judged(less, hopeful, without, None) + [p for p in self._own(less, without) if p.key != here.key]
            best = max([*(p.score for p in judged), *(without.score + c.gain for c in candidates[:1])], default=-np.inf)
            waiting[key] = score + here.score - best
            every += judged
        return _distinct(every)

    def _reshaped(self, less: Structure, every: Sequence[Candidate], here: Predicted) -> list[Predicted]:
        """With an effect in another of its shapes, which is far better than where its fit has ended."""
        table = self.tables(None)
        found = [self.at((*less, self.linear.candidate(table, c)), here.solution.hyper) for c in every]
        return [p for p in found if p.key == here.key and p.score > here.score + RESHAPED]

    def unexplained(self, here: Predicted) -> list[Predicted]:
        """With a black-box term, the most probable first."""
        if len(here.structure) >= MOST:
            return []
        own, every = here.structure, self._own(here.structure, here, True)
        for j in range(self.level.n):
            every += self._judged(own, self._screen(own, here, j).candidates(), here, j)
        return _distinct(every)

    def completed(self, here: Predicted, refused: Container[Key] = ()) -> Predicted:
        """The structure with all further effects of the catalogue that are sure, however small, one after the other.

        Args:
            refused: Effects with which fits were worse than predicted.
        """
        near, start = replace(self, least=0.0), here.key
        while True:
            best = next((p for p in near.added(here) if not any(frozenset({name}) in refused for name in p.key - start)), here)
            if best.score < here.score + SURE:
                return here
            here = best

    def errors(self, structure: Structure, hyper: Hyperparameters) -> np.ndarray:
        """Root of the squared errors of a structure with links that are free, and as declared, (2, n)."""
        rows = np.concatenate([np.arange(*self.level.edges[b : b + 2]) for b in self.blocks])
        ways: tuple[Links, ...] = ("free", "declared")
        steps = [self.level.solved(structure, self.blocks, hyper, True, links).step for links in ways]
        return np.array([np.linalg.norm(self.linear.left(structure, step, rows), axis=1) for step in steps])

    def candidates(self, here: Predicted) -> list[Addition]:
        """The additions of the catalogue that gain most beside a structure, at its hyperparameters."""
        table, every = self.tables(None), self._screen(here.structure, here, None).candidates()
        return [self.linear.candidate(table, c) for c in every if self._open(c, here.structure)][:TRIED]

    def black_boxes(self, here: Predicted, joint: int) -> Iterator[Addition]:
        """The black-box terms of a joint beside a structure, at its hyperparameters, the one that gains most first."""
        table, every = self.tables(joint), self._screen(here.structure, here, joint).candidates()
        return (self.linear.candidate(table, c) for c in every)

    def promising(self, structure: Structure, joint: int | None) -> set[Hashable]:
        """What of a table raises the probability beside a structure, as `sought_as` names it."""
        base = self.at(structure, self.linear.fitted.posterior.hyper)
        return {sought_as(c.trial.effect) for c in self._screen(structure, base, joint).candidates() if c.gain > 0}

    def adopted(self, structure: Structure) -> Structure:
        """A structure of another linear problem, with effects as they are offered here."""
        offered = {a.name: a for a in self.linear.own if a.effect.placement != "many"}
        return tuple(offered.get(a.name, a) for a in structure)

    def _own(self, structure: Structure, here: Predicted, black_box: bool = False) -> list[Predicted]:
        """With an effect, or a black-box term, at its best shape."""
        more = [a for a in self.linear.own if a.effect.black_box == black_box and not any(a is b for b in structure)]
        return [self.at((*structure, a), here.solution.hyper) for a in more if self._open(a, structure)]

    def _judged(self, structure: Structure, every: Sequence[Candidate], base: Predicted, joint: int | None) -> list[Predicted]:
        """The best candidates beside a structure, each with hyperparameters of its own."""
        own, table, result = {a.name for a in self.linear.own}, self.tables(joint), []
        before = self.errors(structure, base.solution.hyper) if self.least and every else np.zeros(0)
        for c in every:
            if len(result) == TRIED:
                break
            single = c.trial.effect.placement != "many" and joint is None
            if single and (c.trial.effect.without_range(), c.scope or ()) in own:
                continue  # it is offered at its best shape
            if self._open(c, structure):
                p = self.at((*structure, self.linear.candidate(table, c)), base.solution.hyper)
                if not self.least or np.any(self.errors(p.structure, p.solution.hyper) < (1 - self.least) * before):
                    result.append(p)
        return result

    def _screen(self, structure: Structure, base: Predicted, joint: int | None) -> Screen:
        return Screen.of(self.level, self.tables(joint), structure, self.blocks, base.solution)

    def _open(self, c: Candidate | Addition, structure: Structure) -> bool:
        """Whether an effect is new; where it is there, it may say that some groups differ from the rest."""
        effect = c.effect if isinstance(c, Addition) else c.trial.effect
        labels = self.linear.fitter.data.labels
        return effect.placement == "many" or all(
            c.scope is not None and effect.partly > 0 and set(c.scope) < set(a.scope or labels)
            for a in overlapping(effect, c.scope, structure)
        )


@dataclass(frozen=True, eq=False)
class Repetitions:
    """Searches on parts of the recordings, in the linear problem about the best structure on all of them and from that structure on.

    Attributes:
        keys: Names of the effects of each fit of the search, by which structures are compared; the first has none.
        last: The neighbours of the last fit.
        table: Signatures of some trials at a fit by its number.
    """

    keys: Sequence[Key]
    last: Neighbours
    table: Callable[[int, Sequence[Trial]], Signatures]
    _promising: dict[int | None, list[Trial]] = field(default_factory=dict, repr=False)
    _tables: dict[tuple[int, int | None], Signatures] = field(default_factory=dict, repr=False)

    def about(self, key: Key, blocks: Blocks) -> Neighbours:
        """The neighbours of a structure on some blocks.

        Signatures are those at the fit with most of its effects and no others: with others, what is linear in the load or in the torque
        would stand for them.
        """
        return replace(self.last, blocks=blocks, tables=partial(self._table, self._inside(key)))

    def _inside(self, key: Key) -> int:
        """The number of the fit with most of these effects and no others."""
        return max((k for k, own in enumerate(self.keys) if own <= key), key=lambda k: (len(self.keys[k]), k))

    def _table(self, number: int, joint: int | None) -> Signatures:
        """Signatures at a fit of what is promising of the catalogue, or of a joint's black-box terms."""
        if (number, joint) not in self._tables:
            self._tables[number, joint] = self.table(number, self.promising(joint))
        return self._tables[number, joint]

    def promising(self, joint: int | None) -> list[Trial]:
        """What raises the probability of the last fit with or without its effects, of the catalogue or of a joint's black-box terms."""
        if joint not in self._promising:
            end, table = self.last, self.last.tables(joint)
            some = end.promising((), joint) | end.promising(end.linear.own, joint)
            self._promising[joint] = [t for t in table.trials if sought_as(t.effect) in some]
            end.level.forget(table)
        return self._promising[joint]

    def best(self, blocks: Blocks) -> tuple[Neighbours, Predicted]:
        """The most probable structure on some blocks that moves reach from the last fit's."""
        near, seen = self.about(self.keys[-1], blocks), set[Key]()
        here = near.at(near.linear.own, near.level.posterior.hyper)
        while here.key not in seen and (better := self._better(near, here)) is not None:
            seen.add(here.key)
            near, here = self.about(better.key, blocks), better
        return near, here

    def _better(self, near: Neighbours, here: Predicted) -> Predicted | None:
        """The best neighbour by the first kind of move that has a better one."""
        for move in (near.removed, near.added, near.exchanged, near.unexplained):
            for p in move(here)[:RETOLD]:
                if p.score > here.score and (again := self._again(near, p)).score > here.score:
                    return again
        return None

    def _again(self, near: Neighbours, p: Predicted) -> Predicted:
        """A structure with signatures at a fit that has no effects but its own.

        At one with an effect that is exchanged, what is linear in the load or in the torque would stand for that effect.
        """
        inside, structure = self._inside(p.key), []
        for a in p.structure:
            if isinstance(a.source, Candidate):
                a = near.linear.candidate(self.table(inside, [a.source.trial]), a.source)
            structure.append(a)
        return near.at(tuple(structure), p.solution.hyper)


def overlapping(effect: Effect, scope: Sequence[str] | None, structure: Structure) -> list[Addition]:
    """The same effect on its joints, in some of its groups."""
    return [
        a
        for a in structure
        if identity(a.effect) == identity(effect) and (not a.scope or scope is None or set(scope) & set(a.scope))
    ]


def _is(c: Candidate, a: Addition) -> bool:
    return c.key == (a.effect.name, a.effect.joints) and c.scope == a.scope


def _distinct(every: Sequence[Predicted]) -> list[Predicted]:
    """The best of each structure, the most probable first."""
    best: dict[Key, Predicted] = {}
    for p in sorted(every, key=lambda p: -p.score):
        best.setdefault(p.key, p)
    return list(best.values())

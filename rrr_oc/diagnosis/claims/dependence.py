"""On what a joint's missing torque depends, and which law it is most like.

Black-box terms are flexible functions of one or two variables, or filters of the load. Each takes the place of a law, on blocks left
out. A law is named unless one of them predicts better beyond chance, and explains much that the law leaves: then the function is in the
model, its variables are told, and the law as what the torque is most like.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.calibration.calibrated_model import Term
from rrr_oc.calibration.estimator.fitting import Fitted
from rrr_oc.calibration.estimator.intervals import described as intervals
from rrr_oc.calibration.estimator.left_out import Fall
from rrr_oc.diagnosis.claims.effect_size import Falls, LeftOut
from rrr_oc.diagnosis.findings import further
from rrr_oc.diagnosis.knobs import NAMED
from rrr_oc.diagnosis.result import Finding, Like
from rrr_oc.diagnosis.structures.linear import Addition, Structure
from rrr_oc.diagnosis.structures.neighbours import Neighbours, kind
from rrr_oc.diagnosis.structures.search import StructureSearch
from rrr_oc.effects import BlackBox, Delay, Signals

LIKE = 2  # laws that are fitted to say what a torque is most like
HALF = 0.5  # of the squares that the best function explains, which a law leaves at most that the torque is said to be most like
FUNCTIONS = 12  # of a joint, of different variables, that are tried, those of the largest gain


@dataclass(frozen=True)
class Shape:
    """What explains a joint's torque in the place of others.

    Attributes:
        addition: The law, or the function.
        falls: How the error falls with it, against nothing in its place.
        reach: Share of what the best of all explains.
    """

    addition: Addition
    falls: Falls
    reach: float = 1.0

    @property
    def effect(self) -> BlackBox:
        """Of a function."""
        assert isinstance(self.addition.effect, BlackBox)
        return self.addition.effect


@dataclass(frozen=True)
class Place:
    """A finding's place: the joint where it is surest, and the structure without it, or a stack of laws, and its companions, which are
    functions of that joint."""

    left_out: LeftOut
    near: Neighbours
    finding: Finding
    less: Structure
    whole: Structure
    companions: tuple[Finding, ...]

    @classmethod
    def of(
        cls, left_out: LeftOut, near: Neighbours, finding: Finding, every: Sequence[Finding], stack: Sequence[Finding] = ()
    ) -> "Place":
        """Of a finding among others, and of those that stand with it."""
        whole, joint = tuple(left_out.of(f.term) for f in every), finding.joint
        here = [f for f in every if f in (finding, *stack) or (f.term.effect.black_box and joint in f.term.effect.joints)]
        gone = [left_out.of(f.term) for f in here]
        companions = tuple(f for f in here if f is not finding and f not in stack)
        return cls(left_out, near, finding, tuple(a for a in whole if a not in gone), whole, companions)

    @property
    def by_error(self) -> bool:
        """Whether the finding is surest in the error, not in its innovations."""
        assert self.finding.fall is not None
        assert self.finding.innovations is not None
        return self.finding.fall.low >= self.finding.innovations.low

    def measure(self, falls: Falls) -> Fall:
        """Of the error or of its innovations, that in which the finding is surest."""
        return falls.error if self.by_error else falls.innovations

    def of_joint(self, squares: np.ndarray) -> float:
        """The same of squares (2, n)."""
        return float(squares[0 if self.by_error else 1, self.finding.joint])

    def against(self, after: Structure, before: Structure) -> Fall:
        """The fall from one structure to another."""
        return self.measure(self.left_out.falls(self.finding.joint, after, before))

    def shape(self, a: Addition) -> Shape:
        """Something in the finding's place."""
        return Shape(a, self.left_out.falls(self.finding.joint, (*self.less, a), self.less))

    def functions(self) -> list[Shape]:
        """Flexible functions, of each set of variables the one of the largest gain."""
        every, scope = dict[object, Addition](), self.finding.term.groups or None
        here = self.near.at(self.less, self.left_out.hyper, True)
        for a in self.near.black_boxes(here, self.finding.joint):
            if a.scope == scope and isinstance(a.effect, BlackBox):
                every.setdefault((a.effect.name, a.effect.depends_on), a)
            if len(every) == FUNCTIONS:
                break
        return [self.shape(a) for a in every.values()]

    def laws(self) -> list[Shape]:
        """Laws of the catalogue that change the joint's torque, each in the best of its trials' shapes."""
        here, joint = self.near.at(self.less, self.left_out.hyper, True), self.finding.joint
        return [self.shape(a) for a in self.near.candidates(here) if a.columns[joint].any()]


def reach(left: float, least: float, before: float) -> float:
    """Share of what the best explains that is explained, by rms, from squares: that are left, that the best leaves, that there were."""
    return float(1 - np.sqrt(max(left - least, 0.0) / (before - least))) if before > least else 0.0


def reached(place: Place, shapes: Sequence[Shape]) -> list[Shape]:
    """Shapes with their reach among themselves."""
    left = [(1 - place.measure(s.falls).share) ** 2 for s in shapes]
    least = min([*left, 1.0])
    return [replace(s, reach=reach(x, least, 1.0)) for s, x in zip(shapes, left, strict=True)]


def by_degree(search: StructureSearch, complete: Fitted, findings: Sequence[Finding]) -> tuple[Fitted, list[Finding]]:
    """A fit in which laws that are not named have given way to functions, and the findings with what these are most like.

    Args:
        complete: A fit with the findings.
        findings: What predicts there, with its sizes.
    """
    near = search.neighbours(complete)
    left_out, offered = LeftOut(near), {a.source: a for a in near.linear.own}
    kept, new, told = list(findings), list[tuple[Addition, Like | None]](), list[Term]()
    for f in sorted(findings, key=lambda f: f.term.effect.black_box):
        if f not in kept or not f.matters:
            continue
        # a sum of laws of one joint can be like any curve
        stack = [g for g in kept if not g.term.effect.black_box and g.term.effect.joints == f.term.effect.joints]
        if len(stack) > 1 and f in stack:
            place = Place.of(left_out, near, f, findings, stack)
            others = tuple(offered[g.term] for g in findings if left_out.of(g.term) in place.less)
            best = _simplest(reached(place, place.functions()))
            if best is not None and _is_better(search, complete, place, (*others, best.addition)):
                kept = [g for g in kept if left_out.of(g.term) in place.less]
                new.append((best.addition, _most_like(search, complete, place, others, reached(place, place.laws()), best)))
                continue
        place = Place.of(left_out, near, f, findings)
        alone, laws, functions = place.shape(left_out.of(f.term)), place.laws(), place.functions()
        every = reached(place, [alone, *laws, *functions])
        laws, functions = every[1 : len(laws) + 1], every[len(laws) + 1 :]
        others = tuple(offered[g.term] for g in findings if left_out.of(g.term) in place.less)
        if f.term.effect.black_box and any(f.term is t for t in told):
            continue
        if f.term.effect.black_box:
            kept[kept.index(f)] = replace(f, like=_most_like(search, complete, place, others, laws, alone))
            continue
        own = max((every[0], *(s for s in laws if kind(s.addition.effect) == kind(f.term.effect))), key=lambda s: s.reach)
        best = _simplest([s for s in functions if s.reach > own.reach])
        after, before = ((*place.less, one.addition) for one in (best or own, own))
        beaten = best is not None and own.reach < NAMED and place.against(after, before).low > 0
        if best is not None and beaten and _is_better(search, complete, place, (*others, best.addition)):
            kept = [g for g in kept if left_out.of(g.term) in place.less]
            new.append((best.addition, _most_like(search, complete, place, others, laws, best)))
        elif beaten and place.companions:  # both together are one torque, which the law is most like
            companion, both = place.companions[0], left_out.falls(f.joint, place.whole, place.less)
            sized = replace(companion, fall=both.error, innovations=both.innovations, worth=companion.worth + f.worth)
            kept = [replace(g, with_function=True) if g is f else g for g in kept]
            kept = [replace(sized, like=Like(f.term, own.reach)) if g is companion else g for g in kept]
            told.append(companion.term)
        elif own is not every[0] and place.against((*place.less, own.addition), place.whole).share > 0:
            kept = [g for g in kept if left_out.of(g.term) in place.less]  # in another shape nothing beside it is needed
            new.append((own.addition, None))
        else:
            kept[kept.index(f)] = replace(f, reach=own.reach)
    if not new:
        return complete, once_of_each(kept)
    structure = (*(offered[g.term] for g in kept), *(a for a, _ in new))
    fitted = search.fit(complete, near.at(structure, left_out.hyper))
    some = [replace(g, term=t) for g, t in zip(kept, fitted.extra, strict=False)]
    every = further(search, fitted, len(kept))
    likes = {t: like for t, (_, like) in zip(fitted.extra[len(kept) :], new, strict=True)}
    return fitted, once_of_each([*some, *(replace(f, like=likes[f.term]) for f in every)])


def _is_better(search: StructureSearch, complete: Fitted, place: Place, structure: Structure) -> bool:
    """Whether a fit with a function is more probable than that with what it takes the place of."""
    fitted = search.fit(complete, place.near.at(structure, place.left_out.hyper))
    return search.scored(fitted).score > search.scored(complete).score


def _most_like(
    search: StructureSearch, complete: Fitted, place: Place, others: Structure, laws: Sequence[Shape], best: Shape
) -> Like | None:
    """The law that reaches most of what the best function does, of some that are fitted beside the others."""
    found = list[Like]()
    before, least = (place.left_out.squares(structure) for structure in (place.less, (*place.less, best.addition)))
    for s in sorted(laws, key=lambda s: -s.reach)[:LIKE]:
        fitted = search.fit(complete, place.near.at((*others, s.addition), place.left_out.hyper))
        left = place.left_out.of_fit(fitted)
        law = intervals(fitted).terms[-1]
        if not _may_be_none(law):
            found.append(Like(law, reach(*map(place.of_joint, (left, least, before)))))
    like = max(found, key=lambda one: one.reach, default=None)
    return like if like is not None and (1 - like.reach) ** 2 < HALF else None


def _may_be_none(law: Term) -> bool:
    """Whether the intervals of all amplitudes of a law hold 0."""
    ends = [e.interval for p, e in zip(law.effect.parameters, law.estimates, strict=True) if p.name in law.effect.amplitudes]
    return bool(ends) and all(x is not None and x[0] <= 0 <= x[1] for x in ends)


def once_of_each(findings: Sequence[Finding]) -> list[Finding]:
    """Findings of which functions of the same variables at one joint are told once, with the largest of them."""
    result, told = list(findings), set[object]()
    for k in sorted(range(len(result)), key=lambda k: -result[k].of_torque):
        effect = result[k].term.effect
        if isinstance(effect, BlackBox):
            key = effect.joints, effect.depends_on, result[k].term.groups
            result[k] = replace(result[k], with_function=result[k].with_function or key in told)
            told.add(key)
    return result


def _simplest(functions: Sequence[Shape]) -> Shape | None:
    """Of functions that explain nearly as much as the best of all that of fewest variables; else the best."""
    return min(functions, key=lambda s: (s.reach < NAMED, len(s.effect.depends_on), -s.reach), default=None)


def variables(term: Term, n: int) -> tuple[tuple[str, int], ...]:
    """On what a term's torque depends, of an arm of n joints, as `BlackBox.depends_on`; of a state on the motion that makes it."""
    effect = term.effect
    if isinstance(effect, BlackBox):
        return effect.depends_on
    own = effect.joints or tuple(range(n))
    if isinstance(effect, Delay):
        return (("time", -1),)
    if "springs" in effect.inputs:
        return tuple(("spring", j) for j in own)
    if effect.side in ("body", "motion") or effect.states:
        on = ("q", "sign") if effect.states else ("load",)
        return tuple((kind, j) for j in own for kind in on)
    signals = _random_signals(n)
    torque = _torque(term, signals)
    found = [(kind, j) for kind in ("load", "q", "ddq") for j in range(n) if _changes(term, torque, _swapped(signals, kind, j))]
    for j in range(n):
        times = np.where(np.arange(n) == j, 3.0, 1.0)[:, None]
        faster = replace(signals, dq=times * signals.dq, braking=times * signals.braking)
        if _changes(term, torque, _swapped(signals, "dq", j)):
            found.append(("dq" if _changes(term, torque, faster) else "sign", j))
    if _changes(term, torque, replace(signals, time=signals.time[::-1])):
        found.append(("time", -1))
    return tuple(found) or ((("sign", own[0]),) if effect.side == "drive" else (("time", -1),))  # of a constant the nearest


def _random_signals(n: int) -> Signals:
    """Signals of no motion in particular, (n, 64)."""
    rng = np.random.default_rng(0)
    q, ddq, load = 3 * rng.uniform(-1, 1, (3, n, 64))
    dq = rng.choice([-1.0, 1.0], (n, 64)) * np.exp(rng.uniform(-3, 2, (n, 64)))
    return Signals(q, dq, ddq, load, rng.uniform(0, 1, 64), np.ones(64), friction=-np.sign(dq), rotor=-ddq, braking=-dq)


def _swapped(signals: Signals, kind: str, j: int) -> Signals:
    """Signals with one of them in another order."""
    values = getattr(signals, kind).copy()
    values[j] = values[j, ::-1]
    more = {"dq": {"friction": -np.sign(values), "braking": -values}, "ddq": {"rotor": -values}}.get(kind, {})
    return replace(signals, **{kind: values}, **more)


def _changes(term: Term, torque: np.ndarray, signals: Signals) -> bool:
    return bool(np.abs(_torque(term, signals) - torque).max() > 1e-6 * np.abs(torque).max())


def _torque(term: Term, signals: Signals) -> np.ndarray:
    """Torque of a term on its joints, one behind the other [Nm]."""
    torques = term.effect.torque(signals, term.named, 1e-3 if term.width is not None else None)
    return np.concatenate([np.broadcast_to(np.asarray(x, float), 64) for x in torques])

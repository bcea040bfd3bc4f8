"""By how much each part of a model lowers the error on data that it was not fitted to.

Recordings are cut into blocks of some seconds. A quarter of the blocks at a time is predicted from the others, with all parts and
without each, in the linear problem about the fit to all, whose shapes of effects stay. Blocks lie in every recording, so that no law
has to predict where it was never seen.

The error sees what is slow. Its innovations, which an autoregression of the plain model's error does not foresee, see what is fast and
lies under a slow disturbance.

Errors are those of least squares, as of the model that is reported. Innovations are of the likeliest coefficients. These leave errors, too,
which are larger where noise may wander: an error falls or rises beyond chance only if it does so with both.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rrr_oc.calibration.calibrated_model import Term
from rrr_oc.calibration.estimator.data import Noise
from rrr_oc.calibration.estimator.evidence import Hyperparameters, NoiseStart
from rrr_oc.calibration.estimator.fitting import Fitted, at_low_frequency
from rrr_oc.calibration.estimator.left_out import PARTS, Fall, block_edges, fall_of
from rrr_oc.calibration.link_findings import FAR
from rrr_oc.diagnosis.held_out import acts_on
from rrr_oc.diagnosis.knobs import MATTERS
from rrr_oc.diagnosis.result import Finding
from rrr_oc.diagnosis.structures.linear import Addition, Level, Links, Structure
from rrr_oc.diagnosis.structures.neighbours import SOUGHT, SURE, Neighbours, beside
from rrr_oc.diagnosis.structures.search import StructureSearch
from rrr_oc.effects import Effect

ELSEWHERE = 1.0  # standard deviations between links from which fits may end in different optima; doubled, fewer are tried


@dataclass(frozen=True)
class Falls:
    """Falls of a joint's error and of its innovations.

    Attributes:
        scales: Whether they are of an effect that scales the torque that the motion needs. With that it scales errors of the motion,
            which are fast, so that the innovations fall where it is not there as well, and only the error counts.
    """

    error: Fall
    innovations: Fall
    scales: bool = False

    @property
    def surest(self) -> Fall:
        """That whose lower end is higher."""
        return self.error if self.scales else max(self.error, self.innovations, key=lambda f: f.low)

    @property
    def of_torque(self) -> float:
        """The larger one, over the rms of the joint's torque."""
        return self.error.of_torque if self.scales else max(self.error.of_torque, self.innovations.of_torque)

    def rises_by(self, share: float) -> bool:
        """Whether one of them rises by a share, and beyond chance."""
        return any(f.high < 0 and f.share < -share for f in (self.error, self.innovations))

    @property
    def predicts(self) -> bool:
        """Whether one of them falls beyond chance, and none rises by as much as one is sought for, or by a like share of that fall."""
        return self.surest.low > 0 and not self.rises_by(SOUGHT * max(MATTERS, self.surest.low))

    @property
    def outweighed(self) -> float:
        """Share by which they may rise on another joint: what does not matter, or is little beside this fall."""
        return max(MATTERS, SOUGHT * self.surest.low)


class LeftOut:
    """Errors of structures on blocks that they were not fitted to, in the linear problem of a fit.

    Attributes:
        near: The neighbours of the fit, with products by block.
        hyper: Under which structures are the likeliest, those of the fit.
        least_squares: The same products in noise that is white and as strong as in slow motion.
    """

    def __init__(self, near: Neighbours) -> None:
        fitted, edges = near.linear.fitted, block_edges(near.level.edges)
        data = near.linear.fitter.data
        slow = NoiseStart.of(data, at_low_frequency(data, fitted))
        white = replace(fitted, posterior=replace(fitted.posterior, hyper=slow.hyper, joints=slow.joints))
        self.near = replace(near, level=Level(near.linear, edges))
        self.least_squares = Level(replace(near.linear, fitted=white), edges)
        self.hyper = fitted.posterior.hyper
        self._own = {a.source: in_shape(a) for a in near.linear.own}
        self._known: dict[tuple[Structure, Links], np.ndarray] = {}

    def of(self, term: Term) -> Addition:
        """A term of the fit as an addition in the shape that was fitted."""
        return self._own[term]

    @property
    def whole(self) -> np.ndarray:
        """What the fit with all its effects leaves, as `residual`."""
        return self.residual(tuple(self._own[t] for t in self.near.linear.fitted.extra))

    def residual(self, structure: Structure, links: Links = "as fitted") -> np.ndarray:
        """What a structure leaves of each joint's torque in least squares and where it is the likeliest, (2, n, M) [Nm]; `links` say how far
        these may be off."""
        if (structure, links) not in self._known:
            self._known[structure, links] = self._residual(structure, links, self.hyper)
        return self._known[structure, links]

    def _residual(self, structure: Structure, links: Links, hyper: Hyperparameters) -> np.ndarray:
        slow = replace(self.least_squares.posterior.hyper, links=hyper.links)
        each = (self.least_squares, slow), (self.near.level, hyper)
        return np.array([self._predicted(level, structure, links, one) for level, one in each])

    def _predicted(self, level: Level, structure: Structure, links: Links, hyper: Hyperparameters) -> np.ndarray:
        """What a structure leaves of blocks that it was not fitted to, (n, M) [Nm]."""
        linear = self.near.linear
        result, blocks = np.zeros_like(linear.residual), level.whole
        for part in range(min(PARTS, len(blocks))):
            held = blocks[part::PARTS]
            rest = tuple(b for b in blocks if b not in held)
            rows = np.concatenate([np.arange(level.edges[b], level.edges[b + 1]) for b in held])
            result[:, rows] = linear.left(structure, level.solved(structure, rest, hyper, True, links).step, rows)
        return result

    def squares(self, structure: Structure, links: Links = "as fitted", hyper: Hyperparameters | None = None) -> np.ndarray:
        """Squares of a structure's errors and of their innovations, (2, n); under other hyperparameters if so asked for."""
        return self.of_both(self.residual(structure, links) if hyper is None else self._residual(structure, links, hyper))

    def of_both(self, residual: np.ndarray) -> np.ndarray:
        """Squares of errors and of innovations, (2, n), of what is left in both ways, (2, n, M)."""
        return np.array([np.sum(x**2, axis=1) for x in (residual[0], self._fast(residual[1]))])

    def of_fit(self, fitted: Fitted) -> np.ndarray:
        """Squares of errors and of innovations, (2, n), of a fit to all blocks."""
        return self.of_both(np.array([self.near.linear.fitter.least_squares(fitted).residual, fitted.residual]))

    def _fast(self, residual: np.ndarray) -> np.ndarray:
        return np.array([white @ x for white, x in zip(self._whitening, residual, strict=True)])

    def falls(self, j: int, after: Structure, before: Structure) -> Falls:
        """How the error and the innovations of a joint fall from one structure to another, in the groups where they differ."""
        scopes = [a.scope for a in (*after, *before) if (a in after) != (a in before)]
        groups = None if None in scopes else {g for scope in scopes for g in scope or ()}
        return self.compared(j, self.residual(after), self.residual(before), groups)

    def compared(self, j: int, after: np.ndarray, before: np.ndarray, groups: Collection[str] | None = None) -> Falls:
        """How errors of a joint and their innovations fall from one model to another, of what these leave (2, n, M), in some groups."""
        data, edges = self.near.linear.fitter.data, self.near.level.edges
        there = np.isin(np.array(data.labels)[data.label[edges[:-1]]], list(groups or data.labels))
        pairs = [[x[k, j] for x in (after, before)] for k in (0, 1)]
        pairs.append([self._whitening[j] @ x for x in pairs[1]])
        error, likeliest, innovations = (fall_of(j, *(self._by_block(x)[there] for x in pair)) for pair in pairs)
        error = replace(error, low=min(error.low, likeliest.low), high=max(error.high, likeliest.high))
        rms = np.sqrt(self._by_block(before[0, j])[there].sum() / max(self._count(j)[there].sum(), 1))
        error, innovations = (replace(f, before=float(rms / data.torque[j])) for f in (error, innovations))
        return Falls(error, innovations)

    def _count(self, j: int) -> np.ndarray:
        """Rows of each block that count, (B,)."""
        return np.add.reduceat(self.near.linear.fitter.data.counted[j], self.near.level.edges[:-1])

    def _by_block(self, residual: np.ndarray) -> np.ndarray:
        """Squares of what is left of a joint (M,), block by block, (B,)."""
        return np.add.reduceat(residual**2, self.near.level.edges[:-1])

    @cached_property
    def _whitening(self) -> list:
        """By joint the matrix that turns what the plain model leaves into innovations."""
        data, plain = self.near.linear.fitter.data, self.residual(())[1]
        noises = [Noise.of(plain[j], data.place[j], data.turning[j]) for j in range(data.n)]
        return [one.whitening(data.place[j], data.turning[j])[0] for j, one in enumerate(noises)]


def in_shape(effect: Addition) -> Addition:
    """An effect in the shape that was fitted to all data, how much there is of it being free; a linear one as it is.

    Derivatives of a law that has events, such as impacts, hold for steps that are smaller than those between parts of the data.
    """
    if effect.effect.linear:
        return effect
    one, none = np.ones(1), np.zeros(1)
    return replace(
        effect, columns=effect.columns[:, :, :1], mean=one, precision=one, flat=none, lower=none - np.inf, upper=none + np.inf
    )


def predictive(left_out: LeftOut, findings: Sequence[Finding]) -> tuple[list[Finding], list[Finding]]:
    """Findings with which the error of a joint or its innovations fall beyond chance, and no joint's rise much beside that, those that
    matter most first; and all others; with their sizes.

    What predicts least is left out first, and the others are judged without it, since of two that stand for each other one predicts.
    """
    kept, sizes = [f.term for f in findings], dict[Term, Falls]()

    def size(term: Term) -> tuple[bool, float]:
        whole = tuple(map(left_out.of, kept))
        less = tuple(a for a in whole if a is not left_out.of(term))
        every = [
            replace(left_out.falls(j, whole, less), scales=scales_load(term.effect))
            for j in acts_on(term.effect, left_out.near.linear.fitter.data.n)
        ]
        sizes[term] = best = max(every, key=lambda falls: falls.surest.low)
        return best.predicts and not any(falls.rises_by(best.outweighed) for falls in every), best.surest.low

    while kept:
        every = {term: size(term) for term in kept}
        least = min(kept, key=every.__getitem__)
        if every[least][0]:
            break
        kept.remove(least)
    sized = [replace(f, fall=sizes[f.term].error, innovations=sizes[f.term].innovations) for f in findings]
    largest = sorted((f for f in sized if f.term in kept), key=lambda f: -sizes[f.term].of_torque)
    return largest, [f for f in sized if f.term not in kept]


def confirmed(
    search: StructureSearch, begin: Fitted, fitted: Fitted, findings: Sequence[Finding]
) -> tuple[Fitted, list[Finding], list[Finding]]:
    """A fit, and those of its findings that predict where all is fitted again without each, shape and links and all; and the others.

    Args:
        begin: The plain fit.
        fitted: A fit with the findings.
    """
    data, out = search.fitter.data, list[Finding]()
    fitted, kept = _of(search, fitted, findings)
    unsure = list(kept)
    while unsure:
        wrong = list[Finding]()
        for f in unsure:
            joints, black_box = acts_on(f.term.effect, data.n), f.term.effect.black_box
            # a law is judged without functions of its joints, which could take its place
            there = (
                kept
                if black_box
                else [g for g in kept if not (g.term.effect.black_box and beside(g.term.effect, f.term.effect))]
            )
            more, _ = _of(search, fitted, there)
            less, _ = _of(search, more, [g for g in there if g is not f], begin)
            whole, worth = LeftOut(search.neighbours(more)), search.scored(more).score - search.scored(less).score
            residual = LeftOut(search.neighbours(less)).whole
            falls = [whole.compared(j, whole.whole, residual, f.term.groups) for j in joints]
            rises = any(one.share < -MATTERS for both in falls for one in (both.error, both.innovations))
            if worth > SURE and farther(less.links, more.links) and not rises:
                # links take up what the law explains, and are less likely to
                every, own = tuple(whole.of(t) for t in more.extra), whole.of(more.extra[there.index(f)])
                falls = [whole.falls(j, every, tuple(a for a in every if a is not own)) for j in joints]
            falls = [replace(one, scales=scales_load(f.term.effect)) for one in falls]
            best = max(falls, key=lambda one: one.surest.low)
            new = replace(f, fall=best.error, innovations=best.innovations, worth=worth)
            kept[kept.index(f)] = new
            if not best.predicts or worth <= 0 or any(one.rises_by(best.outweighed) for one in falls):
                wrong.append(new)
        gone = list[Finding]()  # of those that stand beside each other the worst: without it the others may predict
        for f in sorted(wrong, key=lambda f: f.worth):
            if not any(beside(f.term.effect, g.term.effect) for g in gone):
                gone.append(f)
        if not gone:
            break
        out += gone
        stay = [f for f in kept if f not in gone]
        again = [any(beside(f.term.effect, g.term.effect) for g in gone) for f in stay]
        fitted, kept = _of(search, fitted, stay, begin)
        unsure = [f for f, near in zip(kept, again, strict=True) if near]
    return fitted, sorted(kept, key=lambda f: -f.of_torque), out


def scales_load(effect: Effect) -> bool:
    """Whether an effect scales the torque that the motion needs, or that of the links."""
    return effect.side in ("sensor", "body")


def farther(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether errors of links, in declared deviations, are farther from the description than others, by what is worth telling."""
    return bool(np.abs(one).max(initial=0.0) > np.abs(other).max(initial=0.0) + FAR)


def _of(
    search: StructureSearch, fitted: Fitted, findings: Sequence[Finding], begin: Fitted | None = None
) -> tuple[Fitted, list[Finding]]:
    """The fit with these findings alone, from a fit on, or from the links of the plain fit if that is better, with their terms there."""
    terms = tuple(f.term for f in findings)
    if not terms and begin is not None:
        return begin, []
    if terms == fitted.extra:
        return fitted, list(findings)
    model = replace(fitted.model, terms=(*fitted.model.terms[: fitted.base], *terms))
    found = search.fitter.fit(model, fitted.links, fitted.posterior)
    if begin is not None and np.abs(begin.links - found.links).max(initial=0.0) > ELSEWHERE:
        plain = replace(model, terms=(*begin.model.terms, *terms))
        found = max(found, search.fitter.fit(plain, begin.links, begin.posterior), key=lambda one: one.log_evidence)
    return found, [replace(f, term=t) for f, t in zip(findings, found.extra, strict=True)]

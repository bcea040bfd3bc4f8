"""What recordings cannot separate: effects, others in their place, and links that are not the URDF's.

Odds between such models rest on priors, and on errors of all laws that are smaller than what matters. So what counts is how well data are
predicted: one model is as good as another if it raises no joint's error by `MATTERS`. Candidates are compared on blocks that they were
not fitted to, in the linear problem of a fit; those that are as good there are fitted exactly.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from msgspec.structs import replace as told_with

from rrr_oc.calibration.estimator.evidence import Hyperparameters, NoiseStart
from rrr_oc.calibration.estimator.fitting import Fitted
from rrr_oc.calibration.estimator.intervals import described
from rrr_oc.calibration.link_findings import OffLink, link_findings, with_falls
from rrr_oc.diagnosis.alternatives import Exchange
from rrr_oc.diagnosis.claims.effect_size import LeftOut
from rrr_oc.diagnosis.fitting import EXACT
from rrr_oc.diagnosis.knobs import EXCESS, MATTERS
from rrr_oc.diagnosis.result import LINK_ERRORS, Finding, Undecided, shown_as
from rrr_oc.diagnosis.structures.linear import Addition
from rrr_oc.diagnosis.structures.neighbours import kind
from rrr_oc.diagnosis.structures.search import StructureSearch
from rrr_oc.errors import noted

NEAR = 5.0  # times `MATTERS`, by which an effect may be worse in the shape in which it is predicted, to be fitted exactly
SAME = 0.125  # share of what links do that an effect may leave which does the same; doubled, more effects do
FAR_OFF = max(EXCESS)  # times their declared errors, by which links may be off to stand for an effect


def separated(
    search: StructureSearch, fitted: Fitted, findings: Sequence[Finding], small: Sequence[Finding], failed: dict[str, str]
) -> tuple[list[Finding], list[Undecided], list[Exchange]]:
    """Findings with all that cannot be told from them, what cannot be told from errors of the links, and fits that are as good.

    Args:
        fitted: A fit with all these effects.
        failed: Takes why what may be in an effect's place was not compared.
    """
    near, hyper = search.neighbours(fitted), fitted.posterior.hyper
    left_out = LeftOut(near)
    effects = tuple(left_out.of(f.term) for f in [*findings, *small])
    with_all = left_out.squares(effects)
    shown = dict(zip(fitted.model.terms, described(fitted).terms, strict=True))
    told, undecided, exchanges = [], [], []
    for i, f in enumerate(findings):
        less = (*effects[:i], *effects[i + 1 :])
        others = [a for a in near.candidates(near.at(less, hyper, True)) if kind(a.effect) != kind(f.term.effect)]
        found, fits = [], []
        for a in others:
            with noted(failed, f"comparison: {a.effect.name} in the place of {f.term.effect.name}"):
                if as_good(left_out.squares((*less, a)), with_all, NEAR * MATTERS):
                    exact = search.fit(fitted, near.at((*(b for b in near.linear.own if b.source is not f.term), a), hyper))
                    if as_good(left_out.of_fit(exact), left_out.of_fit(fitted)):
                        found += described(exact).terms[-1:]
                        fits.append(exact)
        rivals = tuple(dict.fromkeys([*f.rivals, *map(shown_as, found)]))
        by_links = False
        with noted(failed, f"comparison: links in the place of {f.term.effect.name}"):
            if near.linear.fitter.data.free:
                by_links = as_good(left_out.squares(less, "free", far_off(hyper)), with_all)
        if not by_links:
            told.append(replace(f, rivals=rivals))
        elif all(t.effect.side == "body" for t in (f.term, *found)):  # all of which say the same to who reads it
            told.append(replace(f, rivals=(*rivals, LINK_ERRORS)))
        else:
            undecided.append(Undecided((shown[f.term], *found), f.probability))
        lacks = (LINK_ERRORS,) if undecided and undecided[-1].terms[0] is shown[f.term] else (f.key,)
        exchanges += [Exchange(one, (shown_as(one.extra[-1]),), lacks) for one in fits]
    return told, undecided, exchanges


def with_links(
    undecided: Sequence[Undecided], search: StructureSearch, fitted: Fitted, failed: dict[str, str]
) -> tuple[list[Undecided], list[Exchange], list[OffLink]]:
    """What is undecided, with the effects that explain as well what links explain that are far off in a fit, their fits, and these links."""
    found, fits = with_falls(search.fitter, fitted, link_findings(fitted)), list[Exchange]()
    if found:
        with noted(failed, "effects in the place of links"):
            fits += instead_of_links(search, fitted, found, failed)
    terms = [described(one.fitted).terms[-1] for one in fits]
    same = [u for u in undecided if {kind(t.effect) for t in u.terms} & {kind(t.effect) for t in terms}]
    result = [u for u in undecided if u not in same]
    if same or any(t.effect.side != "body" for t in terms):  # else all say the same to who reads it
        known = {kind(t.effect) for u in same for t in u.terms}
        every = (*(t for u in same for t in u.terms), *(t for t in terms if kind(t.effect) not in known))
        probability = max([*(u.probability for u in same), *(link.probability for link in found)])
        result.append(Undecided(every, probability))
    names = tuple(dict.fromkeys(t.effect.name for t in (*terms, *(t for u in result for t in u.terms))))
    return result, fits, [told_with(f, indistinguishable_from=names) for f in found]


def instead_of_links(
    search: StructureSearch, fitted: Fitted, found: Sequence[OffLink], failed: dict[str, str]
) -> list[Exchange]:
    """Fits with an effect, their last, that does what the links of a fit do that are off, with these links as described."""
    data, post = search.fitter.data, fitted.posterior
    start = replace(post, hyper=replace(post.hyper, links=np.full_like(post.hyper.links, EXACT)))
    nominal = replace(fitted.model, robot=replace(fitted.model.robot, inertial=data.links.at(data.links.none)[0]))
    none = search.fitter.fit(nominal, data.links.none, start, fixed=True)
    near, result, others = search.neighbours(none), [], post.hyper.links.copy()
    off = [fitted.model.robot.links.index(f.link) for f in found]
    others[off] = EXACT
    every = near.candidates(near.at(near.linear.own, start.hyper, True))
    for a, same in zip(every, do_the_same(fitted, off, every), strict=True):
        with noted(failed, f"comparison: {a.effect.name} in the place of links"):
            if not same:
                continue
            one = search.fit(none, near.at((*near.linear.own, a), start.hyper, True))
            exact = search.fitter.fit(
                one.model, one.links, NoiseStart(replace(post.hyper, links=others), post.joints), fixed=True
            )
            if as_good(squared(exact), squared(fitted), NEAR * MATTERS):
                result.append(Exchange(exact, (shown_as(exact.extra[-1]),), (LINK_ERRORS,)))
    return result


def do_the_same(fitted: Fitted, links: Sequence[int], effects: Sequence[Addition]) -> list[bool]:
    """Whether effects do to the torques of these recordings what links do that are off, by their numbers, but for usual errors of links.

    Torques are linear in inertial parameters. What the links of the fit change of them is explained by plain parameters and links with
    errors of the declared size, at a cost that is the squared size of the errors. The change of links that are off lowers it, as one
    column each; an effect does the same if it lowers it by as much, but for a share `SAME`.
    """
    post, data, size = fitted.posterior, fitted.posterior.data, len(fitted.model.values)
    own, scale = slice(size, size + len(fitted.links)), post.hyper.sigma[:, None, None]
    by_bodies = data.rows(fitted.model).jacobian[:, :, size : size + 10 * data.n]
    each = np.diag((fitted.model.robot.inertial - data.links.plain).T.ravel()).reshape(-1, data.n, 10).sum(axis=2)
    changes, columns = by_bodies @ each, post.columns.copy()  # of each link (n, M, n)
    columns[:, :, own] = by_bodies @ data.links.at(data.links.none)[1]
    y = np.append(changes.sum(axis=2) / scale[:, :, 0], np.zeros(len(post.step)))

    def left(more: np.ndarray) -> float:
        x = (np.concatenate([columns, more], axis=2) / scale).reshape(-1, len(post.step) + more.shape[2])
        x = np.vstack(
            [x, np.eye(len(post.step), x.shape[1]) * np.sqrt(np.append(post.base.precision, np.zeros(more.shape[2])))]
        )
        return float(np.sum((y - x @ np.linalg.lstsq(x, y, rcond=None)[0]) ** 2))

    none, least = left(changes[:, :, :0]), left(changes[:, :, list(links)])
    return [left(a.columns) < least + SAME * (none - least) for a in effects]


def far_off(hyper: Hyperparameters) -> Hyperparameters:
    """Hyperparameters with links that may be far off."""
    return replace(hyper, links=np.maximum(hyper.links, FAR_OFF))


def squared(fitted: Fitted) -> np.ndarray:
    """Squared errors of a fit on its data, (n,)."""
    return np.sum(fitted.residual**2, axis=1)


def as_good(one: np.ndarray, other: np.ndarray, share: float = MATTERS) -> bool:
    """Whether squared errors are no larger than others, but for a share of their root, of what does not matter by default."""
    return bool(np.all(np.sqrt(one) * (1 - share) <= np.sqrt(other)))

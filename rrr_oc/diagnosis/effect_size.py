"""By how much each effect lowers the error on data that it was not fitted to: the size that a claim needs.

Recordings are cut into blocks of some seconds. A quarter of the blocks at a time is predicted from the others, with all effects and
without each, in the linear problem about the fit to all, whose shapes of effects stay. Blocks lie in every recording, so that no law
has to predict where it was never seen.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.stats import t as student

from rrr_oc.calibration.estimator.data import EVERY
from rrr_oc.calibration.estimator.evidence import Hyperparameters
from rrr_oc.calibration.samples import STRIDE
from rrr_oc.diagnosis.findings import Fall, Finding
from rrr_oc.diagnosis.held_out import acts_on
from rrr_oc.diagnosis.knobs import MATTERS
from rrr_oc.diagnosis.structures.linear import Addition, Level, Links, Structure
from rrr_oc.diagnosis.structures.neighbours import Neighbours

BLOCK, LEAST_BLOCKS, LEAST_ROWS = (
    5.0,
    4,
    8,
)  # length [s] of a block, number of a recording that shortens them, least rows of one
PARTS = 4  # of the blocks, each predicted once
QUANTILE = 0.975  # of the upper end of an interval


def sized(near: Neighbours, findings: Sequence[Finding], noise: np.ndarray) -> tuple[list[Finding], list[Finding]]:
    """Findings that lower some joint's error by what a claim needs, those that lower it most first, and those that do not, with the size
    of each.

    The least is left out first, and the others are judged without it, since of two that stand for each other one matters.

    Args:
        noise: What noise leaves of each joint's torque, root of the mean square over the rows, (n,) [Nm].
    """
    own = {id(a.source): a for a in near.linear.own}
    effects = [in_shape(own[id(f.term)]) for f in findings]
    edges = block_edges(near.level.edges)
    near = replace(near, level=Level(near.linear, edges))
    kept, sizes = list(range(len(findings))), dict[int, Fall]()
    while kept:
        sizes |= dict(zip(kept, falls(near, tuple(effects[k] for k in kept), noise), strict=True))
        least = min(kept, key=lambda k: sizes[k].margin)
        if sizes[least].margin > 0:
            break
        kept.remove(least)
    every = [replace(f, fall=sizes[k]) for k, f in enumerate(findings)]
    largest = sorted(kept, key=lambda k: -sizes[k].of_torque)
    return [every[k] for k in largest], [f for k, f in enumerate(every) if k not in kept]


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


def block_edges(edges: np.ndarray) -> np.ndarray:
    """First row of each block, and the number of rows, from those of the recordings."""
    inner = []
    for a, b in pairwise(edges.tolist()):
        number = max(round((b - a) * STRIDE * EVERY / BLOCK), min(LEAST_BLOCKS, (b - a) // LEAST_ROWS), 1)
        inner.append(np.linspace(a, b, number + 1)[:-1].astype(int))
    return np.append(np.concatenate(inner), edges[-1])


def falls(near: Neighbours, effects: Structure, noise: np.ndarray) -> list[Fall]:
    """The size of each effect beside the others, where it acts: on the joint where it exceeds most what a claim needs.

    A law that explains less than what no law explains may be a part of that. So its squares must be larger than those that laws leave
    unexplained, beyond noise; a black-box term is of what is unexplained, and has to matter alone.
    """
    data, hyper = near.linear.fitter.data, near.linear.fitted.posterior.hyper
    after, of_block, result = squares(near, effects, hyper), data.label[near.level.edges[:-1]], []
    laws = tuple(a for a in effects if not a.effect.black_box)
    rows = np.add.reduceat(data.counted, near.level.edges[:-1], axis=1).T  # of each block and joint, (B, n)
    unexplained = (after if len(laws) == len(effects) else squares(near, laws, hyper)) - rows * noise**2
    for k, a in enumerate(effects):
        before = squares(near, (*effects[:k], *effects[k + 1 :]), hyper)
        there = np.isin(np.array(data.labels)[of_block], a.scope or data.labels)
        one = []
        for j in acts_on(a.effect, data.n):
            fall = fall_of(j, after[there, j], before[there, j])
            left = 0.0 if a.effect.black_box else max(unexplained[there, j].sum() / max(after[there, j].sum(), 1e-300), 0.0)
            rms = np.sqrt(before[there, j].sum() / max(rows[there, j].sum(), 1))
            of_torque = float(fall.share * rms / data.torque[j])
            one.append(replace(fall, needed=max(MATTERS, float(1 - 1 / np.sqrt(1 + left))), of_torque=of_torque))
        result.append(max(one, key=lambda f: f.margin))
    return result


def squares(near: Neighbours, structure: Structure, hyper: Hyperparameters, links: Links = "as fitted") -> np.ndarray:
    """Squared errors of a structure on blocks that it was not fitted to, (B, n); hyperparameters are given.

    Args:
        near: With the level's products by block.
        links: How far they may be off.
    """
    level = near.level
    residual, blocks = np.zeros_like(near.linear.residual), level.whole
    for part in range(min(PARTS, len(blocks))):
        held = blocks[part::PARTS]
        rest = tuple(b for b in blocks if b not in held)
        rows = np.concatenate([np.arange(level.edges[b], level.edges[b + 1]) for b in held])
        residual[:, rows] = near.linear.left(structure, near.level.solved(structure, rest, hyper, True, links).step, rows)
    return np.array([(part**2).sum(axis=1) for part in np.split(residual, level.edges[1:-1], axis=1)])


def fall_of(joint: int, after: np.ndarray, before: np.ndarray) -> Fall:
    """From squared errors of a joint in each block, (B,) each: a ratio of sums with its interval (Cochran 1977, section 6.4)."""
    total, count = float(before.sum()), int(np.count_nonzero(before))
    if count < 2:
        return Fall(joint, 0.0, -np.inf, np.inf)
    ratio = float(after.sum()) / total
    std = np.sqrt(count / (count - 1) * np.sum((after - ratio * before) ** 2)) / total
    half = float(student.ppf(QUANTILE, count - 1) * std)
    share, low, high = (float(1 - np.sqrt(max(r, 0.0))) for r in (ratio, ratio + half, ratio - half))
    return Fall(joint, share, low, high)

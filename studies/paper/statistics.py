"""Independent trials of several optimisers compared: rank-sum tests, effect sizes, bootstrap confidence of a ranking."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.stats import mannwhitneyu

from rrr_oc.errors import UserError

RESAMPLES = 10_000  # of the bootstrap; doubled, the shares' standard error of at most 0.5 % falls by 1.4


@dataclass(frozen=True)
class Comparison:
    """Mann and Whitney's rank-sum test of the costs of `better` against those of `worse`.

    Attributes:
        better, worse: Names of the optimisers.
        p: Two-sided p-value; exact where there are no ties.
        p_paper: One-sided p-value by the normal approximation with continuity correction, as the paper prints it: 0.000091 for ten
            trials against ten that do not overlap.
        p_holm: `p` corrected for all comparisons of a table (Holm).
        superiority: Probability that a trial of `better` costs less than one of `worse`, ties counted half [1] (Vargha and Delaney's A).
        delta: Cliff's delta, 2 superiority − 1 [1].
        ratio: Median of `better` over median of `worse` [1].
    """

    better: str
    worse: str
    p: float
    p_paper: float
    p_holm: float
    superiority: float
    delta: float
    ratio: float


def compare(costs: Mapping[str, Sequence[float]], pairs: Sequence[tuple[str, str]]) -> list[Comparison]:
    """Rank-sum tests of pairs (better, worse); raises `UserError` where one of them has fewer than two trials."""
    few = [name for pair in pairs for name in pair if len(costs.get(name, ())) < 2]
    if few:
        raise UserError(f"a rank-sum test needs at least two trials, and {few[0]} has {len(costs.get(few[0], ()))}")
    found = []
    for better, worse in pairs:
        a, b = np.asarray(costs[better], float), np.asarray(costs[worse], float)
        tied = len(np.unique(np.r_[a, b])) < a.size + b.size
        two_sided = float(mannwhitneyu(a, b, method="asymptotic" if tied else "exact").pvalue)
        printed = float(mannwhitneyu(a, b, alternative="less", method="asymptotic", use_continuity=True).pvalue)
        superiority = float((np.sum(a[:, None] < b) + 0.5 * np.sum(a[:, None] == b)) / (a.size * b.size))
        ratio = float(np.median(a) / np.median(b))
        found.append(Comparison(better, worse, two_sided, printed, np.nan, superiority, 2 * superiority - 1, ratio))
    return [replace(c, p_holm=p) for c, p in zip(found, holm([c.p for c in found]), strict=True)]


def holm(p: Sequence[float]) -> list[float]:
    """p-values corrected for as many tests as there are (Holm, Scand. J. Statist. 6, 1979, 65–70).

    The k-th smallest of m is multiplied by m − k + 1, and none is below a smaller one's.
    """
    order = np.argsort(p, kind="stable")
    corrected = np.empty(len(p))
    corrected[order] = np.minimum(np.maximum.accumulate(np.arange(len(p), 0, -1) * np.asarray(p, float)[order]), 1.0)
    return corrected.tolist()


@dataclass(frozen=True)
class Ranking:
    """An order of optimisers, cheapest first, and its bootstrap confidence.

    Attributes:
        order: By the medians of the trials.
        by_median: Share of bootstrap resamples in which the medians of the trials have this order [1].
        by_best: Share of bootstrap resamples in which the best trials have this order [1].
    """

    order: tuple[str, ...]
    by_median: float
    by_best: float


def rank(costs: Mapping[str, Sequence[float]], seed: int = 0, resamples: int = RESAMPLES) -> Ranking:
    """The order by the medians of the trials, and how often resamples with replacement, drawn independently, keep it."""
    order = tuple(sorted(costs, key=lambda name: float(np.median(costs[name]))))
    rng = np.random.default_rng(seed)
    drawn = [np.asarray(costs[n], float)[rng.integers(len(costs[n]), size=(resamples, len(costs[n])))] for n in order]
    shares = []
    for figure in (np.median, np.min):
        values = [figure(d, axis=1) for d in drawn]
        shares.append(float(np.mean(np.all([a < b for a, b in pairwise(values)], axis=0))) if len(values) > 1 else 1.0)
    return Ranking(order, *shares)

"""Candidates for a further effect: the gain in evidence of every trial, by linear algebra on the products of a level."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular

from rrr_oc.calibration.estimator.evidence import LinearSolution
from rrr_oc.diagnosis.fitting import Fitter
from rrr_oc.diagnosis.knobs import EXCESS
from rrr_oc.diagnosis.signatures import Signatures
from rrr_oc.diagnosis.structures.linear import Blocks, Candidate, Level, Structure
from rrr_oc.effects import Trial

SHARES = (1.0, 0.85, 0.7, 0.5)  # of the best coefficients, tried until they are within the effect's bounds
LEAST_SOME = 8.0  # nats that all groups by themselves must gain together for an effect of some groups to be sought
LEAST_APART = 4.0  # nats: with less, an effect of some groups only is not sought
FAINT = 8.0  # nats below the best shape of an effect within which another counts
REGULAR = (1e-12, 1e-10, 1e-8, 1e-6)  # of its diagonal, against a matrix that is singular but for rounding
HELD = 1e9  # times its own precision, by which a coefficient stays at its bound; ten times less or more, no change
UNIQUE = 1e-7  # share of a signature that the model's parameters do not reproduce, below which it says nothing


@dataclass(frozen=True)
class Gains:
    """Gains in evidence (…) by the coefficients of trials, at their best (…, m), the likelihood's part, and the problems."""

    gain: np.ndarray
    coefficients: np.ndarray
    square: np.ndarray
    excess: np.ndarray
    problem: tuple[np.ndarray, np.ndarray, np.ndarray]

    def __getitem__(self, at: Any) -> "Gains":
        """Those of some trials."""
        own, right, scales = self.problem
        problem = own[at], right[at], scales[at]
        return Gains(self.gain[at], self.coefficients[at], self.square[at], self.excess[at], problem)

    @classmethod
    def of(cls, own: np.ndarray, right: np.ndarray, scales: np.ndarray) -> "Gains":
        """From normal equations (…, m, m) and (…, m) and the prior standard deviations (…, m), each at its best excess."""
        values, turn = np.linalg.eigh(own * scales[..., :, None] * scales[..., None, :])
        values, along = np.maximum(values, 0.0), np.einsum("...ji,...j->...i", turn, right * scales)
        options = []
        for excess, believed in EXCESS.items():
            w = excess * along / (1 + excess**2 * values)
            square = np.sum(excess * along * w, axis=-1)
            gain = 0.5 * square - 0.5 * np.sum(np.log1p(excess**2 * values), axis=-1) + np.log(believed)
            options.append((gain, excess * w, square, np.full(gain.shape, excess)))
        gain, coefficients, square, excess = options[0]
        for other in options[1:]:
            better = other[0] > gain
            coefficients = np.where(better[..., None], other[1], coefficients)
            gain, square, excess = (
                np.where(better, x, y) for x, y in zip((other[0], *other[2:]), (gain, square, excess), strict=True)
            )
        return cls(gain, np.einsum("...ij,...j->...i", turn, coefficients) * scales, square, excess, (own, right, scales))


def root_of(matrix: np.ndarray) -> np.ndarray:
    """Cholesky factor of a matrix that is positive definite but for rounding; raises `LinAlgError` for another.

    Units do not matter: each row and column counts as a share of its diagonal.
    """
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    alike = matrix / np.outer(scale, scale)
    for more in REGULAR:
        try:
            return scale[:, None] * cholesky(alike + more * np.eye(len(matrix)), lower=True, check_finite=False)
        except LinAlgError:
            pass
    raise LinAlgError("not positive definite")


def at_bounds(post: LinearSolution) -> np.ndarray:
    """Which coefficients are at a bound where they began, and would leave it if they could, (p,): no other effect moves them."""
    prior = post.prior
    slope = post.right + prior.precision * prior.mean - post.matrix @ post.step
    return ((prior.lower >= 0) & (slope < 0)) | ((prior.upper <= 0) & (slope > 0))


@dataclass(frozen=True, eq=False)
class Screen:
    """The trials of a table beside a structure, all that the structure explains taken off.

    Attributes:
        level: The products.
        table: The trials, of D columns.
        labels, groups: The groups, and for each its blocks.
        sigma: Of each joint.
        covariance: H⁻¹, of the structure's coefficients, (p, p); `ahead`: their step, (p,).
        share: H⁻¹ Cᵀ, by how much these change with the coefficients of the trials, (p, G, D).
        half: L⁻¹ Cᵀ, where L Lᵀ = H, (p, G, D).
        through: Of each joint, products with the features of its discrepancy, weighted by it, (F, G, T).
        right: b of each column, (G, D).
    """

    level: Level
    table: Signatures
    labels: tuple[str, ...]
    groups: list[list[int]]
    sigma: np.ndarray
    covariance: np.ndarray
    ahead: np.ndarray
    share: np.ndarray
    half: np.ndarray
    through: list[np.ndarray]
    right: np.ndarray

    @classmethod
    def of(cls, level: Level, table: Signatures, structure: Structure, blocks: Blocks, post: LinearSolution) -> "Screen":
        """Of the trials of a table beside a structure that was solved on some blocks."""
        hyper, total, names = post.hyper, int(table.start[-1]), level.linear.fitter.data.groups
        labels = tuple(dict.fromkeys(names[b] for b in blocks))
        groups = [[b for b in blocks if names[b] == g] for g in labels]
        count, p = len(post.step), level.p
        cross, right, through = np.zeros((len(groups), count, total)), np.zeros((len(groups), total)), []
        grams, sums = level.grams(structure, blocks), level.sums(blocks)
        at = p + np.cumsum([0, *(a.size for a in structure)])
        slope = post.prior.precision * post.prior.mean
        for j, (one, gram, products) in enumerate(zip(sums, grams, level.table(table), strict=True)):
            sigma2 = hyper.sigma[j] ** 2
            d = 1 / (one.spectrum.values + sigma2 / hyper.discrepancy[j] ** 2)
            slope[gram.live] += (gram.xy - gram.tx.T @ (d * gram.ty)) / sigma2
            here = [k for k, a in enumerate(structure) if j in level.part(a).back]
            every = [products.left, *(level.across(structure[k], table, j) for k in here)]
            summed = [np.array([x[g].sum(axis=0) for g in groups]) for x in every]  # (G, L or m, T)
            features = np.einsum("fe,get->fgt", one.turn.T, summed[0][:, p:-1], optimize=True)
            numbers = np.concatenate([np.arange(p), *(np.arange(at[k], at[k + 1]) for k in here)])
            x = np.concatenate([summed[0][:, :p], *summed[1:]], axis=1)[:, np.isin(numbers, gram.live)]
            x = x - np.einsum("fx,fgt->gxt", gram.tx * d[:, None], features, optimize=True)
            cross[:, gram.live[:, None], products.used] += x / sigma2
            right[:, products.used] += (summed[0][:, -1] - np.einsum("f,fgt->gt", d * gram.ty, features)) / sigma2
            through.append(features * np.sqrt(d / sigma2)[:, None, None])
        matrix = post.matrix + np.diag(HELD * np.diag(post.matrix) * at_bounds(post))
        factor = root_of(matrix)
        half = solve_triangular(factor, np.moveaxis(cross, 0, 1).reshape(count, -1), lower=True, check_finite=False)
        share = solve_triangular(factor, half, lower=True, trans=1, check_finite=False)
        shape = count, len(groups), total
        covariance = cho_solve((factor, True), np.eye(count))
        ahead = covariance @ slope
        right -= np.einsum("p,pgd->gd", ahead, np.moveaxis(cross, 0, 1))
        of_structure = covariance, ahead, share.reshape(shape), half.reshape(shape)
        return cls(level, table, labels, groups, hyper.sigma, *of_structure, through, right)

    @property
    def fitter(self) -> Fitter:
        """The data, and what is believed."""
        return self.level.linear.fitter

    def candidates(self, out: Sequence[int] = (), near: np.ndarray | None = None) -> list[Candidate]:
        """The candidates, largest gain first: each effect at its joints, in all recordings and in its best groups.

        Args:
            out: Numbers of coefficients of the structure that are left out.
            near: Which of the trials are sought; all if None.
        """
        half, right = self.half, self.right
        if len(out):
            root = root_of(self.covariance[np.ix_(list(out), list(out))])
            flat = self.share[list(out)].reshape(len(out), -1)
            more = solve_triangular(root, flat, lower=True, check_finite=False).reshape(len(out), *right.shape)
            right = right + np.einsum("o,ogd->gd", solve_triangular(root, self.ahead[list(out)], lower=True), more)
        else:
            more = np.zeros((0, *right.shape))
        found: dict[tuple, list[Candidate]] = {}
        sizes = np.diff(self.table.start)
        for m in np.unique(sizes).tolist():
            trials = np.flatnonzero(sizes == m)
            sought = np.ones(len(trials), bool) if near is None else near[trials]
            if sought.any():
                self._of_size(m, trials, sought, (half, more, right), found)
        return self._families(found)

    def _of_size(self, m: int, trials: np.ndarray, sought: np.ndarray, products, found: dict) -> None:
        """Candidates among the trials of m columns."""
        half, more, right = products
        some = np.flatnonzero(sought)
        trials = trials[some]
        columns = self.table.start[trials][:, None] + np.arange(m)  # (K, m)
        count, G = len(trials), len(self.groups)
        place = np.full(len(sought), -1)
        place[some] = np.arange(count)
        z, w = (x[:, :, columns].transpose(2, 1, 3, 0).reshape(count, G * m, -1) for x in (half, more))  # (K, G m, p)
        pairs = (w @ w.transpose(0, 2, 1) - z @ z.transpose(0, 2, 1)).reshape(count, G, m, G, m)
        raw = np.zeros((count, m))
        for products, through, sigma in zip(self.level.table(self.table), self.through, self.sigma, strict=True):
            where, first, blocks = products.own[m]
            here = place[where] >= 0
            if not here.any():
                continue
            to, at = place[where[here]], first[here][:, None] + np.arange(m)
            t = through[:, :, at].transpose(2, 1, 3, 0).reshape(len(to), G * m, -1)
            pairs[to] -= (t @ t.transpose(0, 2, 1)).reshape(len(to), G, m, G, m)
            for g, own in enumerate(self.groups):
                block = blocks[own][:, here].sum(axis=0) / sigma**2
                pairs[to, g, :, g] += block
                raw[to] += np.einsum("kmm->km", block)
        slopes = right[:, columns].transpose(1, 0, 2)  # (K, G, m)
        scales = np.array([self.fitter.scales(self.table.trials[k]) for k in trials])
        own, there = pairs.sum(axis=(1, 3)), slopes.sum(axis=1)
        live = ~np.all(np.einsum("kmm->km", own) < UNIQUE * raw, axis=1) & (raw.max(axis=1) > 0)
        partly = np.array([self.table.trials[k].effect.partly for k in trials])
        gains = Gains.of(own, there, scales)
        for i in np.argsort(-gains.gain).tolist():
            if live[i] and partly[i] < 1.0:
                self._keep(found, self.table.trials[trials[i]], None, gains, i)
        apart = np.flatnonzero((partly > 0) & (raw.max(axis=1) > 0)) if G > 1 else np.zeros(0, int)
        if m == 1 and len(apart):
            each = np.einsum("kgmgm->kg", pairs[apart])
            seen = each > UNIQUE * raw[apart]
            alone = np.where(seen, slopes[apart, :, 0] ** 2 / np.where(seen, each, 1.0), 0.0)
            common = there[apart, 0] ** 2 / np.where(live[apart], own[apart, 0, 0], 1.0) * live[apart]
            apart = apart[0.5 * (alone.sum(axis=1) - common) >= LEAST_APART]
        if len(apart):
            self._in_groups(trials[apart], (pairs[apart], slopes[apart], scales[apart]), found)

    def _in_groups(self, trials: np.ndarray, products, found: dict) -> None:
        """Candidates in the best groups of each number that pays, chosen one after the other."""
        pairs, slopes, scales = products
        count, G, m = slopes.shape
        alive, chosen = np.ones(count, bool), np.zeros((count, G), bool)
        own, there, last = np.zeros((count, m, m)), np.zeros((count, m)), np.full(count, -np.inf)
        for step in range(G - 1):
            at = np.flatnonzero(alive)
            if not len(at):
                return
            with_chosen = np.einsum("kh,khmgn->kgmn", chosen[at], pairs[at], optimize=True)
            each = np.einsum("kgmgn->kgmn", pairs[at])
            option = own[at][:, None] + each + with_chosen + with_chosen.transpose(0, 1, 3, 2)
            gains = Gains.of(option, there[at][:, None] + slopes[at], np.repeat(scales[at][:, None], G, axis=1))
            gain = np.where(chosen[at] | (np.einsum("kgmm->kg", option) <= 0), -np.inf, gains.gain)
            best = np.argmax(gain, axis=1)
            rows = np.arange(len(at))
            top = gain[rows, best]
            stay = np.isfinite(top) & (top >= last[at] - LEAST_APART)
            if step == 0:
                stay &= np.sum(np.maximum(gain, 0.0), axis=1) >= LEAST_SOME
            alive[at[~stay]] = False
            chosen[at[stay], best[stay]] = True
            own[at], there[at], last[at] = option[rows, best], there[at] + slopes[at, best], top
            mine = gains[rows, best]
            for i in np.flatnonzero(stay).tolist():
                scope = tuple(self.labels[g] for g in np.flatnonzero(chosen[at[i]]))
                self._keep(found, self.table.trials[trials[at[i]]], scope, mine, i)

    def _keep(self, found: dict, trial: Trial, scope: tuple[str, ...] | None, gains: Gains, i: int) -> None:
        """Add a trial to those of its effect, unless another shape is far better.

        Coefficients out of bounds are made smaller or, one at a time, set to 0.
        """
        effect, one, use = trial.effect, gains[i], np.arange(len(trial.points))
        family = found.setdefault((effect if effect.black_box else effect.name, effect.joints, scope), [])
        if one.gain < 0 or (family and one.gain < family[0].gain - FAINT):
            return
        least = self.fitter.data.least_payload(scope)
        while True:
            coefficients = np.zeros(len(trial.points))
            coefficients[use] = one.coefficients
            for share in SHARES:
                theta = effect.combined(trial.points, share * coefficients)
                if effect.possible(theta, least) and self.fitter.believed(trial, theta):
                    gain = float(one.gain - 0.5 * (1 - share) ** 2 * one.square)
                    family.append(Candidate(trial, scope, share * coefficients, gain, float(one.excess), 0.0))
                    return
            if len(use) == 1 or len(effect.amplitudes) != len(trial.points):
                return
            own, right, scales = one.problem
            stay = np.delete(np.arange(len(use)), np.argmin(one.coefficients / scales))
            use, one = use[stay], Gains.of(own[np.ix_(stay, stay)], right[stay], scales[stay])

    def _families(self, found: dict) -> list[Candidate]:
        """For each effect and its groups the best shape, with the gain over all shapes and the prior odds."""
        numbers: dict[tuple, int] = {}
        for trial in self.table.trials:
            name = trial.effect if trial.effect.black_box else trial.effect.name
            numbers[name, trial.effect.joints] = numbers.get((name, trial.effect.joints), 0) + 1
        result = []
        for (name, joints, scope), every in found.items():
            if every:
                best = max(every, key=lambda c: c.gain)
                odds = self.fitter.log_prior(best.trial.effect, scope) - float(np.log(numbers[name, joints]))
                gain = float(np.logaddexp.reduce([c.gain for c in every])) + odds
                result.append(replace(best, gain=gain, log_prior=gain - best.gain))
        return sorted(result, key=lambda c: -c.gain)

"""Candidates for a further effect: the gain in evidence of every trial, by linear algebra at one fitted model."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.diagnosis.data import Data
from rrr_oc.diagnosis.evidence import Posterior, joined, solve
from rrr_oc.diagnosis.fitting import Fitted, Fitter
from rrr_oc.diagnosis.knobs import EXCESS
from rrr_oc.diagnosis.signatures import Table, table
from rrr_oc.effects import Trial

SHARES = (1.0, 0.85, 0.7, 0.5)  # of the best coefficients, tried until they are within the effect's bounds
LEAST_SOME = 8.0  # nats that all groups by themselves must gain together for the same
LEAST_APART = 4.0  # nats: with less, an effect of some groups only is not sought
LEAST_FIT = 1.0  # nats of likelihood that a trial must gain to be looked at closer
UNIQUE = 1e-7  # share of a signature that the model's parameters do not reproduce, below which it says nothing


class Option(NamedTuple):
    """A trial in some groups (None: all), its gain in evidence, its coefficients (m,), and the width of their prior over its scales."""

    scope: tuple[str, ...] | None
    gain: float
    coefficients: np.ndarray
    excess: float


@dataclass(frozen=True)
class Candidate:
    """One way to extend a model.

    Attributes:
        trial: With the best shape.
        scope: Groups that have the effect; None for all.
        coefficients: (m,).
        gain: Gain in the logarithm of the posterior probability, over all shapes.
        excess: Width of the prior of the coefficients, over their typical scales.
        log_prior: The part of the gain that is the prior's, without that of this width.
    """

    trial: Trial
    scope: tuple[str, ...] | None
    coefficients: np.ndarray
    gain: float
    excess: float
    log_prior: float

    @property
    def key(self) -> tuple:
        """Name and joints of the effect."""
        return self.trial.effect.name, self.trial.effect.joints

    @property
    def term(self) -> Term:
        """The candidate as a term of a model."""
        effect, groups = self.trial.effect, self.scope or ()
        theta = effect.combined(self.trial.points, self.coefficients)
        estimates = tuple(Estimate(float(theta[p.name])) for p in effect.parameters)
        return Term(effect, estimates, self.trial.width, "all" if self.scope is None else (), groups)


def signatures(data: Data, model: CalibratedModel, every: Sequence[Trial]) -> Table:
    """Signatures of trials at a model, at the rows that are used."""
    found = table(data.prepared, model, every, data.signatures)
    return replace(found, values=tuple(v[data.at] for v in found.values))


@dataclass(frozen=True)
class Screen:
    """A fitted model with the signatures of trials, whitened.

    Attributes:
        fitter, fitted: The data and the model.
        post: Its posterior.
        trials: The trials; `start` their first columns.
        cross: For each group the products with the model's parameters, discrepancy integrated out, (L, p, D).
        own: Blocks of the trials: for each, (L, m, m).
        through: For each joint the products of its discrepancy with columns, (L, F, D).
        right: Products with the residual, (L, D).
    """

    fitter: Fitter
    fitted: Fitted
    post: Posterior
    trials: tuple[Trial, ...]
    start: np.ndarray
    cross: np.ndarray
    own: list[np.ndarray]
    through: list[np.ndarray]
    right: np.ndarray
    slope: np.ndarray

    @classmethod
    def of(cls, fitter: Fitter, fitted: Fitted, found: Table, post: Posterior) -> "Screen":
        data = fitter.data
        labels, total, p = len(data.labels), int(found.start[-1]), post.columns.shape[2]
        cross, right = np.zeros((labels, p, total)), np.zeros((labels, total))
        sizes, slope = np.diff(found.start), np.zeros(p)
        own = [np.zeros((labels, m, m)) for m in sizes]
        through, at = [], [np.flatnonzero(data.label == g) for g in range(labels)]
        for j, one in enumerate(post.joints):
            sigma2 = post.sizes.sigma[j] ** 2
            rho = sigma2 / post.sizes.discrepancy[j] ** 2
            d = 1 / (one.values + rho)
            live = np.flatnonzero(np.any(post.columns[j] != 0, axis=0))
            x, y = one.white @ post.columns[j][:, live], one.white @ fitted.residual[j]
            y = one.beyond_discrepancy(y, rho)
            slope[live] += x.T @ y / sigma2
            x = one.beyond_discrepancy(x, rho)
            c, used = one.white @ found.values[j], found.used[j]
            t = np.zeros((labels, len(d), total))
            for g, rows in enumerate(at):
                part = c[rows]
                cross[g][np.ix_(live, used)] += x[rows].T @ part / sigma2
                right[g, used] += y[rows] @ part / sigma2
                t[g][:, used] = (one.turn.T @ (one.features[rows].T @ part)) * np.sqrt(d[:, None] / sigma2)
                square = np.sum(part**2, axis=0) / sigma2
                owner = np.searchsorted(found.start, used, side="right") - 1
                for k in np.unique(owner):
                    here = np.flatnonzero(owner == k)
                    inside = used[here] - found.start[k]
                    block = np.diag(square[here]) if len(here) == 1 else part[:, here].T @ part[:, here] / sigma2
                    own[k][g][np.ix_(inside, inside)] += block
            through.append(t)
        return cls(fitter, fitted, post, found.trials, found.start, cross, own, through, right, slope)

    def candidates(self) -> list[Candidate]:
        """The candidates, largest gain first: each effect at its joints, in all recordings and in its best groups."""
        slope = self.slope + self.post.prior.precision * self.post.prior.mean
        scale = np.sqrt(np.maximum(np.diag(self.post.matrix), 1e-30))
        factor = cho_factor(self.post.matrix / np.outer(scale, scale) + 1e-12 * np.eye(len(scale)))
        ahead = cho_solve(factor, slope / scale) / scale
        right = self.right - np.einsum("p,gpd->gd", ahead, self.cross)
        solved = np.stack([cho_solve(factor, c / scale[:, None]) / scale[:, None] for c in self.cross])
        found: dict[tuple, list[Candidate]] = {}
        bounds = self._bounds(solved, right)
        for k, trial in enumerate(self.trials):
            if bounds[k] < LEAST_FIT:
                continue
            for scope, gain, coefficients, excess in self._options(k, solved, right):
                one = Candidate(trial, scope, coefficients, gain, excess, 0.0)
                name = trial.effect if trial.effect.black_box else trial.effect.name
                found.setdefault((name, trial.effect.joints, scope), []).append(one)
        numbers: dict[tuple, int] = {}
        for trial in self.trials:
            name = trial.effect if trial.effect.black_box else trial.effect.name
            numbers[name, trial.effect.joints] = numbers.get((name, trial.effect.joints), 0) + 1
        result = []
        for (name, joints, scope), every in found.items():
            best = max(every, key=lambda c: c.gain)
            prior = self.fitter.log_prior(best.trial.effect, scope) - np.log(numbers[name, joints])
            gain = float(np.logaddexp.reduce([c.gain for c in every])) + prior
            result.append(replace(best, gain=gain, log_prior=prior))
        return sorted(result, key=lambda c: -c.gain)

    def _bounds(self, solved: np.ndarray, right: np.ndarray) -> np.ndarray:
        """For each trial the largest increase of the log-likelihood, in all groups together or in each by itself, (trials,)."""
        sizes, result, groups = np.diff(self.start), np.zeros(len(self.trials)), range(len(self.fitter.data.labels))
        for m in np.unique(sizes):
            which = np.flatnonzero(sizes == m)
            at = self.start[which][:, None] + np.arange(m)  # (trials, m)
            total = []
            for some in (list(groups), *([g] for g in groups)):
                own = np.array([self.own[k][some].sum(axis=0) for k in which])
                raw = np.einsum("kmm->km", own).copy()
                parts = [t[some].sum(axis=0)[:, at] for t in self.through]
                own -= sum(np.einsum("fkm,fkn->kmn", p, p) for p in parts)
                crossed, through = self.cross[some].sum(axis=0)[:, at], solved[some].sum(axis=0)[:, at]
                own -= np.einsum("pkm,pkn->kmn", crossed, through)
                there = right[some].sum(axis=0)[at]
                scale = np.sqrt(np.maximum(raw, 1e-300))
                scaled = own / (scale[:, :, None] * scale[:, None, :]) + UNIQUE * np.eye(m)
                b = there / scale
                total.append(0.5 * np.einsum("km,km->k", b, np.linalg.solve(scaled, b[..., None])[..., 0]))
            result[which] = np.maximum(total[0], np.sum(total[1:], axis=0) if len(groups) > 1 else 0.0)
        return result

    def _options(self, k: int, solved: np.ndarray, right: np.ndarray) -> Iterator[Option]:
        """A trial in all groups, and in the best groups of each number that pays, with their gains."""
        data, trial = self.fitter.data, self.trials[k]
        c, groups = slice(self.start[k], self.start[k + 1]), len(data.labels)
        every, gain = tuple(range(groups)), -np.inf

        def option(some: tuple[int, ...], scope: tuple[str, ...] | None) -> Option | None:
            own, there = self._reduced(k, some, solved), right[list(some), c].sum(axis=0)
            found = None if own is None else self._best_within(trial, own, there, data.least_payload(scope))
            return found and Option(scope, *found)

        if trial.effect.partly < 1.0 and (one := option(every, None)) is not None:
            yield one
        if trial.effect.partly == 0.0 or groups == 1 or self._apart(k, solved, right) < LEAST_APART:
            return
        chosen: tuple[int, ...] = ()
        for _ in range(groups - 1):
            some = [tuple(sorted((*chosen, g))) for g in every if g not in chosen]
            tried = [(s, one) for s in some if (one := option(s, tuple(data.labels[i] for i in s))) is not None]
            if not tried or (not chosen and sum(max(one.gain, 0.0) for _, one in tried) < LEAST_SOME):
                return
            chosen, best = max(tried, key=lambda t: t[1].gain)
            if best.gain < gain - LEAST_APART:
                return
            gain = best.gain
            yield best

    def _reduced(self, k: int, some: Sequence[int], solved: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """A trial's normal matrix in some groups, the model's parameters eliminated, and its diagonal before; None for no torque."""
        g, c = list(some), slice(self.start[k], self.start[k + 1])
        own = self.own[k][g].sum(axis=0)
        raw = np.diag(own).copy()
        if not raw.max(initial=0.0) > 0:
            return None
        for t in self.through:
            part = t[g, :, c].sum(axis=0)
            own = own - part.T @ part
        return own - self.cross[g, :, c].sum(axis=0).T @ solved[g, :, c].sum(axis=0), raw

    def _apart(self, k: int, solved: np.ndarray, right: np.ndarray) -> float:
        """By how much one coefficient of its own in each group explains more than a common one [nats]; enough for several."""
        c, every = slice(self.start[k], self.start[k + 1]), range(len(self.fitter.data.labels))
        if c.stop - c.start > 1:
            return LEAST_APART
        parts = []
        for g in (*[[g] for g in every], list(every)):
            found, there = self._reduced(k, g, solved), float(right[g, c].sum())
            live = found is not None and found[0][0, 0] > UNIQUE * found[1][0]
            parts.append(0.5 * there**2 / found[0][0, 0] if found is not None and live else 0.0)
        return sum(parts[:-1]) - parts[-1]

    def _best_within(
        self, trial: Trial, quadratic: tuple[np.ndarray, np.ndarray], right: np.ndarray, least: float
    ) -> tuple[float, np.ndarray, float] | None:
        """Gain in evidence, coefficients within the effect's bounds, and width of their prior; None where there is none.

        Coefficients out of bounds are made smaller or, one at a time, set to 0.
        """
        (own, raw), effect = quadratic, trial.effect
        scales, use = self.fitter.scales(trial), list(range(len(right)))
        while use:
            if np.all(np.diag(own)[use] < UNIQUE * raw[use]):
                return None
            values, turn = np.linalg.eigh(own[np.ix_(use, use)] * np.outer(scales[use], scales[use]))
            values, along = np.maximum(values, 0.0), turn.T @ (right[use] * scales[use])
            options = []
            for excess, believed in EXCESS.items():
                w = excess * along / (1 + excess**2 * values)
                square = float(excess * along @ w)
                gain = 0.5 * square - 0.5 * float(np.log1p(excess**2 * values).sum()) + np.log(believed)
                options.append((gain, excess, square, excess * w))
            gain, excess, square, best = max(options, key=lambda o: o[0])
            best = turn @ best * scales[use]
            full = np.zeros(len(right))
            full[use] = best
            for share in SHARES:
                theta = effect.combined(trial.points, share * full)
                if effect.possible(theta, least) and self.fitter.believed(trial, theta):
                    return gain - 0.5 * (1 - share) ** 2 * square, share * full, excess
            if len(use) == 1 or len(effect.amplitudes) != len(right):
                return None
            use.pop(int(np.argmin(best / scales[use])))
        return None

    def evaluated(self, candidate: Candidate) -> Posterior:
        """The evidence of a candidate with all sizes estimated anew, its prediction linear in its coefficients."""
        data, post, trial = self.fitter.data, self.post, candidate.trial
        found = signatures(data, self.fitted.model, [trial])
        m = len(trial.points)
        columns = np.zeros((data.n, post.columns.shape[1], m))
        for j in range(data.n):
            columns[j][:, found.used[j]] = found.values[j]
        if candidate.scope is not None:
            columns *= np.isin(np.array(data.labels)[data.label], candidate.scope)[None, :, None]
        prior = joined(self.post.base, candidate.excess * self.fitter.scales(trial))
        return solve(data, self.fitted.residual, np.concatenate([post.columns, columns], axis=2), prior, post)

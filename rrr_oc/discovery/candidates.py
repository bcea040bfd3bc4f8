"""Candidates for a further effect: the gain in evidence of every trial, by linear algebra at one fitted model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import logsumexp

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.diagnosis.signatures import Table, table
from rrr_oc.discovery.data import Data
from rrr_oc.discovery.evidence import Posterior, Prior, at_size, solve
from rrr_oc.discovery.fitting import Fitted, Fitter
from rrr_oc.effects import Trial

SHARES = (1.0, 0.85, 0.7, 0.5)  # of the best coefficients, tried until they are within the effect's bounds
LEAST_SOME = 8.0  # nats that all groups by themselves must gain together for the same
LEAST_APART = 4.0  # nats: with less, an effect of some groups only is not sought
UNIQUE = 1e-7  # share of a signature that the model's parameters do not reproduce, below which it says nothing


@dataclass(frozen=True)
class Candidate:
    """One way to extend a model.

    Attributes:
        trial: With the best shape.
        scope: Groups that have the effect; None for all.
        coefficients: (m,).
        gain: Gain in the logarithm of the posterior probability, over all shapes.
        log_prior: The part of it that is the prior's.
    """

    trial: Trial
    scope: tuple[str, ...] | None
    coefficients: np.ndarray
    gain: float
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
            d = 1 / (one.values + sigma2 / post.sizes.discrepancy[j] ** 2)
            live = np.flatnonzero(np.any(post.columns[j] != 0, axis=0))
            x, y = one.white @ post.columns[j][:, live], one.white @ fitted.residual[j]
            tx, ty = one.along(x), one.along(y)
            y = y - one.features @ (one.turn @ (d * ty))
            slope[live] += x.T @ y / sigma2
            x = x - one.features @ (one.turn @ (d[:, None] * tx))
            c, used = one.white @ found.values[j], found.used[j]
            t = np.zeros((labels, len(d), total))
            for g, rows in enumerate(at):
                part = c[rows]
                cross[np.ix_([g], live, used)] += (x[rows].T @ part)[None] / sigma2
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
        prior = self.fitter.prior(self.fitted.model, self.fitted.links)
        prior = at_size(prior, self.post.sizes.links)
        slope = self.slope + prior.precision * prior.mean
        scale = np.sqrt(np.maximum(np.diag(self.post.matrix), 1e-30))
        factor = cho_factor(self.post.matrix / np.outer(scale, scale) + 1e-12 * np.eye(len(scale)))
        ahead = cho_solve(factor, slope / scale) / scale
        right = self.right - np.einsum("p,gpd->gd", ahead, self.cross)
        solved = np.stack([cho_solve(factor, c / scale[:, None]) / scale[:, None] for c in self.cross])
        found: dict[tuple, list[Candidate]] = {}
        for k, trial in enumerate(self.trials):
            for scope, gain, coefficients in self._options(k, trial, solved, right):
                one = Candidate(trial, scope, coefficients, gain, 0.0)
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
            gain = float(logsumexp([c.gain for c in every])) + prior
            result.append(replace(best, gain=gain, log_prior=prior))
        return sorted(result, key=lambda c: -c.gain)

    def _options(self, k: int, trial: Trial, solved: np.ndarray, right: np.ndarray):
        data, effect = self.fitter.data, trial.effect
        c = slice(self.start[k], self.start[k + 1])
        scales = self.fitter.priors.scales(self.fitter.view, trial)
        groups = len(data.labels)
        every = tuple(range(groups))
        scoped = effect.partly > 0.0 and groups > 1
        if effect.partly < 1.0:
            yield from self._option(k, c, every, None, trial, scales, solved, right)
        if not scoped or self._apart(k, c, every, solved, right) < LEAST_APART:
            return
        chosen: tuple[int, ...] = ()
        for _ in range(groups - 1):
            options = []
            for g in every:
                if g not in chosen:
                    some = tuple(sorted((*chosen, g)))
                    options += self._option(k, c, some, tuple(data.labels[i] for i in some), trial, scales, solved, right)
            if not options or (not chosen and sum(max(o[1], 0.0) for o in options) < LEAST_SOME):
                return
            best = max(options, key=lambda o: o[1])
            if chosen and best[1] < last - 3.0:
                return
            last = best[1]
            chosen = tuple(data.labels.index(x) for x in best[0])
            yield best

    def _apart(self, k, c, every, solved, right) -> float:
        """By how much coefficients of their own in each group explain more than common ones [nats], first coefficients only."""
        i, parts = c.start, []
        for g in (*[(g,) for g in every], every):
            at = list(g)
            own = self.own[k][at, 0, 0].sum() - sum(float(np.sum(t[at, :, i].sum(axis=0) ** 2)) for t in self.through)
            own -= float(self.cross[at, :, i].sum(axis=0) @ solved[at, :, i].sum(axis=0))
            parts.append(0.5 * float(right[at, i].sum()) ** 2 / own if own > UNIQUE * self.own[k][at, 0, 0].sum() else 0.0)
        return sum(parts[:-1]) - parts[-1] if c.stop - c.start == 1 else LEAST_APART

    def _option(self, k, c, some, scope, trial: Trial, scales, solved, every_right):
        g = list(some)
        own = self.own[k][g].sum(axis=0)
        raw = np.diag(own).copy()
        if not raw.max(initial=0.0) > 0:
            return
        for t in self.through:
            part = t[g, :, c].sum(axis=0)
            own = own - part.T @ part
        cross = self.cross[g, :, c].sum(axis=0)
        own = own - cross.T @ solved[g, :, c].sum(axis=0)
        right = every_right[g, c].sum(axis=0)
        least = self.fitter.data_least_payload(scope)
        use = list(range(len(right)))
        while use:
            s = scales[use]
            m = own[np.ix_(use, use)] * np.outer(s, s)
            b = right[use] * s
            if np.all(np.diag(m) < UNIQUE * raw[use] * s**2):
                return
            a = m + np.eye(len(use))
            w = np.linalg.solve(a, b)
            full = np.zeros(len(right))
            full[use] = w * s
            log_det = np.linalg.slogdet(a)[1]
            for share in SHARES:
                if trial.effect.possible(trial.effect.combined(trial.points, share * full), least):
                    gain = 0.5 * share * (2 - share) * float(b @ w) - 0.5 * log_det
                    yield scope, gain, share * full
                    return
            if len(use) == 1 or len(trial.effect.amplitudes) != len(right):
                return
            worst = int(np.argmin(w))
            use = use[:worst] + use[worst + 1 :]

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
        base = self.fitter.prior(self.fitted.model, self.fitted.links)
        return solve(data, self.fitted.residual, np.concatenate([post.columns, columns], axis=2), joined(base, self.fitter.priors.scales(self.fitter.view, trial)), post)


def joined(base: Prior, scales: np.ndarray) -> Prior:
    m, inf = len(scales), np.full(len(scales), np.inf)
    return Prior(
        np.append(base.mean, np.zeros(m)),
        np.append(base.precision, scales**-2.0),
        np.append(base.proper, np.ones(m, bool)),
        np.append(base.links, np.zeros(m, bool)),
        np.append(base.lower, -inf),
        np.append(base.upper, inf),
        np.append(base.flat, np.zeros(m)),
    )

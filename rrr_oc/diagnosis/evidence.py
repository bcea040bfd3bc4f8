"""Evidence for effects that a model lacks: likelihood ratios by linear algebra on residuals and signatures.

The coefficients of every trial are fitted together with all parameters of the model, on all recordings or on some groups of them.
The evidence is the growth of twice the log-likelihood, with each joint's noise variance estimated again, minus what so many
coefficients and trials gain by chance. Autocorrelated residuals have a smaller effective sample size (`fitting.independent`).
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.regression import Rows, rows
from rrr_oc.calibration.samples import STRIDE
from rrr_oc.diagnosis.fitting import WHITE, Bench, independent
from rrr_oc.diagnosis.signatures import Table, table
from rrr_oc.effects import Effect, Trial
from rrr_oc.numerics.rank import UNIQUE, UNIQUE_TOGETHER, Directions, pseudo_inverse

PIECES = 4  # of a recording that alone has an effect, for cross-validation within it; doubled, each is more like the others
ALARMS = 0.01  # probability of naming an effect where nothing is missing; doubled, fainter effects are found
# Multiples of coefficients, tried until one is within bounds
SHARES = 1.0, 0.85, 0.7, 0.5
FIRST = 40  # candidates, by quadratic gain, whose likelihood is computed; doubled, it costs time
Key = tuple[str, tuple[int, ...]]  # name and joints of an effect


@dataclass(frozen=True)
class Candidate:
    """A trial with its coefficients and its likelihood.

    Attributes:
        trial: The trial.
        number: Index of the trial among those of the evidence.
        scope: Groups that have the effect; None for all.
        coefficients: Fitted together with all parameters of the model, (m,).
        likelihood: Growth of twice the log-likelihood, at the effective sample size of the residuals that the trial leaves.
        compared: The same at the effective sample size of the model without it, which is equal for all candidates.
        dimensions: Number of independent coefficients that the recordings determine.
        penalty: Likelihood that its parameters and the choice among all trials and groups gain by chance.
        least: Likelihood from which it is significant.
    """

    trial: Trial
    number: int
    scope: tuple[str, ...] | None
    coefficients: np.ndarray
    likelihood: float
    compared: float
    dimensions: int
    penalty: float
    least: float

    @property
    def score(self) -> float:
        """Likelihood minus penalty, by which candidates are ranked."""
        return self.likelihood - self.penalty

    @property
    def key(self) -> Key:
        """Name and joints of the effect."""
        return self.trial.effect.name, self.trial.effect.joints

    @property
    def term(self) -> Term:
        """The candidate as a term of a model."""
        effect, groups = self.trial.effect, self.scope or ()
        theta = effect.combined(self.trial.points, self.coefficients)
        estimates = tuple(Estimate(float(theta[p.name])) for p in effect.parameters)
        return Term(effect, estimates, self.trial.width, "all" if self.scope is None else (), groups)


@dataclass(frozen=True)
class Evidence:
    """A model at a bench, with the signatures of trials.

    Attributes:
        bench, model: The recordings and the model.
        rows: Residuals and derivatives by the parameters of the model.
        table: Signatures of the trials.
        weights: 1/variance of each joint's residual, times the share of independent samples in white noise, (n,). The residuals of a
            model that lacks a slow effect have a much smaller effective sample size; `_judged` uses that of the residuals left.
        counts: Effective sample size of each joint, (n,).
        products: Normal equations of (derivatives, signatures, residual) by recording, weighted, (R, D, D).
    """

    bench: Bench
    model: CalibratedModel
    rows: Rows
    table: Table
    weights: np.ndarray
    counts: np.ndarray
    products: np.ndarray

    @classmethod
    def gather(cls, bench: Bench, model: CalibratedModel, every: Sequence[Trial]) -> "Evidence":
        """The evidence for trials at a model, weighted by its own residuals."""
        found = rows(bench.prepared, model, bench.identify)
        signatures = table(bench.prepared, model, every, bench.signatures)
        nothing = np.zeros(len(found.residual)), np.zeros(len(found.residual)), np.zeros((len(bench.prepared), 0, 0))
        return cls(bench, model, found, signatures, *nothing).under(found)

    def under(self, noise: Rows) -> "Evidence":
        """The same, weighted by the residuals of another model at the same rows."""
        counts, weights = independent(noise), STRIDE / WHITE / noise.deviation() ** 2
        size = self.size + int(self.table.start[-1]) + 1
        products = np.zeros((len(self.bench.prepared), size, size))
        for j, weight in enumerate(weights):
            used, stack = _stack(self.rows, self.table, j)
            for r in range(len(products)):
                part = stack[self.bench.edges[r] : self.bench.edges[r + 1]]
                products[r][np.ix_(used, used)] += weight * (part.T @ part)
        return replace(self, weights=weights, counts=np.maximum(counts, 1.0), products=products)

    @property
    def size(self) -> int:
        """Number of parameters of the model."""
        return self.rows.jacobian.shape[2]

    @cached_property
    def _total(self) -> np.ndarray:
        return self.products.sum(axis=0) + self._believed

    @cached_property
    def _believed(self) -> np.ndarray:
        """`Bench.believed` in the place of the inertial parameters, the last of the model's, in `products`."""
        result, known = np.zeros(self.products.shape[1:]), self.bench.believed(self.model.robot.inertial)
        at = np.append(np.arange(self.size - len(known) + 1, self.size), len(result) - 1)
        result[np.ix_(at, at)] = known * STRIDE / WHITE
        return result

    @cached_property
    def inverse(self) -> np.ndarray:
        """Pseudo-inverse of the normal matrix of the model's parameters."""
        return pseudo_inverse(self._total[: self.size, : self.size])

    @cached_property
    def _left(self) -> np.ndarray:
        """The normal equations after elimination of the model's parameters."""
        return self._total - self._total[:, : self.size] @ self.inverse @ self._total[: self.size]

    def candidates(self) -> list[Candidate]:
        """The candidates with the most evidence, best first: each effect at its joints, in all recordings and in its best groups."""
        total, inverse, left = self._total, self.inverse, self._left
        best: dict[tuple, tuple] = {}  # of each effect at its joints, everywhere and in some groups
        for k, trial in enumerate(self.table.trials):
            c = self._columns(k)
            options = [(None, left[np.ix_(c, c)], left[c, -1], np.diag(total)[c])]
            if trial.effect.scope != "everywhere" and len(self.bench.labels) > 1:
                options += self._scopes(c, total, inverse, _solve(*options[0][1:])[0])
            if trial.effect.scope == "some":
                del options[0]
            for scope, *quadratic in options:
                gain, coefficients, dimensions = self._possibly(k, scope, *quadratic)
                cost = 2 * dimensions + (0.0 if scope is None else scope_cost(len(self.bench.labels), len(scope)))
                kind = (trial.effect if trial.effect.black_box else trial.effect.name), trial.effect.joints
                key = (*kind, scope is None)
                if dimensions and gain - cost > best.get(key, (0.0,))[0]:
                    best[key] = (gain - cost, k, scope, coefficients, dimensions)
        found = sorted(best.values(), key=lambda one: -one[0])
        result = [self._judged(*one[1:]) for one in found[:FIRST]]
        return sorted(result, key=lambda r: -r.score)

    def pairs(self, parameters: int, count: int, joint: int | None = None) -> list[tuple[Candidate, Candidate]]:
        """The pairs of effects of all recordings, of fewer parameters than given, that explain most together, best first.

        Effects of one given joint are tried in every shape, those of the whole arm in the shape that is best alone.
        """
        left, raw, effects = self._left, np.diag(self._total), [trial.effect for trial in self.table.trials]

        def explained(*numbers: int) -> tuple[float, np.ndarray, int]:
            c = np.concatenate([self._columns(k) for k in numbers])
            return _solve(left[np.ix_(c, c)], left[c, -1], raw[c])

        shapes = [k for k, effect in enumerate(effects) if joint is None or effect.joints == (joint,)]
        if joint is None:
            ascending = sorted(shapes, key=lambda k: explained(k)[0])
            shapes = sorted({(effects[k].name, effects[k].joints): k for k in ascending}.values())  # the last stays
        found: dict[tuple[Effect, Effect], tuple[float, Candidate, Candidate]] = {}
        for pair in itertools.combinations(shapes, 2):
            one, other = (effects[k] for k in pair)
            if len(one.parameters) + len(other.parameters) < parameters and (one != other or one.placement == "many"):
                gain, coefficients, dimensions = explained(*pair)
                a, b = np.split(coefficients, [len(self._columns(pair[0]))])
                better = (one, other) not in found or gain - 2 * dimensions > found[one, other][0]
                if better and self._possible(pair[0], None, a) and self._possible(pair[1], None, b):
                    found[one, other] = gain - 2 * dimensions, self._bare(pair[0], a), self._bare(pair[1], b)
        return [(one, other) for _, one, other in sorted(found.values(), key=lambda f: -f[0])[:count]]

    def _bare(self, k: int, coefficients: np.ndarray, scope: tuple[str, ...] | None = None) -> Candidate:
        return Candidate(self.table.trials[k], k, scope, coefficients, 0.0, 0.0, len(coefficients), 0.0, 0.0)

    @property
    def tests(self) -> int:
        """Number of effects at their joints that compete."""
        return len({(t.effect.name, t.effect.joints) for t in self.table.trials})

    def _possible(self, k: int, scope, coefficients: np.ndarray) -> bool:
        trial = self.table.trials[k]
        return trial.effect.possible(trial.effect.combined(trial.points, coefficients), self.bench.least_payload(scope))

    def _possibly(self, k: int, scope, matrix: np.ndarray, right: np.ndarray, raw: np.ndarray) -> tuple[float, np.ndarray, int]:
        """Gain, coefficients and dimensions of a trial within the bounds of its effect; a gain of 0 where there is nothing.

        Coefficients out of bounds are made smaller or, one at a time, set to 0: the recordings may hardly determine one of them.
        """
        used, found = list(range(len(right))), (0.0, np.zeros(len(right)), 0)
        alone = len(self.table.trials[k].effect.amplitudes) == len(right)  # each coefficient is a parameter
        while used:
            gain, some, dimensions = _solve(matrix[np.ix_(used, used)], right[used], raw[used])
            coefficients = np.zeros(len(right))
            coefficients[used] = some
            for share in SHARES:
                worth = share * (2 - share) * gain
                if worth > found[0] and self._possible(k, scope, share * coefficients):
                    found = worth, share * coefficients, dimensions
                    break
            if found[0] >= gain or not alone or len(used) == 1:
                break
            parts = [[i for i in used if i != out] for out in used]
            used = max(parts, key=lambda part: _solve(matrix[np.ix_(part, part)], right[part], raw[part])[0])
        return found

    def _columns(self, k: int) -> np.ndarray:
        return self.size + np.arange(self.table.start[k], self.table.start[k + 1])

    def _scopes(self, c: np.ndarray, total: np.ndarray, inverse: np.ndarray, whole: float) -> list:
        """The best set of groups of each size, found by adding one group at a time, with its normal equations."""
        labels = self.bench.labels
        member = np.array([[g == label for g in self.bench.groups] for label in labels], float)  # (groups, R)
        own = np.einsum("gr,rab->gab", member, self.products[:, c][:, :, c])
        cross = np.einsum("gr,rab->gab", member, self.products[:, c][:, :, : self.size])
        right = np.einsum("gr,ra->ga", member, self.products[:, c, -1])
        base = inverse @ total[: self.size, -1]
        if _apart(own, cross, right, inverse, base) - whole < scope_cost(len(labels), 1):
            return []  # separate coefficients in each group explain no more
        chosen: list[int] = []
        result = []
        for _ in range(len(labels) - 1):
            options = []
            for g in (g for g in range(len(labels)) if g not in chosen):
                at = [*chosen, g]
                x = cross[at].sum(axis=0)
                matrix, target = own[at].sum(axis=0) - x @ inverse @ x.T, right[at].sum(axis=0) - x @ base
                quadratic = matrix, target, np.diag(own[at].sum(axis=0))
                options.append((_solve(*quadratic)[0], g, quadratic))
            _, g, quadratic = max(options, key=lambda option: option[0])
            chosen.append(g)
            result.append((tuple(labels[i] for i in sorted(chosen)), *quadratic))
        return result

    def _judged(self, k: int, scope, coefficients, dimensions: int) -> Candidate:
        """The candidate with its likelihood."""
        trial = self.table.trials[k]
        bare = replace(self._bare(k, coefficients, scope), dimensions=dimensions)
        left = replace(self.rows, residual=self.left_by(bare))
        after, before = (np.sum(x**2, axis=1) for x in (left.residual, self.left_by()))
        ratio = np.log(np.maximum(before, 1e-300) / np.maximum(after, 1e-300))
        shape = len(trial.effect.parameters) - len(trial.effect.amplitudes)
        penalty = chance(dimensions + shape, self.counts, self.tests)
        chosen = 0.0 if scope is None else scope_cost(len(self.bench.labels), len(scope))
        least = penalty if trial.effect.black_box else min(penalty, significant(dimensions + shape, self.tests))
        likelihood = float(independent(left) @ ratio)  # of the residuals left, since a missing effect is autocorrelated
        gains = {"likelihood": likelihood, "compared": float(self.counts @ ratio)}
        return replace(bare, penalty=penalty + chosen, least=least + chosen, **gains)

    def left_by(self, *candidates: Candidate) -> np.ndarray:
        """Residuals with these candidates at their coefficients and the model's parameters fitted beside them, (n, M)."""
        target, change = self._total[: self.size, -1], np.zeros_like(self.rows.residual)
        for c in candidates:
            cross = np.einsum(
                "r,rab->ab", self.bench.within(c.scope), self.products[:, : self.size][:, :, self._columns(c.number)]
            )
            target = target - cross @ c.coefficients
            change = change + self.signature(c.number, c.scope) @ c.coefficients
        return self.rows.residual - self.rows.jacobian @ (self.inverse @ target) - change

    def confirmed(self, candidate: Candidate) -> float:
        """Fall of the squared residual in leave-one-out cross-validation, relative to that of the fit to all; 1 for a true law.

        Each recording in turn is left out of the fit of the model's parameters and the candidate's coefficients; pieces of the
        recording if only one has the effect.
        """
        c, within = self._columns(candidate.number), self.bench.within(candidate.scope)
        used = np.concatenate([np.arange(self.size), c, [self.products.shape[1] - 1]])
        part = self.products[:, used][:, :, used].copy()
        for r, inside in enumerate(within):
            part[r, self.size : -1] *= inside
            part[r, :, self.size : -1] *= inside
        if within.sum() == 1 < len(within):
            only = int(np.argmax(within))
            part = np.concatenate([np.delete(part, only, axis=0), self._pieces(candidate, only)])
        total, out = part.sum(axis=0) + self._believed[np.ix_(used, used)], 0.0
        inside = _fall(total, total, self.size)
        for one in part:
            rest = total - one
            lost = np.append(
                np.diag(rest)[:-1] < UNIQUE * np.diag(total)[:-1], False
            )  # parameters that this recording alone determines
            rest[lost] = rest[:, lost] = 0.0
            out += _fall(rest, one, self.size)
        return out / max(inside, 1e-300)

    def robust_p(self, candidate: Candidate) -> float:
        """P-value of a score test that tolerates autocorrelated residuals of unequal variance: scores by block of time."""
        whole = self.signature(candidate.number, candidate.scope)
        cross = np.einsum("jka,j,jkb->ab", self.rows.jacobian, self.weights, whole)
        clean = whole - self.rows.jacobian @ (self.inverse @ cross)
        scores = np.einsum("jkm,jk,j->km", clean, self.left_by(candidate), self.weights)
        matrix = np.einsum("jka,j,jkb->ab", clean, self.weights, clean)
        blocks = self.bench.by_block(scores)
        gain = matrix @ candidate.coefficients
        statistic = float(gain @ Directions.of(blocks.T @ blocks).solve(gain))
        return float(chi2.sf(statistic, candidate.dimensions))

    def joint(self, candidate: Candidate) -> int:
        """The joint on which a candidate explains most."""
        change = self.signature(candidate.number, candidate.scope) @ candidate.coefficients
        return int(np.argmax(self.weights * np.sum(change**2, axis=1)))

    def _pieces(self, candidate: Candidate, r: int) -> np.ndarray:
        """Normal equations of (derivatives, signature of a candidate, residual) for pieces of one recording, (`PIECES`, …)."""
        rows = np.arange(self.bench.edges[r], self.bench.edges[r + 1])
        residual = self.rows.residual[:, rows, None]
        stack = np.concatenate([self.rows.jacobian[:, rows], self.signature(candidate.number, None)[:, rows], residual], axis=2)
        parts = np.array_split(stack, PIECES, axis=1)
        return np.array([np.einsum("j,jka,jkb->ab", self.weights, x, x, optimize=True) for x in parts])

    def signature(self, k: int, scope) -> np.ndarray:
        """Columns of a trial at all rows, (n, M, m)."""
        c, result = np.arange(self.table.start[k], self.table.start[k + 1]), []
        for values, used in zip(self.table.values, self.table.used, strict=True):
            columns, here = np.zeros((len(values), len(c))), np.isin(used, c)
            columns[:, used[here] - c[0]] = values[:, here]
            result.append(columns)
        whole = np.array(result)
        if scope is not None:
            whole *= np.repeat(self.bench.within(scope), np.diff(self.bench.edges))[:, None]
        return whole


def chance(parameters: int, counts: np.ndarray, tests: int) -> float:
    """Twice the log-likelihood that parameters gain by chance: Schwarz's criterion (BIC), and the maximum over so many tests."""
    return float(parameters * np.log(max(counts.sum(), 2.0)) + 2 * np.log(max(tests, 2)))


def significant(parameters: int, tests: int) -> float:
    """Twice the log-likelihood that parameters gain by chance with probability `ALARMS`, after Bonferroni's correction for all tests."""
    return float(chi2.isf(ALARMS / max(tests, 1), parameters))


def scope_cost(groups: int, size: int) -> float:
    """Penalty for the choice of so many of the groups: twice the logarithm of the number of choices."""
    choices = float(np.prod([(groups - i) / (i + 1) for i in range(size)]))
    return 2 * np.log(max(choices, 1.0) * groups)


def _fall(train: np.ndarray, test: np.ndarray, size: int) -> float:
    """Further fall of the squared residual on `test` with all columns instead of the first `size`, fitted on `train`."""
    falls = []
    for count in (size, len(train) - 1):
        theta = pseudo_inverse(train[:count, :count]) @ train[:count, -1]
        falls.append(float(2 * theta @ test[:count, -1] - theta @ test[:count, :count] @ theta))
    return falls[1] - falls[0]


def _stack(found: Rows, signatures: Table, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns of one joint that are not 0, and their numbers."""
    size, total = found.jacobian.shape[2], int(signatures.start[-1])
    live = np.flatnonzero(np.any(found.jacobian[j] != 0, axis=0))
    used = np.concatenate([live, size + signatures.used[j], [size + total]])
    return used, np.concatenate([found.jacobian[j][:, live], signatures.values[j], found.residual[j][:, None]], axis=1)


def _apart(own: np.ndarray, cross: np.ndarray, right: np.ndarray, inverse: np.ndarray, base: np.ndarray) -> float:
    """Gain of a trial with separate coefficients in each group."""
    groups, m = right.shape
    flat = cross.reshape(groups * m, -1)
    matrix = -flat @ inverse @ flat.T
    for g in range(groups):
        at = slice(g * m, (g + 1) * m)
        matrix[at, at] += own[g]
    return _solve(matrix, right.ravel() - flat @ base, np.einsum("gaa->ga", own).ravel())[0]


def _solve(matrix: np.ndarray, right: np.ndarray, raw: np.ndarray) -> tuple[float, np.ndarray, int]:
    """Gain, coefficients and dimensions of a least-squares problem, without directions collinear with the model's parameters."""
    live = raw > 1e-12 * max(raw.max(initial=0.0), 1e-300)
    coefficients = np.zeros(len(right))
    if not live.any() or raw.max() <= 0:
        return 0.0, coefficients, 0
    if live.sum() == 1:  # most trials: without an eigenvalue problem
        own = matrix[live][0, live]
        if own[0] < UNIQUE * raw[live][0]:
            return 0.0, coefficients, 0
        coefficients[live] = right[live] / own
        return float(right @ coefficients), coefficients, 1
    left = Directions.of(matrix[np.ix_(live, live)], UNIQUE_TOGETHER, np.sqrt(raw[live]))
    coefficients[live] = left.solve(right[live])
    return float(right @ coefficients), coefficients, int(left.determined.sum())

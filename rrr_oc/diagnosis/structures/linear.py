"""A fitted model as a linear problem, and its products by block: the evidence of any structure near it is linear algebra on few numbers.

About a fit, the residual without the effects beyond the plain model is linear in the changes of the plain parameters, in how much of
each present effect there is, and in the coefficients of trials of others. For one noise of each joint, all products of these columns
are summed over rows once, block by block (a block is a recording). What follows from any of the blocks, for any structure and
any hyperparameters, is a sum of such products.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from rrr_oc.calibration.calibrated_model import Estimate, Term
from rrr_oc.calibration.estimator.evidence import (
    Gram,
    Hyperparameters,
    LinearSolution,
    ParameterPrior,
    Spectrum,
    estimated,
    extended,
    joined,
    orthogonal,
)
from rrr_oc.calibration.estimator.fitting import Fitted
from rrr_oc.calibration.link_findings import FAR
from rrr_oc.diagnosis.fitting import Fitter
from rrr_oc.diagnosis.knobs import EXCESS
from rrr_oc.diagnosis.signatures import Signatures
from rrr_oc.effects import Effect, Trial

COLUMNS = 3000  # of tables whose products a level keeps; more take memory
AS_FITTED = 1e-9  # variance of the share of an effect that is there, about 1
Blocks = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Candidate:
    """One way to extend a model.

    Attributes:
        trial: With the best shape.
        scope: Groups that have the effect; None for all.
        coefficients: (m,).
        gain: Gain in the logarithm of the posterior probability, over all shapes.
        excess: Width of the prior of the coefficients, over their typical scales.
        log_prior: The part of the gain that is due to the prior odds and to other shapes, without that of this width.
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


@dataclass(frozen=True, eq=False)
class Addition:
    """What an effect adds to the linear problem.

    Attributes:
        effect: The effect.
        scope: Groups that have it; None for all.
        columns: (n, M, m) [Nm].
        mean, precision, flat, lower, upper: Of the prior of their coefficients, see `evidence.ParameterPrior`, (m,) each.
        log_prior: Logarithm of the prior odds of the effect, of its shape, and of the width of the prior of its coefficients.
        source: The term of the fitted model, or the candidate that it is.
    """

    effect: Effect
    scope: tuple[str, ...] | None
    columns: np.ndarray
    mean: np.ndarray
    precision: np.ndarray
    flat: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    log_prior: float
    source: Term | Candidate

    @property
    def size(self) -> int:
        """Number of columns."""
        return self.columns.shape[2]

    @property
    def name(self) -> tuple[Effect, tuple[str, ...]]:
        """What a structure is compared by: effect without its range, and groups."""
        return self.effect.without_range(), self.scope or ()


Structure = tuple[Addition, ...]
Links = Literal["free", "as fitted", "declared"]  # how far links may be off
Key = frozenset[tuple[Any, ...]]


def numbered(names: Iterable[tuple[Effect, tuple[str, ...]]]) -> list[tuple[Any, ...]]:
    """The names of effects, of which further ones of a name are numbered."""
    seen: Counter[Any] = Counter()
    result = []
    for name in names:
        seen[name] += 1
        result.append(name if seen[name] == 1 else (*name, seen[name]))
    return result


def key_of(names: Iterable[tuple[Effect, tuple[str, ...]]]) -> Key:
    """By what structures are compared."""
    return frozenset(numbered(names))


@dataclass(frozen=True, eq=False)
class Linear:
    """A fit as a linear problem.

    Attributes:
        fitter, fitted: The data and the fit.
        columns: Derivatives by the plain parameters, links' errors and widths, then mixtures of the ways in which friction changes
            sign, (n, M, p).
        prior: Of these.
        residual: Of the fitted model without the effects beyond the plain ones, (n, M).
        own: These effects.
    """

    fitter: Fitter
    fitted: Fitted
    columns: np.ndarray
    prior: ParameterPrior
    residual: np.ndarray
    own: Structure

    @classmethod
    def of(cls, fitter: Fitter, fitted: Fitted) -> "Linear":
        """The linear problem about a fit."""
        data, model, links = fitter.data, fitted.model, fitted.links
        (whole_residual, columns), whole = fitter.linearised(model, links), fitter.prior(model, links)
        first, last = model.offsets[fitted.base], model.offsets[-1]
        inside = np.r_[np.arange(first), np.arange(last, len(whole.mean))]
        residual, own = whole_residual.copy(), []
        for i, term in enumerate(fitted.extra):
            mine = slice(*model.offsets[fitted.base + i : fitted.base + i + 2])
            if term.effect.linear and term.effect.side == "drive":  # all that the effect explains
                change = columns[:, :, mine] @ term.values
            else:
                less = replace(model, terms=tuple(t for t in model.terms if t is not term))
                change = data.residual(less) - whole_residual
            residual += change
            bounds = whole.lower[mine], whole.upper[mine]
            own.append(_of_term(fitter, fitted, i, np.concatenate([change[:, :, None], columns[:, :, mine]], axis=2), bounds))
        signs = fitter.mixtures(model)
        base = joined(whole.some(inside), np.ones(signs.shape[2]))
        return cls(fitter, fitted, np.concatenate([columns[:, :, inside], signs], axis=2), base, residual, tuple(own))

    def prior_with(self, structure: Structure, links: Links = "free") -> ParameterPrior:
        """The prior of all coefficients; links are free, no further off than in the fit or than is worth telling, or never so far."""
        prior = self.prior
        if links != "free" and np.any(prior.links):
            own, here = np.flatnonzero(prior.links), self.fitted.links
            most = np.maximum(np.abs(here), FAR) if links == "as fitted" else np.full(len(here), FAR)
            lower, upper = prior.lower.copy(), prior.upper.copy()
            lower[own], upper[own] = -most - here, most - here
            prior = replace(prior, lower=lower, upper=upper)
        for a in structure:
            prior = extended(prior, a.mean, a.precision, a.flat, a.lower, a.upper)
        return prior

    def left(self, structure: Structure, step: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """The residual (n, rows) of a structure with these coefficients (p,), the discrepancy included."""
        some = slice(None) if len(rows) == self.residual.shape[1] else rows  # a slice copies nothing
        result, at = self.residual[:, some].copy(), 0
        for columns in (self.columns, *(a.columns for a in structure)):
            result -= columns[:, some] @ step[at : at + columns.shape[2]]
            at += columns.shape[2]
        return result

    def candidate(self, table: Signatures, c: Candidate) -> Addition:
        """A candidate as an addition."""
        columns = table.of(next(k for k, t in enumerate(table.trials) if t is c.trial))
        if c.scope is not None:
            data = self.fitter.data
            columns *= np.isin(np.array(data.labels)[data.label], c.scope)[None, :, None]
        scales, m = c.excess * self.fitter.scales(c.trial), columns.shape[2]
        log_prior = c.log_prior + float(np.log(EXCESS[c.excess]))
        none, free = np.zeros(m), np.full(m, np.inf)
        return Addition(c.trial.effect, c.scope, columns, none, scales**-2.0, none, -free, free, log_prior, c)


def _of_term(fitter: Fitter, fitted: Fitted, i: int, columns: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]) -> Addition:
    """An effect of a fit, with the columns of the effect as a whole and of its parameters."""
    term = fitted.extra[i]
    wide, log_excess = fitter.excess(term)
    mean, precision, flat = [1.0], [1 / AS_FITTED], [0.0]
    for span, value in zip(fitter.spans(term.effect), term.values, strict=True):
        m, p, f = span.of_change(value, wide)
        mean.append(m)
        precision.append(p)
        flat.append(f)
    log_prior = fitter.log_prior(term.effect, term.groups or None) + log_excess
    lower, upper = np.append(-np.inf, bounds[0]), np.append(np.inf, bounds[1])
    arrays = np.array(mean), np.array(precision), np.array(flat), lower, upper
    return Addition(term.effect, term.groups or None, columns, *arrays, log_prior, term)


@dataclass(frozen=True, eq=False)
class TableProducts:
    """Products of a table's columns with those of a level, of one joint.

    Attributes:
        used: Their numbers, (T,).
        left: With the level's columns, features and residual, by block, (B, L, T).
        own: For each number of columns that trials have: which of these trials have columns here, by their place among them, (K,);
            where their columns begin, (K,); and their products, by block, (B, K, m, m).
    """

    used: np.ndarray
    left: np.ndarray
    own: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class WhiteAddition:
    """An addition under a level's noise, by the joints whose torque it changes: whitened (M, m), also back, and products (B, L, m)."""

    white: dict[int, np.ndarray]
    back: dict[int, np.ndarray]
    left: dict[int, np.ndarray]


@dataclass(frozen=True, eq=False)
class Sums:
    """Products of a joint's columns, features and residual over some blocks.

    Attributes:
        spectrum: Of its discrepancy.
        products: (L, L).
        turn: From features to orthogonal ones, (F, F').
        turned: Products of the orthogonal features, (F', L).
    """

    spectrum: Spectrum
    products: np.ndarray
    turn: np.ndarray
    turned: np.ndarray


class Level:
    """All products of a linear problem under one noise of each joint.

    Attributes:
        posterior: From which the noise is.
        edges: First row of each block, and the number of rows, (B + 1,); those of the recordings by default. Tables are for these.
        products: Of each joint those of [columns, features, residual], whitened, by block, (B, L, L).
    """

    def __init__(self, linear: Linear, edges: np.ndarray | None = None) -> None:
        self.linear, self.posterior = linear, linear.fitted.posterior
        data = linear.fitter.data
        self.edges, self.n, self.p = data.edges if edges is None else edges, data.n, linear.columns.shape[2]
        white = [one.white @ self.columns(j) for j, one in enumerate(self.posterior.joints)]
        self.products = [np.array([x.T @ x for x in self.split(w)]) for w in white]
        # W does not cross the ends of recordings; where blocks are shorter, products by block need both sides whitened
        self._white = None if edges is None else white
        self._parts: dict[Addition, WhiteAddition] = {}
        self._pairs: dict[tuple[Addition, Addition, int], np.ndarray] = {}
        self._tables: dict[Signatures, list[TableProducts]] = {}
        self._sums: dict[Blocks, list[Sums]] = {}
        self._last: tuple[tuple[Structure, Blocks], list[Gram]] | None = None

    def columns(self, j: int) -> np.ndarray:
        """[columns, features, residual] of a joint, (M, L)."""
        return np.column_stack([self.linear.columns[j], self.linear.fitter.data.features[j], self.linear.residual[j]])

    def split(self, x: np.ndarray) -> list[np.ndarray]:
        """Rows (M, …) by block."""
        return np.split(x, self.edges[1:-1])

    @property
    def whole(self) -> Blocks:
        """All blocks."""
        return tuple(range(len(self.edges) - 1))

    def part(self, a: Addition) -> WhiteAddition:
        """An addition under this noise."""
        if a not in self._parts:
            noise = [one.white for one in self.posterior.joints]
            white = {j: noise[j] @ x for j, x in enumerate(a.columns) if x.any()}
            back = {j: noise[j].T @ x for j, x in white.items()}
            left = {
                j: self._blockwise(self.columns(j), back[j]) if self._white is None else self._blockwise(self._white[j], x)
                for j, x in white.items()
            }
            self._parts[a] = WhiteAddition(white, back, left)
        return self._parts[a]

    def pair(self, a: Addition, b: Addition, j: int) -> np.ndarray:
        """Products of two additions at a joint, (B, m, m)."""
        if (b, a, j) in self._pairs:
            return self._pairs[b, a, j].transpose(0, 2, 1)
        if (a, b, j) not in self._pairs:
            x, y = self.part(a).white[j], self.part(b).white[j]
            self._pairs[a, b, j] = self._blockwise(x, y)
        return self._pairs[a, b, j]

    def sums(self, blocks: Blocks) -> list[Sums]:
        """The products over some blocks, by joint."""
        if blocks not in self._sums:
            result = []
            rows = np.concatenate([np.arange(self.edges[b], self.edges[b + 1]) for b in blocks])
            for j, one in enumerate(self.posterior.joints):
                products = self.products[j][list(blocks)].sum(axis=0)
                features = slice(self.p, len(products) - 1)
                values, turn = orthogonal(products[features, features])
                count = int(self.linear.fitter.data.counted[j][rows].sum())
                # the determinant of W over some blocks is the same for all structures
                spectrum = Spectrum(values, one.log_det, count)
                result.append(Sums(spectrum, products, turn, turn.T @ products[features]))
            self._sums[blocks] = result
        return self._sums[blocks]

    def grams(self, structure: Structure, blocks: Blocks) -> list[Gram]:
        """The products of a structure's columns over some blocks, by joint; those of the last structure are kept."""
        if self._last is None or self._last[0] != (structure, blocks):
            self._last = (structure, blocks), self._grams(structure, blocks)
        return self._last[1]

    def _grams(self, structure: Structure, blocks: Blocks) -> list[Gram]:
        p, some, grams = self.p, list(blocks), []
        parts, ends = [self.part(a) for a in structure], self.p + np.cumsum([0, *(a.size for a in structure)])
        for j, one in enumerate(self.sums(blocks)):
            here = [i for i, part in enumerate(parts) if j in part.left]
            at = np.concatenate([np.arange(p), *(np.arange(ends[i], ends[i + 1]) for i in here)])
            xx, xy, tx = one.products[:p, :p], one.products[:p, -1], one.turned[:, :p]
            if here:
                left = np.hstack([parts[i].left[j][some].sum(axis=0) for i in here])  # (L, m)
                every = [[self.pair(structure[i], structure[k], j)[some].sum(axis=0) for k in here if k <= i] for i in here]
                pairs = np.block(
                    [[every[i][k] if k <= i else every[k][i].T for k in range(len(here))] for i in range(len(here))]
                )
                xx = np.block([[xx, left[:p]], [left[:p].T, pairs]])
                xy, tx = np.append(xy, left[-1]), np.hstack([tx, one.turn.T @ left[p:-1]])
            live = np.flatnonzero(np.diag(xx) > 0)
            products = xx[np.ix_(live, live)], xy[live], float(one.products[-1, -1]), tx[:, live], one.turned[:, -1]
            grams.append(Gram(*products, at[live]))
        return grams

    def solved(
        self, structure: Structure, blocks: Blocks, hyper: Hyperparameters, fixed: bool = False, links: Links = "free"
    ) -> LinearSolution:
        """The posterior of a structure from some blocks; its hyperparameters are estimated, from `hyper` on, or these are `fixed`.

        Args:
            links: How far they may be off, see `Linear.prior_with`.
        """
        spectra = [one.spectrum for one in self.sums(blocks)]
        return estimated(self.grams(structure, blocks), spectra, hyper, self.linear.prior_with(structure, links), fixed)

    def table(self, table: Signatures) -> list[TableProducts]:
        """The products of a table, by joint; those of the first tables are kept, and of the newest."""
        if table not in self._tables:
            while len(self._tables) > 1 and sum(int(t.start[-1]) for t in (table, *self._tables)) > COLUMNS:
                self._tables.popitem()
            self._tables[table] = [self._of_table(table, j) for j in range(self.n)]
        return self._tables[table]

    def forget(self, table: Signatures) -> None:
        """Keep the products of a table no longer."""
        self._tables.pop(table, None)

    def _of_table(self, table: Signatures, j: int) -> TableProducts:
        values, used, sizes = table.values[j], table.used[j], np.diff(table.start)
        owner = np.searchsorted(table.start, used, side="right") - 1
        noise = self.posterior.joints[j].white
        left = self._blockwise(noise.T @ (noise @ self.columns(j)), values)
        white = self.split(noise @ values)
        own = {}
        for m in np.unique(sizes).tolist():
            trials = np.flatnonzero(sizes == m)
            where = np.flatnonzero(np.isin(trials, owner))
            first = np.searchsorted(used, table.start[trials[where]])
            if m == 1:
                products = np.array([np.einsum("ij,ij->j", w[:, first], w[:, first])[:, None, None] for w in white])
            else:
                at = (first[:, None] + np.arange(m)).ravel()
                every = [w[:, at].T.reshape(len(where), m, len(w)) for w in white]
                products = np.array([x @ x.transpose(0, 2, 1) for x in every])
            own[m] = where, first, products
        return TableProducts(used, left, own)

    def across(self, a: Addition, table: Signatures, j: int) -> np.ndarray:
        """Products of an addition with a table's columns at a joint, by block, (B, m, T)."""
        return self._blockwise(self.part(a).back[j], table.values[j])

    def _blockwise(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Products of columns (M, a) and (M, b), by block, (B, a, b)."""
        return np.array([u.T @ v for u, v in zip(self.split(x), self.split(y), strict=True)])

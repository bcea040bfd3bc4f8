"""What the posterior of a fit says of parameters: standard errors, intervals, correlations, and what the recordings leave open."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import t as student

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.estimator.data import order_of
from rrr_oc.calibration.estimator.evidence import root_of_covariance
from rrr_oc.calibration.estimator.fitting import Fitted
from rrr_oc.calibration.estimator.knobs import CLOCK_ERROR
from rrr_oc.calibration.estimator.left_out import std_by_blocks
from rrr_oc.calibration.parameter_vector import bounds, labels, with_estimates
from rrr_oc.calibration.samples import Prepared
from rrr_oc.effects import Delay
from rrr_oc.numerics import rank
from rrr_oc.numerics.rank import condition, lengths
from rrr_oc.robot.inertial_parameters import base_parameters, pseudo_inertia
from rrr_oc.storage import number

ROUNDING = 1e-14  # of a scaled precision, whose eigenvalues are not less
LOOSE = 100.0  # times; ten times as much, nothing changes
OPEN = 0.5  # share of a wide prior's variance that is left, from which the recordings do not determine a plain parameter
CORRELATED = 0.9  # from which a pair of parameters is named


def covariance(fitted: Fitted, bent: bool = True, loose: bool = False) -> np.ndarray:
    """Posterior covariance of the parameters: of the terms, the links' errors and the widths, (p, p).

    Args:
        bent: Whether it has that by which a discrepancy bends them.
        loose: Whether errors of links are `LOOSE` times as far off as they are believed to be, so that recordings alone tell of them.
    """
    post = fitted.posterior
    drawn = np.where(post.prior.links > 0, post.prior.precision * (1 - LOOSE**-2), 0.0) if loose else 0.0 * post.step
    matrix = post.matrix - np.diag(drawn)
    scale = np.outer(lengths(matrix), lengths(matrix))
    values, vectors = np.linalg.eigh(matrix / scale)
    found = (vectors / np.maximum(values, ROUNDING)) @ vectors.T / scale
    if not bent or fitted.bent is None:
        return found
    moved = found @ (post.matrix @ fitted.bent) if loose else fitted.bent
    return found + moved @ moved.T


def half_width(count: float) -> float:
    """Half of a 95 % interval in standard errors, where noise is known from so many rows.

    How strong noise is at frequency 0 is an estimate from an autoregression of order k on M rows: its relative variance is 4 k / M (Berk
    1974), as that of a variance with M / (2 k) degrees of freedom.
    """
    return float(student.ppf(0.975, max(count / (2 * max(order_of(count), 1)), 1.0)))


def described(fitted: Fitted) -> CalibratedModel:
    """The model with standard errors and 95 % intervals from the posterior, none where the recordings leave a plain parameter open."""
    model, counts = fitted.model, np.array([one.count for one in fitted.posterior.joints])
    std = np.sqrt(np.diag(covariance(fitted)))[: len(model.values)]
    half = [half_width(counts[list(t.effect.joints) or slice(None)].min()) for t in model.terms for _ in t.estimates]
    by_blocks, number = fitted.by_blocks or std_by_blocks(fitted.posterior)
    by_blocks, changes = by_blocks[: len(std)], spread(fitted)
    wide = np.maximum(np.array(half) * std, student.ppf(0.975, number - 1) * by_blocks)
    larger = np.maximum(std, by_blocks)
    changes[: len(std)] *= (larger / std)[:, None]
    return replace(with_intervals(model, larger, wide, ~undetermined(fitted)), spread=changes)


def spread(fitted: Fitted) -> np.ndarray:
    """`CalibratedModel.spread` of a fit: a root of the posterior covariance, of links as their errors move them, (p + 10 n, r)."""
    terms, size, k = fitted.model.terms, len(fitted.model.values), len(fitted.links)
    root = root_of_covariance(fitted.posterior.matrix)
    if fitted.bent is not None:
        root = np.asarray(np.linalg.qr(np.hstack([root, fitted.bent]).T, mode="r")).T
    signs = np.concatenate([np.ones(0), *(np.where(canonical(t).values == -t.values, -1.0, 1.0) for t in terms)])
    links = fitted.posterior.data.links.at(fitted.links)[1] @ root[size : size + k]
    return np.concatenate([signs[:, None] * root[:size], links])


def with_intervals(model: CalibratedModel, std: np.ndarray, half: np.ndarray, known: np.ndarray) -> CalibratedModel:
    """A model with standard errors and half widths of its intervals, which are cut at bounds, where parameters are known, (p,) each."""
    values, (lower, upper) = model.values, bounds(model.terms)
    held, (low, high) = (values <= lower) | (values >= upper), np.clip([values - half, values + half], lower, upper)
    estimates = [
        Estimate(float(v), float(s), (float(a), float(b)), bool(h)) if k else Estimate(float(v), at_bound=bool(h))
        for v, s, a, b, h, k in zip(values, std, low, high, held, known, strict=True)
    ]
    return replace(model, terms=tuple(canonical(t) for t in with_estimates(model.terms, estimates)))


def undetermined(fitted: Fitted) -> np.ndarray:
    """Which parameters of the terms the recordings leave open, (p,).

    Those of the plain terms of which hardly more is known than before; and those that are told from unknown links by their prior alone.
    """
    post, size = fitted.posterior, len(fitted.model.values)
    variance, plain = np.diag(covariance(fitted, bent=False)), fitted.model.offsets[fitted.base]
    delays = [isinstance(t.effect, Delay) for t in fitted.model.terms for _ in t.estimates]
    before = np.where(delays, CLOCK_ERROR**-2, post.prior.precision[:size])  # of a delay before it was held
    left = (variance[:size] * before > OPEN) & (np.arange(size) < plain)
    return left if post.data.free else left | rank.undetermined(post.likelihood)[:size]


def canonical(term: Term) -> Term:
    """The term with parameters in their usual range, and intervals of what has no sign cut at 0."""
    named = term.effect.canonical(term.named)
    estimates = []
    for p, e in zip(term.effect.parameters, term.estimates, strict=True):
        value = float(named[p.name])
        shift = value - e.value
        interval = None if e.interval is None else (e.interval[0] + shift, e.interval[1] + shift)
        if p.name in term.effect.amplitudes and value == -e.value and e.interval is not None:
            interval = -e.interval[1], -e.interval[0]
        if interval is not None and value > 0 and term.effect.canonical({**named, p.name: -value})[p.name] == value:
            interval = max(interval[0], 0.0), interval[1]
        estimates.append(replace(e, value=value, interval=interval))
    return replace(term, estimates=tuple(estimates))


def fit_report(fitted: Fitted, prepared: Sequence[Prepared]) -> dict[str, Any]:
    """What `CalibratedModel.report` says of a fit to recordings: conditioning, correlations, bounds, rows and links."""
    model, names, size = fitted.model, labels(fitted.model), len(fitted.model.values)
    whole, left, (lower, upper) = covariance(fitted), undetermined(fitted), bounds(fitted.model.terms)
    std = np.sqrt(np.diag(whole)[:size])
    correlation = whole[:size, :size] / np.outer(std, std)
    known = np.flatnonzero(~left)
    values, counted = model.values, np.concatenate([p.counted for p in prepared], axis=1)
    report = {
        "condition": number(condition(np.linalg.inv(whole[np.ix_(known, known)]))) if len(known) else None,
        "correlated": [
            {"parameters": [names[i], names[j]], "correlation": float(correlation[i, j])}
            for i in known
            for j in known[known < i]
            if abs(correlation[i, j]) > CORRELATED
        ],
        "correlation": {"parameters": names, "matrix": correlation.tolist()},
        "at_bound": [name for name, v, a, b in zip(names, values, lower, upper, strict=True) if v <= a or v >= b],
        "undetermined": [name for name, k in zip(names, left, strict=True) if k],
        "rows": int(counted.shape[1]),
        "resting_share": dict(zip(model.joints, (1 - counted.mean(axis=1)).tolist(), strict=True)),
        "spikes": dict(zip(model.joints, np.sum([p.spikes for p in prepared], axis=0).tolist(), strict=True)),
    }
    return report | (_of_links(fitted, whole) if model.inertial == "identify" else {})


def _of_links(fitted: Fitted, whole: np.ndarray) -> dict[str, Any]:
    """Base parameters with intervals, and the least eigenvalue of the pseudo-inertias."""
    size, inertial = len(fitted.model.values), fitted.model.robot.inertial
    base, own = base_parameters(fitted.model.robot), slice(size, size + len(fitted.links))
    slopes = base.projection @ fitted.posterior.data.links.at(fitted.links)[1]
    std = np.sqrt(np.einsum("ik,kl,il->i", slopes, whole[own, own], slopes))
    half = half_width(min(one.count for one in fitted.posterior.joints)) * std
    values = base.projection @ inertial.T.ravel()
    return {
        "base_parameters": [
            {"name": name, "unit": unit, "value": float(v), "std": float(s), "interval": [float(v - h), float(v + h)]}
            for name, unit, v, s, h in zip(base.names, base.units, values, std, half, strict=True)
        ],
        "smallest_pseudo_inertia": float(min(np.linalg.eigvalsh(pseudo_inertia(x))[0] for x in inertial.T)),
    }

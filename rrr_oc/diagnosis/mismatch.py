"""Location of the mismatch: on which joints, in which recordings and over which range of a variable the plain model fails."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.stats import f as fisher

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.estimator.data import EVERY, Data
from rrr_oc.calibration.estimator.fitting import Fitted
from rrr_oc.calibration.samples import STRIDE, noise, residuals
from rrr_oc.diagnosis.knobs import FAR
from rrr_oc.diagnosis.result import Finding
from rrr_oc.storage import number

LEAST_GROWTH = 0.005  # relative growth of the squared residual without effects that counts as a mismatch; doubled: fewer
COUPLED = 0.1  # the same for a joint that only effects of other joints act on; doubled, fewer joints are marked
BINS = 12  # of a variable for the range with the largest error; more bins give narrower ranges
PERSISTS = 1.0  # [s] after which a residual that wanders is alike; longer: only slower ones are said to wander
ALIKE = 0.5  # correlation of a residual that wanders by then; higher: less is said to wander
ROWS = 3  # of 0.08 s each, of whose mean what wanders is made; more: less of a random walk
NOTABLE = 1.25  # ratio of mean squares, without over with the effects, from which a recording is named; doubled: fewer
MOST, NARROW = 0.5, 0.05  # least share of the error in a range, and least excess over its share of time; doubled: fewer ranges
UNITS = {"q": "rad", "dq": "rad/s", "ddq": "rad/s²", "load_torque": "Nm", "time": "s", "payload": "kg", "spring_torque": "Nm"}


def mismatch(
    bench: Data,
    plain: Fitted,
    fitted: Fitted,
    findings: Sequence[Finding],
    left_over: np.ndarray,
    nrmse: tuple[np.ndarray, np.ndarray],
) -> tuple[dict[str, Any], ...]:
    """For each joint whether, where and in which recordings the plain model's error exceeds that of the final model.

    Args:
        left_over: Residual of `fitted` over noise, (n,); above `FAR` a joint has a mismatch whatever was found.
        nrmse: Of the plain model on the recordings calibrated on and on held-out ones, (n,) each.
    """
    result, joints = [], plain.model.joints
    squares = [np.maximum(np.sum(f.residual**2, axis=1), 1e-300) for f in (plain, fitted)]
    growth = np.maximum(squares[0] / squares[1] - 1, 0.0)
    variables = signals_at_rows(bench, plain.model)
    for j, joint in enumerate(joints):
        own = [f for f in findings if not f.term.effect.joints or j in f.term.effect.joints]
        p = min((f.p_value for f in own), default=1.0)
        significant = bool(own and growth[j] > LEAST_GROWTH)
        if not significant and findings and growth[j] > COUPLED:  # an effect of another joint acts here too
            significant, p = True, min(f.p_value for f in findings)
        alone = left_over[j] > FAR and not significant
        if alone:
            count = max(float(bench.counted[j].sum()), 1.0)
            significant, p = True, float(fisher.sf(left_over[j] ** 2, count, count))
        moving = bench.counted[j]
        error = (plain.residual[j] ** 2) * moving
        left = np.array([float(np.mean(e)) for e in np.split(error, bench.edges[1:-1])])
        floor = float(np.mean((fitted.residual[j] ** 2) * moving))
        files = [p.recording.file for p, e in zip(bench.prepared, left, strict=True) if e > NOTABLE * floor or alone]
        result.append(
            {
                "joint": joint,
                "significant": significant,
                "p_value": p,
                "nrmse": {"calibration": number(nrmse[0][j]), "held_out": number(nrmse[1][j])},
                "where": _where(error, moving, j, joint, variables) if significant else [],
                "recordings": list(dict.fromkeys(files)) if significant else [],
            }
        )
    return tuple(result)


def idle(bench: Data, model: CalibratedModel) -> tuple[tuple[int, float, float], ...]:
    """Joints that never move enough to tell anything, with the mean torque that the model leaves there and its spread [Nm].

    Dry friction may hold any part of it, so that no recording of a joint at rest says what it is.
    """
    still = np.flatnonzero(~bench.counted.any(axis=1))
    if not len(still):
        return ()
    left = np.concatenate([residuals(p, model)[still] for p in bench.prepared], axis=1)
    return tuple((int(j), float(np.mean(x)), float(np.std(x))) for j, x in zip(still, left, strict=True))


def left_over(bench: Data, fitted: Fitted, noisy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rms of each joint's filtered residual, less what of it wanders, over that of noise; and rms of what wanders, 0 where that is not
    `FAR` above noise [Nm]; (n,) each.

    Args:
        noisy: Standard deviation of filtered noise, (n,) [Nm].
    """
    slow = wander(bench, fitted)
    size = _rms(bench, slow)
    return _rms(bench, fitted.residual - slow) / noisy, np.where(size > FAR * noisy, size, 0.0)


def _rms(bench: Data, x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sum((x * bench.counted) ** 2, axis=1) / np.maximum(bench.counted.sum(axis=1), 1))


def wander(bench: Data, fitted: Fitted) -> np.ndarray:
    """What of each joint's residual changes over seconds whatever the arm does, as the zero of a torque sensor, (n, M) [Nm]; 0 of a joint
    whose residual is not alike after `PERSISTS`.

    It is a mean over `ROWS` rows. What depends on the motion turns with it, and is not alike by then.
    """
    result, lag = np.zeros_like(fitted.residual), round(PERSISTS / STRIDE / EVERY)
    for j, row in enumerate(fitted.residual * bench.counted):
        parts = np.split(row, bench.edges[1:-1])
        products = sum(float(part[lag:] @ part[:-lag]) * len(part) / (len(part) - lag) for part in parts if len(part) > 2 * lag)
        if products > ALIKE * float(row @ row):
            result[j] = np.concatenate([uniform_filter1d(part, ROWS, mode="nearest") if len(part) else part for part in parts])
    return result


def unexplained(left: np.ndarray, noisy: np.ndarray) -> np.ndarray:
    """Rms of what `left_over` has of each joint's torque beyond noise, 0 where it is not `FAR` above that, (n,) [Nm]."""
    return np.where(left > FAR, np.sqrt(np.maximum(left**2 - 1, 0)), 0.0) * noisy


def filtered_noise(bench: Data, model: CalibratedModel) -> np.ndarray:
    """Standard deviation of the noise of each joint's samples, filtered as the rows of the fit are, (n,) [Nm]."""
    gains = [np.asarray(p.matrix.multiply(p.matrix).sum(axis=1)).ravel() for p in bench.prepared]
    return np.maximum(noise(bench.prepared, model) * np.sqrt(np.mean(np.concatenate(gains))), 1e-9)


def signals_at_rows(bench: Data, model: CalibratedModel) -> dict[str, tuple[np.ndarray, str]]:
    """Signals that an error may depend on, filtered, at the rows of the fit: (n, M) by name, with units."""
    parts, bare = [], replace(model, terms=())
    for p in bench.prepared:
        r = p.recording
        load = model.torques(r)[1]
        pull = bare.torques(replace(r, springs=()))[1] - bare.torques(r)[1] if r.springs else np.zeros_like(load)
        clock, payload = (np.tile(x, (bench.n, 1)) for x in (r.clock, r.payload))
        parts.append([p.filtered(x) for x in (r.q, r.dq, r.ddq, load, clock, payload, pull)])
    whole = (np.concatenate(found, axis=1)[:, bench.at] for found in zip(*parts, strict=True))
    return {name: (values, unit) for (name, unit), values in zip(UNITS.items(), whole, strict=True)}


def _where(
    error: np.ndarray, moving: np.ndarray, j: int, joint: str, variables: Mapping[str, tuple[np.ndarray, str]]
) -> list[dict[str, Any]]:
    """For up to three variables the range that holds at least half of the squared error in the smallest share of time."""
    found = []
    total = float(error.sum()) or 1.0
    for name, (values, unit) in variables.items():
        x = values[j][moving]
        if not len(x) or np.ptp(x) <= 1e-9:
            continue
        edges = np.unique(np.quantile(x, np.linspace(0, 1, BINS + 1)))
        bins = np.clip(np.searchsorted(edges, values[j], side="right") - 1, 0, len(edges) - 2)
        power = np.bincount(bins, weights=error, minlength=len(edges) - 1) / total
        time = np.bincount(bins, weights=moving, minlength=len(edges) - 1) / max(moving.sum(), 1)
        spans = itertools.combinations(range(len(power) + 1), 2)
        shares = [(float(power[a:b].sum()), float(time[a:b].sum()), a, b) for a, b in spans]
        enough = [s for s in shares if s[0] >= MOST and s[1] > 0]
        inside, lasting, a, b = max(enough, key=lambda s: s[0] - s[1], default=(0.0, 0.0, 0, 0))
        if inside - lasting > NARROW:
            label = f"{name}_{joint}" if name in ("q", "dq", "ddq") else name
            entry = {"variable": label, "range": [float(edges[a]), float(edges[b])], "unit": unit}
            found.append((inside - lasting, entry | {"share_of_error": inside, "share_of_time": lasting}))
    return [entry for _, entry in sorted(found, key=lambda one: -one[0])[:3]]

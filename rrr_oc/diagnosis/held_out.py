"""Errors on held-out recordings before and after a diagnosis: bootstrap intervals, and tracking in MuJoCo."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import bootstrap

from rrr_oc import parallel
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.prediction_error import SIGNALS, Errors, evaluate_simulated, summary
from rrr_oc.diagnosis.procedure import Diagnosis
from rrr_oc.errors import UserError
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.storage import number

LEVEL = 0.95  # confidence level of the intervals
RESAMPLES = 4000  # of the bootstrap; twice as many double its time and move the ends of an interval by about 1 %
LEAST_RECORDINGS = 3  # for a bootstrap interval


def intervals(diagnosis: Diagnosis) -> dict[str, dict[str, Any]]:
    """Held-out NRMSE before and after and their ratio, by joint, each {"value": …, "interval": [low, high] or null}.

    Means over recordings; the 95 % intervals are percentiles of means over whole recordings (blocks of an only one) drawn with
    replacement, before and after in pairs (Efron & Tibshirani 1993, `scipy.stats.bootstrap`; its corrections for bias and skewness
    are unstable with so few). They measure the variation between recordings; with fewer than three there is no interval.
    """
    before, after = (np.concatenate([getattr(f, key) for f in diagnosis.folds]) for key in ("before", "after"))
    result = {}
    for j, joint in enumerate(diagnosis.model.joints):
        known = np.isfinite(before[:, j]) & np.isfinite(after[:, j])
        pair = before[known, j], after[known, j]
        result[joint] = {
            "before": _interval((pair[0],), np.mean),
            "after": _interval((pair[1],), np.mean),
            "ratio": _interval(pair, _ratio),
        }
    return result


def _ratio(before: np.ndarray, after: np.ndarray, axis: int = -1) -> np.ndarray:
    return np.mean(after, axis=axis) / np.maximum(np.mean(before, axis=axis), 1e-300)


def _interval(data: tuple[np.ndarray, ...], statistic: Any) -> dict[str, Any]:
    count = len(data[0])
    if not count:
        return {"value": None, "interval": None}
    value = float(statistic(*data))
    if count < LEAST_RECORDINGS:
        return {"value": value, "interval": None}
    seed, options = np.random.default_rng(0), {"paired": True, "method": "percentile"}
    found = bootstrap(data, statistic, confidence_level=LEVEL, n_resamples=RESAMPLES, rng=seed, **options).confidence_interval
    return {"value": value, "interval": [number(found.low), number(found.high)]}


def in_closed_loop(diagnosis: Diagnosis, jobs: int = -1) -> dict[str, Any]:
    """NRMSE of `prediction_error.SIGNALS` while the MuJoCo model tracks the recordings, before and after, by joint and signal.

    Each recording is tracked by the models found without it; a single recording by the models found on it.

    Returns:
        {"held_out": whether the recordings took no part, "before": …, "after": …}, the last two {joint: {signal: mean over the
        recordings, or null}}, or {"why_not": sentence} where a model has an effect that MuJoCo cannot simulate.
    """
    every, held_out = diagnosis.recordings.recordings, diagnosis.way == "recordings"
    if held_out:
        parts = [(f.plain, f.model, tuple(every[k] for k in f.held)) for f in diagnosis.folds]
    else:
        parts = [(diagnosis.plain, diagnosis.model, every)]
    sets = [replace(diagnosis.recordings, recordings=some) for *_, some in parts]
    extended = [k for k, (plain, model, _) in enumerate(parts) if len(model.terms) > len(plain.terms)]
    wanted = [(plain, some) for (plain, *_), some in zip(parts, sets, strict=True)] + [(parts[k][1], sets[k]) for k in extended]
    found = parallel.ordered(_tracked, wanted, jobs)
    before = found[: len(parts)]
    changed = dict(zip(extended, found[len(parts) :], strict=True))
    after = [changed.get(k, one) for k, one in enumerate(before)]
    joints = diagnosis.model.joints
    return {"held_out": held_out, "before": _means(before, joints), "after": _means(after, joints)}


def _tracked(model: CalibratedModel, recordings: RecordingSet) -> Errors | str:
    """Errors of the simulated signals, or the reason why there are none."""
    try:
        return evaluate_simulated(model, recordings)
    except UserError as error:
        return str(error)


def _means(parts: Sequence[Errors | str], joints: Sequence[str]) -> dict[str, Any]:
    """NRMSE by joint and signal, means over the recordings, or the reason why there are none."""
    errors: Errors = {}
    for part in parts:
        if isinstance(part, str):
            return {"why_not": part}
        errors |= part
    for file, one in errors.items():
        if one[joints[0]]["q"]["rmse"] is None:
            return {"why_not": f"it diverges while it follows {file}"}
    mean = summary({}, errors)["mean"]["simulated"]
    return {joint: {signal: mean[joint][signal]["nrmse"] for signal in SIGNALS} for joint in joints}

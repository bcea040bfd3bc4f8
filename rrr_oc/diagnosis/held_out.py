"""One check of the whole: everything is repeated without some of the recordings, which it then predicts.

Errors before and after with bootstrap intervals, and while MuJoCo tracks the recordings.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import bootstrap

from rrr_oc import parallel
from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.calibration.estimator.data import Data
from rrr_oc.calibration.estimator.fitting import Fitted
from rrr_oc.calibration.prediction_error import SIGNALS, Errors, error, evaluate_simulated, mean_nrmse, summary
from rrr_oc.calibration.samples import blocks_of
from rrr_oc.diagnosis.fitting import Fitter
from rrr_oc.diagnosis.knobs import MATTERS
from rrr_oc.diagnosis.result import Diagnosis, Finding, Fold, shown_as
from rrr_oc.diagnosis.stages import Stages
from rrr_oc.diagnosis.structures.neighbours import Repetitions, kind
from rrr_oc.diagnosis.structures.search import StructureSearch, terms_of
from rrr_oc.effects import Effect
from rrr_oc.errors import noted, tried
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.storage import number

FOLDS = 4  # of the recordings, each held out once; twice as many double the time
FOLDS_OF_MANY, MANY_JOINTS = 2, 5  # folds of arms with so many joints or more
LEVEL = 0.95  # confidence level of the intervals
RESAMPLES = 4000  # of the bootstrap; twice as many double its time and move the ends of an interval by about 1 %
LEAST_RECORDINGS = 3  # for a bootstrap interval
OUTSIDE = 0.05  # share of samples, and of a range, from which a motion leaves that range


Start = tuple[CalibratedModel, np.ndarray]  # where a fit begins: a model, and the errors of its links


def folds_of(data: Data) -> list[list[int]]:
    """The indices held out in each fold.

    Recordings of one set-up (payload, number of springs, group) go to different folds.
    """
    recordings = [p.recording for p in data.prepared]
    mounted = [(float(r.payload.max()), len(r.springs), data.labels.index(r.group)) for r in recordings]
    alike = sorted(range(len(recordings)), key=mounted.__getitem__)
    number = min(len(recordings), FOLDS_OF_MANY if data.n >= MANY_JOINTS else FOLDS)
    return [sorted(alike[k::number]) for k in range(number)]


def repeated(
    search: StructureSearch, begin: Fitted, findings: Sequence[Finding], stages: Stages, failed: dict[str, str], again: str = ""
) -> list[Fold]:
    """The folds, in which the search is repeated in the linear problems about its fits, if anything is claimed, from what it found on.

    They are fitted with those effects alone that were found in them and are claimed.

    Args:
        failed: Takes why a fold is missing.
        again: What the stages are called beside those of other findings.
    """
    held = folds_of(search.fitter.data)
    names = [f"search without part {k} of {len(held)}{again}" for k in range(1, len(held) + 1)]
    saved = {k: one for k, name in enumerate(names) if (one := stages.saved(name)) is not None}
    missing = [k for k in range(len(held)) if k not in saved]
    stages.progress.count("search without parts", len(saved), len(held), kind="parts")
    parts, calls = search.repetitions if missing and findings else None, []
    for k in missing:
        with noted(failed, names[k]):
            start = None if parts is None else _found(parts, held[k], findings)
            calls.append((names[k], _fold, k, search.fitter, begin, start, held[k]))
    for found, why in parallel.unordered(tried, calls) if parts else (tried(*call) for call in calls):
        failed |= why
        for k, fold in found:
            saved[k] = stages.keep(names[k], fold)
        stages.progress.count("search without parts", len(saved), len(held), kind="parts")
    return [saved[k] for k in sorted(saved)]


def _found(again: Repetitions, held: Sequence[int], findings: Sequence[Finding]) -> Start | None:
    """The claimed effects that a search on all but some recordings finds, at the fit about which they are predicted."""
    near, best = again.best(tuple(k for k in again.last.blocks if k not in held))
    fitted, kept = near.linear.fitted, list[Term]()
    every = terms_of(fitted, best.structure, near.linear.fitter.data.labels)[fitted.base :]
    for f in findings:
        same = [t for t in every if kind(t.effect) == kind(f.term.effect) or shown_as(t) in f.rivals]
        kept += [t for t in same if not any(t is k for k in kept)][:1]
    terms = (*fitted.model.terms[: fitted.base], *kept)
    return (replace(fitted.model, terms=terms), fitted.links) if kept else None


def _fold(number: int, fitter: Fitter, begin: Fitted, start: Start | None, held: Sequence[int]) -> tuple[int, Fold]:
    """A fold and its number; `start` is where the fit of what was found begins."""
    rest = fitter.data.part([i for i in range(len(fitter.data.prepared)) if i not in held])
    train = replace(fitter, data=rest, holds_delays=False)
    test, plain = fitter.data.part(held), train.fit(begin.model, begin.links, steps=1)
    near = train.closest(plain)  # as of the whole diagnosis, the model is reported that predicts best
    before = nrmse(test, near.model)
    if start is None:
        return number, Fold(tuple(held), near.model, near.model, before, before)
    found = train.closest(train.fit(*start, plain.posterior, steps=1))
    return number, Fold(tuple(held), near.model, found.model, before, nrmse(test, found.model))


def acts_on(effect: Effect, n: int) -> list[int]:
    """Joints whose torque an effect changes: all n where it changes the motion or the body, of which every joint feels a part."""
    return list(range(n)) if not effect.joints or effect.side in ("motion", "body") else list(effect.joints)


def nrmse(data: Data, model: CalibratedModel) -> np.ndarray:
    """NRMSE of the predicted torque by recording and joint (R, n); NaN where a joint does not move."""
    every = ((p.recording, p.measured) for p in data.prepared)
    return np.array([error(r.t, tau, model.predicted_torque(r), r.segments)["nrmse"] for r, tau in every])


def intervals(diagnosis: Diagnosis) -> dict[str, dict[str, Any]]:
    """Held-out NRMSE before and after and their ratio, by joint, each {"value": …, "interval": [low, high] or null}.

    Means over recordings; the 95 % intervals are percentiles of means over whole recordings (blocks of an only one) drawn with
    replacement, before and after in pairs (Efron & Tibshirani 1993, `scipy.stats.bootstrap`; its corrections for bias and skewness
    are unstable with so few). They measure the variation between recordings; with fewer than three there is no interval.
    """
    before, after, result = *errors_of(diagnosis.folds, len(diagnosis.model.joints)), {}
    for j, joint in enumerate(diagnosis.model.joints):
        known = np.isfinite(before[:, j]) & np.isfinite(after[:, j])
        pair = before[known, j], after[known, j]
        result[joint] = {
            "before": _interval((pair[0],), np.mean),
            "after": _interval((pair[1],), np.mean),
            "ratio": _interval(pair, _ratio),
        }
    return result


def errors_of(folds: Sequence[Fold], n: int) -> tuple[np.ndarray, np.ndarray]:
    """NRMSE before and after on all that was held out, (number of them, n) each."""
    none = np.zeros((0, n))
    before, after = (np.concatenate([none, *(getattr(f, key) for f in folds)]) for key in ("before", "after"))
    return before, after


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


def ranges(recordings: RecordingSet, folds: Sequence[Fold]) -> dict[str, str]:
    """Whether what was held out moved where the fit had seen the joint move, by joint: "inside" or "outside".

    Outside is a joint if more than `OUTSIDE` of the samples of a recording are at angles or speeds that the others do not reach. There a
    law has to predict what it was never fitted to, and an error tells less of it.
    """
    every, joints = recordings.recordings, recordings.joints
    parts = [np.concatenate([r.q, np.abs(r.dq)]) for r in every]  # (2 n, K) each
    if len(every) == 1:
        parts = [parts[0][:, block] for block in blocks_of(every[0])]
    outside = np.zeros(len(parts[0]), bool)
    for fold in folds:
        rest = np.concatenate([x for k, x in enumerate(parts) if k not in fold.held], axis=1)
        low, high = rest.min(axis=1, keepdims=True), rest.max(axis=1, keepdims=True)
        margin = OUTSIDE * (high - low)
        for k in fold.held:
            outside |= np.mean((parts[k] < low - margin) | (parts[k] > high + margin), axis=1) > OUTSIDE
    return {joint: "outside" if np.any(outside[j :: len(joints)]) else "inside" for j, joint in enumerate(joints)}


def joints_made_worse(recordings: RecordingSet, folds: Sequence[Fold]) -> set[int]:
    """Joints whose error rises with what was found, on held-out recordings that moved where the fits had seen them move."""
    before, after = map(mean_nrmse, errors_of(folds, len(recordings.joints)))
    there = [where == "inside" for where in ranges(recordings, folds).values()]
    return set(np.flatnonzero((after > (1 + MATTERS) * before) & there).tolist())


def in_closed_loop(diagnosis: Diagnosis) -> dict[str, Any]:
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
    found = parallel.ordered(tried, [("why_not", evaluate_simulated, *one) for one in wanted])
    before = found[: len(parts)]
    changed = dict(zip(extended, found[len(parts) :], strict=True))
    after = [changed.get(k, one) for k, one in enumerate(before)]
    joints = diagnosis.model.joints
    return {"held_out": held_out, "before": _means(before, joints), "after": _means(after, joints)}


def _means(parts: Sequence[tuple[list[Errors], dict[str, str]]], joints: Sequence[str]) -> dict[str, Any]:
    """NRMSE by joint and signal, means over the recordings, or the reason why there are none."""
    errors: Errors = {}
    for some, why_not in parts:
        if why_not:
            return dict(why_not)
        errors |= some[0]
    for file, one in errors.items():
        if one[joints[0]]["q"]["rmse"] is None:
            return {"why_not": f"it diverges while it follows {file}"}
    mean = summary({}, errors)["mean"]["simulated"]
    return {joint: {signal: mean[joint][signal]["nrmse"] for signal in SIGNALS} for joint in joints}

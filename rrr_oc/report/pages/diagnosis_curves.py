"""The data of a diagnosis' figures: recorded and predicted torques held out, and what is left of them, thinned to be shown.

They are saved beside diagnosis.json, so that a page can be made again without fitting anything."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rrr_oc.calibration.samples import blocks_of
from rrr_oc.diagnosis.result import Diagnosis, Finding, shown_as
from rrr_oc.effects import Delay
from rrr_oc.errors import noted
from rrr_oc.numerics.savitzky_golay import smooth
from rrr_oc.recordings.recording import Recording
from rrr_oc.report.figures import thinned

POINTS = 2000  # of a curve or cloud, at most
ALL_POINTS = 40_000  # of all curves together, and of all clouds, more or less; doubled, a page grows by 1 MB
FEWEST = 200  # of a curve or cloud, whatever their number
PREDICTED: tuple[str, ...] = ("t", "recorded", "before", "after")  # rows of "predicted 0 1", of recording 0 and joint 1
LAW: tuple[str, ...] = ("x", "low", "high", "law")  # rows of "law 0", of the first claim
BINS = 40  # along the variable that a law is drawn over; doubled, its band is of half as many samples
IN_BIN = 20  # samples, at least, of whose torque a band is told
LEFT: tuple[str, ...] = ("t", "q", "dq", "load_before", "load_after", "residual_before", "residual_after")  # rows of "left 0 1"
Curves = Mapping[str, np.ndarray]


def curves(diagnosis: Diagnosis, failed: dict[str, str]) -> dict[str, np.ndarray]:
    """The data of the figures by name, in SI units; K samples at most `POINTS`, with NaN between segments.

    Args:
        failed: Takes why there are no torques of a recording.

    Returns:
        "predicted k j": rows of `PREDICTED` (4, K) for recording k, where it was held out, and joint j. "left k j": rows of `LEFT`
        (7, K). "missed" and "remains": rms of what the plain and the extended model do not predict, held out and not, over all samples,
        (recordings, n, 2); "samples" of each recording. "law i" and "over": see `laws`. "files" and "joints": names. "worst":
        the recording that the plain model predicts worst, held out.
    """
    recordings, joints = diagnosis.recordings, diagnosis.model.joints
    every, n = recordings.recordings, len(joints)
    points = int(np.clip(ALL_POINTS / (len(every) * n), FEWEST, POINTS))
    missed, remains = np.full((2, len(every), n, 2), np.nan)
    result = {"files": np.array([r.file for r in every]), "joints": np.array(joints), "worst": np.array(worst(diagnosis))}
    result["samples"] = np.array([len(r.t) for r in every])
    for k, r in enumerate(every):
        recorded, both = recordings.output_torque(r), (diagnosis.plain, diagnosis.model)
        time, left = np.tile(r.t - r.t[0], (n, 1)), np.full((4, *r.q.shape), np.nan)
        with noted(failed, f"held-out torques of {r.file}"):
            held = held_out_predictions(diagnosis, k, r)
            if held is not None:
                rows = np.array([time, *(smooth(r.t, x, r.segments) for x in (recorded, *held))])
                missed[k] = np.sqrt(np.nanmean((rows[2:] - rows[1]) ** 2, axis=2)).T
                result |= {f"predicted {k} {j}": _shown(rows[:, j], r.segments, points, (1, 2, 3)) for j in range(n)}
        with noted(failed, f"residuals of {r.file}"):
            left[:2] = [model.torques(r)[1] for model in both]
            left[2:] = [smooth(r.t, recorded - model.predicted_torque(r), r.segments) for model in both]
            remains[k] = np.sqrt(np.mean(left[2:] ** 2, axis=2)).T
        rows = np.array([time, r.q, r.dq, *left])
        result |= {f"left {k} {j}": _shown(rows[:, j], r.segments, points, (5, 6)) for j in range(n)}
    with noted(failed, "laws over what was recorded"):
        result |= laws(diagnosis)
    return result | {"missed": missed, "remains": remains}


def claimed(diagnosis: Diagnosis) -> list[Finding]:
    """The findings in the order in which a report has claims: laws, then torques whose law is not sure."""
    named = [f for f in diagnosis.findings if f.named and not isinstance(f.term.effect, Delay)]
    return [*named, *(f for f in diagnosis.findings if not (f.named or f.with_function))]


def laws(diagnosis: Diagnosis) -> dict[str, np.ndarray]:
    """Of each claim i the rows "law i", on the joint where it is surest: the variable that tells most of its torque, the ends of what holds
    95 % of the torque that all else leaves there, and the median of the law's. "over" has the variables as diagnosis.json names them."""
    result, over = {}, []
    for i, f in enumerate(claimed(diagnosis)):
        j, model, joint = f.joint, diagnosis.model, diagnosis.model.joints[f.joint]
        others = replace(model, terms=tuple(term for term in model.terms if shown_as(term) != f.key))
        parts = []
        for r in (r for r in diagnosis.recordings.recordings if f.term.holds_for(r)):
            rest, all_of_it = others.predicted_torque(r)[j], model.predicted_torque(r)[j]
            left = diagnosis.recordings.output_torque(r)[j] - rest
            seen = smooth(r.t, left[None], r.segments)[0]
            parts.append(np.array([r.q[j], r.dq[j], r.ddq[j], others.torques(r)[1][j], r.t - r.t[0], seen, all_of_it - rest]))
        *variables, seen, law = np.concatenate(parts, axis=1)
        names = (f"q_{joint}", f"dq_{joint}", f"ddq_{joint}", "load_torque", "time")
        bins = [
            np.digitize(x, np.linspace(np.nanquantile(x, 0.002), np.nanquantile(x, 0.998), BINS + 1)[1:-1]) for x in variables
        ]
        scatter = [sum(np.nanvar(law[b == k]) * np.sum(b == k) for k in np.unique(b)) for b in bins]
        best = int(np.argmin(scatter))
        over.append(names[best])
        result[f"law {i}"] = _banded(variables[best], bins[best], seen, law)
    return result | {"over": np.array(over, dtype=str)}


def _banded(x: np.ndarray, bins: np.ndarray, seen: np.ndarray, law: np.ndarray) -> np.ndarray:
    """Rows of `LAW` from samples (K,) in bins."""
    own = [bins == k for k in range(BINS) if np.sum(np.isfinite(seen) & (bins == k)) >= IN_BIN]
    rows = [(np.nanmedian(x[b]), *np.nanquantile(seen[b], (0.025, 0.975)), np.nanmedian(law[b])) for b in own]
    return np.array(rows).reshape(-1, len(LAW)).T


def worst(diagnosis: Diagnosis) -> int:
    """The number of the recording that the plain model predicts worst, held out."""
    if diagnosis.way == "blocks":
        return 0
    errors = {k: np.nanmax([-1.0, *e]) for f in diagnosis.folds for k, e in zip(f.held, f.before, strict=True)}
    return max(errors, key=errors.__getitem__, default=0)


def held_out_predictions(diagnosis: Diagnosis, k: int, r: Recording) -> tuple[np.ndarray, np.ndarray] | None:
    """Torques (n, K) [Nm] that the plain and the extended model predict for a recording, or for each of its blocks, that they did not
    see; None where nothing was held out."""
    if diagnosis.way == "recordings":
        fold = next((f for f in diagnosis.folds if k in f.held), None)
        return None if fold is None else (fold.plain.predicted_torque(r), fold.model.predicted_torque(r))
    if not diagnosis.folds:
        return None
    before, after = (np.full_like(r.tau, np.nan) for _ in range(2))
    blocks = blocks_of(r)
    for fold in diagnosis.folds:
        own = np.concatenate([blocks[b] for b in fold.held])
        for to, model in ((before, fold.plain), (after, fold.model)):
            to[:, own] = model.predicted_torque(r)[:, own]
    return before, after


def _shown(rows: np.ndarray, segments: Sequence[slice], points: int, keep: Sequence[int]) -> np.ndarray:
    """Some of the samples (K,) of rows (m, K), with a column of NaN after each segment but the last."""
    index = thinned(rows, points, keep)
    ends = np.searchsorted(index, [s.start for s in segments[1:]])
    return np.insert(rows[:, index], ends, np.nan, axis=1)

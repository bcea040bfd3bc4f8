"""The data of a diagnosis' figures: recorded and predicted torques held out, and what is left of them, thinned to be shown.

They are saved beside diagnosis.json, so that a page can be made again without fitting anything."""

from collections.abc import Mapping, Sequence

import numpy as np

from rrr_oc.calibration.samples import blocks_of
from rrr_oc.diagnosis.result import Diagnosis
from rrr_oc.errors import noted
from rrr_oc.numerics.savitzky_golay import smooth
from rrr_oc.recordings.recording import Recording
from rrr_oc.report.pages.page import thinned

POINTS = 2000  # of a curve or cloud, at most
ALL_POINTS = 60_000  # of all curves together, and of all clouds, more or less; doubled, a page grows by 2 MB
FEWEST = 200  # of a curve or cloud, whatever their number
PREDICTED: tuple[str, ...] = ("t", "recorded", "before", "after")  # rows of "predicted 0 1", of recording 0 and joint 1
LEFT: tuple[str, ...] = ("t", "q", "dq", "load_before", "load_after", "residual_before", "residual_after")  # rows of "left 0 1"
Curves = Mapping[str, np.ndarray]


def curves(diagnosis: Diagnosis, failed: dict[str, str]) -> dict[str, np.ndarray]:
    """The data of the figures by name, in SI units; K samples at most `POINTS`, with NaN between segments.

    Args:
        failed: Takes why there are no torques of a recording.

    Returns:
        "predicted k j": rows of `PREDICTED` (4, K) for recording k, where it was held out, and joint j. "left k j": rows of `LEFT`
        (7, K). "missed" and "remains": rms of what the plain and the extended model do not predict, held out and not, over all samples,
        (recordings, n, 2); "samples" of each recording. "files" and "joints": names. "worst": the recording that the plain model
        predicts worst, held out.
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
    return result | {"missed": missed, "remains": remains}


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

"""The files of a diagnosis: model.json, the figures and their data, suggested motions, the page, and diagnosis.json."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.calibration.model_file import save_model
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile, to_json
from rrr_oc.diagnosis.held_out import intervals
from rrr_oc.diagnosis.result import Diagnosis
from rrr_oc.errors import noted
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.report.diagnosis_figures import draw_errors, draw_prediction
from rrr_oc.report.figures import save_figure
from rrr_oc.report.pages.diagnosis_curves import curves
from rrr_oc.report.pages.diagnosis_page import FIGURES, write_diagnosis_page
from rrr_oc.schema import built
from rrr_oc.storage import new_files, write_json, write_npz, write_text

# What `write_diagnosis` writes, and takes away of an earlier diagnosis
FILES = ("model.json", "diagnosis.json", "report.html", "before_after.png", "prediction.png", FIGURES, "suggested_*.csv")


def write_diagnosis(
    diagnosis: Diagnosis, folder: Path, simulated: Mapping[str, Any] | None = None, command: str = ""
) -> dict[str, Any]:
    """Write model.json, the figures, report.html and diagnosis.json, all in one step, in place of those of an earlier diagnosis.

    A figure or page that cannot be made is left out; diagnosis.json says why.

    Args:
        simulated: What `in_closed_loop` returns; None leaves that part out.
        command: What makes the diagnosis again; the page leaves it out where it is not known.

    Returns:
        The content of diagnosis.json, with "bootstrap" (`held_out.intervals`), "alone" and "simulated".
    """
    found = {**to_json(diagnosis), "bootstrap": intervals(diagnosis), "alone": _alone(diagnosis)}
    if simulated is not None:
        found["simulated"] = dict(simulated)
    with new_files(folder, FILES) as made:
        _write(diagnosis, made, found, command)
    return found


def _write(diagnosis: Diagnosis, folder: Path, found: dict[str, Any], command: str) -> None:
    save_model(diagnosis.model, folder / "model.json")
    failed = found["failed"]
    for suggestion, entry in zip(diagnosis.suggestions, found["suggested_recordings"], strict=True):
        header = ",".join(["t", *(f"q_{joint}" for joint in diagnosis.model.joints)])
        table = np.vstack([suggestion.motion.t, suggestion.motion.q]).T
        lines = [",".join(f"{value:.6f}" for value in row) for row in table]
        write_text(folder / entry["trajectory"], "\n".join([header, *lines]) + "\n")
    with noted(failed, "before_after.png"):
        save_figure(draw_errors(built(found, DiagnosisFile)), folder / "before_after.png")
    with noted(failed, "report.html and prediction.png"):
        shown = curves(diagnosis, failed) | {"subject": np.array(about(diagnosis.recordings)), "command": np.array(command)}
        write_npz(folder / FIGURES, shown)
        with noted(failed, "prediction.png"):
            save_figure(draw_prediction(shown), folder / "prediction.png")
        write_diagnosis_page(folder, found)
    write_json(folder / "diagnosis.json", found)


def _alone(diagnosis: Diagnosis) -> list[str]:
    """Held-out recordings of whose group no recording is in the fit, where a term is present in some groups only."""
    every, result = diagnosis.recordings.recordings, []
    if diagnosis.way == "recordings" and any(term.groups for term in diagnosis.model.terms):
        for fold in diagnosis.folds:
            known = {r.group for k, r in enumerate(every) if k not in fold.held}
            result += [every[k].file for k in fold.held if every[k].group not in known]
    return sorted(result)


def _began(note: str, recordings: RecordingSet) -> str:
    """A note as a sentence; the name of a file stays as it is."""
    return note if note.startswith(tuple(r.file for r in recordings.recordings)) else note[0].upper() + note[1:]


def about(recordings: RecordingSet) -> str:
    """The robot and its recordings in a sentence, and notes on how they were read."""
    every, robot = recordings.recordings, recordings.robot
    seconds = sum(float(np.ptp(r.t)) for r in every)
    carrying, sprung = sum(bool(r.payload.any()) for r in every), sum(bool(r.springs) for r in every)
    return (
        f"Robot {robot.name}, {robot.n} joint{'s' * (robot.n > 1)} ({', '.join(robot.joints)}); {len(every)} "
        f"recording{'s' * (len(every) > 1)} of {seconds:.0f} s together, {carrying or 'none'} with a payload, {sprung or 'none'} with springs; "
        f"{recordings.torque} {'torque ' * (recordings.torque != 'current')}recorded."
        + "".join(f" {_began(note, recordings)}." for note in recordings.notes)
    )

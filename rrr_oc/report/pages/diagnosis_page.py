"""The page of a diagnosis, made from its saved files alone: diagnosis.json, model.json, and the data of its figures."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.calibration.prediction_error import SIGNALS
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile, Mean, Mismatch, SimulatedEntry
from rrr_oc.effects.words import joint_words, rounded
from rrr_oc.report import diagnosis_words as say
from rrr_oc.report.diagnosis_figures import ALL, SIGNAL_NAMES, diagnosis_figures
from rrr_oc.report.pages.diagnosis_claims import claims, covered, record_next, remaining, small
from rrr_oc.report.pages.diagnosis_curves import LEFT, Curves
from rrr_oc.report.pages.diagnosis_model import model_numbers
from rrr_oc.report.pages.page import render
from rrr_oc.report.tables import NONE
from rrr_oc.schema import validated, with_nan
from rrr_oc.storage import read_npz, write_text

FIGURES = "figures.npz"  # what `diagnosis_curves.curves` returns, with "subject" and "command"


def write_diagnosis_page(folder: Path, content: Mapping[str, Any] | None = None) -> Path:
    """Write report.html from figures.npz, diagnosis.json and model.json in a folder; nothing is fitted.

    Args:
        content: Of diagnosis.json, where that is not written yet.

    Raises:
        UserError: The page cannot be written.
    """
    path = folder / "diagnosis.json"
    plain = _json(path) if content is None else content
    found = validated(path, with_nan(plain, DiagnosisFile), DiagnosisFile)
    text = diagnosis_page(found, read_npz(folder / FIGURES), _json(folder / "model.json"))
    write_text(folder / "report.html", text)
    return folder / "report.html"


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def diagnosis_page(found: DiagnosisFile, curves: Curves, model: Mapping[str, Any]) -> str:
    """The page as HTML, from the content of diagnosis.json, figures.npz and model.json."""
    joints, files, verdict = curves["joints"].tolist(), curves["files"].tolist(), say.sentence(found)
    claimed = claims(found, files)
    not_claimed = [*say.undecided(found), *say.off_links(found.link_findings), *say.measured(found.measurement)]
    return render(
        "diagnosis.html",
        diagnosis_figures(found, curves, [claim.title for claim in claimed]),
        found=found,
        subject=str(curves["subject"]),
        command=str(curves["command"]),
        verdict=verdict,
        recordings=[(str(k), file) for k, file in enumerate(files)],
        joints=[(str(j), joint_words(joint)) for j, joint in enumerate(joints)],
        first=first_shown(found, curves, joints),
        everything=ALL,
        same=say.same(found),
        errors=_error_rows(found),
        numbers=model_numbers(model),
        extrapolated=say.extrapolated(found),
        signals=list(SIGNAL_NAMES.values()),
        simulated=_simulated_rows(found.simulated),
        strays=_strays(found.simulated),
        claims=claimed,
        remaining=say.unsaid(remaining(found), verdict) or ["Nothing beyond what is said above."],
        anatomy=say.anatomy(found),
        raised=any(part.share < -LEAST for own in found.anatomy.values() for part in own),
        small=small(found),
        small_said=say.SMALL,
        mismatch=[_mismatch_row(m) for m in found.mismatch],
        not_claimed=say.unsaid([*not_claimed, *say.not_claimed(found), *say.not_made(found)], verdict),
        next=record_next(found),
        covered=covered(joints, _motions(curves)),
        suggestions=[[say.told_apart(found, s.separates), s.why, s.trajectory] for s in found.suggested_recordings],
    )


LEAST = 0.02  # share of a squared error from which a part that raises it is explained


def first_shown(found: DiagnosisFile, curves: Curves, joints: Sequence[str]) -> tuple[str, str]:
    """Numbers of the recording and of the joint that are shown at first: the joint of the first claim, where its error falls most; without
    a claim what the plain model predicts worst."""
    claimed = [*say.missing(found), *found.unexplained]
    if not claimed:
        worst = max(range(len(joints)), key=lambda j: found.bootstrap[joints[j]].before.value or 0.0)
        return str(curves["worst"]), str(worst)
    j = joints.index(claimed[0].lowers_error.joint)
    falls = curves["missed"][:, j, 0] - curves["missed"][:, j, 1]
    return str(int(np.argmax(np.nan_to_num(falls, nan=-np.inf)))), str(j)


def _motions(curves: Curves) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Angles and speeds of all recordings by joint."""
    result = {}
    for j, joint in enumerate(curves["joints"].tolist()):
        every = np.concatenate([curves[f"left {k} {j}"] for k in range(len(curves["files"]))], axis=1)
        result[joint] = every[LEFT.index("q")], every[LEFT.index("dq")]
    return result


def _simulated_rows(simulated: SimulatedEntry | None) -> list[list[str]]:
    """By joint, its errors in closed loop before → after, or both where they are equal; no rows where neither model was simulated."""
    if simulated is None:
        return []
    both = (simulated.before, simulated.after)
    joints = next((list(one) for one in both if "why_not" not in one), [])

    def cell(joint: str, signal: str) -> str:
        return " → ".join(dict.fromkeys(_shown(errors.get(joint, {}).get(signal)) for errors in both))

    return [[joint_words(joint), *(cell(joint, signal) for signal in SIGNALS)] for joint in joints]


def _strays(simulated: SimulatedEntry | None) -> bool:
    """Whether a simulated signal is further from the recorded one than a constant."""
    both = () if simulated is None else (simulated.before, simulated.after)
    errors = [own for one in both if "why_not" not in one for own in one.values()]
    return any((value or 0.0) > 1 for own in errors for value in own.values())


def _error_rows(found: DiagnosisFile) -> list[list[str]]:
    """By joint, its held-out error; where the models differ also that of the extended one, and their ratio."""
    rows = []
    for joint, b in found.bootstrap.items():
        shown = [b.before] if say.same(found) else [b.before, b.after]
        errors = [say.error(one) if one.value is not None else NONE for one in shown]
        rows.append([joint_words(joint), *errors, *[_ratio(b.ratio)] * (len(shown) > 1)])
    return rows


def _ratio(entry: Mean) -> str:
    value, interval = entry.value, entry.interval
    if value is None or interval is None or None in interval:
        return NONE if value is None else f"{value:.3f}"
    return f"{value:.3f} (95 %: {interval[0]:.3f} to {interval[1]:.3f})"


def _mismatch_row(m: Mismatch) -> list[str]:
    where, certain = "; ".join(say.place(w) for w in m.where), "yes" if m.significant else "no"
    errors = [_shown(m.nrmse.calibration), _shown(m.nrmse.held_out)]
    return [joint_words(m.joint), certain, *errors, where, ", ".join(m.recordings)]


def _shown(value: float | None) -> str:
    """An error as a share of the signal's standard deviation."""
    return NONE if value is None else f"{rounded(100 * value)} %"

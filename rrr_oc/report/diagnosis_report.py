"""The report of a diagnosis: one HTML page that contains its figures."""

import base64
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from rrr_oc.calibration.model_file import save_model
from rrr_oc.calibration.prediction_error import SIGNALS
from rrr_oc.diagnosis.diagnosis_file import to_json
from rrr_oc.diagnosis.held_out import intervals
from rrr_oc.diagnosis.procedure import Diagnosis
from rrr_oc.effects.words import joint_words
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.report import diagnosis_words as say
from rrr_oc.report.diagnosis_figures import SIGNAL_NAMES, draw_errors, draw_prediction, draw_residuals
from rrr_oc.report.figures import save_figure
from rrr_oc.storage import write_json, write_text


def write_diagnosis(diagnosis: Diagnosis, folder: Path, simulated: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Write model.json, the figures, report.html and, when all else is there, diagnosis.json.

    Args:
        simulated: What `in_closed_loop` returns; None leaves that part out.

    Returns:
        The content of diagnosis.json, with "bootstrap" (`held_out.intervals`), "alone" and "simulated".
    """
    found = {**to_json(diagnosis), "bootstrap": intervals(diagnosis), "alone": _alone(diagnosis)}
    if simulated is not None:
        found["simulated"] = dict(simulated)
    save_model(diagnosis.model, folder / "model.json")
    figures = {"before_after": save_figure(draw_errors(found), folder / "before_after.png")}
    figures["prediction"] = save_figure(draw_prediction(diagnosis), folder / "prediction.png")
    for j, joint in enumerate(diagnosis.model.joints):
        name = re.sub(r"[^\w.-]", "_", joint)  # a joint may be called what a file may not
        figures[f"residual_{joint}"] = save_figure(draw_residuals(diagnosis, j), folder / f"residual_{name}.png")
    for suggestion, entry in zip(diagnosis.suggestions, found["suggested_recordings"], strict=True):
        header = ",".join(["t", *(f"q_{joint}" for joint in diagnosis.model.joints)])
        table = np.vstack([suggestion.motion.t, suggestion.motion.q]).T
        lines = [",".join(f"{value:.6f}" for value in row) for row in table]
        write_text(folder / entry["trajectory"], "\n".join([header, *lines]) + "\n")
    write_text(folder / "report.html", page(found, about(diagnosis.recordings), figures))
    write_json(folder / "diagnosis.json", found)
    return found


def _alone(diagnosis: Diagnosis) -> list[str]:
    """Held-out recordings whose physical set-up no recording in the fit has, where a term is present in some set-ups only."""
    every, result = diagnosis.recordings.recordings, []
    if diagnosis.way == "recordings" and any(term.groups for term in diagnosis.model.terms):
        for fold in diagnosis.folds:
            known = {r.group for k, r in enumerate(every) if k not in fold.held}
            result += [every[k].file for k in fold.held if every[k].group not in known]
    return sorted(result)


def about(recordings: RecordingSet) -> str:
    """The robot and its recordings in a sentence, and notes on how they were read."""
    every, robot = recordings.recordings, recordings.robot
    seconds = sum(float(np.ptp(r.t)) for r in every)
    carrying, sprung = sum(bool(r.payload.any()) for r in every), sum(bool(r.springs) for r in every)
    return (
        f"Robot {robot.name}, {robot.n} joint{'s' * (robot.n > 1)} ({', '.join(robot.joints)}); {len(every)} "
        f"recording{'s' * (len(every) > 1)} of {seconds:.0f} s together, {carrying} with a payload, {sprung} with springs; "
        f"{recordings.torque} {'torque ' * (recordings.torque != 'current')}recorded."
        + "".join(f" {note[0].upper()}{note[1:]}." for note in recordings.notes)
    )


def page(found: Mapping[str, Any], subject: str, figures: Mapping[str, Path]) -> str:
    """The report as HTML (`templates/diagnosis.html`), its figures inside."""
    environment = Environment(loader=PackageLoader("rrr_oc.report"), autoescape=True, undefined=StrictUndefined)
    environment.filters["base64"] = lambda path: base64.b64encode(path.read_bytes()).decode()
    undecided = [
        f"{say.placed(e)} ({say.percent(e['probability_of_itself'])}) or {', '.join(say.rivals(e))}: one of them, "
        + say.percent(e["probability"])
        for e in found["effects"]
        if e["rivals"]
    ]
    errors = found["bootstrap"].items()
    return environment.get_template("diagnosis.html").render(
        found={"alone": [], "simulated": None, **found},
        subject=subject,
        figures=figures,
        verdict=say.sentence(found),
        errors=[[joint_words(joint), *(_with_interval(b[key]) for key in ("before", "after", "ratio"))] for joint, b in errors],
        signals=list(SIGNAL_NAMES.values()),
        simulated=_simulated_rows(found.get("simulated")),
        findings=[(say.plain(e), e["equation"], f"{e['share_of_error']:.0%}") for e in found["effects"]],
        effects=say.rows(found),
        unexplained=[
            (say.unexplained(u), say.percent(u["probability"]), f"{u['share_of_error']:.0%}") for u in found["unexplained"]
        ],
        mismatch=[_mismatch_row(m) for m in found["mismatch"]],
        on_prior=say.on_prior(found),
        not_claimed=say.not_claimed(found),
        undecided=undecided,
        suggestions=[[say.told_apart(found, s["separates"]), s["why"], s["trajectory"]] for s in found["suggested_recordings"]],
        versions=", ".join(f"{name} {version}" for name, version in found["versions"].items()),
    )


def _simulated_rows(simulated: Mapping[str, Any] | None) -> list[list[str]]:
    """By joint, its errors in closed loop before → after; no rows where neither model was simulated."""
    if simulated is None:
        return []
    before, after = simulated["before"], simulated["after"]
    joints = next((list(one) for one in (before, after) if "why_not" not in one), [])

    def cell(joint: str, signal: str) -> str:
        return " → ".join(_shown(errors.get(joint, {}).get(signal)) for errors in (before, after))

    return [[joint_words(joint), *(cell(joint, signal) for signal in SIGNALS)] for joint in joints]


def _with_interval(entry: Mapping[str, Any]) -> str:
    value, interval = entry["value"], entry["interval"]
    if value is None or interval is None or None in interval:
        return _shown(value)
    return f"{value:.4f} [{interval[0]:.4f}, {interval[1]:.4f}]"


def _mismatch_row(m: dict[str, Any]) -> list[str]:
    where = "; ".join(
        f"{say.variable(w['variable'])} in {w['range'][0]:.3g} … {w['range'][1]:.3g} {w['unit']}: {w['share_of_error']:.0%} of the error in "
        f"{w['share_of_time']:.0%} of the time"
        for w in m["where"]
    )
    return [
        joint_words(m["joint"]), "yes" if m["significant"] else "no", _chance(m["p_value"]),
        _shown(m["nrmse"]["calibration"]), _shown(m["nrmse"]["held_out"]), where, ", ".join(m["recordings"]),
    ]  # fmt: skip


def _chance(p: float) -> str:
    return f"{p:.1g}" if p > 1e-16 else "< 1e-16"


def _shown(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"

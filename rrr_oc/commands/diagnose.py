"""`rrr-oc diagnose`: which physics a calibrated model lacks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rrr_oc import __version__, parallel
from rrr_oc.commands.output import Json, Output, Quiet
from rrr_oc.commands.shared import (
    Dataset,
    Jobs,
    Workers,
    check_apart,
    command_line,
    doubted,
    loaded,
    note_without_compiler,
    shown,
    unexplained_torques,
)
from rrr_oc.errors import ends_at_once, noted
from rrr_oc.kept import Keeping, known, save
from rrr_oc.progress import Progress
from rrr_oc.schema import built
from rrr_oc.storage import check_folder, code, hash_of
from rrr_oc.storage import plain as plain_data

if TYPE_CHECKING:
    from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile
    from rrr_oc.diagnosis.result import Diagnosis

app = typer.Typer(add_completion=False)


@app.command()
def diagnose(
    context: typer.Context,
    dataset: Dataset,
    out: Annotated[Path, typer.Option(help="folder for diagnosis.json, model.json, report.html and figures")],
    jobs: Jobs = -1,
    workers: Workers = parallel.LOCAL,
    simulate: Annotated[bool, typer.Option(help="let the MuJoCo model track the recordings before and after, held out")] = True,
    priors: Annotated[
        Path | None,
        typer.Option(
            help="TOML file with what is known of the arm before: a table for each effect with its probability and typical sizes, "
            "and \\[context] with springs and inertias; without it, each effect's own prior holds"
        ),
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Say where the calibrated model fails, which physics it lacks, and how well it predicts once that is added."""
    with ends_at_once():
        from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile
        from rrr_oc.diagnosis.procedure import diagnose as diagnose_recordings
        from rrr_oc.diagnosis.stages import SHARES
        from rrr_oc.effects.priors import load_priors
        from rrr_oc.effects.words import words
        from rrr_oc.report.diagnosis_report import FILES, write_diagnosis
    output = Output(quiet, as_json)
    check_folder(out)
    believed = None if priors is None else load_priors(priors)
    recordings = loaded(dataset, output)
    check_apart([*recordings.files, *([] if priors is None else [priors])], [out / name for name in FILES])
    doubted(recordings, output)
    if simulate:
        note_without_compiler(output)
    asked = {"recordings": hash_of(recordings.files), "priors": None if priors is None else hash_of([priors])}
    kept = Keeping(out, asked | {"version": __version__, "code": code()}, output)
    with parallel.workers(jobs, workers), output.stages() as tell, parallel.one_thread():
        found = diagnose_recordings(recordings, lambda step: tell(replace(step, said=words(step.said))), believed, kept)
        progress, failed = Progress(SHARES, tell), dict(found.failed)
        simulated = None
        if simulate:
            progress.tell("tracking")
            with noted(failed, "tracking"):
                simulated = _tracked(found, kept)
        progress.tell("report")
        content = write_diagnosis(replace(found, failed=failed), out, simulated, command_line(context))
    output.result(content)
    _show_diagnosis(built(content, DiagnosisFile), output)
    for said in found.model.report["clocks"]:
        output.note(f"Note: {said}.")
    for warning in unexplained_torques(found.model):
        output.note(f"{warning}.")
    output.show(f"{out} holds diagnosis.json, model.json and report.html.")


def _tracked(found: Diagnosis, kept: Keeping) -> dict[str, Any]:
    """Errors in closed loop. Where there are none, the reason may be gone at the next try, such as a missing compiler: it is not kept."""
    from rrr_oc.diagnosis.held_out import in_closed_loop

    simulated = known(kept, "tracking")
    if simulated is None:
        simulated = plain_data(in_closed_loop(found))
        if not any("why_not" in simulated[when] for when in ("before", "after")):
            save(kept, "tracking", simulated)
    return simulated


def _show_diagnosis(found: DiagnosisFile, output: Output) -> None:
    from rrr_oc.effects.words import joint_words
    from rrr_oc.report import diagnosis_words as told
    from rrr_oc.report.pages.diagnosis_claims import small

    said = told.sentence(found)
    output.show(said)
    for line in [*map(told.plain, told.missing(found)), *map(told.unexplained, found.unexplained)]:
        output.show(line)
    output.table(*told.rows(found))
    if found.small:
        output.show(told.SMALL)
        output.table(*small(found))
    output.table(*told.anatomy(found), "Error on data left out, in percent of that of the robot's file, as parts are added")
    parts = (
        told.events,
        told.wanders,
        told.undecided,
        lambda found: told.off_links(found.link_findings),
        lambda found: told.measured(found.measurement),
        told.on_prior,
        told.idle,
        told.not_claimed,
        told.not_made,
    )
    for line in told.unsaid([line for part in parts for line in part(found)], said):
        output.show(line)
    rows = []
    for joint, b in found.bootstrap.items():
        interval = b.ratio.interval
        ratio = "–" if interval is None else f"{shown(interval[0])} … {shown(interval[1])}"
        rows.append([joint_words(joint), *(told.error(one) for one in (b.before, b.after)), ratio])
    header = ["joint", "plain model", "extended model", "extended / plain, 95 % interval"]
    output.table(header, rows, "Error held out, of the torque's standard deviation")
    for line in told.extrapolated(found):
        output.show(line)

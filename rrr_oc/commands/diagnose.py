"""`rrr-oc diagnose`: which physics a calibrated model lacks."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from rrr_oc import parallel
from rrr_oc.commands.output import Json, Output, Quiet
from rrr_oc.commands.shared import Dataset, Jobs, Workers, check_apart, command_line, loaded, shown
from rrr_oc.diagnosis.held_out import in_closed_loop
from rrr_oc.diagnosis.procedure import diagnose as diagnose_recordings
from rrr_oc.effects.priors import load_priors
from rrr_oc.effects.words import joint_words, words
from rrr_oc.report.diagnosis_report import FILES, write_diagnosis
from rrr_oc.report.diagnosis_words import not_claimed, on_prior, plain, rows, unexplained, verdict
from rrr_oc.storage import check_folder

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
    output = Output(quiet, as_json)
    check_folder(out)
    believed = None if priors is None else load_priors(priors)
    recordings = loaded(dataset, output)
    check_apart([*recordings.files, *([] if priors is None else [priors])], [out / name for name in FILES])
    with parallel.workers(jobs, workers), output.steps("reading") as step, parallel.one_thread():
        found = diagnose_recordings(recordings, lambda line: step(words(line)), believed)
        if simulate:
            step("tracking the recordings in closed loop")
        simulated = in_closed_loop(found) if simulate else None
        step("writing the report")
        content = write_diagnosis(found, out, simulated, command_line(context))
    output.result(content)
    _show_diagnosis(content, output)
    output.show(f"{out} holds diagnosis.json, model.json and report.html.")


def _show_diagnosis(found: dict[str, Any], output: Output) -> None:
    output.show(f"Verdict: {verdict(found)}.")
    for line in [*map(plain, found["effects"]), *map(unexplained, found["unexplained"])]:
        output.show(line)
    header, body = rows(found)
    table = Table(*header)
    for row in body:
        table.add_row(*row)
    if body:
        output.show(table)
    for line in [*on_prior(found), *not_claimed(found)]:
        output.show(line)
    errors = Table("joint", "NRMSE held out, before", "after", "after / before, 95 % interval")
    for joint, b in found["bootstrap"].items():
        interval = b["ratio"]["interval"]
        ratio = "–" if interval is None else f"{shown(interval[0])} … {shown(interval[1])}"
        errors.add_row(joint_words(joint), shown(b["before"]["value"]), shown(b["after"]["value"]), ratio)
    output.show(errors)

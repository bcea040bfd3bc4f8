"""`rrr-oc diagnose`."""

from pathlib import Path
from typing import Any

from rich.table import Table

from rrr_oc.commands.common import Output, check_apart, loaded, shown
from rrr_oc.diagnosis.held_out import in_closed_loop
from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.effects.priors import load_priors
from rrr_oc.effects.words import joint_words, words
from rrr_oc.parallel import check_jobs, one_thread
from rrr_oc.report.diagnosis_report import write_diagnosis
from rrr_oc.report.diagnosis_words import not_claimed, on_prior, plain, rows, unexplained, verdict
from rrr_oc.storage import check_folder


def run(dataset: Path, out: Path, options: dict[str, Any], output: Output) -> None:
    """Diagnose a recording set, write the report and its files, and show what was found.

    Args:
        options: "jobs", "simulate" and "priors" as the command declares them.
    """
    jobs = options["jobs"]
    check_jobs(jobs)
    check_folder(out)
    believed = None if options["priors"] is None else load_priors(options["priors"])
    recordings = loaded(dataset, output)
    check_apart(recordings.files, [out / r.file for r in recordings.recordings if Path(r.file).match("suggested_*.csv")])
    with one_thread():
        found = diagnose(recordings, lambda line: output.progress(words(line)), jobs, believed)
        if options["simulate"]:
            output.progress("tracking the recordings in closed loop")
        simulated = in_closed_loop(found, jobs) if options["simulate"] else None
        output.progress("writing the report")
        content = write_diagnosis(found, out, simulated)
    _show(content, output)
    output.show(f"{out} holds diagnosis.json, model.json and report.html.")
    output.result(content)


def _show(found: dict[str, Any], output: Output) -> None:
    output.show(f"Verdict: {verdict(found)}.", *map(plain, found["effects"]), *map(unexplained, found["unexplained"]))
    header, body = rows(found)
    table = Table(*header)
    for row in body:
        table.add_row(*row)
    if body:
        output.show(table)
    output.show(*on_prior(found), *not_claimed(found))
    errors = Table("joint", "NRMSE held out, before", "after", "after / before, 95 % interval")
    for joint, b in found["bootstrap"].items():
        interval = b["ratio"]["interval"]
        ratio = "–" if interval is None else f"{shown(interval[0])} … {shown(interval[1])}"
        errors.add_row(joint_words(joint), shown(b["before"]["value"]), shown(b["after"]["value"]), ratio)
    output.show(errors)

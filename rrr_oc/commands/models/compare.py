"""`rrr-oc compare`: diagnoses, models or designs side by side."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from rrr_oc.commands.output import Json, Output, Quiet
from rrr_oc.errors import UserError, ends_at_once
from rrr_oc.storage import check_folder

app = typer.Typer(add_completion=False)


@app.command()
def compare(
    results: Annotated[list[Path], typer.Argument(help="two or more diagnoses, models or designs: folders, or JSON files")],
    out: Annotated[Path | None, typer.Option(help="folder for fleet.html, the page of any number of diagnoses")] = None,
    every: Annotated[bool, typer.Option("--all", help="show the numbers that agree within their errors, too")] = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Show what differs between two diagnoses or models by more than its error, between two designs, or in a fleet of diagnosed arms."""
    if len(results) < 2:
        raise UserError("one result was given; two or more can be compared")
    output = Output(quiet, as_json)
    if len(results) > 2 or out is not None:
        _fleet(results, out, output)
    else:
        _two(results[0], results[1], every, output)


def _fleet(paths: Sequence[Path], out: Path | None, output: Output) -> None:
    with ends_at_once():
        from rrr_oc.comparison.page import write_fleet_page
        from rrr_oc.comparison.results import compared_fleet, fleet_data
        from rrr_oc.comparison.words import fleet_table, fleet_verdict, outlier_table
    found = compared_fleet(paths)
    output.result(fleet_data(found))
    for table in (fleet_table(found), outlier_table(found)):
        output.table(*table)
    output.show(fleet_verdict(found))
    if out is not None:
        check_folder(out)
        output.show(f"{write_fleet_page(found, out)} is the page.")


def _two(a: Path, b: Path, every: bool, output: Output) -> None:
    with ends_at_once():
        from rrr_oc.comparison.models import Compared
        from rrr_oc.comparison.results import as_data, compared
        from rrr_oc.comparison.words import CHANGES, change_row, design_table, design_verdict, sentences
    found = compared(a, b)
    output.result(as_data(a, b, found))
    if isinstance(found, Compared):
        output.table(CHANGES, [change_row(one) for one in found.changes if every or one.changed])
    else:
        output.table(*design_table(*found))
    for line in sentences(found) if isinstance(found, Compared) else [f"{design_verdict(*found)}."]:
        output.show(line)

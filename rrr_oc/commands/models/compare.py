"""`rrr-oc compare`: two diagnoses, models or designs side by side."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from rrr_oc.commands.output import Json, Output, Quiet
from rrr_oc.errors import ends_at_once

app = typer.Typer(add_completion=False)
Given = Annotated[Path, typer.Argument(help="a diagnosis, model or design: its folder, or its JSON file")]


@app.command()
def compare(
    a: Given,
    b: Given,
    every: Annotated[bool, typer.Option("--all", help="show the numbers that agree within their errors, too")] = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Show what differs between two diagnoses or models by more than its error, or between two designs."""
    with ends_at_once():
        from rrr_oc.comparison.models import Compared
        from rrr_oc.comparison.results import as_data, compared
        from rrr_oc.comparison.words import CHANGES, change_row, design_table, design_verdict, sentences
    output, found = Output(quiet, as_json), compared(a, b)
    output.result(as_data(a, b, found))
    if isinstance(found, Compared):
        header, rows = CHANGES, [change_row(one) for one in found.changes if every or one.changed]
    else:
        header, rows = design_table(*found)
    table = Table(*header)
    for row in rows:
        table.add_row(*row)
    if rows:
        output.show(table)
    for line in sentences(found) if isinstance(found, Compared) else [f"{design_verdict(*found)}."]:
        output.show(line)

"""`rrr-oc effects`: the catalogue."""

import typer
from rich.table import Table

from rrr_oc.commands.shared import console
from rrr_oc.effects import CATALOGUE
from rrr_oc.effects.base import PLACEMENTS, SIDES

app = typer.Typer(add_completion=False)


@app.command()
def effects() -> None:
    """List the effects of the catalogue: their laws, parameters and units, and where they act."""
    table = Table("effect", "law", "parameters", "acts on", "where", show_lines=True)
    for kind in CATALOGUE.values():
        fixed = isinstance(kind.parameters, tuple)  # else their number depends on what the term was found to depend on
        parameters = ", ".join(f"{p.name} [{p.unit}]" for p in kind.parameters) if fixed else "coefficients [Nm]"
        table.add_row(kind.name, kind.equation, parameters, kind.side, PLACEMENTS[kind.placement])
    console.print(table)
    for side, meaning in SIDES.items():
        console.print(f"{side}: {meaning}.", highlight=False, soft_wrap=True)

"""`rrr-oc effects`."""

from rich.table import Table

from rrr_oc.commands.common import Output
from rrr_oc.effects import CATALOGUE
from rrr_oc.effects.base import PLACEMENTS, SIDES


def run(output: Output) -> None:
    """Show the catalogue."""
    table, entries = Table("effect", "law", "parameters", "acts on", "where", show_lines=True), []
    for kind in CATALOGUE.values():
        fixed = isinstance(kind.parameters, tuple)  # else their number depends on what the term was found to depend on
        parameters = ", ".join(f"{p.name} [{p.unit}]" for p in kind.parameters) if fixed else "coefficients [Nm]"
        table.add_row(kind.name, kind.equation, parameters, kind.side, PLACEMENTS[kind.placement])
        units = {p.name: p.unit for p in kind.parameters} if fixed else {}
        entries.append(
            {
                "effect": kind.name,
                "law": kind.equation,
                "parameters": units,
                "acts_on": kind.side,
                "where": PLACEMENTS[kind.placement],
            }
        )
    output.show(table, *(f"{side}: {meaning}." for side, meaning in SIDES.items()))
    output.result(entries)

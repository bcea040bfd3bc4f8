"""`rrr-oc effects`: the catalogue."""

from typing import Any

import typer

from rrr_oc.commands.output import Json, Output, Quiet
from rrr_oc.effects import CATALOGUE
from rrr_oc.effects.base import PLACEMENTS, SIDES, Effect
from rrr_oc.robot.parameters import Parameter

app = typer.Typer(add_completion=False)


@app.command()
def effects(quiet: Quiet = False, as_json: Json = False) -> None:
    """List the effects of the catalogue: their laws, parameters and units, and where they act."""
    output = Output(quiet, as_json)
    output.result({"effects": [_described(kind) for kind in CATALOGUE.values()], "acts_on": SIDES})
    rows = []
    for kind in CATALOGUE.values():
        known = _parameters(kind)
        parameters = "coefficients [Nm]" if known is None else ", ".join(f"{p.name} [{p.unit}]" for p in known)
        rows.append([kind.name, kind.equation, parameters, kind.side, PLACEMENTS[kind.placement]])
    output.table(["effect", "law", "parameters", "acts on", "where"], rows, lines=True)
    for side, meaning in SIDES.items():
        output.show(f"{side}: {meaning}.")


def _described(kind: type[Effect]) -> dict[str, Any]:
    """An effect as data; the parameters are null where their number depends on what the term was found to depend on."""
    known = _parameters(kind)
    named = None if known is None else [{"name": p.name, "unit": p.unit} for p in known]
    return {
        "effect": kind.name,
        "law": kind.equation,
        "parameters": named,
        "acts_on": kind.side,
        "where": PLACEMENTS[kind.placement],
    }


def _parameters(kind: type[Effect]) -> tuple[Parameter, ...] | None:
    return kind.parameters if isinstance(kind.parameters, tuple) else None

"""`rrr-oc init`: the files that a user writes, begun for an arm."""

from pathlib import Path
from typing import Annotated

import typer

from rrr_oc.commands.example_set import write_example
from rrr_oc.commands.output import Json, Output, Quiet

app = typer.Typer(add_completion=False)


@app.command()
def init(
    robot: Annotated[str, typer.Argument(help="path of the arm's URDF, or a bundled model")],
    out: Annotated[Path, typer.Option(help="folder to make")],
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Begin with an arm: write a commented recordings.json, CSV header and task.json for it, and the next commands."""
    output = Output(quiet, as_json)
    made = write_example(robot, out)
    files = (
        "recordings/recordings.json, recordings/first.csv with a header, " + "task.json " * bool(made.moving) + "and README.md"
    )
    output.show(f"{out} holds {files}, with comments, for {', '.join(made.joints)}.")
    for note in made.notes:
        output.note(f"Note: {note}.")
    if made.no_task:
        output.note(f"Note: there is no task.json: {made.no_task}.")
    output.show((out / "README.md").read_text(encoding="utf-8").partition("```\n")[2].partition("```")[0].rstrip())
    output.result({"folder": str(out), "joints": made.joints, "moving": made.moving, "no_task": made.no_task})

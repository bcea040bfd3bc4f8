"""`rrr-oc init`."""

from pathlib import Path

from rrr_oc.codesign.example_set import write_example
from rrr_oc.commands.common import Output


def run(robot: str, out: Path, output: Output) -> None:
    """Write the example files and say what they are."""
    made = write_example(robot, out)
    files = (
        "recordings/recordings.json, recordings/first.csv with a header, " + "task.json " * bool(made.moving) + "and README.md"
    )
    output.show(f"{out} holds {files}, with comments, for {', '.join(made.joints)}.")
    for note in made.notes:
        output.warn(f"Note: {note}.")
    if made.no_task:
        output.warn(f"Note: there is no task.json: {made.no_task}.")
    output.show((out / "README.md").read_text(encoding="utf-8").partition("```\n")[2].partition("```")[0].rstrip())
    output.result({"folder": str(out), "joints": made.joints, "moving": made.moving, "no_task": made.no_task})

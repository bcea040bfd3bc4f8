"""`rrr-oc animate`: a design or a recording as a moving picture."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from rrr_oc.codesign.task import load_task
from rrr_oc.commands.output import Output, Quiet
from rrr_oc.commands.shared import loaded
from rrr_oc.errors import UserError
from rrr_oc.report.animation import Scene, animate
from rrr_oc.storage import check_file

app = typer.Typer(add_completion=False)


@app.command(name="animate")
def command(
    source: Annotated[Path, typer.Argument(help="npz of a design, or a folder with recordings.json")],
    out: Annotated[Path, typer.Option(help="file to write: .gif, or .mp4 where ffmpeg is installed")],
    task: Annotated[str | None, typer.Option(help="of a design: its task file, or a bundled task")] = None,
    recording: Annotated[str | None, typer.Option(help="of a set: the file; default: the first")] = None,
    quiet: Quiet = False,
) -> None:
    """Show a motion: the arm with its payload, and the torques of its joints beside it, in real time."""
    output = Output(quiet)
    check_file(out)
    scene = _recording(source, recording, output) if source.is_dir() else _design(source, task)
    with output.steps("drawing"):
        animate(scene, out)
    output.show(f"{out} shows {scene.title}.")


def _design(source: Path, name: str | None) -> Scene:
    if name is None:
        raise UserError("--task is missing: the task file of the design, or a bundled task, is required")
    task = load_task(name)
    try:
        with np.load(source) as file:
            t, q, load, springs, payload = (file[key] for key in ("t", "q", "tau_load", "tau_spring", "payload"))
    except (OSError, ValueError, KeyError):
        raise UserError(f"{source}: is no npz of a design; one that `rrr-oc design` wrote is required") from None
    if len(q) != len(task.joints):
        raise UserError(
            f"{source}: has {len(q)} moving joints and task {task.name!r} {len(task.joints)}; the design's task is required"
        )
    torques = {"load torque": load, "springs": springs}
    return Scene(task.robot, task.tool, t, task.full(q), torques, task.joints, payload, f"{source.stem} of task {task.name}")


def _recording(source: Path, name: str | None, output: Output) -> Scene:
    recordings = loaded(source, output)
    every = {r.file: r for r in recordings.recordings}
    if name is not None and name not in every:
        raise UserError(f"{source}: has no recording {name!r}; there are {', '.join(every)}")
    r = every[name] if name is not None else recordings.recordings[0]
    torques = {f"recorded {recordings.torque} torque": recordings.output_torque(r)}
    return Scene(recordings.robot, recordings.tool, r.t - r.t[0], r.q, torques, recordings.joints, r.payload, r.file)

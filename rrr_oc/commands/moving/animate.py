"""`rrr-oc animate`: a design or a recording as a moving picture."""

from pathlib import Path
from typing import Annotated

import typer

from rrr_oc.commands.output import Output, Quiet
from rrr_oc.commands.shared import check_apart, loaded
from rrr_oc.errors import ends_at_once
from rrr_oc.report.moving import Renderer
from rrr_oc.storage import check_file

app = typer.Typer(add_completion=False)


@app.command(name="animate")
def command(
    source: Annotated[Path, typer.Argument(help="npz of a design, or a folder with recordings.json")],
    out: Annotated[Path, typer.Option(help="file to write: .gif, or .mp4 where ffmpeg is installed")],
    task: Annotated[str | None, typer.Option(help="of a design: its task file, or a bundled task")] = None,
    recording: Annotated[str | None, typer.Option(help="of a set: the file; default: the first")] = None,
    renderer: Annotated[
        Renderer, typer.Option(help="mujoco: solid bodies, where there is OpenGL; matplotlib: lines")
    ] = "mujoco",
    quiet: Quiet = False,
) -> None:
    """Show a motion: the arm with its springs and payload, and the torques of its joints beside it, in real time.

    A spring's colour is its tension, from grey, without load, to red. The springs of a design are those of the summary.json beside it.
    """
    with ends_at_once():
        from rrr_oc.commands.moving.sources import chosen, designed, recorded
        from rrr_oc.report.moving.animation import animate
    output = Output(quiet)
    check_file(out)
    if source.is_dir():
        recordings = loaded(source, output)
        check_apart(recordings.files, [out])
        scene = recorded(recordings, chosen(recordings, recording))
    else:
        check_apart([source, *([] if task is None else [Path(task)])], [out])
        scene = designed(source, task)
    with output.steps("drawing"):
        used, why = animate(scene, out, renderer)
    if why:
        output.note(f"Note: MuJoCo's renderer does not work here ({why}); the arm is drawn as lines.")
    output.show(f"{out} shows {scene.title}, drawn by {used}.")

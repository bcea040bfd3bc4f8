"""`rrr-oc view`: a task, a design or recordings in the browser, beside the model's simulation."""

import time
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from rrr_oc.commands.output import Output, Quiet
from rrr_oc.errors import ends_at_once

TICK = 1 / 30  # [s] between two pictures while it plays
app = typer.Typer(add_completion=False)


@app.command(name="view")
def command(
    source: Annotated[str, typer.Argument(help="a task, the npz of a design, or a folder with recordings.json")],
    task: Annotated[str | None, typer.Option(help="of a design: its task file, or a bundled task")] = None,
    model: Annotated[Path | None, typer.Option(help="model.json: recordings are shown beside its simulation in MuJoCo")] = None,
    port: Annotated[int, typer.Option(min=1, max=65535, help="of this machine; the next free one if it is taken")] = 8080,
    browser: Annotated[bool, typer.Option(help="open the page")] = True,
    quiet: Quiet = False,
) -> None:
    """Show an arm in the browser until Ctrl-C: a time slider, its springs and payload, its torques.

    With --model, a second arm that can be seen through is the model in MuJoCo, which tracks the recording.
    """
    with ends_at_once():
        from rrr_oc.commands.moving.sources import choices
        from rrr_oc.report.moving.viewer import Viewer
    output = Output(quiet)
    names, load = choices(source, task, model, output)
    viewer = Viewer(names, load, port)
    try:
        output.show(f"{viewer.address} shows {source}. Ctrl-C ends it.")
        if browser:
            webbrowser.open(viewer.address)
        before = time.monotonic()
        while True:
            time.sleep(TICK)
            now = time.monotonic()
            viewer.go_on(now - before)
            before = now
    except KeyboardInterrupt:
        output.show("The viewer has ended.")
    finally:
        viewer.stop()

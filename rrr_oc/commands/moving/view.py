"""`rrr-oc view`: a task, a design or recordings in the browser, beside the model's simulation."""

import time
import webbrowser
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.model_file import load_model
from rrr_oc.calibration.prediction_error import simulated
from rrr_oc.codesign.task import load_task
from rrr_oc.commands.moving.sources import designed, recorded
from rrr_oc.commands.output import Output, Quiet
from rrr_oc.commands.shared import loaded
from rrr_oc.errors import UserError
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.report.moving.scene import Scene
from rrr_oc.report.moving.viewer import Shown, Viewer

TICK = 1 / 30  # [s] between two pictures while it plays
WAY = 2.0  # [s] from the start of a task to its release, where only the task is shown
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
    output = Output(quiet)
    names, load = _shown(Path(source), source, task, model, output)
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


def _shown(
    path: Path, source: str, task: str | None, model: Path | None, output: Output
) -> tuple[list[str], Callable[[str], Shown]]:
    """What can be chosen, and what belongs to each name."""
    if path.is_dir():
        recordings, calibrated = loaded(path, output), None if model is None else load_model(model)
        return [r.file for r in recordings.recordings], cache(lambda name: _recording(recordings, calibrated, name))
    if model is not None:
        raise UserError("--model goes with a folder of recordings, which the model tracks")
    scene = designed(path, task) if path.suffix == ".npz" else _of_task(source)
    return [scene.title], lambda _: Shown(scene)


def _of_task(name: str) -> Scene:
    """A task: from its start to its release along the straight way of the joints, with the payload, and back without."""
    task, s = load_task(name), np.linspace(0, 1, 101)
    way = (1 - np.cos(np.pi * s)) / 2
    go = task.start[:, None] + (task.release - task.start)[:, None] * way
    t = WAY * np.concatenate([s, 1 + s[1:]])
    payload = np.where(np.arange(t.size) < s.size, task.payload, 0.0)
    q = task.full(np.concatenate([go, go[:, -2::-1]], axis=1))
    return Scene(task.robot, task.tool, t, q, {}, (), payload, f"start and release of task {task.name}")


def _recording(recordings: RecordingSet, model: CalibratedModel | None, name: str) -> Shown:
    """A recording, beside what the model does while it tracks it."""
    one = replace(recordings, recordings=tuple(r for r in recordings.recordings if r.file == name))
    scene = recorded(one, one.recordings[0])
    if model is None:
        return Shown(scene)
    found = simulated(model, one)[name]
    torque = found.tau_load if recordings.torque == "load" else found.tau_motor
    return Shown(replace(scene, torques={**scene.torques, "model in MuJoCo": torque}), found.q)

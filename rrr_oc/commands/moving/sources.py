"""Scenes from what commands are given: the npz of a design, or a recording."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.model_file import load_model
from rrr_oc.calibration.prediction_error import simulated
from rrr_oc.codesign.optimum import SampledMotion
from rrr_oc.codesign.springs import acting, saved_springs
from rrr_oc.codesign.task import Task, load_task
from rrr_oc.codesign.trajectory import saved_motion
from rrr_oc.commands.output import Output
from rrr_oc.commands.shared import loaded
from rrr_oc.effects import Signals
from rrr_oc.errors import UserError, meant
from rrr_oc.recordings.header import Spring
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.report.moving.scene import Scene, ShownSpring
from rrr_oc.report.moving.viewer import Shown

SUMMARY = "summary.json"  # of a study, beside the npz of its designs
WAY = 2.0  # [s] from the start of a task to its release, where only the task is shown


def designed(source: Path, name: str | None) -> Scene:
    """The scene of a design; raises `UserError` without a task, for another file, or for another task."""
    if name is None:
        raise UserError("--task is missing: the task file of the design, or a bundled task, is required")
    task = load_task(name)
    m = saved_motion(source, task)
    torques = {"load torque": m.tau_load}
    if np.any(m.tau_spring):
        torques = {
            "load torque with springs": m.tau_load,
            "without springs": m.tau_load + m.tau_spring,
            "springs": m.tau_spring,
        }
    title = f"{source.stem} of task {task.name}"
    springs = _of_design(source, task, m)
    return Scene(task.robot, task.tool, m.t, task.full(m.q), torques, task.joints, m.payload, title, springs)


def _of_design(source: Path, task: Task, m: SampledMotion) -> tuple[ShownSpring, ...]:
    """The springs that the study's summary beside the npz has; without it, one at each joint that springs act on."""
    if (source.parent / SUMMARY).is_file():
        springs = saved_springs(source.parent / SUMMARY, source.stem, task).mounted
        shown = zip(shown_springs(springs, task.full(m.q)), springs, strict=True)
        return tuple(replace(s, tension=s.tension * np.isin(m.phase, acting(effect))) for s, (effect, _) in shown)
    return tuple(ShownSpring((j,), np.abs(row)) for j, row in zip(task.moving, m.tau_spring, strict=True) if np.any(row))


def shown_springs(springs: Sequence[Spring], q: np.ndarray) -> tuple[ShownSpring, ...]:
    """Springs with their exact torques along positions (n, K)."""
    return tuple(
        ShownSpring(effect.joints, np.abs(np.asarray(effect.torque(Signals(q), theta, 0.0)[0], float)))
        for effect, theta in springs
    )


def recorded(recordings: RecordingSet, recording: Recording) -> Scene:
    """The scene of a recording."""
    r = recording
    torques = {f"recorded {recordings.torque} torque": recordings.output_torque(r)}
    springs = shown_springs(r.springs, r.q)
    return Scene(recordings.robot, recordings.tool, r.t - r.t[0], r.q, torques, recordings.joints, r.payload, r.file, springs)


def chosen(recordings: RecordingSet, name: str | None) -> Recording:
    """The recording of a file, or the first; raises `UserError` for one that is not there."""
    every = {r.file: r for r in recordings.recordings}
    if name is not None and name not in every:
        raise UserError(f"{recordings.path}: has no recording {name!r}; there are {', '.join(every)}{meant(name, every)}")
    return every[name] if name is not None else recordings.recordings[0]


def choices(source: str, task: str | None, model: Path | None, output: Output) -> tuple[list[str], Callable[[str], Shown]]:
    """What can be chosen of a task, a design or recordings, and what belongs to each name.

    Raises `UserError` for a model without recordings, and as `designed` does.
    """
    path = Path(source)
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

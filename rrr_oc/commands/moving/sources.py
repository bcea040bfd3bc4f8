"""Scenes from what commands are given: the npz of a design, or a recording."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rrr_oc.codesign.springs import saved_springs
from rrr_oc.codesign.task import PHASES, Task, load_task
from rrr_oc.effects import Clutched, Signals
from rrr_oc.errors import UserError
from rrr_oc.recordings.header import Spring
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.report.moving.scene import Scene, ShownSpring
from rrr_oc.storage import read_npz

SUMMARY = "summary.json"  # of a study, beside the npz of its designs


def designed(source: Path, name: str | None) -> Scene:
    """The scene of a design; raises `UserError` without a task, for another file, or for another task."""
    if name is None:
        raise UserError("--task is missing: the task file of the design, or a bundled task, is required")
    task = load_task(name)
    try:
        file = read_npz(source)
        t, q, load, own, payload = (file[key] for key in ("t", "q", "tau_load", "tau_spring", "payload"))
    except (UserError, KeyError):
        raise UserError(f"{source}: is no npz of a design; one that `rrr-oc design` wrote is required") from None
    if len(q) != len(task.joints):
        raise UserError(
            f"{source}: has {len(q)} moving joints and task {task.name!r} {len(task.joints)}; the design's task is required"
        )
    torques = {"load torque": load}
    if np.any(own):
        torques = {"load torque with springs": load, "without springs": load + own, "springs": own}
    positions = task.full(q)
    springs = _of_design(source, task, positions, own)
    return Scene(
        task.robot, task.tool, t, positions, torques, task.joints, payload, f"{source.stem} of task {task.name}", springs
    )


def _of_design(source: Path, task: Task, q: np.ndarray, own: np.ndarray) -> tuple[ShownSpring, ...]:
    """The springs that the study's summary beside the npz has; without it, one at each joint that springs act on."""
    if (source.parent / SUMMARY).is_file():
        springs = saved_springs(source.parent / SUMMARY, source.stem, task).mounted
        phase = read_npz(source).get("phase", np.zeros(0))
        acting = [phase == PHASES.index(effect.phase) if isinstance(effect, Clutched) else 1.0 for effect, _ in springs]
        shown = zip(shown_springs(springs, q), acting, strict=True)
        return tuple(replace(spring, tension=spring.tension * share) for spring, share in shown)
    return tuple(ShownSpring((j,), np.abs(row)) for j, row in zip(task.moving, own, strict=True) if np.any(row))


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
        raise UserError(f"{recordings.path}: has no recording {name!r}; there are {', '.join(every)}")
    return every[name] if name is not None else recordings.recordings[0]

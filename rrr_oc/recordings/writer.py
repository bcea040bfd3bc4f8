"""Recording sets written as a folder with `recordings.json` and CSV files."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.recordings.header import EFFORTS, FORMAT, HEADER
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.recordings.springs import spring_json
from rrr_oc.robot.robot import BUNDLED, urdf_text
from rrr_oc.storage import new_folder, write_csv, write_json, write_text


def save_recordings(recordings: RecordingSet, folder: str | Path) -> None:
    """Write a set as a new folder, whole or not at all; numbers are written exactly, computed derivatives are left out.

    Raises `UserError` where the folder exists with something in it, or what is to be written could not be read again.
    """
    robot, tool = recordings.robot, recordings.tool
    pose = robot.frames[robot.links[tool.joint]][1]
    header: dict[str, Any] = {
        "joints": list(robot.joints),
        "torque": recordings.torque,
        "inertial": recordings.inertial,
        "gravity": robot.gravity.tolist(),
        "tool": {"link": robot.links[tool.joint], "position": (pose[:3, :3].T @ (tool.position - pose[:3, 3])).tolist()},
        "actuators": constants({j: k for j, k in zip(robot.joints, recordings.torque_constant, strict=True) if k is not None}),
        "fixed_deg": {joint: float(np.degrees(angle)) for joint, angle in robot.held.items()},
    }
    tables = {r.file: _table(r, robot.joints, recordings.torque) for r in recordings.recordings}
    entries = []
    for r in recordings.recordings:
        entry = {"file": r.file, "group": r.group, "springs": spring_json(r.springs, robot.joints)}
        entry |= _gains(r, robot.joints)
        entries.append(entry if "payload" in tables[r.file] else {**entry, "payload": float(r.payload[0])})
    write_set(folder, recordings.source, {**header, "recordings": entries}, tables)


def write_files(
    folder: str | Path,
    source: str | Path,
    header: Mapping[str, Any],
    files: Sequence[str | Path],
    read: Callable[[Path], Mapping[str, np.ndarray]],
) -> RecordingSet:
    """Write files of another layout as a new set, each one recording under its own name; `read` turns one into columns.

    Raises `UserError` where two would get the same name, and as `write_set`.
    """
    tables: dict[str, Mapping[str, np.ndarray]] = {}
    for file in map(Path, files):
        name = f"{file.stem}.csv"
        if name in tables:
            raise UserError(f"{file}: another file has the same name; each needs its own, for it becomes {name!r}")
        tables[name] = read(file)
    return write_set(folder, source, {**header, "recordings": [{"file": name} for name in tables]}, tables)


def constants(torque_constant: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """Torque constants [Nm/A] by joint as the key `actuators` of a set has them."""
    return {joint: {"torque_constant": constant} for joint, constant in torque_constant.items()}


def write_set(
    folder: str | Path, source: str | Path, header: Mapping[str, Any], tables: Mapping[str, Mapping[str, np.ndarray]]
) -> RecordingSet:
    """Write a new set, with a copy of its URDF, which an MJCF is made into, and read it again; nothing is written where it could not be read.

    Args:
        folder: Folder to make.
        source: Bundled model or path of a URDF or MJCF.
        header: Content of `recordings.json` except its keys `format` and `robot`.
        tables: By file, its columns (K,) by name.

    Raises:
        UserError: `folder` has something in it, the URDF is missing, or the set is not what `load_recordings` accepts.
    """
    folder, bundled = Path(folder), str(source) in BUNDLED
    robot = str(source) if bundled else f"{Path(source).stem}.urdf"  # never a bundled name
    with new_folder(folder) as temporary:
        if not bundled:
            write_text(temporary / robot, urdf_text(source))
        write_json(temporary / HEADER, {"format": FORMAT, "robot": robot, **header})
        for file, columns in tables.items():
            write_csv(temporary / file, columns)
        try:
            written = load_recordings(temporary)
        except UserError as error:
            raise UserError(str(error).replace(str(temporary), str(folder))) from None
    return replace(written, path=folder, source=source if bundled else folder / robot)


def _gains(recording: Recording, joints: Sequence[str]) -> dict[str, dict[str, float]]:
    """The keys `kp` and `kd` of a recording with commands; none of any other."""
    if recording.loop is None:
        return {}
    gains = (("kp", recording.loop.kp), ("kd", recording.loop.kd))
    return {key: dict(zip(joints, gain.tolist(), strict=True)) for key, gain in gains}


def _table(recording: Recording, joints: Sequence[str], torque: str) -> dict[str, np.ndarray]:
    """Columns of a recording's CSV file."""
    recorded = EFFORTS.get(torque, "tau"), recording.tau if recording.command is None else recording.command
    columns = {"t": recording.t}
    for kind, values in (("q", recording.q), ("dq", recording.dq), ("ddq", recording.ddq), recorded):
        columns |= {f"{kind}_{joint}": values[i] for i, joint in enumerate(joints)}
    columns = {name: values for name, values in columns.items() if name not in recording.computed}
    if np.ptp(recording.payload) > 0:
        columns["payload"] = recording.payload
    return columns

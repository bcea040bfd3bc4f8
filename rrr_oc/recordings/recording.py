"""Recordings of a robot's motion and torques: a folder with `recordings.json` and CSV files, read and written."""

import difflib
import itertools
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.sparse import csr_matrix

from rrr_oc.errors import UserError
from rrr_oc.numerics.savitzky_golay import LEAST_ROWS, differentiate, split
from rrr_oc.recordings import plausibility
from rrr_oc.recordings.csv_table import Table, read_table
from rrr_oc.recordings.header import FORMAT, Entry, Header, Spring, read_header, spring_json
from rrr_oc.robot.robot import BUNDLED, Robot, ToolPoint, load_robot
from rrr_oc.storage import new_folder

HEADER = "recordings.json"


@dataclass(frozen=True)
class Recording:
    """One motion of n joints in K samples.

    Attributes:
        file: Its CSV file, as listed: its name in reports.
        group: Label of the physical set-up.
        t: Time [s], strictly increasing, shape (K,).
        q, dq, ddq: Positions [rad], speeds [rad/s], accelerations [rad/s²], shape (n, K).
        tau: What was recorded, in the recorded unit: torque [Nm] or current [A], shape (n, K).
        payload: Mass at the tool [kg], shape (K,).
        springs: Springs believed to be mounted, each an effect with its parameters.
        segments: Slices of the samples that no filter or derivative may cross.
        computed: Names of the columns that the file lacks and Savitzky–Golay derivatives fill.
        dropped: Number of rows dropped for a NaN.
        short: Number of rows dropped because their segment is too short for a derivative that had to be computed.
        ignored: Columns of the file that mean nothing here.
        turned: Columns of positions that jumped by a turn and were made to go on.
        start: When the motion began [s]; None: with the first sample.
    """

    file: str
    group: str
    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray
    payload: np.ndarray
    springs: tuple[Spring, ...] = ()
    segments: tuple[slice, ...] = ()
    computed: tuple[str, ...] = ()
    dropped: int = 0
    short: int = 0
    ignored: tuple[str, ...] = ()
    turned: tuple[str, ...] = ()
    start: float | None = None

    @classmethod
    def planned(
        cls,
        name: str,
        t: np.ndarray,
        q: np.ndarray,
        dq: np.ndarray,
        ddq: np.ndarray,
        payload: float,
        springs: tuple[Spring, ...] = (),
        group: str | None = None,
    ) -> "Recording":
        """A motion that has not been recorded yet, without torque, with one payload [kg]."""
        return cls(name, group or name, t, q, dq, ddq, 0.0 * q, np.full(len(t), payload), springs, (slice(0, len(t)),))

    @property
    def clock(self) -> np.ndarray:
        """Time since the motion began [s], (K,)."""
        return self.t - (self.t[0] if self.start is None else self.start)

    @cached_property
    def filters(self) -> dict[tuple[str, float], csr_matrix]:
        """Filters made for this recording, as matrices, by their kind and window [s]."""
        return {}


@dataclass(frozen=True)
class RecordingSet:
    """Recordings of one robot.

    Attributes:
        robot: The chain of the joints recorded, under the set's gravity.
        source: Where the robot comes from: the name of a bundled model or the path of a URDF.
        torque: What `Recording.tau` holds: "motor" torque at the joint's output k_t I [Nm], "load" torque of Eq. 1 [Nm], or
            motor "current" [A].
        inertial: "nominal": the URDF's inertial parameters are trusted; "identify": only its kinematics are.
        tool: Where a payload is held.
        torque_constant: Per joint [Nm/A at the output]; None where it is not given.
        recordings: The recordings, in the order of the file.
        path: The folder.
    """

    robot: Robot
    source: str | Path
    torque: Literal["motor", "load", "current"]
    inertial: Literal["nominal", "identify"]
    tool: ToolPoint
    torque_constant: tuple[float | None, ...]
    recordings: tuple[Recording, ...]
    path: Path

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints recorded, base first."""
        return self.robot.joints

    @property
    def gravity(self) -> np.ndarray:
        """Acceleration of gravity in the base frame [m/s²], shape (3,)."""
        return self.robot.gravity

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that the set is read from."""
        robot = () if str(self.source) in BUNDLED else (Path(self.source),)
        return (self.path / HEADER, *robot, *(self.path / r.file for r in self.recordings))

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know of how the set was read, a sentence each."""
        notes: list[str] = []
        ignored: dict[tuple[str, ...], list[Recording]] = {}
        torn = [r for r in self.recordings if r.dropped + r.short]
        if torn:
            nan, short = sum(r.dropped for r in torn), sum(r.short for r in torn)
            rows = sum(len(r.t) for r in torn) + nan + short
            notes.append(
                f"{_named(torn)}: {nan + short} of {rows} rows are left out ({nan} with a NaN, {short} in pieces too short for a "
                "derivative)"
            )
        turned: dict[tuple[str, ...], list[Recording]] = {}
        for r in self.recordings:
            if r.turned:
                turned.setdefault(r.turned, []).append(r)
            if r.ignored:
                ignored.setdefault(r.ignored, []).append(r)
        for names, found in turned.items():
            notes.append(f"{_named(found)}: {', '.join(names)} jumped by a whole turn and is taken to go on")
        for names, found in ignored.items():
            locked = "; joints that are not listed are taken to stay at 0" * any(name.startswith("q_") for name in names)
            notes.append(f"{_named(found)}: column{'s' * (len(names) > 1)} {', '.join(names)} mean nothing here{locked}")
        same = self.tool.joint == self.robot.tool.joint and np.array_equal(self.tool.position, self.robot.tool.position)
        if same and any(np.any(r.payload > 0) for r in self.recordings):
            notes.append(
                f"the payload is held at the frame of link {self.robot.tool_link!r}, "
                f"{np.linalg.norm(self.tool.position):.3g} m from {self.joints[self.tool.joint]}; 'tool' says where else it may be"
            )
        return tuple(notes)

    def output_torque(self, recording: Recording) -> np.ndarray:
        """Recorded torque at the joints' output [Nm], shape (n, K): k_t I for currents."""
        if self.torque != "current":
            return recording.tau
        return np.array(self.torque_constant, float)[:, None] * recording.tau


def _named(some: Sequence[Recording]) -> str:
    return some[0].file if len(some) == 1 else f"{some[0].file} and {len(some) - 1} more"


def load_recordings(path: str | Path, robot: str | Path | None = None) -> RecordingSet:
    """Read a recording set.

    Args:
        path: The folder, or its `recordings.json`.
        robot: Bundled model or URDF that takes the place of the one in the file.

    Raises:
        UserError: Something is missing or wrong; the message names the file, the line or key, what was found and what is
            allowed.
    """
    path = Path(path)
    folder, file = (path.parent, path) if path.suffix == ".json" else (path, path / HEADER)
    if not file.is_file():
        raise UserError(f"{path}: no recording set; a folder with {HEADER} is required")
    header = read_header(file)
    source = robot if robot is not None else header.robot
    if robot is None and header.robot not in BUNDLED:
        source = folder / header.robot
    arm, tool = _robot(file, source, header)
    loaded = tuple(_recording(folder / entry.file, entry, header, arm) for entry in header.entries)
    return RecordingSet(arm, source, header.torque, header.inertial, tool, header.torque_constant, loaded, folder)  # pyright: ignore[reportArgumentType]


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
        "actuators": {
            joint: {"torque_constant": constant}
            for joint, constant in zip(robot.joints, recordings.torque_constant, strict=True)
            if constant is not None
        },
    }
    tables = {}
    entries = []
    for r in recordings.recordings:
        tables[r.file] = _table(r, robot.joints, recordings.torque)
        entry = {"file": r.file, "group": r.group, "springs": spring_json(r.springs, robot.joints)}
        entries.append(entry if "payload" in tables[r.file] else {**entry, "payload": float(r.payload[0])})
    write_set(folder, recordings.source, {**header, "recordings": entries}, tables)


def write_set(
    folder: str | Path, source: str | Path, header: Mapping[str, Any], tables: Mapping[str, Mapping[str, np.ndarray]]
) -> RecordingSet:
    """Write a new set from the content of `recordings.json` but for format and robot, and columns by file; read it again.

    A URDF is copied into the folder. Nothing is left behind where the set could not be read.
    """
    folder = Path(folder)
    bundled = str(source) in BUNDLED
    robot = str(source) if bundled else f"{Path(source).stem}.urdf"  # never a bundled name
    with new_folder(folder) as temporary:
        if not bundled:
            try:
                shutil.copyfile(source, temporary / robot)
            except OSError as error:
                raise UserError(
                    f"{source}: cannot be read: {error.strerror}; a URDF or one of {', '.join(BUNDLED)} is needed"
                ) from None
        content = {"format": FORMAT, "robot": robot, **header}
        (temporary / HEADER).write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        for file, columns in tables.items():
            (temporary / file).parent.mkdir(parents=True, exist_ok=True)
            _write_csv(temporary / file, columns)
        try:
            written = load_recordings(temporary)
        except UserError as error:
            raise UserError(str(error).replace(str(temporary), str(folder))) from None
    return replace(written, path=folder, source=source if bundled else folder / robot)


def _robot(file: Path, source: str | Path, header: Header) -> tuple[Robot, ToolPoint]:
    try:
        robot = load_robot(source, header.joints, header.inertial == "nominal", header.gravity)
        return robot, robot.tool if header.tool is None else robot.point(*header.tool)
    except UserError as error:
        raise UserError(f"{file}: {error}") from None
    except OSError as error:  # such as a name that is too long
        raise UserError(f"{file}: robot {str(source)!r} cannot be read: {error.strerror}") from None


def _recording(path: Path, entry: Entry, header: Header, robot: Robot) -> Recording:
    table = read_table(path)
    recorded = tuple(f"{'current' if header.torque == 'current' else 'tau'}_{joint}" for joint in robot.joints)
    used, ignored = _used_columns(table, robot.joints, recorded)
    values = table.columns(used)
    rows = _usable_rows(table, used, values)
    with np.errstate(all="ignore"):  # absurd numbers are looked for
        columns = dict(zip(used, values[:, rows], strict=True))
        plausibility.check_time(str(path), columns["t"])
        columns.setdefault("payload", np.full(len(rows), entry.payload))
        plausibility.check_magnitudes(str(path), columns)
        segments = split(columns["t"])
        turned = _unwrap(columns, robot.joints, segments)
        q, dq, ddq, computed = _motion(columns, robot.joints, segments)
        tau = np.array([columns[name] for name in recorded])
        result = Recording(
            entry.file, entry.group, columns["t"], q, dq, ddq, tau, columns["payload"], entry.springs, segments, computed,
            dropped=values.shape[1] - len(rows), ignored=ignored, turned=turned,
        )  # fmt: skip
        result = _without_short_segments(path, result)
        _check_units(path, result, robot, header, recorded)
    return result


def _used_columns(table: Table, joints: Sequence[str], recorded: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The columns to read and those that mean nothing; raises `UserError` for one missing or misspelt."""
    required = ("t", *(f"q_{joint}" for joint in joints), *recorded)
    optional = (*(f"{kind}_{joint}" for kind in ("dq", "ddq") for joint in joints), "payload")
    allowed = f"required are {', '.join(required)}; allowed are {', '.join(optional)}"
    for name in required:
        if name not in table.names:
            found = ", ".join(table.names)
            raise UserError(
                f"{table.path}, line {table.header_line}: column {name!r} is missing; found {found[:300]}; {allowed}"
            )
    ignored = tuple(name for name in table.names if name not in required and name not in optional)
    absent = [name for name in optional if name not in table.names]
    for name in ignored:
        close = difflib.get_close_matches(name, absent, 1, 0.85)
        if close and not name.startswith(("q_", "dq_", "ddq_", "tau_", "current_")):  # those belong to joints not recorded
            raise UserError(f"{table.path}, line {table.header_line}: unknown column {name!r}; is it {close[0]!r}? {allowed}")
    return (*required, *(name for name in optional if name in table.names)), ignored


def _usable_rows(table: Table, used: Sequence[str], values: np.ndarray) -> np.ndarray:
    """Indices of the rows without a NaN; raises `UserError` where what is left is no motion."""
    if values.shape[1] == 0:
        raise UserError(f"{table.path}: a header and no rows; at least {LEAST_ROWS} rows are required")
    infinite = np.argwhere(np.isinf(values).T)
    if len(infinite):
        row, column = map(int, infinite[0])
        raise _wrong_cell(table, row, used[column], "an infinite value", "numbers or nan are allowed")
    rows = np.flatnonzero(~np.isnan(values).any(axis=0))
    if len(rows) < LEAST_ROWS:
        total = values.shape[1]
        raise UserError(f"{table.path}: {len(rows)} of {total} rows are without a NaN; at least {LEAST_ROWS} are required")
    t = values[used.index("t"), rows]
    back = np.flatnonzero(t[1:] <= t[:-1])
    if len(back):
        before, now = t[back[0] : back[0] + 2].tolist()
        found = f"{now!r} s {'again' if now == before else f'after {before!r} s'}"
        raise _wrong_cell(table, int(rows[back[0] + 1]), "t", found, "time must increase from row to row")
    if "payload" in used:
        payload = values[used.index("payload"), rows]
        if payload.min() < 0:
            i = int(np.argmax(payload < 0))
            raise _wrong_cell(table, int(rows[i]), "payload", f"{payload[i]:g}", "0 kg or more is allowed")
    return rows


def _wrong_cell(table: Table, row: int, column: str, found: str, allowed: str) -> UserError:
    return UserError(f"{table.path}, line {table.line(row)}, column {column!r}: found {found}; {allowed}")


def _unwrap(columns: dict[str, np.ndarray], joints: Sequence[str], segments: Sequence[slice]) -> tuple[str, ...]:
    """Make positions go on that jump by a turn from one sample to the next; the names of these columns."""
    names = [f"q_{joint}" for joint in joints]
    turned = [name for name in names if any(np.any(np.abs(np.diff(columns[name][s])) > np.pi) for s in segments)]
    for name in turned:
        columns[name] = np.unwrap(columns[name])
    return tuple(turned)


def _motion(
    columns: Mapping[str, np.ndarray], joints: Sequence[str], segments: tuple[slice, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[str, ...]]:
    """q, dq, ddq (n, K) and the names of those computed; ddq comes from a measured dq where there is one."""
    t, names = columns["t"], {kind: [f"{kind}_{joint}" for joint in joints] for kind in ("q", "dq", "ddq")}
    q = np.array([columns[name] for name in names["q"]])
    dq, ddq = (np.array([columns.get(name, np.zeros_like(t)) for name in names[kind]]) for kind in ("dq", "ddq"))
    no_speed, no_acceleration = (np.array([name not in columns for name in names[kind]]) for kind in ("dq", "ddq"))
    from_q, from_dq = no_acceleration & no_speed, no_acceleration & ~no_speed
    dq[no_speed] = differentiate(t, q[no_speed], segments)
    ddq[from_dq] = differentiate(t, dq[from_dq], segments)
    ddq[from_q] = differentiate(t, q[from_q], segments, derivative=2)
    return q, dq, ddq, tuple(name for name in (*names["dq"], *names["ddq"]) if name not in columns)


def _without_short_segments(path: Path, recording: Recording) -> Recording:
    """Drop the segments in which a derivative is wanted and cannot be computed; raises `UserError` where none is left."""
    if not recording.computed:
        return recording
    kept = [s for s in recording.segments if s.stop - s.start >= LEAST_ROWS]
    if not kept:
        raise UserError(
            f"{path}: gaps in 't' leave no segment of {LEAST_ROWS} rows, of which derivatives could be computed; "
            "give dq and ddq or longer pieces"
        )
    rows = np.concatenate([np.arange(s.start, s.stop) for s in kept])
    ends = np.cumsum([s.stop - s.start for s in kept]).tolist()
    arrays = {name: getattr(recording, name)[..., rows] for name in ("t", "q", "dq", "ddq", "tau", "payload")}
    for name in ("dq", "ddq"):
        if not np.all(np.isfinite(arrays[name])):
            raise UserError(
                f"{path}: {name} computed from the file is not finite; positions are too large or times too close together"
            )
    segments = tuple(slice(a, b) for a, b in itertools.pairwise([0, *ends]))
    return replace(recording, **arrays, segments=segments, short=len(recording.t) - len(rows))


def _check_units(path: Path, recording: Recording, robot: Robot, header: Header, recorded: tuple[str, ...]) -> None:
    where, r = str(path), recording
    plausibility.check_positions(where, robot, r.q)
    for i, joint in enumerate(robot.joints):
        names = [f"{kind}_{joint}" for kind in ("q", "dq", "ddq")]
        pairs = ((names[0], r.q[i]), (names[1], r.dq[i])), ((names[1], r.dq[i]), (names[2], r.ddq[i]))
        for value, rate in pairs:
            if rate[0] not in r.computed and value[0] not in r.computed:
                plausibility.check_derivative(where, r.t, r.segments, value, rate)
    if all(f"dq_{joint}" in r.computed for joint in robot.joints):
        plausibility.check_slowness(where, r.t, r.q, r.dq)
    unit = "A" if header.torque == "current" else "Nm"
    constants = np.array(header.torque_constant, float) if unit == "A" else np.ones(robot.n)
    plausibility.check_torques(where, robot, constants[:, None] * r.tau, recorded, unit)


def _table(recording: Recording, joints: Sequence[str], torque: str) -> dict[str, np.ndarray]:
    """Columns of a recording's CSV file."""
    recorded = "current" if torque == "current" else "tau"
    columns = {"t": recording.t}
    for kind, values in (("q", recording.q), ("dq", recording.dq), ("ddq", recording.ddq), (recorded, recording.tau)):
        columns |= {f"{kind}_{joint}": values[i] for i, joint in enumerate(joints)}
    columns = {name: values for name, values in columns.items() if name not in recording.computed}
    if np.ptp(recording.payload) > 0:
        columns["payload"] = recording.payload
    return columns


def _write_csv(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write columns; `repr` of a float is the shortest text that reads back as the same number."""
    rows = np.column_stack(list(columns.values())).tolist()
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join(columns) + "\n")
        file.writelines(",".join(map(repr, row)) + "\n" for row in rows)

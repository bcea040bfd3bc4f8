"""Data sets of LeRobot, versions 2 and 3, in a folder of this machine, turned into a recording set: one recording an episode."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.recordings.header import Gain
from rrr_oc.recordings.importers.column_mapping import UNITS, Column, ColumnMapping, understood
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.recordings.writer import write_set
from rrr_oc.robot.robot import load_robot
from rrr_oc.schema import check_names, read_json, read_toml, validated

INFO, DATA = "meta/info.json", "data/chunk-*/*.parquet"  # both versions: one file an episode, or several episodes a file
VERSIONS = re.compile(r"v?[23]\.")
TIME, EPISODE, FRAME, STATE = "timestamp", "episode_index", "frame_index", "observation.state"
EFFORT = re.compile(r"torque|effort|current|load", re.IGNORECASE)  # in the name of a column of torques, currents or loads
ACTION = "action"  # the feature of commands, or what its name begins with
# What a column's name ends with, or its feature's where it is that of a joint alone, by the set's column
WORDS = {
    "q": ("pos", "position"),
    "dq": ("vel", "velocity"),
    "tau": ("torque", "effort"),
    "current": ("current", "load"),
    "command": ("pos", "position"),
}


@dataclass(frozen=True)
class Efforts:
    """How torques are made of what a data set has in their place; beside what a mapping says of it.

    Attributes:
        torque_constant: By joint, Nm per unit of its column of currents or loads.
        kp, kd: Of the loop that follows the commands (`action`), a number or one per joint by name [Nm/rad, Nm s/rad]; with both,
            commands are read.
    """

    torque_constant: Mapping[str, float] = field(default_factory=dict)
    kp: Gain | None = None
    kd: Gain | None = None

    @property
    def of_commands(self) -> bool:
        """Whether torques are those of a loop; raises `UserError` for half of its gains."""
        if (self.kp is None) != (self.kd is None):
            given, missing = ("kp", "kd") if self.kd is None else ("kd", "kp")
            raise UserError(f"--{given} is given and --{missing} is not; a loop that follows commands needs both")
        return self.kp is not None


class Feature(msgspec.Struct, frozen=True):
    """A feature of `meta/info.json`: its numbers a frame, and their names, as a list or by a word such as "motors"."""

    dtype: str
    shape: tuple[int, ...]
    names: Any = None


class Info(msgspec.Struct, frozen=True):
    """Of `meta/info.json` what is read."""

    codebase_version: str
    features: dict[str, Feature]


NOTHING_MORE = Efforts()


def import_lerobot(
    folder: str | Path,
    robot: str | Path,
    out: str | Path,
    mapping: str | Path | None = None,
    unit: str = "rad",
    efforts: Efforts = NOTHING_MORE,
) -> RecordingSet:
    """Write the episodes of a data set, each one recording, of a robot (bundled model, URDF or MJCF) as a new set in the folder `out`.

    A column is a number of a feature: `observation.state.shoulder` where the feature names its numbers, `observation.state.0` where
    it does not, `timestamp` where there is one alone. Commands (`action`) are read where `efforts` has the gains of the loop
    that follows them, or the mapping; pictures are not.

    Args:
        mapping: TOML file as `ColumnMapping` describes it; without `t`, time is `timestamp`. Default: columns whose names are those
            of joints, alone or with a word such as `.pos`, `.vel`, `.torque` or `.current`.
        unit: Of positions, and per second of speeds, where there is no mapping: a unit of positions of `UNITS`.
        efforts: What torques are made of.

    Raises:
        UserError: The packages for Parquet are missing; the folder holds no such data set, or one without torques, currents and gains; the
            mapping is wrong (`understood`), or there is none and a joint's columns are not found; `out` exists.
    """
    folder = Path(folder)
    info = _info(folder)
    columns = _columns(info.features)
    given = None if mapping is None else validated(mapping, read_toml(mapping), ColumnMapping)
    mapped = () if given is None else given.columns
    named = any(EFFORT.search(name) and not name.startswith(ACTION) for name in columns)
    if not named and not efforts.of_commands and not any(name.startswith(("tau_", "current_", "command_")) for name in mapped):
        raise UserError(
            f"{folder}: no feature is named as torques or currents, without which an arm cannot be calibrated (--map says which "
            f"column holds them if one does; --kp and --kd make torques of the commands); there are {', '.join(info.features)}"
        )
    if given is None:
        joints = load_robot(robot).joints
        where, chosen = f"{folder / INFO}", _by_names(folder, columns, joints, unit, efforts.of_commands)
    else:
        time = {} if given.rate_Hz is not None else {"t": TIME}
        where, chosen = str(mapping), msgspec.structs.replace(given, columns={**time, **given.columns})
    chosen = _with_efforts(folder, chosen, efforts)
    known = understood(where, chosen, robot)
    wanted = {source.column for source, _ in known.sources.values()} & columns.keys()
    tables = {}
    for number, episode in _episodes(folder, {columns[name][0] for name in wanted}).items():
        cells = {name: _numbers(folder, episode, *columns[name]) for name in wanted}
        named = known.columns(f"{folder / INFO}", tuple(columns), lambda names, cells=cells: [cells[name] for name in names])
        tables[f"episode_{number:06d}.csv"] = named
    return write_set(out, robot, {**known.header, "recordings": [{"file": name} for name in tables]}, tables)


def _info(folder: Path) -> Info:
    if not (folder / INFO).is_file():
        raise UserError(f"{folder}: no data set of LeRobot; a folder with {INFO} is required")
    info = read_json(folder / INFO, Info)
    if not VERSIONS.match(info.codebase_version):
        raise UserError(f"{folder / INFO}: codebase_version: found {info.codebase_version!r}; versions 2 and 3 can be read")
    return info


def _columns(features: Mapping[str, Feature]) -> dict[str, tuple[str, int]]:
    """By name of a column, its feature and its place in it; pictures and text are left out."""
    found = {}
    for name, feature in features.items():
        if not feature.dtype.startswith(("float", "int", "uint")) or len(feature.shape) != 1:
            continue
        names = feature.names
        if isinstance(names, dict):  # as {"motors": [...]}
            names = next((value for value in names.values() if isinstance(value, list)), None)
        size = feature.shape[0]
        if names is None and size == 1:
            found[name] = name, 0
            continue
        if not isinstance(names, list) or len(names) != size or max(Counter(map(str, names)).values(), default=1) > 1:
            names = range(size)
        found |= {f"{name}.{one}": (name, i) for i, one in enumerate(names)}
    return found


def _by_names(
    folder: Path, columns: Mapping[str, tuple[str, int]], joints: Sequence[str], unit: str, commands: bool
) -> ColumnMapping:
    """The mapping that columns' names tell; raises `UserError` where a joint has no position, or no torque, current or command."""
    check_names([unit], UNITS["position"], "--unit", "unit of positions")
    units = {"q": unit, "dq": f"{unit}/s", "command": unit}
    check_names([units["dq"]], UNITS["speed"], "--unit", "unit of speeds")
    found = {kind: [_column(columns, joint, kind) for joint in joints] for kind in WORDS}
    effort = "command" if commands else "tau" if all(found["tau"]) else "current"
    for kind, what in (("q", "position"), (effort, "command" if commands else "torque or current")):
        if None in found[kind]:
            joint = joints[found[kind].index(None)]
            there = ", ".join(
                name for name, (feature, _) in columns.items() if feature.startswith(ACTION) == (kind == "command")
            )
            raise UserError(
                f"{folder}: no column is by its name the {what} of joint {joint!r}; --map says which it is; there are {there or 'none'}"
            )
    kinds = ["q", *(["dq"] if all(found["dq"]) else []), effort]
    named: dict[str, str | Column] = {"t": TIME}
    for kind in kinds:
        named |= {f"{kind}_{j}": Column(str(name), units.get(kind)) for j, name in zip(joints, found[kind], strict=True)}
    return ColumnMapping(named, joints=tuple(joints), torque="motor" if effort == "tau" else effort)


def _with_efforts(folder: Path, mapping: ColumnMapping, efforts: Efforts) -> ColumnMapping:
    """The mapping with what torques are made of; raises `UserError` where currents or loads lack a constant."""
    if efforts.of_commands:
        return msgspec.structs.replace(mapping, torque="command", kp=efforts.kp, kd=efforts.kd)
    every = {**mapping.torque_constant, **efforts.torque_constant}
    joints = [name.removeprefix("current_") for name in mapping.columns if name.startswith("current_")]
    missing = [joint for joint in joints if joint not in every]
    if missing:
        raise UserError(
            f"{folder}: has currents or loads and no torques; --torque-constant JOINT=NUMBER is required for "
            f"{', '.join(missing)}: Nm at the joint's output per unit of its column"
        )
    return msgspec.structs.replace(mapping, torque_constant=every)


def _column(columns: Mapping[str, tuple[str, int]], joint: str, kind: str) -> str | None:
    """The column of a joint that its name tells, if there is one."""
    for name, (feature, _) in columns.items():
        own, last = name.removeprefix(f"{feature}."), feature.rsplit(".", 1)[-1]
        if feature.startswith(ACTION) != (kind == "command"):
            continue
        of_feature = (kind, feature) in (("q", STATE), ("command", ACTION)) or last in WORDS[kind]
        if (own == joint and of_feature) or own in {f"{joint}{mark}{word}" for word in WORDS[kind] for mark in "._"}:
            return name
    return None


def _episodes(folder: Path, features: set[str]) -> dict[int, dict[str, Any]]:
    """By number of the episode, the columns of its features, sorted by frame."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise UserError("reading data sets of LeRobot needs one more package: pip install pyarrow") from None
    files = sorted(folder.glob(DATA))
    if not files:
        raise UserError(f"{folder}: no data; files like {DATA} are required")
    parts = []
    for file in files:
        wanted = [EPISODE, FRAME, *sorted(features - {EPISODE, FRAME})]
        try:
            there = parquet.read_schema(file).names
            if missing := [name for name in wanted if name not in there]:
                raise UserError(f"{file}: no column {missing[0]!r}, which {INFO} lists; there are {', '.join(there)}")
            parts.append(parquet.read_table(file, columns=wanted))
        except (pa.ArrowException, OSError) as error:
            raise UserError(f"{file}: no readable Parquet file: {str(error).splitlines()[0]}") from None
    table = pa.concat_tables(parts, promote_options="permissive").sort_by([(EPISODE, "ascending"), (FRAME, "ascending")])
    numbers, starts, counts = np.unique(table[EPISODE].to_numpy(), return_index=True, return_counts=True)
    return {
        int(number): {name: table[name].slice(start, count).combine_chunks() for name in features}
        for number, start, count in zip(numbers, starts.tolist(), counts.tolist(), strict=True)
    }


def _numbers(folder: Path, episode: Mapping[str, Any], feature: str, place: int) -> np.ndarray:
    """The numbers at one place of a feature along an episode (K,)."""
    values = episode[feature]
    flat = values.flatten() if hasattr(values, "flatten") else values
    numbers = np.asarray(flat.to_numpy(zero_copy_only=False), float)
    if len(numbers) % len(values) or place >= len(numbers) // len(values):
        raise UserError(f"{folder}: {feature}: {len(numbers)} numbers in {len(values)} frames; as many in each are required")
    return numbers.reshape(len(values), -1)[:, place]

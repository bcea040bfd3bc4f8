"""Columns and units of one's own, turned into those of a recording set by a mapping in a TOML file."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from msgspec import field

from rrr_oc.errors import UserError
from rrr_oc.recordings.header import EFFORTS, Gain, Torque, check_gains
from rrr_oc.recordings.writer import constants
from rrr_oc.robot.robot import load_robot
from rrr_oc.schema import Payload, Schema, Text, check_names, spellings

MOST_BITS = 31  # of counts with a sign
ONE_SIGN = 0.02  # share of counts with and without it from which they have two signs; doubled, motions to one side are missed
TURN = 2 * math.pi  # [rad] of a revolution
# Units of one's own that are read, by quantity, the SI unit first, each with its size in that unit
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0},
    "position": {"rad": 1.0, "mrad": 1e-3, "deg": TURN / 360, "°": TURN / 360, "rev": TURN, "turn": TURN},
    "speed": {
        "rad/s": 1.0, "mrad/s": 1e-3, "deg/s": TURN / 360, "°/s": TURN / 360, "rev/s": TURN, "rpm": TURN / 60, "rev/min": TURN / 60
    },
    "acceleration": {
        "rad/s²": 1.0, "rad/s^2": 1.0, "deg/s²": TURN / 360, "deg/s^2": TURN / 360, "rev/s²": TURN, "rev/s^2": TURN, "rpm/s": TURN / 60
    },
    "torque": {"Nm": 1.0, "kNm": 1e3, "Ncm": 1e-2, "Nmm": 1e-3, "mNm": 1e-3},
    "current": {"A": 1.0, "mA": 1e-3, "raw": 1.0},  # raw: counts of a drive, such as of its load; their constant is Nm a count
    "mass": {"kg": 1.0, "g": 1e-3},
}  # fmt: skip
QUANTITIES = {  # by what a column's name begins with
    "t": "time",
    "q": "position",
    "dq": "speed",
    "ddq": "acceleration",
    "tau": "torque",
    "current": "current",
    "command": "position",
    "payload": "mass",
}


def looks_signed(counts: np.ndarray) -> bool:
    """Whether counts (K,) are sizes below 1024 of which some have bit 10 as a sign: on either side of 1024, and none just below."""
    inside = counts.size > 0 and bool(np.all((counts >= 0) & (counts < 2048) & (counts % 1 == 0)))
    if not inside:
        return False
    negative = counts >= 1024
    sizes = counts % 1024
    several = ONE_SIGN < np.mean(negative) < 1 - ONE_SIGN
    return bool(several and sizes.max() < 1000 and np.min(counts[negative]) - np.max(counts[~negative]) > 0)


class Column(Schema, frozen=True):
    """Where a column of the set comes from: its value is factor (cell − zero), in the unit given.

    Attributes:
        column: Name of the column in your files.
        unit: Unit of its cells; by default the SI unit.
        factor: Multiplies the cells, such as -1 for a joint that turns the other way, or 1/gear ratio for an angle of the motor.
        zero: What your column reads where the URDF has zero, in the unit of the cells.
        sign_bit: Number of the bit that is set where a count is below 0, the others being its size; 10 of the loads of many serial servos.
            0 where there is none. Default: 0, and counts that look so are refused.
    """

    column: Text
    unit: Text | None = None
    factor: float = 1.0
    zero: float = 0.0
    sign_bit: int | None = None

    def __post_init__(self) -> None:
        if self.sign_bit is not None and not 0 <= self.sign_bit <= MOST_BITS:
            raise ValueError(f"sign_bit: found {self.sign_bit}; 0 (none) to {MOST_BITS} is allowed")
        if not 0 < abs(self.factor) < math.inf:
            raise ValueError(f"factor: found {self.factor:g}; a finite number other than 0 is required")
        if not math.isfinite(self.zero):
            raise ValueError(f"zero: found {self.zero:g}; a finite number is required")

    def signed(self, where: str, cells: np.ndarray) -> np.ndarray:
        """The cells (K,) as numbers of either sign.

        Raises `UserError` for counts in whose place a sign and a size may stand, where nothing says so, and cells that are none with a sign.
        """
        known = cells[np.isfinite(cells)]
        if self.sign_bit is None and self.unit == "raw" and looks_signed(known):
            raise UserError(
                f"{where}: column {self.column!r} has counts from 0 to {known.max():g}, and none from {known[known < 1024].max():g} to 1024: "
                "bit 10 looks like their sign; sign_bit = 10 reads them so, and sign_bit = 0 as they are"
            )
        if not self.sign_bit:
            return cells
        most = 2 ** (self.sign_bit + 1)
        if np.any((known < 0) | (known >= most) | (known % 1 != 0)):
            counts = f"counts from 0 to {most - 1}, of which bit {self.sign_bit} may be a sign"
            raise UserError(f"{where}: column {self.column!r} has other cells than {counts}")
        size = cells % (most // 2)
        return np.where(cells >= most // 2, -size, size)


class ColumnMapping(Schema, frozen=True):
    """How the columns of other files are to be understood.

    Attributes:
        columns: By name of the set's column, yours: its name alone where the unit is SI's, else with its unit.
        joints: Joints recorded, in the order of the chain; by default all of the robot's.
        torque: What the effort columns hold: motor or load torque, current, or "command": angles that a PD loop follows.
        inertial: Whether the URDF's masses and inertias are used ("nominal") or estimated ("identify").
        torque_constant: By joint, for currents, or for the counts of a drive, then Nm a count [Nm/A].
        rate_Hz: Samples a second, in place of a column of times [Hz].
        kp: Of that loop, a number or one per joint by name [Nm/rad].
        kd: As `kp` [Nm s/rad].
    """

    columns: dict[str, str | Column]
    joints: tuple[Text, ...] | None = None
    torque: Torque = "motor"
    inertial: Literal["nominal", "identify"] = "nominal"
    torque_constant: dict[str, float] = field(default_factory=dict)
    rate_Hz: float | None = None
    kp: Gain | None = None
    kd: Gain | None = None

    def __post_init__(self) -> None:
        for joint, constant in self.torque_constant.items():
            if not math.isfinite(constant):
                raise ValueError(f"torque_constant: found {constant:g} for {joint!r}; a finite number of Nm/A is required")
        if self.rate_Hz is not None and self.rate_Hz <= 0:
            raise ValueError(f"rate_Hz: found {self.rate_Hz:g}; a finite number above 0 is required")
        if self.rate_Hz is not None and "t" in self.columns:
            raise ValueError("found both rate_Hz and a column for t; one of them is allowed")


@dataclass(frozen=True)
class Understood:
    """A mapping for a robot.

    Attributes:
        where: The mapping's file, or what else it comes from, for messages.
        sources: Source and size of its unit in SI's, by column of the set.
        header: Content of `recordings.json` that follows.
        rate: Samples a second [Hz]; None where a column has the times.
    """

    where: str
    sources: Mapping[str, tuple[Column, float]]
    header: Mapping[str, Any]
    rate: float | None = None

    def columns(
        self, file: str, names: Sequence[str], values: Callable[[Sequence[str]], Sequence[np.ndarray]]
    ) -> dict[str, np.ndarray]:
        """Columns (K,) of a recording in SI units, by the set's names; time counts from the first instant.

        Args:
            file: The file, for messages.
            names: Its columns.
            values: Gives the cells of some of them, each (K,).

        Raises `UserError` where the file lacks a column that the mapping names, or numbers in it.
        """
        for name, (source, _) in self.sources.items():
            if source.column not in names:
                there = ", ".join(names)
                raise UserError(
                    f"{file}: no column {source.column!r}, which {self.where} takes for {name!r}; there are {there}"
                )
        cells = values([source.column for source, _ in self.sources.values()])
        for (name, (source, _)), row in zip(self.sources.items(), cells, strict=True):
            if len(row) and np.isnan(row).all():
                raise UserError(f"{file}: column {source.column!r}, which {self.where} takes for {name!r}, holds no number")
        columns = {
            name: source.factor * size * (source.signed(file, row) - source.zero)
            for (name, (source, size)), row in zip(self.sources.items(), cells, strict=True)
        }
        if self.rate is not None:
            return {"t": np.arange(len(cells[0])) / self.rate, **columns}
        source, size = self.sources["t"]
        columns["t"] = source.factor * size * _from_the_first(cells[list(self.sources).index("t")])
        return columns


def understood(where: str | Path, mapping: ColumnMapping, robot: str | Path) -> Understood:
    """A mapping for a robot (bundled model, URDF or MJCF).

    Raises `UserError` where the mapping names a column of the set, a unit or a joint that there is not, or leaves out one that is
    required.
    """
    joints = load_robot(robot, mapping.joints, mapping.inertial == "nominal").joints
    sources = _sources(where, mapping, joints)
    check_names(mapping.torque_constant, joints, f"{where}: torque_constant", "joint")
    header = {
        "joints": list(joints),
        "torque": mapping.torque,
        "inertial": mapping.inertial,
        "actuators": constants(mapping.torque_constant),
        **{key: gain for key, gain in (("kp", mapping.kp), ("kd", mapping.kd)) if gain is not None},
    }
    try:
        check_gains(mapping.kp, mapping.kd, joints)
    except ValueError as error:
        raise UserError(f"{where}: {error}") from None
    return Understood(str(where), sources, header, mapping.rate_Hz)


def _sources(path: str | Path, mapping: ColumnMapping, joints: Sequence[str]) -> dict[str, tuple[Column, float]]:
    """Source and size of its unit in SI's, by column of the set; raises `UserError` for a mapping that makes no set."""
    effort = EFFORTS.get(mapping.torque, "tau")
    required = [*(["t"] if mapping.rate_Hz is None else []), *(f"{kind}_{joint}" for kind in ("q", effort) for joint in joints)]
    optional = [*(f"{kind}_{joint}" for kind in ("dq", "ddq") for joint in joints), *spellings(Payload)]
    check_names(mapping.columns, [*required, *optional], f"{path}: columns", "column of a set")
    missing = [name for name in required if name not in mapping.columns]
    if missing:
        instead = " (or rate_Hz in its place)" if missing[0] == "t" else ""
        raise UserError(f"{path}: columns: {missing[0]!r} is missing{instead}; required are {', '.join(required)}")
    found = {}
    for name, given in mapping.columns.items():
        source = Column(given) if isinstance(given, str) else given
        found[name] = source, _size(f"{path}: columns.{name}.unit", source.unit, QUANTITIES[name.split("_")[0]])
    return found


def _size(where: str, unit: str | None, quantity: str) -> float:
    """Size of a unit of a quantity in SI's; raises `UserError` that lists the units known."""
    known = UNITS[quantity]
    if unit is None:
        return 1.0
    if unit not in known:
        other = next((name for name, units in UNITS.items() if unit in units), None)
        found = f"{unit!r} is a unit of {other}" if other else f"unit {unit!r} is not known"
        raise UserError(f"{where}: {found}; units of {quantity} are {', '.join(known)}")
    return known[unit]


def _from_the_first(times: np.ndarray) -> np.ndarray:
    """Times less the first that is a number, before a unit scales them: stamps since 1970 are not rounded once more."""
    known = times[np.isfinite(times)]
    return times - known[0] if known.size else times

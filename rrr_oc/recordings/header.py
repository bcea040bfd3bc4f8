"""`recordings.json`: what a recording set says about itself, read and checked key by key."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, field

from rrr_oc.effects import Effect
from rrr_oc.schema import LARGEST, Payload, Position, Schema, Text, Vector, check_names, parsed, validated, without_free_text
from rrr_oc.storage import read_utf8

HEADER = "recordings.json"
FORMAT = "rrr_oc-recordings/1"

Spring = tuple[Effect, dict[str, float]]
Torque = Literal["motor", "load", "current", "command"]  # what may be recorded
Gain = float | dict[str, float]  # of a loop: of all joints, or by joint
EFFORTS = {"current": "current", "command": "command"}  # by what is recorded, what its columns' names begin with; else "tau"
UNIT_OF = {"current": "A", "command": "rad"}  # of these columns; else Nm


@dataclass(frozen=True, eq=False)
class Loop:
    """A PD loop at each joint: torque = kp (q_d − q) − kd dq, with commanded angles q_d.

    Attributes:
        kp: [Nm/rad], above 0, (n,).
        kd: [Nm s/rad], 0 or above, (n,).
    """

    kp: np.ndarray
    kd: np.ndarray

    def torque(self, command: np.ndarray, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """What the loop gives [Nm], (n, K), for commanded and measured positions [rad] and speeds [rad/s], each (n, K)."""
        return self.kp[:, None] * (command - q) - self.braking(dq)

    def braking(self, dq: np.ndarray) -> np.ndarray:
        """Its torque against the motion, kd dq [Nm], (n, K), for speeds (n, K) [rad/s]."""
        return self.kd[:, None] * dq


class ToolOnLink(Schema, frozen=True):
    """Where a payload is held.

    Attributes:
        link: Name of the link that carries it.
        position: The point in the link's frame [m].
    """

    link: Text
    position: Position


class Actuator(Schema, frozen=True):
    """A joint's drive.

    Attributes:
        torque_constant: Motor torque at the joint's output by current, not 0; required where `torque` is "current" [Nm/A].
    """

    torque_constant: float | None = None

    def __post_init__(self) -> None:
        if self.torque_constant == 0:
            raise ValueError("torque_constant: found 0; a number of Nm/A other than 0 is required")


class RecordingEntry(Schema, frozen=True):
    """One recording as it is listed.

    Attributes:
        file: The CSV file, within the set's own folder.
        group: Name of a set-up; recordings of one group share what is estimated per set-up; by default the file's name.
        payload: Mass at the tool; a CSV column of that name takes its place [kg].
        springs: Springs that are mounted, by kind.
        kp, kd: Gains of the loop in this recording, in place of the set's, where `torque` is "command" [Nm/rad], [Nm s/rad].
    """

    file: Text
    group: Text | None = None
    payload: Payload = 0.0
    springs: dict[str, Any] = field(default_factory=dict)
    kp: Gain | None = None
    kd: Gain | None = None

    def __post_init__(self) -> None:
        if PurePosixPath(self.file).is_absolute() or ".." in PurePosixPath(self.file).parts:
            raise ValueError(f"file: found {self.file!r}; a recording must lie in the set's own folder")


class Coupling(Schema, frozen=True):
    """Columns that are sums of joints: an angle counted from an earlier link than the one before, motors that act through a parallelogram.

    Attributes:
        q: Joint angles = q (columns of positions), and their rates likewise: a row for each joint. Default: as the columns are.
        tau: Joint torques = tau (columns of torques), of currents times their constants: a row for each joint. Default: as they are.
    """

    q: tuple[tuple[float, ...], ...] | None = None
    tau: tuple[tuple[float, ...], ...] | None = None


class Header(Schema, frozen=True):
    """The content of `recordings.json`.

    Attributes:
        format: What the file is.
        robot: A bundled model or the path of a URDF or MJCF, relative to this file.
        joints: The recorded joints, in the order of the chain; all others are held still.
        recordings: The recordings.
        torque: What the effort columns hold: motor or load torque [Nm], current [A] with a `torque_constant` in `actuators`, or
            "command": commanded angles q_d [rad] of a loop that gives kp (q_d − q) − kd dq.
        inertial: Whether the URDF's masses and inertias are about right ("nominal") or unknown ("identify").
        gravity: Acceleration of gravity in the base frame [m/s²]. Default: the MJCF's; of a URDF [0, 0, -9.81].
        tool: Where a payload is held; by default the last link's tool frame, or twice as far as its centre of mass where it has none.
        actuators: Drives by joint.
        fixed_deg: Angles of joints that are not recorded [°]; 0 for those left out, or the middle of a range that lacks 0.
        coupling: Columns that are sums of joints, where they are.
        kp: Of the loop where `torque` is "command", above 0: a number, or one per joint by name [Nm/rad]. One that is not known (null, or
            left out) follows from the masses of the robot's file.
        kd: As `kp`, 0 or above [Nm s/rad]. One that is not known is a part of viscous friction.
    """

    format: Literal["rrr_oc-recordings/1"]
    robot: Text
    joints: Annotated[tuple[Text, ...], Meta(min_length=1)]
    recordings: Annotated[tuple[RecordingEntry, ...], Meta(min_length=1)]
    torque: Torque = "motor"
    inertial: Literal["nominal", "identify"] = "nominal"
    gravity: Vector | None = None
    tool: ToolOnLink | None = None
    actuators: dict[str, Actuator] = field(default_factory=dict)
    fixed_deg: dict[str, float] = field(default_factory=dict)
    coupling: Coupling | None = None
    kp: Gain | None = None
    kd: Gain | None = None

    def __post_init__(self) -> None:
        if len(set(self.joints)) != len(self.joints):
            raise ValueError(f"joints: found {', '.join(self.joints)}; each joint may stand once")
        files = [PurePosixPath(entry.file) for entry in self.recordings]
        for i, file in enumerate(files):
            if file in files[:i]:
                raise ValueError(f"recordings[{i}].file: {str(file)!r} stands twice; each file may stand once")
        missing = [joint for joint, k in zip(self.joints, self.torque_constant, strict=True) if k is None]
        if self.torque == "current" and missing:
            raise ValueError(
                f"actuators: no torque_constant [Nm/A] of {', '.join(missing)}; torque 'current' needs one per joint"
            )
        for i, entry in enumerate(self.recordings):
            if self.torque != "command" and (entry.kp is not None or entry.kd is not None):
                raise ValueError(f"recordings[{i}]: has gains of a loop; torque {self.torque!r} has none")
            check_gains(*self._gains(entry), self.joints)
        if self.coupling is not None and self.torque == "command":
            raise ValueError("coupling: is for torques and currents that are recorded; with torque 'command' there is none")
        for kind in ("q", "tau") if self.coupling is not None else ():
            matrix, n = getattr(self.coupling, kind), len(self.joints)
            if matrix is not None and ([len(row) for row in matrix] != [n] * n or np.linalg.matrix_rank(matrix) < n):
                raise ValueError(
                    f"coupling.{kind}: {n} rows of {n} numbers are required, one for each joint, that can be inverted"
                )

    def coupled(self, kind: Literal["q", "tau"]) -> np.ndarray | None:
        """Joints' angles, or what is recorded of their torques, by columns, (n, n); None where they are as the columns are."""
        matrix = None if self.coupling is None else getattr(self.coupling, kind)
        if matrix is None:
            return None
        constant = np.array(self.torque_constant if kind == "tau" and self.torque == "current" else np.ones(len(matrix)), float)
        return np.array(matrix, float) * constant / constant[:, None]

    def loop(self, entry: RecordingEntry) -> Loop | None:
        """The loop that follows the commands of a recording, with NaN for a kp that is not known; None where torques or currents are
        recorded."""
        if self.torque != "command":
            return None
        kp, kd = (_by_joint(gain, self.joints) for gain in self._gains(entry))
        return Loop(kp, np.nan_to_num(kd))

    def _gains(self, entry: RecordingEntry) -> tuple[Gain | None, Gain | None]:
        """kp and kd in a recording."""
        return self.kp if entry.kp is None else entry.kp, self.kd if entry.kd is None else entry.kd

    @property
    def torque_constant(self) -> tuple[float | None, ...]:
        """Per joint [Nm/A]; None where it is not given."""
        return tuple(self.actuators.get(joint, Actuator()).torque_constant for joint in self.joints)


def check_gains(kp: Gain | None, kd: Gain | None, joints: Sequence[str]) -> None:
    """Raise `ValueError` for gains of a loop of joints that there are not, or that are out of range."""
    for key, gain, unit, above in (("kp", kp, "Nm/rad", True), ("kd", kd, "Nm s/rad", False)):
        if gain is None:
            continue
        found = gain if isinstance(gain, dict) else dict.fromkeys(joints, gain)
        unknown = [j for j in found if j not in joints]
        if unknown:
            raise ValueError(f"{key}: unknown joint {unknown[0]!r}; there are {', '.join(joints)}")
        for joint, value in found.items():
            if not (math.isfinite(value) and (value > 0 if above else value >= 0)):
                least = "above 0" if above else "of 0 or more"
                raise ValueError(f"{key}: found {value:g} for {joint!r}; a finite number of {unit} {least} is required")


def _by_joint(gain: Gain | None, joints: Sequence[str]) -> np.ndarray:
    """Gains (n,), NaN where one is not known."""
    return np.array([gain.get(joint) if isinstance(gain, dict) else gain for joint in joints], float)


def read_header(path: Path) -> Header:
    """Read and check `recordings.json`; raises `UserError` that names the key, what was found and what is allowed."""
    data = without_free_text(parsed(path, read_utf8(path).decode(), LARGEST))
    header = validated(path, data, Header)
    check_names(header.actuators, header.joints, f"{path}: actuators", "joint")
    return header

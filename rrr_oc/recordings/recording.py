"""Recordings of a robot's motion and torques, as data."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rrr_oc.model.motion import Motion
from rrr_oc.recordings import faults, plausibility
from rrr_oc.recordings.header import EFFORTS, HEADER, UNIT_OF, Loop, Spring, Torque
from rrr_oc.robot.robot import BUNDLED, Robot, ToolPoint

# Shares of rows in which a loop's torque beyond the joint's limit is said, and above which gains or limit are wrong; doubled, fewer are told
BEYOND, MOST_BEYOND = 0.01, 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording(Motion):
    """A recorded motion of n joints in K samples; of a planned one, `tau` is zero.

    Attributes:
        file: Its CSV file, as listed in `recordings.json`; also its name in reports.
        group: Label of the physical set-up.
        tau: What was recorded, in the recorded unit: torque [Nm] or current [A], shape (n, K); of commands, the loop's torque.
        springs: Springs believed to be mounted, each an effect with its parameters.
        computed: Names of the columns that the file lacks and Savitzky–Golay derivatives fill.
        dropped: Number of rows dropped for a NaN.
        short: Number of rows dropped because their segment is too short for a derivative that had to be computed.
        ignored: Columns of the file that are not read.
        turned: Columns of positions that jumped by a whole turn and were unwrapped.
        filled: Columns of rates that are missing in some rows, where derivatives fill them, and the number of these rows.
        faults: What looks wrong in the file's positions and speeds, a part of a sentence each.
        rates: Measured rates beside the derivatives of their values; those that are no better are not used.
        mended: What the logger did to the file and the reader has undone, a part of a sentence each, by kind.
        command: Commanded positions [rad], shape (n, K), and
        loop: the loop that follows them, where these are recorded.
    """

    file: str
    group: str
    tau: np.ndarray
    springs: tuple[Spring, ...] = ()
    computed: tuple[str, ...] = ()
    dropped: int = 0
    short: int = 0
    ignored: tuple[str, ...] = ()
    turned: tuple[str, ...] = ()
    filled: tuple[tuple[str, int], ...] = ()
    faults: tuple[str, ...] = ()
    rates: tuple[plausibility.Rate, ...] = ()
    mended: Mapping[str, str] = field(default_factory=dict)
    command: np.ndarray | None = None
    loop: Loop | None = None

    def samples(self, rows: Any) -> dict[str, np.ndarray]:
        """All that is recorded, by attribute, at some samples: an index array or a slice."""
        names = ("t", "q", "dq", "ddq", "tau", "payload", *(("command",) if self.command is not None else ()))
        return {name: getattr(self, name)[..., rows] for name in names}

    @classmethod
    def planned(cls, name: str, motion: Motion, springs: tuple[Spring, ...] = (), group: str | None = None) -> "Recording":
        """A motion that has not been recorded yet: without torque, its group labelled by its name unless given."""
        of_motion = {f.name: getattr(motion, f.name) for f in fields(Motion)}
        return cls(file=name, group=group or name, tau=np.zeros_like(motion.q), springs=springs, **of_motion)


@dataclass(frozen=True)
class RecordingSet:
    """Recordings of one robot.

    Attributes:
        robot: The chain of the joints recorded, under the set's gravity.
        source: Where the robot comes from: the name of a bundled model or the path of a URDF or MJCF.
        torque: The signal in `Recording.tau`: "motor" torque at the joint's output k_t I [Nm], "load" torque of Eq. 1 [Nm],
            motor "current" [A], or motor torque [Nm] by a loop whose angles of "command" are recorded.
        inertial: "nominal": the URDF's inertial parameters are trusted up to usual errors; "identify": only its kinematics are.
        tool: Where a payload is held.
        torque_constant: Per joint [Nm/A at the output]; None where it is not given.
        recordings: The recordings, in the order of the file.
        path: The folder.
        estimated_kp: Of a loop, by joint, where it is not known [Nm/rad]; it is in the recordings.
    """

    robot: Robot
    source: str | Path
    torque: Torque
    inertial: Literal["nominal", "identify"]
    tool: ToolPoint
    torque_constant: tuple[float | None, ...]
    recordings: tuple[Recording, ...]
    path: Path
    estimated_kp: Mapping[str, float] = field(default_factory=dict)

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
        notes = list(self.robot.notes)
        incomplete = [r for r in self.recordings if r.dropped + r.short]
        if incomplete:
            nan, short = sum(r.dropped for r in incomplete), sum(r.short for r in incomplete)
            rows = sum(len(r.t) for r in incomplete) + nan + short
            notes.append(
                f"{_named(incomplete)}: {nan + short} of {rows} rows are left out ({nan} with a NaN, of unknown time, "
                f"that stand there again or jump away and back; {short} in pieces too short for a derivative)"
            )
        for kind in dict.fromkeys(kind for r in self.recordings for kind in r.mended):
            some = [r for r in self.recordings if kind in r.mended]
            notes.append(f"{_named(some)}: {some[0].mended[kind]}")
        for names, found in self._by("turned").items():
            notes.append(f"{_named(found)}: {', '.join(names)} jumped by a whole turn and is taken to go on")
        for names, found in self._by("ignored").items():
            locked = "; joints that are not listed are held still, where 'fixed_deg' says" * any(
                name.startswith("q_") for name in names
            )
            notes.append(f"{_named(found)}: column{'s' * (len(names) > 1)} {', '.join(names)} mean nothing here{locked}")
        if self.estimated_kp:
            gains = ", ".join(f"{kp:.3g} Nm/rad for {joint}" for joint, kp in self.estimated_kp.items())
            notes.append(
                f"kp is not known: {gains}, by the masses of the robot's file, with which all torques grow in proportion"
            )
        notes += [*self._of_rates(), *self._doubts()]
        default = self.tool.joint == self.robot.tool.joint and np.array_equal(self.tool.position, self.robot.tool.position)
        if default and any(np.any(r.payload > 0) for r in self.recordings):
            notes.append(
                f"the payload is held at the tool of link {self.robot.tool_link!r}, "
                f"{np.linalg.norm(self.tool.position):.3g} m from {self.joints[self.tool.joint]}; 'tool' says where else it may be"
            )
        return tuple(notes)

    def _of_rates(self) -> list[str]:
        """Which measured rates are not used, or not everywhere, a sentence each."""
        notes, found = [], dict[tuple[bool, tuple[str, ...]], dict[str, None]]()
        wrong = [(r.file, rate) for r in self.recordings for rate in r.rates if rate.is_late or not rate.right_scale]
        for name, used in dict.fromkeys((rate.column, rate.used) for _, rate in wrong):
            some = {file: rate for file, rate in wrong if (rate.column, rate.used) == (name, used)}
            worst = max(
                some.values(),
                key=lambda rate: (not rate.right_scale, abs(rate.times - 1) * (not rate.right_scale), abs(rate.late)),
            )
            found.setdefault((used, tuple(some)), {})[f"{name} {worst.said}"] = None
        for (used, files), said in found.items():
            where, several = _named([r for r in self.recordings if r.file in files]), len(said) > 1
            instead = (
                "the derivative takes its place",
                "derivatives take their place",
                "it is moved by that",
                "they are moved by that",
            )
            notes.append(f"{where}: {'; '.join(said)}; {instead[2 * used + several]}")
        for r in self.recordings:
            for name, count in r.filled:
                notes.append(
                    f"{r.file}: {name} is missing in {count} of {len(r.t) + r.short} rows, where the derivative takes its place"
                )
        return notes

    def _doubts(self) -> list[str]:
        """What looks wrong in the recorded motions and is no error for certain, a sentence each."""
        still = [r for r in self.recordings if plausibility.stands_still(r.q)]
        doubts = [f"{_named(still)}: no joint moves, which says nothing of friction and inertia"] if still else []
        doubts += self._of_times_and_travel()
        doubts += self._of_faults()
        held = any(np.any(r.payload > 0) for r in self.recordings)
        if self.torque == "command" and self.inertial == "identify" and not held:
            doubts.append(
                "masses are not known and no payload is listed: commands and positions tell friction, inertia and springs in proportion to kp "
                "alone; a recording with a known payload tells kp"
            )
        for r in self.recordings:
            for i, j in plausibility.swapped(r.t, r.segments, r.q, r.dq) if len(self.joints) > 1 else ():
                columns = f"dq_{self.joints[i]} is the derivative of q_{self.joints[j]}, not of q_{self.joints[i]}"
                doubts.append(f"{r.file}: {columns}; are columns swapped?")
        return doubts

    def _of_faults(self) -> list[str]:
        """Encoders that stand still, joints that are not listed and move, torques that are cut off, and recordings that are there twice."""
        doubts = [f"{r.file}: {fault}" for r in self.recordings for fault in r.faults]
        for j, joint in enumerate(self.joints):
            column, unit = f"{EFFORTS.get(self.torque, 'tau')}_{joint}", UNIT_OF.get(self.torque, "Nm")
            cut = [(r, rows) for r in self.recordings if r.command is None and (rows := self._cut_off(r, j)).any()]
            if cut:
                share, size = max((float(np.mean(rows)), float(np.median(np.abs(r.tau[j][rows])))) for r, rows in cut)
                where = f"{_named([r for r, _ in cut])}: {column} is cut off at {size:.4g} {unit}"
                doubts.append(
                    f"{where}, in up to {100 * share:.2g} % of the rows, and the true one is larger there; these rows of the joint do not count"
                )
            band = [(r, rows) for r in self.recordings if r.command is None and (rows := faults.zeroed(r.tau[j])).any()]
            if band:
                share, size = max((float(np.mean(rows)), float(np.min(np.abs(r.tau[j][~rows])))) for r, rows in band)
                doubts.append(
                    f"{_named([r for r, _ in band])}: {column} is 0 where it is below {size:.2g} {unit}, in up to {100 * share:.2g} % of the "
                    "rows, as in a drive's dead band; these rows of the joint do not count"
                )
            if self.recordings[0].command is None and faults.unsigned(
                [r.tau[j] for r in self.recordings], [r.dq[j] for r in self.recordings]
            ):
                doubts.append(f"{column} is 0 or above wherever {joint} moves to; is it a magnitude, without its sign?")
        for later, earlier, share in faults.repeated([np.concatenate([r.q, r.tau]) for r in self.recordings]):
            names = self.recordings[later].file, self.recordings[earlier].file
            doubts.append(
                f"{names[0]}: {100 * share:.0f} % of its rows stand in {names[1]} again; one recording must not be there twice"
            )
        return doubts

    def _of_times_and_travel(self) -> list[str]:
        """Recordings of few samples or with gaps, torques that never change, and motions as of radians that were taken for degrees."""
        found: dict[str, list[Recording]] = {}
        for r in self.recordings:
            for doubt in plausibility.sampling_doubts(r.t, r.segments):
                found.setdefault(doubt, []).append(r)
            for joint in itertools.compress(self.joints, np.ptp(r.tau, axis=1) == 0):
                found.setdefault(f"the recorded torque of {joint} never changes; was it recorded?", []).append(r)
        shares = np.array([np.mean(self._asks(r), axis=1) for r in self.recordings])
        for joint, limit, of in zip(self.joints, self.robot.effort, shares.T, strict=True):
            for some, what in (
                ((of > BEYOND) & (of <= MOST_BEYOND), "where a motor gives less; these rows of the joint do not count"),
                (
                    of > MOST_BEYOND,
                    "and all rows count: kp, kd, a command or this limit of the robot's file is wrong, or the motor too weak",
                ),
            ):
                if some.any():
                    often = f"in up to {100 * np.max(of[some]):.2g} % of the rows, {what}"
                    doubt = f"the gains give {joint} more than its effort limit, {limit:g} Nm, {often}"
                    found[doubt] = [r for r, at in zip(self.recordings, some, strict=True) if at]
        travel = np.degrees(max(float(np.max(np.ptp(r.q, axis=1))) for r in self.recordings))
        small = [f"no joint travels more than {travel:.3g}°; were angles in rad taken for degrees?"]
        still = travel < np.degrees(plausibility.STILL) or travel > plausibility.SMALL_TRAVEL
        return [f"{_named(some)}: {doubt}" for doubt, some in found.items()] + small * (not still)

    def _by(self, names: str) -> dict[tuple[str, ...], list[Recording]]:
        """Recordings by one of their tuples of columns, where it is not empty."""
        result: dict[tuple[str, ...], list[Recording]] = {}
        for r in self.recordings:
            result.setdefault(getattr(r, names), []).append(r)
        result.pop((), None)
        return result

    def _asks(self, recording: Recording) -> np.ndarray:
        """Where a loop asks for more than a joint's limit of torque, (n, K)."""
        return (np.abs(recording.tau) > self.robot.effort[:, None]) & (recording.loop is not None)

    def _cut_off(self, recording: Recording, j: int) -> np.ndarray:
        """Where the recorded torque of a joint is cut off, (K,)."""
        return faults.cut_off(self.output_torque(recording)[j], float(self.robot.effort[j]))

    def clipped(self, recording: Recording) -> np.ndarray:
        """Where recorded torques are cut off or in a dead band, or a motor gives less than its loop asks for, (n, K).

        Of a loop nowhere for a joint of which that is so in most rows.
        """
        if recording.command is None:
            return np.array([self._cut_off(recording, j) | faults.zeroed(tau) for j, tau in enumerate(recording.tau)])
        asks = self._asks(recording)
        return asks & (np.mean(asks, axis=1, keepdims=True) <= MOST_BEYOND)

    def output_torque(self, recording: Recording) -> np.ndarray:
        """Recorded torque at the joints' output [Nm], shape (n, K): k_t I for currents, of commands as the motion's speeds say."""
        if recording.loop is not None and recording.command is not None:
            return recording.loop.torque(recording.command, recording.q, recording.dq)
        if self.torque != "current":
            return recording.tau
        return np.array(self.torque_constant, float)[:, None] * recording.tau


def _named(some: Sequence[Recording]) -> str:
    return some[0].file if len(some) == 1 else f"{some[0].file} and {len(some) - 1} more"

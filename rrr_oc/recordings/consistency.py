"""Whether the columns of a recording set fit each other and the robot: signs, order, units, clocks, and what the motions show.

Where other readings of the columns explain the torques much better, the best is named beside its rivals.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.recordings import faults, mends
from rrr_oc.recordings.comparison import Comparison, Reading, Samples
from rrr_oc.recordings.mends import BAD, CLEAN, GOOD, Hypothesis, torque_column
from rrr_oc.recordings.recording import RecordingSet

LAGS = 0.3  # [s] up to which clocks are compared; doubled, slower links are seen and the check takes longer
LATE = 0.04, 1.5  # [s] and sampling steps of a lag that is said; filters, drivers and friction at reversals have less
LAG_GAIN = 0.6  # share of the error that a lag leaves at most; at 0.8, friction at reversals is taken for one
LAG_STEP = 0.01  # [s] between two lags that are tried; doubled, a lag is told half as exactly
MOVES = 0.05  # [rad] of travel, below which a joint tells nothing of its friction
SEEN = 0.1  # share of a torque's noise that accelerations must make to show inertia; at 0.3, light wrists are warned of
DIAGNOSIS = 2.0, 30.0  # [s] of a diagnosis for each joint, where nothing is missing and where much is (two and six joints)
# Times the others' error from which a recording is unlike them, if a joint is poor, and share of the deviation for a row; doubled, stops pass
UNLIKE = 4.0, 0.2
PIECE = (
    0.7,
    0.6,
)  # share of a recording's time that is told as its piece, and least share of rows there that are off; at 1, all are pieces
EXCESS = 3.0, 0.05  # times the error elsewhere, and share of a limit, by which the arm needs more than it; doubled, limits pass
NOTHING = 1e-9  # [Nm], below which the robot's file has no inertia there


@dataclass(frozen=True)
class Doubt:
    """What looks wrong in a set.

    Attributes:
        kind: "sign", "order", "unit", "coupling", "zero", "robot", "payload", "limit", "recording", "clock" or "excitation".
        columns: The columns that it is about.
        said: A sentence with the columns, the figures, the mend and its rivals, without a full stop.
        before, after: NRMSE of the worst joint concerned without and with the mend; None where nothing is mended.
        rivals: Other mends that are about as good, in words.
    """

    kind: str
    columns: tuple[str, ...]
    said: str
    before: float | None = None
    after: float | None = None
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True)
class Consistency:
    """What a check found.

    Attributes:
        doubts: What looks wrong.
        nrmse: Of each joint's torque as the set is given, (n,).
        diagnosis_s: Least and greatest processor time that a diagnosis usually takes [s].
    """

    doubts: tuple[Doubt, ...]
    nrmse: tuple[float, ...]
    diagnosis_s: tuple[float, float]


def check_consistency(recordings: RecordingSet) -> Consistency:
    """What looks wrong in a set beside what its reader says, and how well a rigid arm with friction explains it."""
    samples, given = Samples.of(recordings), Reading.as_given(recordings.robot.n)
    doubts, rigid = list[Doubt](), Comparison(samples)
    for doubt, j, level in () if recordings.torque == "command" else _limits(recordings, given):
        doubts.append(doubt)
        effort = np.where(np.arange(recordings.robot.n) == j, level, recordings.robot.effort)
        recordings = replace(recordings, robot=replace(recordings.robot, effort=effort))
    compared = _both(recordings)
    mend = _mend(*compared)
    if mend is None:
        told, others = _unlike(recordings, given)
        doubts += told
        compared = _both(others) if told else compared
        mend = _mend(*compared) if told else None
    doubts += [] if mend is None else _told(compared[1], *mend)
    reading = given if mend is None or mend[0].reading is None else mend[0].reading
    doubts += [*_clocks(compared[0], reading), *_excitation(compared[0], reading)]
    return Consistency(
        tuple(doubts),
        tuple(rigid.nrmse(given).tolist()),
        (DIAGNOSIS[0] * recordings.robot.n, DIAGNOSIS[1] * recordings.robot.n),
    )


def _both(recordings: RecordingSet) -> tuple[Comparison, Comparison]:
    """The comparison without and with springs that are not listed."""
    samples = Samples.of(recordings)
    return Comparison(samples), Comparison(samples, springs=True)


def _limits(recordings: RecordingSet, given: Reading) -> Iterator[tuple[Doubt, int, float]]:
    """Levels at which recorded torques stay up to their noise though the arm needs more, with the joint and the level [Nm]."""
    compared = Comparison(Samples.of(recordings), springs=True)
    for j, joint in enumerate(recordings.joints if compared.nominal else ()):
        found = [faults.flat_top(recordings.output_torque(r)[j]) for r in recordings.recordings]
        at = np.concatenate([at[some] for (at, _), some in zip(found, compared.samples.rows, strict=True)])
        if not 0 < np.mean(at) < 0.5:
            continue
        level = min(level for rows, level in found if rows.any())
        more, error = compared.beyond(given, j, at)
        if more > max(EXCESS[0] * error, EXCESS[1] * level) and error < CLEAN * level:
            column = f"{torque_column(recordings)}_{joint}"
            said = f"{column} stays at {level:.3g} Nm, where the arm needs {more:.2g} Nm more: it is cut off there; as 'effort' of "
            yield Doubt("limit", (column,), f"{said}{joint} in the robot's file, this limit leaves the rows out"), j, level


def _mend(rigid: Comparison, compared: Comparison) -> tuple[Hypothesis, tuple[str, ...]] | None:
    """The mistakes that explain the torques of all poor joints, and their rivals in words; None where none does."""
    given = Reading.as_given(compared.samples.recordings.robot.n)
    before, poor = _poor(rigid, compared)
    hypotheses = [*mends.of_columns(compared, bool(poor.any()))]
    if max(np.nanmax(rigid.nrmse(given), initial=0.0), np.nanmax(before, initial=0.0)) > CLEAN:
        hypotheses += [*mends.of_robot(compared)]
    if np.nanmax(before, initial=0.0) > CLEAN and compared.nominal:
        hypotheses += [*mends.units(rigid, compared)]
    return mends.best_of(hypotheses, before, poor)


def _poor(rigid: Comparison, compared: Comparison) -> tuple[np.ndarray, np.ndarray]:
    """The joints' errors, (n,), and which of them are poor; a torque of another size than the arm's is no better than a constant."""
    given = Reading.as_given(compared.samples.recordings.robot.n)
    far = mends.far_factors(rigid.without_braking.factors(given)) if compared.nominal else np.zeros(len(given.zero), bool)
    before = compared.nrmse(given)
    before = np.where(far, np.maximum(before, 1.0), before)
    return before, before > BAD


def _told(compared: Comparison, found: Hypothesis, rivals: tuple[str, ...], where: str = "") -> list[Doubt]:
    """A doubt for each mistake of a hypothesis, the first with its rivals."""
    before = compared.nrmse(Reading.as_given(compared.samples.recordings.robot.n))
    gain, doubts = np.nan_to_num(before / np.maximum(found.after, mends.LEAST_ERROR)), []
    for k, mistake in enumerate(found.mistakes):
        j = int(np.argmax(gain)) if mistake.joint is None else mistake.joint
        joint = compared.samples.recordings.joints[j]
        told = f"{where}{mistake.said}: NRMSE of the torque of {joint} {before[j]:.2g} → {found.after[j]:.2g}"
        others = rivals if k == 0 else ()
        told += f"; about as good: {'; '.join(others)}" if others else ""
        doubts.append(Doubt(mistake.kind, mistake.columns, told, float(before[j]), float(found.after[j]), others))
    return doubts


def _unlike(recordings: RecordingSet, given: Reading) -> tuple[list[Doubt], RecordingSet]:
    """What is told of recordings that the drives and the arm of all others explain far worse, and the set of the others."""
    doubts, far, compared = list[Doubt](), list[int](), Comparison(Samples.of(recordings), springs=True)
    for k, r in enumerate(recordings.recordings if len(recordings.recordings) > 1 else ()):
        off, errors, sizes = compared.left_out(given, k)
        least, poor = (np.maximum(UNLIKE[0] * errors, share * sizes) for share in (UNLIKE[1], BAD))
        joints = np.flatnonzero((np.sqrt(np.mean(off**2, axis=1)) > poor) & (sizes > 0))
        if not len(joints):
            continue
        far.append(k)
        alone = _both(replace(recordings, recordings=(r,)))
        mend = _mend(*alone)
        if mend is not None:
            doubts += _told(alone[1], *mend, f"{r.file}: ")
            continue
        names = ", ".join(recordings.joints[j] for j in joints)
        when = _piece(r.t[compared.samples.rows[k]], np.any(off > least[:, None], axis=0))
        said = f"{r.file}: the torque of {names}{when} is not that of the arm that the other recordings show; was it held, pushed or "
        said += "stopped, did an encoder stand still, was the payload, a unit or a zero changed, or is it another arm? Leave these rows out"
        doubts.append(Doubt("recording", tuple(f"{torque_column(recordings)}_{recordings.joints[j]}" for j in joints), said))
    if 2 * len(far) >= len(recordings.recordings):
        return [], recordings
    return doubts, replace(recordings, recordings=tuple(r for k, r in enumerate(recordings.recordings) if k not in far))


def _piece(t: np.ndarray, off: np.ndarray) -> str:
    """The piece of a recording in which rows (K,) are off, in words; nothing where it is most of it."""
    rows = np.flatnonzero(off)
    inside = (
        len(rows) and t[rows[-1]] - t[rows[0]] < PIECE[0] * (t[-1] - t[0]) and len(rows) > PIECE[1] * (rows[-1] - rows[0] + 1)
    )
    return f" from {t[rows[0]]:.3g} to {t[rows[-1]]:.3g} s" if inside else ""


def _clocks(compared: Comparison, reading: Reading) -> Iterator[Doubt]:
    """Torques that are late or early beside the positions."""
    recordings = compared.samples.recordings
    if recordings.torque == "command":
        return  # commands that are early look like viscous friction, whatever the time
    step = max(float(np.median(np.diff(r.t))) for r in recordings.recordings)
    before = compared.nrmse(reading)
    grid = [k * LAG_STEP for k in range(-round(LAGS / LAG_STEP), round(LAGS / LAG_STEP) + 1)]
    later = [replace(compared.samples, lag=lag).torque for lag in grid]
    errors = np.array([compared.nrmse(reading, torque=torque) for torque in later])
    for j, joint in enumerate(recordings.joints):
        if not np.isfinite(errors[:, j]).all():
            continue
        k = int(np.argmin(errors[:, j]))
        lag, after = grid[k], float(errors[k, j])
        if abs(lag) > max(LATE[0], LATE[1] * step) and after < LAG_GAIN * before[j] and after < GOOD and 0 < k < len(grid) - 1:
            column, how = f"{torque_column(recordings)}_{joint}", "late" if lag > 0 else "early"
            said = f"{column} is {abs(lag):.2g} s {how} beside the positions: with that, NRMSE {before[j]:.2g} → {after:.2g}"
            yield Doubt("clock", (column,), said, float(before[j]), after)


def _excitation(compared: Comparison, reading: Reading) -> Iterator[Doubt]:
    """Joints that never move, and inertias that no motion shows."""
    recordings = compared.samples.recordings
    travel = np.max([np.ptp(r.q, axis=1) for r in recordings.recordings], axis=0)
    for joint, way in zip(recordings.joints, travel, strict=True):
        if way < MOVES:
            said = f"{joint} never moves more than {np.degrees(way):.2g}°: its friction and rotor inertia cannot be told; record it moving"
            yield Doubt("excitation", (f"q_{joint}",), said)
    if not compared.nominal:
        return
    inertial = np.std(compared.samples.load(reading) - compared.samples.load(reading, rates=False), axis=1)
    noise = np.mean([faults.white_noise(recordings.output_torque(r)) for r in recordings.recordings], axis=0)
    left = compared.nrmse(reading) * np.std(compared.samples.read(reading, compared.samples.torque), axis=1)
    noise = np.fmin(noise, left)  # steps of commands are none
    for joint, way, part, least in zip(recordings.joints, travel, inertial, SEEN * noise, strict=True):
        if way >= MOVES and NOTHING < part < least:
            said = f"accelerations change the torque of {joint} by {part:.2g} Nm, and its noise is {least / SEEN:.2g} Nm"
            said += ": the inertia of the links is hardly seen there; record it faster"
            yield Doubt("excitation", (f"ddq_{joint}",), said)

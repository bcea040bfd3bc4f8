"""Whether the columns of a recording set fit each other and the robot: signs, order, units, clocks, and what the motions show.

Where other readings of the columns explain the torques much better, the best is named beside its rivals.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.recordings import mends
from rrr_oc.recordings.comparison import Comparison, Reading, Samples
from rrr_oc.recordings.mends import BAD, BETTER, CLEAN, GOOD, Hypothesis, torque_column
from rrr_oc.recordings.recording import RecordingSet

LAGS = 0.3  # [s] up to which clocks are compared; doubled, slower links are seen and the check takes longer
LATE = 0.04, 1.5  # [s] and sampling steps of a lag that is said; filters, drivers and friction at reversals have less
LAG_GAIN = 0.6  # share of the error that a lag leaves at most; at 0.8, friction at reversals is taken for one
LAG_STEP = 0.01  # [s] between two lags that are tried; doubled, a lag is told half as exactly
MOVES = 0.05  # [rad] of travel, below which a joint tells nothing of its friction
SEEN = 0.1  # share of a torque's noise that accelerations must make to show inertia; at 0.3, light wrists are warned of
DIAGNOSIS = 2.0, 30.0  # [s] of a diagnosis for each joint, where nothing is missing and where much is (two and six joints)
NOTHING = 1e-9  # [Nm], below which the robot's file has no inertia there


@dataclass(frozen=True)
class Doubt:
    """What looks wrong in a set.

    Attributes:
        kind: "sign", "order", "unit", "coupling", "zero", "robot", "payload", "clock" or "excitation".
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
    rigid, compared = Comparison(samples), Comparison(samples, springs=True)
    mend = _mend(rigid, compared)
    doubts = [*_of_one_recording(recordings, given)] if mend is None else _told(compared, *mend)
    reading = given if mend is None or mend[0].reading is None else mend[0].reading
    doubts += [*_clocks(rigid, reading), *_excitation(rigid, reading)]
    return Consistency(
        tuple(doubts),
        tuple(rigid.nrmse(given).tolist()),
        (DIAGNOSIS[0] * recordings.robot.n, DIAGNOSIS[1] * recordings.robot.n),
    )


def _mend(rigid: Comparison, compared: Comparison) -> tuple[Hypothesis, tuple[str, ...]] | None:
    """The mistakes that explain the torques of all poor joints, and their rivals in words; None where none does."""
    given = Reading.as_given(compared.samples.recordings.robot.n)
    before, poor = _poor(rigid, compared)
    hypotheses = [*mends.of_columns(compared, bool(poor.any()))]
    if max(np.nanmax(rigid.nrmse(given), initial=0.0), np.nanmax(before, initial=0.0)) > CLEAN:
        hypotheses += [*mends.of_robot(compared)]
    if poor.any() and compared.nominal:
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


def _of_one_recording(recordings: RecordingSet, given: Reading) -> Iterator[Doubt]:
    """Mistakes of one recording alone, in which a joint's error is far larger than in the others."""
    sets = [replace(recordings, recordings=(r,)) for r in recordings.recordings]
    every = [Comparison(Samples.of(one), springs=True) for one in sets] if len(sets) > 1 else []
    errors = np.array([compared.nrmse(given) for compared in every])
    for k, compared in enumerate(every):
        others = np.ma.median(np.ma.masked_invalid(np.delete(errors, k, axis=0)), axis=0).filled(np.inf)
        far = others < BETTER * errors[k]
        if not far.any():
            continue
        poor = errors[k] > BAD
        found = mends.best_of([*mends.of_columns(compared, bool(poor.any()))], errors[k], poor)
        if found is not None and np.all(far[poor]):
            yield from _told(compared, *found, f"{recordings.recordings[k].file}: ")


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
    noise = np.mean([_noise(recordings.output_torque(r)) for r in recordings.recordings], axis=0)
    for joint, way, part, least in zip(recordings.joints, travel, inertial, SEEN * noise, strict=True):
        if way >= MOVES and NOTHING < part < least:
            said = f"accelerations change the torque of {joint} by {part:.2g} Nm, and its noise is {least / SEEN:.2g} Nm"
            said += ": the inertia of the links is hardly seen there; record it faster"
            yield Doubt("excitation", (f"ddq_{joint}",), said)


def _noise(torque: np.ndarray) -> np.ndarray:
    """Standard deviation of white noise in torques (n, K), from their second differences, (n,); steps and spikes are none."""
    second = np.diff(torque, 2, axis=1)
    return np.minimum(np.std(second, axis=1), np.quantile(np.abs(second), 0.683, axis=1)) / np.sqrt(6)

"""Recording sets read from a folder with `recordings.json` and CSV files."""

import difflib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.numerics.savitzky_golay import LEAST_ROWS, differentiate, split
from rrr_oc.recordings import faults, plausibility
from rrr_oc.recordings.csv_table import Table, read_table
from rrr_oc.recordings.gains import with_gains
from rrr_oc.recordings.header import EFFORTS, HEADER, UNIT_OF, Header, RecordingEntry, Spring, read_header
from rrr_oc.recordings.plausibility import Rate
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.recordings.springs import read_springs
from rrr_oc.recordings.stamps import at_every_row, between_updates, even, spread
from rrr_oc.robot.robot import BUNDLED, Robot, ToolPoint, load_robot
from rrr_oc.schema import HEAVIEST, Payload, one_spelling, spellings
from rrr_oc.storage import resolved

RATES = ("dq_", "ddq_")
SHARED = 0.5  # share of rows with all signals below which these are sampled at times of their own; doubled, rows marked as wrong are filled
# Times its fastest steps and those beside it, and [rad], by which a position jumps; doubled, small jumps pass for motion
JUMP, LEAST_JUMP = 10.0, 0.02


def load_recordings(path: str | Path, robot: str | Path | None = None) -> RecordingSet:
    """Read a recording set.

    Args:
        path: The folder, or its `recordings.json`.
        robot: Bundled model, URDF or MJCF that takes the place of the one in the file.

    Raises:
        UserError: Something is missing or wrong; the message names the file, the line or key, what was found and what is allowed.
    """
    path = Path(path)
    file = path if path.suffix == ".json" else path / HEADER
    if not file.is_file():
        raise UserError(f"{path}: no recording set; a folder with {HEADER} is required")
    header = read_header(file)
    folder = file.parent
    listed = header.robot if header.robot in BUNDLED else folder / header.robot
    source = listed if robot is None else robot
    arm, tool = _robot(file, source, header)
    loaded = tuple(
        _recording(folder, entry, springs, header, arm)
        for entry, springs in zip(header.recordings, read_springs(file, header), strict=True)
    )
    loaded = _of_session(loaded)
    plausibility.check_alike({str(folder / r.file): float(np.median(np.diff(r.t))) for r in loaded})
    recordings = RecordingSet(arm, source, header.torque, header.inertial, tool, header.torque_constant, loaded, folder)
    return with_gains(file, recordings)


def _of_session(recordings: tuple[Recording, ...]) -> tuple[Recording, ...]:
    """The recordings on the clock of their session, which files show whose times do not overlap."""
    ordered = sorted(recordings, key=lambda r: float(r.t[0]))
    if any(after.t[0] <= before.t[-1] for before, after in itertools.pairwise(ordered)):
        return recordings
    return tuple(replace(r, start=float(ordered[0].t[0])) for r in recordings)


def _robot(file: Path, source: str | Path, header: Header) -> tuple[Robot, ToolPoint]:
    try:
        fixed = {joint: float(np.radians(degrees)) for joint, degrees in header.fixed_deg.items()}
        robot = load_robot(source, header.joints, header.inertial == "nominal", header.gravity, fixed)
        return robot, robot.tool if header.tool is None else robot.point(header.tool.link, header.tool.position)
    except UserError as error:
        raise UserError(f"{file}: {error}") from None
    except OSError as error:  # such as a name that is too long
        raise UserError(f"{file}: robot {str(source)!r} cannot be read: {error.strerror}") from None


def _recording(folder: Path, entry: RecordingEntry, springs: tuple[Spring, ...], header: Header, robot: Robot) -> Recording:
    path = folder / entry.file
    if not resolved(path).is_relative_to(resolved(folder)):  # a message may show what stands in it
        raise UserError(f"{path}: is a link that leads out of the set's folder; a recording must lie in it")
    table = _one_payload(read_table(path))
    recorded = tuple(f"{EFFORTS.get(header.torque, 'tau')}_{joint}" for joint in robot.joints)
    used, ignored = _used_columns(table, robot.joints, recorded)
    values = np.array(table.columns(used))
    mended = dict[str, str]()
    _settle_times(used, values, mended)
    _drop_faults(used, values, (*(f"q_{joint}" for joint in robot.joints), *recorded), mended)
    rows = _usable_rows(table, used, values)
    with np.errstate(all="ignore"):  # absurd numbers are looked for
        columns = dict(zip(used, values[:, rows], strict=True))
        plausibility.check_time(str(path), columns["t"])
        columns.setdefault("payload", np.full(len(rows), entry.payload))
        plausibility.check_magnitudes(str(path), columns)
        if header.coupled("q") is None:  # before turns are taken off
            raw = np.array([columns[f"q_{joint}"] for joint in robot.joints])
            plausibility.check_positions(str(path), robot, raw, 4 * np.pi)  # turns of an encoder are fewer
        segments = _split(columns, robot.joints, mended)
        turned = _unwrap(columns, robot.joints, segments)
        _fill_updates(columns, robot.joints, segments, mended)
        _even(columns, robot.joints, segments, mended)
        _couple(columns, robot.joints, recorded, header)
        loop = header.loop(entry)
        if loop is not None:
            _turn_commands(columns, turned)
        filled = _fill_rates(columns, robot.joints, segments)
        wrong = _faults(table, columns, ignored, robot, segments)
        plausibility.check_positions(str(path), robot, np.array([columns[f"q_{joint}"] for joint in robot.joints]))
        rates = _compare_rates(str(path), columns, robot.joints, segments)
        q, dq, ddq, computed = _motion(columns, robot.joints, segments)
        tau = signal = np.array([columns[name] for name in recorded])
        if loop is not None:
            plausibility.check_commands(str(path), robot, signal, q)
            tau = loop.torque(signal, q, dq)  # NaN without a kp
        result = Recording(
            columns["t"], q, dq, ddq, columns["payload"], segments,
            file=entry.file, group=entry.group or entry.file, tau=tau, springs=springs, computed=computed,
            dropped=values.shape[1] - len(rows), ignored=ignored, turned=turned, filled=filled, faults=wrong, rates=rates,
            mended=mended, command=None if loop is None else signal, loop=loop,
        )  # fmt: skip
        result = _without_short_segments(path, result)
        _check_units(path, result, robot, header, recorded)
    return result


def _faults(
    table: Table, columns: Mapping[str, np.ndarray], ignored: Sequence[str], robot: Robot, segments: Sequence[slice]
) -> tuple[str, ...]:
    """What looks wrong in positions of joints that are not listed, and in positions beside their speeds."""
    q, dq = ({j: columns[f"{kind}_{j}"] for j in robot.joints if f"{kind}_{j}" in columns} for kind in ("q", "dq"))
    others = [name for name in ignored if name.startswith("q_")]
    try:
        values = table.columns(others) if others else []
    except UserError:  # they may hold anything
        values = []
    beside = {name.removeprefix("q_"): x for name, x in zip(others, values, strict=False)}
    signals = {name: x for name, x in columns.items() if name not in ("t", "payload") and not name.startswith(RATES)}
    return (*faults.unlisted(beside, robot.held), *faults.frozen(columns["t"], segments, q, dq), *faults.copies(signals))


def _one_payload(table: Table) -> Table:
    """The table with its column of payloads, if it has one, under the name "payload"."""
    given = one_spelling(table.names, spellings(Payload), f"{table.path}, line {table.header_line}")
    return replace(table, names=tuple("payload" if name == given else name for name in table.names))


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
        if close and not name.startswith(
            ("q_", "dq_", "ddq_", "tau_", "current_", "command_")
        ):  # those belong to joints not recorded
            raise UserError(f"{table.path}, line {table.header_line}: unknown column {name!r}; is it {close[0]!r}? {allowed}")
    return (*required, *(name for name in optional if name in table.names)), ignored


def _usable_rows(table: Table, used: Sequence[str], values: np.ndarray) -> np.ndarray:
    """Indices of the rows without a NaN, rates excepted; raises `UserError` where what is left is no motion."""
    if values.shape[1] == 0:
        raise UserError(f"{table.path}: no recordings yet: a header and no rows; at least {LEAST_ROWS} rows are required")
    infinite = np.argwhere(np.isinf(values).T)
    if len(infinite):
        row, column = map(int, infinite[0])
        raise _wrong_cell(table, row, used[column], "an infinite value", "numbers or nan are allowed")
    needed = [i for i, name in enumerate(used) if not name.startswith(RATES)]
    rows = np.flatnonzero(~np.isnan(values[needed]).any(axis=0))
    if len(rows) < LEAST_ROWS:
        total = values.shape[1]
        empty = ", ".join(used[i] for i in needed if np.isnan(values[i]).all())
        raise UserError(
            f"{table.path}: {len(rows)} of {total} rows are without a NaN; at least {LEAST_ROWS} are required"
            + f"; no row has {empty}" * bool(empty)
        )
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
        if payload.max() > HEAVIEST:
            i = int(np.argmax(payload))
            raise _wrong_cell(table, int(rows[i]), "payload", f"{payload[i]:g}", f"up to {HEAVIEST:g} kg are allowed")
    return rows


def _settle_times(used: Sequence[str], values: np.ndarray, mended: dict[str, str]) -> None:
    """Give every row a time of its own, and the signals that are sampled at other times.

    Rows that stand there again, with all they hold, have none.
    """
    t = values[used.index("t")]
    if not len(t):
        return
    same = (values[:, 1:] == values[:, :-1]) | (np.isnan(values[:, 1:]) & np.isnan(values[:, :-1]))
    again = np.concatenate([[False], np.all(same, axis=0)])
    if again.any() and np.array_equal(again[1:], np.diff(t) == 0):
        t[again] = np.nan
        mended["again"] = f"{np.sum(again)} rows stand there again and are left out"
    known = np.isfinite(t)
    t[known], batch = spread(t[known])
    if batch > 1:
        mended["batches"] = f"samples are stamped in batches of {batch:g}; their times are spread"
    needed = [i for i, name in enumerate(used) if not name.startswith(RATES) and name != "t"]
    filled = []
    if np.mean(np.isfinite(values[needed][:, known]).all(axis=0)) < SHARED:
        for i in needed:
            given = values[i].copy()
            values[i] = at_every_row(t, given, used[i].startswith("q_"))
            filled += [used[i]] * (not np.array_equal(given, values[i], equal_nan=True))
    if filled:
        mended["rates"] = f"{', '.join(filled)} are sampled at times of their own, and taken between these at those of all rows"


def _split(columns: Mapping[str, np.ndarray], joints: Sequence[str], mended: dict[str, str]) -> tuple[slice, ...]:
    """Segments between gaps in time, and between jumps of a position that no motion makes, other than by whole turns."""
    pieces, jumps = list[slice](), list[int]()
    for s in split(columns["t"]):
        steps = np.abs(np.diff(np.unwrap([columns[f"q_{joint}"][s] for joint in joints])))
        beside = np.maximum(np.pad(steps, ((0, 0), (1, 0)))[:, :-1], np.pad(steps, ((0, 0), (0, 1)))[:, 1:])
        fastest = np.quantile(steps, 0.99, axis=1, keepdims=True) if s.stop - s.start > 1 else np.inf
        inside = (
            np.flatnonzero(np.any(steps > np.maximum(JUMP * np.maximum(fastest, beside), LEAST_JUMP), axis=0)) + s.start + 1
        )
        jumps += inside.tolist()
        pieces += [slice(a, b) for a, b in itertools.pairwise([s.start, *inside.tolist(), s.stop])]
    if jumps:
        mended["jumps"] = (
            f"positions jump at {columns['t'][jumps[0]]:.4g} s, where a new piece begins; no derivative crosses it"
        )
    return tuple(pieces)


def _drop_faults(used: Sequence[str], values: np.ndarray, names: Sequence[str], mended: dict[str, str]) -> None:
    """Put NaN into the place of positions and torques that jump away and back, and of positions that stand still until they jump."""
    for name in names:
        x, t = values[used.index(name)], values[used.index("t")]
        if len(x) < LEAST_ROWS or not np.isfinite(x).all():
            continue
        position = name.startswith("q_")
        wrong = faults.spikes(x, 2 * np.pi if position else np.inf)
        if not position:  # friction turns over within a sample; smaller spikes are the calibration's to smooth
            wrong &= np.abs(x) > faults.FAR * np.quantile(np.abs(x), faults.USUAL)
        stays = faults.stays(t, np.where(wrong, np.nan, x)) if position else np.zeros_like(wrong)
        for rows, said in ((wrong, "jumps away and back"), (stays, "stands still until it jumps, as no motion does,")):
            if rows.any():
                x[rows] = np.nan
                mended[f"{said} {name}"] = f"{name} {said} in {np.sum(rows)} rows, which are left out"


def _wrong_cell(table: Table, row: int, column: str, found: str, allowed: str) -> UserError:
    return UserError(f"{table.path}, line {table.line(row)}, column {column!r}: found {found}; {allowed}")


def _unwrap(columns: dict[str, np.ndarray], joints: Sequence[str], segments: Sequence[slice]) -> tuple[str, ...]:
    """Unwrap positions that jump by a turn from one sample to the next; returns the names of these columns."""
    names = [f"q_{joint}" for joint in joints]
    turned = [name for name in names if any(np.any(np.abs(np.diff(columns[name][s])) > np.pi) for s in segments)]
    for name in turned:
        columns[name] = np.unwrap(columns[name])
    return tuple(turned)


def _fill_updates(
    columns: dict[str, np.ndarray], joints: Sequence[str], segments: Sequence[slice], mended: dict[str, str]
) -> None:
    """Put what positions are between their updates into the place of repeated values."""
    longest = 0.0
    for name in (f"q_{joint}" for joint in joints):
        filled = [between_updates(columns["t"][s], columns[name][s]) for s in segments]
        if any(usual for _, usual in filled):
            columns[name] = np.concatenate([q for q, _ in filled])
            longest = max(longest, *(usual for _, usual in filled))
    if longest:
        mended["updates"] = (
            f"positions are updated every {1000 * longest:.3g} ms and repeated until then; a spline through the updates is used"
        )


def _even(columns: dict[str, np.ndarray], joints: Sequence[str], segments: Sequence[slice], mended: dict[str, str]) -> None:
    """Take the jitter from times where positions show that it is the stamps' alone."""
    columns["t"], jitter = even(columns["t"], np.array([columns[f"q_{joint}"] for joint in joints]), segments)
    if jitter:
        mended["jitter"] = (
            f"stamps jitter by {1000 * jitter:.2g} ms about even times, at which positions are smoother; these are used"
        )


def _couple(columns: dict[str, np.ndarray], joints: Sequence[str], recorded: Sequence[str], header: Header) -> None:
    """Put joints' angles, rates and torques into the place of columns that are sums of them; a rate that some joint lacks is left out."""
    for prefix, matrix in (
        ("q_", header.coupled("q")),
        ("dq_", header.coupled("q")),
        ("ddq_", header.coupled("q")),
        ("", header.coupled("tau")),
    ):
        names = [f"{prefix}{joint}" for joint in joints] if prefix else [*recorded]
        if matrix is None:
            continue
        if not all(name in columns for name in names):
            for name in names:
                columns.pop(name, None)
            continue
        given = [columns[name] for name in names]
        for name, row in zip(names, matrix, strict=True):
            columns[name] = sum((k * x for k, x in zip(row, given, strict=True) if k), start=np.zeros_like(given[0]))


def _turn_commands(columns: dict[str, np.ndarray], turned: Sequence[str]) -> None:
    """Put commands of joints whose positions were unwrapped on the turn nearest to these."""
    for joint in (name.removeprefix("q_") for name in turned):
        command, q = columns[f"command_{joint}"], columns[f"q_{joint}"]
        columns[f"command_{joint}"] = command - 2 * np.pi * np.round((command - q) / (2 * np.pi))


def _fill_rates(
    columns: dict[str, np.ndarray], joints: Sequence[str], segments: tuple[slice, ...]
) -> tuple[tuple[str, int], ...]:
    """Fill rows in which a rate is missing with the derivative; returns these columns and how many rows. One without a number is dropped."""
    filled, t = [], columns["t"]
    for joint in joints:
        for kind in RATES:
            name, rate = f"{kind}{joint}", columns.get(f"{kind}{joint}", np.zeros(0))
            empty = np.isnan(rate)
            if len(rate) and empty.all():
                del columns[name]
            elif empty.any():
                derivative = 2 if kind == "ddq_" and f"dq_{joint}" not in columns else 1
                source = columns[f"q_{joint}" if kind == "dq_" or derivative == 2 else f"dq_{joint}"]
                columns[name] = np.where(empty, differentiate(t, source[None], segments, derivative)[0], rate)
                filled.append((name, int(empty.sum())))
    return tuple(filled)


def _compare_rates(
    where: str, columns: dict[str, np.ndarray], joints: Sequence[str], segments: tuple[slice, ...]
) -> tuple[Rate, ...]:
    """Measured rates beside the derivatives of their values; drop those that are no better, unless they are of another joint.

    Those that are better and late are moved by as much.

    Raises `UserError` where a unit explains how many times the derivative one is, or the sign is wrong.
    """
    t, result = columns["t"], []
    for joint in joints:
        for value, rate, least in zip(("q_", "dq_"), RATES, plausibility.LEAST_CHANGE, strict=True):
            one, other = f"{value}{joint}", f"{rate}{joint}"
            if other not in columns:
                continue
            x = columns[one] if one in columns else differentiate(t, columns[f"q_{joint}"][None], segments)[0]
            plausibility.check_derivative(where, t, segments, (one, x), (other, columns[other]))
            found = plausibility.measured_rate(t, segments, (one, x), (other, columns[other]), least)
            others = [f"{value}{j}" for j in joints if j != joint and f"{value}{j}" in columns]
            if found is None or plausibility.is_derivative(t, segments, columns[other], [columns[o] for o in others]):
                continue
            result.append(found)
            if found.used:
                columns[other] = found.in_time(t, segments, columns[other])
            else:
                del columns[other]
    return tuple(result)


def _motion(
    columns: Mapping[str, np.ndarray], joints: Sequence[str], segments: tuple[slice, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[str, ...]]:
    """q, dq, ddq (n, K) and the names of those computed; ddq comes from a measured dq where there is one."""
    t = columns["t"]
    names = [[f"{kind}_{joint}" for joint in joints] for kind in ("q", "dq", "ddq")]
    q, dq, ddq = (np.array([columns.get(name, np.zeros_like(t)) for name in row]) for row in names)
    _, no_speed, no_acceleration = (np.array([name not in columns for name in row]) for row in names)
    from_q, from_dq = no_acceleration & no_speed, no_acceleration & ~no_speed
    dq[no_speed] = differentiate(t, q[no_speed], segments)
    ddq[from_dq] = differentiate(t, dq[from_dq], segments)
    ddq[from_q] = differentiate(t, q[from_q], segments, derivative=2)
    return q, dq, ddq, tuple(name for name in (*names[1], *names[2]) if name not in columns)


def _without_short_segments(path: Path, recording: Recording) -> Recording:
    """Drop segments too short for the derivatives that must be computed; raises `UserError` where none is left."""
    if not recording.computed:
        return recording
    kept = [np.arange(len(recording.t))[s] for s in recording.segments if s.stop - s.start >= LEAST_ROWS]
    if not kept:
        raise UserError(
            f"{path}: gaps in 't' leave no segment of {LEAST_ROWS} rows, of which derivatives could be computed; "
            "give dq and ddq or longer pieces"
        )
    rows = np.concatenate(kept)
    arrays = recording.samples(rows)
    for name in ("dq", "ddq"):
        if not np.all(np.isfinite(arrays[name])):
            raise UserError(
                f"{path}: {name} computed from the file is not finite; positions are too large or times too close together"
            )
    segments = tuple(slice(a, b) for a, b in itertools.pairwise(np.cumsum([0, *map(len, kept)]).tolist()))
    return replace(recording, **arrays, segments=segments, short=len(recording.t) - len(rows))


def _check_units(path: Path, recording: Recording, robot: Robot, header: Header, recorded: tuple[str, ...]) -> None:
    where, r = str(path), recording
    if all(f"dq_{joint}" in r.computed for joint in robot.joints):
        plausibility.check_slowness(where, robot, r.t, r.q, r.dq)
    unit = UNIT_OF.get(header.torque, "Nm")
    constants = np.array(header.torque_constant, float) if unit == "A" else np.ones(robot.n)
    if recording.loop is None:
        plausibility.check_torques(where, robot, constants[:, None] * r.tau, recorded, unit)
    else:
        plausibility.check_loop(where, robot, np.nan_to_num(r.tau))  # NaN without a kp, which is estimated from all recordings
    plausibility.check_changes(where, r.q, np.where(np.isnan(r.tau), r.q, r.tau))

"""The public recordings of the arm's authors (github.com/Co-Evolve/elastic-actuation-arm), turned into a recording set."""

import re
import warnings
from pathlib import Path

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.recordings.writer import write_set

PATTERN = re.compile(r"data_file_([123])_Exp(\d+)\.txt")
NAME = "experiment_{:02d}.csv"
JOINTS = ("joint1", "joint2", "joint3")
SIGNS = (1.0, 1.0, -1.0)  # the files' elbow turns the other way
COLUMNS = 7  # time [s], position [°], speed [°/s], acceleration [°/s²], zero, motor torque [Nm], the controller's own signal
PAYLOAD = 5.0  # [kg]
PAYLOAD_AT = 0.310  # [m] along link 3, as in the authors' code; fitted to their recordings, the point lies at 0.355 m
WITH_PAYLOAD = (1, 3, 7, 9)  # experiments
WITH_SPRINGS = (1, 4, 7, 10)
SPRINGS = {
    "pea": {
        "joint2": {"stiffness_Nm_per_rad": 13.705, "equilibrium_rad": np.radians(110.0), "active": "below"},
        "joint3": {"stiffness_Nm_per_rad": 1.318, "equilibrium_rad": np.radians(140.0), "active": "below"},
    }
}


def import_prototype(folder: str | Path, out: str | Path, payload_at: float = PAYLOAD_AT) -> RecordingSet:
    """Write the experiments of a folder of `data_file_M_ExpN.txt` (motor M of 1…3, experiment N) as a new recording set.

    The payload is held at `payload_at` [m] along link 3.

    The motors are polled one after the other, 2 ms apart; positions, speeds and torques of motors 1 and 3 are interpolated to
    the times of motor 2, within the time that all three cover. Linearly: over steps of 6 ms the error, ddq step²/8 below
    1e-5 rad, is less than the encoder's resolution of 2.4e-5 rad, and torque noise is not amplified as a cubic would.

    The recorded acceleration is left out: against the derivative of the recorded speed it comes 50 ms to 70 ms late and is 3 %
    (experiments 7 to 12) to 57 % (1 to 6) too small. The reader differentiates the recorded speed instead.

    Raises:
        UserError: A file is missing or not in this layout, `out` exists, or `payload_at` is no length.
    """
    if not 0 <= payload_at < 10:
        raise UserError(f"the payload's point is {payload_at:g} m along link 3; 0 m to 10 m are allowed")
    folder = Path(folder)
    experiments = _experiments(folder)
    tables = {}
    for number, files in experiments.items():
        tables[NAME.format(number)] = columns = _columns([_motor(folder / file) for file in files])
        if not columns["t"].size:
            raise UserError(f"{folder}: the times of {', '.join(files)} have nothing in common; one experiment is required")
    header = {
        "description": "Arm of the authors of the paper, from github.com/Co-Evolve/elastic-actuation-arm",
        "joints": list(JOINTS),
        "torque": "motor",
        "tool": {"link": "link3", "position": [payload_at, 0.0, 0.0]},
        "recordings": [_entry(number) for number in experiments],
    }
    return write_set(out, "rrr_prototype", header, tables)


def _experiments(folder: Path) -> dict[int, list[str]]:
    """Files of motors 1, 2, 3 by experiment."""
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; one with files data_file_M_ExpN.txt is required")
    matches = [PATTERN.fullmatch(path.name) for path in folder.iterdir()]
    numbers = sorted({int(match[2]) for match in matches if match})
    if not numbers:
        raise UserError(f"{folder}: holds no file data_file_M_ExpN.txt (motor M of 1…3, experiment N)")
    experiments = {number: [f"data_file_{motor}_Exp{number}.txt" for motor in (1, 2, 3)] for number in numbers}
    for file in (file for files in experiments.values() for file in files):
        if not (folder / file).is_file():
            raise UserError(f"{folder}: {file} is missing; every experiment needs the files of motors 1, 2 and 3")
    return experiments


def _motor(path: Path) -> np.ndarray:
    """Columns of one motor's file, shape (7, K)."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")
            values = np.loadtxt(path, ndmin=2)
    except (ValueError, OSError) as error:
        found = str(error).split(";")[0]  # what follows is advice to callers of numpy
        raise UserError(f"{path}: {found}; {COLUMNS} columns of numbers without a header are required") from None
    if values.shape[1] != COLUMNS or len(values) < 2:
        raise UserError(f"{path}: found {len(values)} rows of {values.shape[1]} numbers; {COLUMNS} a row are required")
    if not np.all(np.diff(values[:, 0]) > 0):
        row = int(np.argmin(np.diff(values[:, 0]) > 0)) + 2
        raise UserError(f"{path}, row {row}: time is {values[row - 1, 0]:g} s after {values[row - 2, 0]:g} s; it must increase")
    return values.T


def _columns(motors: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Columns of a recording, in our units and signs, at the times of motor 2 that all three motors cover."""
    start, end = max(m[0, 0] for m in motors), min(m[0, -1] for m in motors)
    t = motors[1][0, (motors[1][0] >= start) & (motors[1][0] <= end)]
    columns = {"t": t}
    for kind, source, unit in (("q", 1, np.pi / 180), ("dq", 2, np.pi / 180), ("tau", 5, 1.0)):
        for joint, sign, motor in zip(JOINTS, SIGNS, motors, strict=True):
            columns[f"{kind}_{joint}"] = sign * unit * np.interp(t, motor[0], motor[source])
    return columns


def _entry(number: int) -> dict:
    """One recording's entry; its group says what is mounted."""
    mounted = [name for name, numbers in (("payload", WITH_PAYLOAD), ("springs", WITH_SPRINGS)) if number in numbers]
    entry: dict = {"file": NAME.format(number), "group": "+".join(mounted) or "bare"}
    if "payload" in mounted:
        entry["payload"] = PAYLOAD
    if "springs" in mounted:
        entry["springs"] = SPRINGS
    return entry

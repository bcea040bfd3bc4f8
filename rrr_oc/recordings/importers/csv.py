"""CSV files with columns and units of one's own, turned into a recording set by a mapping in a TOML file."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.recordings.csv_table import read_table
from rrr_oc.recordings.importers.column_mapping import ColumnMapping, understood
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.recordings.writer import write_files
from rrr_oc.schema import read_toml, validated


def import_csv(files: Sequence[str | Path], robot: str | Path, out: str | Path, mapping: str | Path) -> RecordingSet:
    """Write CSV files, each one recording, of a robot (bundled model, URDF or MJCF) as a new recording set in the folder `out`.

    Time counts from a file's first instant. Columns that the mapping does not name are left out.

    Args:
        mapping: TOML file as `ColumnMapping` describes it.

    Raises:
        UserError: The mapping names a column, a unit or a joint that there is not, or leaves out one that is required; a file
            is no CSV file of numbers; the set could not be read; `out` exists.
    """
    if not files:
        raise UserError("no CSV file given; at least one is required")
    known = understood(mapping, validated(mapping, read_toml(mapping), ColumnMapping), robot)

    def read(file: Path) -> dict[str, np.ndarray]:
        table = read_table(file)
        return known.columns(f"{table.path}, line {table.header_line}", table.names, lambda names: list(table.columns(names)))

    return write_files(out, robot, known.header, files, read)

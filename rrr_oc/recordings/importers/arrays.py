"""Arrays of numpy (`.npz`) and MATLAB (`.mat`), turned into a recording set by a mapping in a TOML file."""

import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.recordings.importers.column_mapping import ColumnMapping, understood
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.recordings.writer import write_files
from rrr_oc.schema import read_toml, validated
from rrr_oc.storage import read_npz, read_regular

LEAST = 3  # rows of a recording; an array whose sides are all shorter is none


def import_arrays(files: Sequence[str | Path], robot: str | Path, out: str | Path, mapping: str | Path) -> RecordingSet:
    """Write files of arrays, each one recording, of a robot (bundled model, URDF or MJCF) as a new recording set in the folder `out`.

    A column is an array of K numbers by its name, or one row or column of a table by its name and number, from 0 on: `q.0`. Along
    which side a table has the time tells its longer side. Fields of MATLAB's structures are `log.q`. Arrays of other kinds are left out.

    Args:
        mapping: TOML file as `ColumnMapping` describes it.

    Raises:
        UserError: The mapping names a column, a unit or a joint that there is not, or leaves out one that is required; a file cannot be
            read; columns that the mapping names differ in length; the set could not be read; `out` exists.
    """
    if not files:
        raise UserError("no file of arrays given; at least one is required")
    known = understood(mapping, validated(mapping, read_toml(mapping), ColumnMapping), robot)

    def read(file: Path) -> dict[str, np.ndarray]:
        columns = dict(_columns("", _read(file)))
        return known.columns(
            str(file), tuple(columns), lambda names: _alike(file, {name: columns[name] for name in names}, names)
        )

    return write_files(out, robot, known.header, files, read)


def _read(file: Path) -> Mapping[str, Any]:
    """The variables of a file by name."""
    if file.suffix == ".npz":
        return read_npz(file)
    if file.suffix != ".mat":
        raise UserError(f"{file}: a file .npz or .mat is required")
    from scipy import io as of_matlab  # here: other commands need not wait for it

    try:
        found = of_matlab.loadmat(io.BytesIO(read_regular(file)), simplify_cells=True)
    except NotImplementedError:  # HDF5
        raise UserError(f"{file}: is a MAT file of version 7.3; save it with save(..., '-v7')") from None
    except Exception as error:  # the reader raises whatever broken bytes lead to
        raise UserError(f"{file}: no readable MAT file: {error or type(error).__name__}") from None
    return {name: value for name, value in found.items() if not name.startswith("__")}


def _columns(prefix: str, variables: Mapping[str, Any]) -> Iterator[tuple[str, np.ndarray]]:
    """Columns (K,) by name, of arrays, tables and structures of these."""
    for key, value in variables.items():
        name, array = f"{prefix}{key}", np.asarray(value)
        if isinstance(value, dict):
            yield from _columns(f"{name}.", value)
        elif array.dtype.kind in "fiub" and array.ndim in (1, 2) and max(array.shape) >= LEAST:
            table = np.atleast_2d(array.astype(float))
            table = table if table.shape[0] <= table.shape[1] else table.T  # (n, K)
            yield from [(name, table[0])] if len(table) == 1 else ((f"{name}.{i}", row) for i, row in enumerate(table))


def _alike(file: Path, columns: Mapping[str, np.ndarray], names: Sequence[str]) -> list[np.ndarray]:
    """The columns named; raises `UserError` where their lengths differ."""
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise UserError(
            f"{file}: columns of one length are required; found {', '.join(f'{n} of {k}' for n, k in lengths.items())}"
        )
    return [columns[name] for name in names]

"""CSV files of numbers under a header line: read by numpy, with exact line numbers where they are wrong."""

import itertools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.schema import decimal
from rrr_oc.storage import read_utf8

_WORD = re.compile(r"([+-]?(nan|inf|infinity))?", re.IGNORECASE)  # cells that hold no number; one without end is refused later
LINE = re.compile(rb"([^\r\n]*)(?:\r\n|\r|\n|\Z)")


@dataclass(frozen=True)
class Table:
    """A CSV file whose header has been read.

    Blank lines, text after `#`, a byte-order mark, CRLF, quotes and spaces around names, and `;` or tabs in place of commas
    are harmless. A header may stand behind `#`, where `numpy.savetxt` puts it. An empty cell is a NaN.

    Attributes:
        path: The file.
        data: All of it, in UTF-8.
        names: The columns.
        header_line: Number of the header's line, the first being 1.
        start: Number of bytes before the first row.
        delimiter: What separates cells.
    """

    path: Path
    data: bytes
    names: tuple[str, ...]
    header_line: int
    start: int
    delimiter: str

    def columns(self, names: Sequence[str]) -> np.ndarray:
        """Values of the columns named, shape (number of names, K); others may hold anything.

        Raises `UserError` for a row with more or fewer cells than the header and a cell that is no number.
        """
        indices, rows = [self.names.index(name) for name in names], list(self._rows())
        values = self._parsed([content for _, content in rows], indices)
        if values is not None:
            return values
        return np.array([self._row(number, content, indices) for number, content in rows], float).reshape(-1, len(indices)).T

    def line(self, row: int) -> int:
        """Number of the line that holds a row of `columns`."""
        return next(itertools.islice(self._rows(), row, None))[0]

    def _parsed(self, rows: Sequence[str], indices: Sequence[int]) -> np.ndarray | None:
        """Values as numpy reads them; None where it refuses a cell, as an empty one, or would accept a wrong row."""
        if not rows or any(row.count(self.delimiter) != len(self.names) - 1 for row in rows):
            return None
        try:
            return np.loadtxt(rows, delimiter=self.delimiter, usecols=indices, comments=None, ndmin=2).T.copy()
        except ValueError:
            return None

    def _rows(self) -> Iterator[tuple[int, str]]:
        for i, line in enumerate(self.data[self.start :].splitlines(), self.header_line + 1):
            content = line.split(b"#", 1)[0].decode()
            if content.strip():
                yield i, content

    def _row(self, number: int, content: str, indices: Sequence[int]) -> list[float]:
        cells = content.split(self.delimiter)
        if len(cells) != len(self.names):
            raise UserError(
                f"{self.path}, line {number}: {len(cells)} {'cell' if len(cells) == 1 else 'cells'}, "
                f"but the header names {len(self.names)} columns; every row needs one cell per column"
            )
        return [self._cell(number, i, cells[i].strip()) for i in indices]

    def _cell(self, number: int, column: int, cell: str) -> float:
        value = decimal(cell)
        if value is not None:
            return value
        if _WORD.fullmatch(cell):
            return float(cell or "nan")
        found = cell if len(cell) <= 40 else cell[:40] + "…"
        comma = " with a decimal point," if "," in cell else ""
        raise UserError(
            f"{self.path}, line {number}, column {self.names[column]!r}: found {found!r}; a number{comma} or nan is allowed"
        )


def read_table(path: Path) -> Table:
    """Read a file and its header; raises `UserError` where there is none, or a name is empty or stands twice."""
    data = read_utf8(path)
    comment = None
    for number, line in enumerate(LINE.finditer(data), 1):
        content = line[1].decode().strip()
        if content.startswith("#"):
            comment = number, line.end(), content.lstrip("# ")
        elif content:
            header = comment if _all_numbers(content) else (number, line.end(), content)
            if header is None:
                raise UserError(f"{path}, line {number}: found numbers; a header line that names the columns must come first")
            return Table(path, data, *_with_names(path, *header))
    raise UserError(f"{path}: the file is empty; a header line and rows of numbers are required")


def _with_names(path: Path, number: int, start: int, content: str) -> tuple[tuple[str, ...], int, int, str]:
    """Names of the columns, the header's line, its end and the delimiter."""
    content = content.split("#", 1)[0]
    delimiter = next((d for d in ",;\t" if d in content), ",")
    names = tuple(name.strip().strip("\"'").strip() for name in content.split(delimiter))
    if names[0] == "" != names[-1] and len(names) > 1:
        names = ("index", *names[1:])  # of rows, which data frames write without a name
    if "" in names:
        raise UserError(
            f"{path}, line {number}: column {names.index('') + 1} of {len(names)} has no name; every column needs one"
        )
    for i, name in enumerate(names):
        if name in names[:i]:
            raise UserError(f"{path}, line {number}: column {name!r} stands twice; each may stand once")
    return names, number, start, delimiter


def _all_numbers(content: str) -> bool:
    try:
        return all(math.isfinite(float(cell)) for cell in content.replace(";", ",").replace("\t", ",").split(","))
    except ValueError:
        return False

"""CSV files of numbers under a header line: read by numpy, with exact line numbers where they are wrong."""

import itertools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.schema import decimal
from rrr_oc.storage import read_utf8

_WORD = re.compile(r"([+-]?(nan|inf|infinity))?", re.IGNORECASE)  # cells that hold no number; one without end is refused later
_STAMP = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d([.,]\d+)?(Z|[+-]\d\d:?\d\d)?")  # date and time of ISO 8601
DELIMITERS = ",;\t|"  # between cells, beside spaces
LINE = re.compile(rb"([^\r\n]*)(?:\r\n|\r|\n|\Z)")


@dataclass(frozen=True)
class Table:
    """A CSV file whose header has been read.

    Blank lines, text after `#`, a byte-order mark, CRLF, quotes and spaces around names, and `;`, `|`, tabs or runs of spaces in place
    of commas are harmless. A cell with date and time (ISO 8601) is the seconds since 1970. Where cells are not separated by commas, and
    none of those that are read has a point, commas are decimal commas. A header may stand behind `#`, where `numpy.savetxt` puts it. An
    empty cell is a NaN.

    Attributes:
        path: The file.
        data: All of it, in UTF-8.
        names: The columns.
        header_line: Number of the header's line, the first being 1.
        start: Number of bytes before the first row.
        delimiter: What separates cells; None for spaces, as many as there are.
    """

    path: Path
    data: bytes
    names: tuple[str, ...]
    header_line: int
    start: int
    delimiter: str | None

    def columns(self, names: Sequence[str]) -> np.ndarray:
        """Values of the columns named, shape (number of names, K); others may hold anything.

        Raises `UserError` for a row with more or fewer cells than the header and a cell that is no number.
        """
        indices, rows = [self.names.index(name) for name in names], list(self._rows())
        if self._decimal_commas([content for _, content in rows], indices):
            rows = [(number, content.replace(",", ".")) for number, content in rows]
        values = self._parsed([content for _, content in rows], indices)
        if values is not None:
            return values
        return np.array([self._row(number, content, indices) for number, content in rows], float).reshape(-1, len(indices)).T

    def line(self, row: int) -> int:
        """Number of the line that holds a row of `columns`."""
        return next(itertools.islice(self._rows(), row, None))[0]

    def _decimal_commas(self, rows: Sequence[str], indices: Sequence[int]) -> bool:
        """Whether commas in the cells of some columns are decimal commas."""
        if self.delimiter == "," or not any("," in row for row in rows):
            return False
        cells = (row.split(self.delimiter) for row in rows)
        return not any("." in row[i] for row in cells for i in indices if i < len(row))

    def _parsed(self, rows: Sequence[str], indices: Sequence[int]) -> np.ndarray | None:
        """Values as numpy reads them; None where it refuses a cell, as an empty one, or would accept a wrong row."""
        between, d = len(self.names) - 1, self.delimiter
        if not rows or any((len(row.split()) - 1 if d is None else row.count(d)) != between for row in rows):
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
            commas = (
                "; decimal commas need ; or tabs between cells"
                if self.delimiter == "," and len(cells) == 2 * len(self.names)
                else ""
            )
            raise UserError(
                f"{self.path}, line {number}: {len(cells)} {'cell' if len(cells) == 1 else 'cells'}, "
                f"but the header names {len(self.names)} columns; every row needs one cell per column{commas}"
            )
        return [self._cell(number, i, cells[i].strip()) for i in indices]

    def _cell(self, number: int, column: int, cell: str) -> float:
        value = decimal(cell)
        if value is not None:
            return value
        if _WORD.fullmatch(cell):
            return float(cell or "nan")
        if _STAMP.fullmatch(cell.strip("\"'")):
            return _seconds(cell.strip("\"'"))
        found = cell if len(cell) <= 40 else cell[:40] + "…"
        comma = " with a decimal point," if "," in cell else ""
        raise UserError(
            f"{self.path}, line {number}, column {self.names[column]!r}: found {found!r}; a number{comma} or nan is allowed"
        )


def _seconds(stamp: str) -> float:
    """Seconds since 1970 of date and time, of UTC where it says no zone; NaN for a day that there is not."""
    try:
        at = datetime.fromisoformat(stamp.replace(",", "."))
    except ValueError:
        return math.nan
    return (at if at.tzinfo is not None else at.replace(tzinfo=UTC)).timestamp()


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
            rows = (line[1].decode().split("#", 1)[0] for line in LINE.finditer(data, header[1]))
            first = next((row for row in rows if row.strip()), "")
            return Table(path, data, *_with_names(path, *header, first))
    raise UserError(f"{path}: the file is empty; a header line and rows of numbers are required")


def _with_names(path: Path, number: int, start: int, content: str, row: str) -> tuple[tuple[str, ...], int, int, str | None]:
    """Names of the columns, the header's line, its end and the delimiter, for which the first row may help."""
    content = content.split("#", 1)[0]
    delimiter = _delimiter(content, row)
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


def _delimiter(header: str, row: str) -> str | None:
    """What separates cells: of what stands in the header, the first that gives as many cells in the first row, or the first."""
    there = [d for d in DELIMITERS if d in header]
    if there:
        return next((d for d in there if header.count(d) == row.count(d)), there[0])
    return None if len(header.split()) > 1 else ","


def _all_numbers(content: str) -> bool:
    """Whether a line has finite numbers alone, whatever separates them."""
    try:
        return all(math.isfinite(float(cell)) for cell in re.split(r"[\s,;|]+", content.strip(" ,;|\t")))
    except ValueError:
        return False

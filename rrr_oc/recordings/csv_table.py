"""CSV files of numbers under a header line, read fast, with exact line numbers where they are wrong."""

import io
import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.storage import read_text


@dataclass(frozen=True)
class Table:
    """A CSV file whose header has been read.

    Blank lines, text after `#`, a byte-order mark, CRLF, quotes and spaces around names, and `;` or tabs in place of commas
    are harmless. A header may stand behind `#`, where `numpy.savetxt` puts it. An empty cell is a NaN, as pandas writes it.

    Attributes:
        path: The file.
        text: All of it.
        names: The columns.
        header_line: Number of the header's line, the first being 1.
        delimiter: What separates cells.
    """

    path: Path
    text: str
    names: tuple[str, ...]
    header_line: int
    delimiter: str

    def columns(self, names: Sequence[str]) -> np.ndarray:
        """Values of the columns named, shape (number of names, K); others may hold anything.

        Raises `UserError` for a row with more or fewer cells than the header and a cell that is no number.
        """
        indices = [self.names.index(name) for name in names]
        stream = io.StringIO(self.text, newline=None)
        for _ in range(self.header_line):
            stream.readline()
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "loadtxt: input contained no data")
                values = np.loadtxt(stream, delimiter=self.delimiter, ndmin=2)
        except ValueError:  # the file is wrong, or has empty cells or text in columns that nobody asked for: look closely
            return self._closely(indices)
        if values.size == 0 or values.shape[1] != len(self.names):
            return self._closely(indices)
        return np.ascontiguousarray(values[:, indices].T)

    def line(self, row: int) -> int:
        """Number of the line that holds a row of `columns`."""
        return next(number for i, (number, _) in enumerate(self._rows()) if i == row)

    def _rows(self) -> Iterator[tuple[int, str]]:
        for number, line in enumerate(io.StringIO(self.text, newline=None), 1):
            content = line.split("#", 1)[0]
            if number > self.header_line and content.strip():
                yield number, content

    def _closely(self, indices: Sequence[int]) -> np.ndarray:
        rows = [self._row(number, content, indices) for number, content in self._rows()]
        return np.array(rows, float).reshape(-1, len(indices)).T

    def _row(self, number: int, content: str, indices: Sequence[int]) -> list[float]:
        cells = content.rstrip("\r\n").split(self.delimiter)
        if len(cells) != len(self.names):
            raise UserError(
                f"{self.path}, line {number}: {len(cells)} {'cell' if len(cells) == 1 else 'cells'}, "
                f"but the header names {len(self.names)} columns; every row needs one cell per column"
            )
        return [self._cell(number, i, cells[i].strip()) for i in indices]

    def _cell(self, number: int, column: int, cell: str) -> float:
        try:
            return float(cell) if cell else math.nan
        except ValueError:
            found = cell if len(cell) <= 40 else cell[:40] + "…"
            comma = " with a decimal point," if "," in cell else ""
            raise UserError(
                f"{self.path}, line {number}, column {self.names[column]!r}: found {found!r}; a number{comma} or nan is allowed"
            ) from None


def read_table(path: Path) -> Table:
    """Read a file and its header; raises `UserError` where there is none, or a name is empty or stands twice."""
    text = read_text(path)
    comment = None
    for number, line in enumerate(io.StringIO(text, newline=None), 1):
        content = line.strip()
        if content.startswith("#"):
            comment = number, content.lstrip("# ")
        elif content:
            if _all_numbers(content):
                if comment is None:
                    raise UserError(
                        f"{path}, line {number}: found numbers; a header line that names the columns must come first"
                    )
                number, content = comment
            return _with_header(path, text, number, content)
    raise UserError(f"{path}: the file is empty; a header line and rows of numbers are required")


def _with_header(path: Path, text: str, number: int, content: str) -> Table:
    content = content.split("#", 1)[0]
    delimiter = next((d for d in ",;\t" if d in content), ",")
    names = tuple(name.strip().strip("\"'").strip() for name in content.split(delimiter))
    if names[0] == "" != names[-1] and len(names) > 1:
        names = ("index", *names[1:])  # as pandas writes it
    if "" in names:
        raise UserError(
            f"{path}, line {number}: column {names.index('') + 1} of {len(names)} has no name; every column needs one"
        )
    for i, name in enumerate(names):
        if name in names[:i]:
            raise UserError(f"{path}, line {number}: column {name!r} stands twice; each may stand once")
    return Table(path, text, names, number, delimiter)


def _all_numbers(content: str) -> bool:
    try:
        return all(math.isfinite(float(cell)) for cell in content.replace(";", ",").replace("\t", ",").split(","))
    except ValueError:
        return False

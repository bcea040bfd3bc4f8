"""What commands share: the set they read, what they print and how, and files that they must not write over."""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import RenderableType

from rrr_oc.errors import UserError
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.report.console import wide_console


@dataclass(frozen=True)
class Output:
    """Where a command says what it found: tables and sentences, the result as JSON alone, or nothing but errors and warnings.

    Attributes:
        quiet: Print no tables, sentences and progress.
        as_json: Print the result as JSON to stdout in their place.
    """

    quiet: bool = False
    as_json: bool = False
    began: float = field(default_factory=time.perf_counter)

    def show(self, *what: RenderableType) -> None:
        """Tables and sentences on stdout."""
        if not (self.quiet or self.as_json):
            for one in what:
                wide_console().print(one, highlight=False, soft_wrap=isinstance(one, str))

    def warn(self, text: str) -> None:
        """What a user has to know, on stderr."""
        wide_console(stderr=True).print(text, highlight=False, soft_wrap=True)

    def result(self, content: Any) -> None:
        """The result, if it is asked for as JSON."""
        if self.as_json:
            print_json(content)

    def progress(self, line: str) -> None:
        """What begins now, on stderr, with the time since the command began."""
        if not self.quiet:
            wide_console(stderr=True).print(
                f"{time.perf_counter() - self.began:6.0f} s  {line}", highlight=False, soft_wrap=True
            )


def print_json(content: Any) -> None:
    """JSON on stdout."""
    print(json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False))


def loaded(dataset: Path, output: Output) -> RecordingSet:
    """A recording set; what a user should know of how it was read goes to stderr."""
    recordings = load_recordings(dataset)
    for note in recordings.notes:
        output.warn(f"Note: {note}.")
    return recordings


def check_apart(read: Sequence[Path], written: Sequence[Path]) -> None:
    """Raise `UserError` where what is to be written would take the place of what was read."""
    inputs = {path.resolve() for path in read}
    for path in written:
        if path.resolve() in inputs:
            raise UserError(f"{path}: is read by this command and would be overwritten; another place is required")


def shown(value: float | None) -> str:
    """A number with four digits."""
    return "–" if value is None else f"{value:.4g}"

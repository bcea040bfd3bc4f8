"""What commands say: tables for people on stdout, JSON for programs in their place, notes and progress on stderr."""

import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from rrr_oc.errors import printable
from rrr_oc.progress import Step
from rrr_oc.report.console import wide_console

LINE_EVERY = 10.0  # [s] between two lines of a count where there is no terminal
LEAST_DONE = 0.05  # share of a computation from which the time that is left is told; twice as much: told later, and better
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="no tables, notes and progress, only errors")]
Json = Annotated[bool, typer.Option("--json", help="the result as JSON on stdout in place of tables")]


_kept_results: ContextVar[list[Any] | None] = ContextVar("kept results", default=None)


@contextmanager
def progress_alone() -> Iterator[list[Any]]:
    """Within this block commands tell their progress and notes, but show no results: these go to a list, which is yielded, as plain data."""
    results: list[Any] = []
    before = _kept_results.set(results)
    try:
        yield results
    finally:
        _kept_results.reset(before)


class TimeLeft:
    """The time that a computation has taken and may still take, from the share of it that was done since its first step."""

    def __init__(self) -> None:
        self._began, self._first = time.monotonic(), None

    def of(self, step: Step) -> tuple[float, float | None]:
        """Seconds spent, and seconds left if that can be told."""
        spent = time.monotonic() - self._began
        self._first = step.done if self._first is None else self._first
        done = step.done - self._first
        return spent, spent / done * (1 - step.done) if done >= LEAST_DONE else None


def _remarks(step: Step, left: float | None) -> list[str]:
    """What is known of a step beside its stage."""
    count = f"{step.tried}{f' of {step.total}' * bool(step.total)} {step.kind}"
    tried = count if step.tried or step.total else ""
    return [remark for remark in (tried, "" if left is None else f"about {left:.0f} s left") if remark]


@dataclass(frozen=True)
class Output:
    """Where a command's result goes.

    Attributes:
        quiet: Nothing is said, whether of the result, of the data or of the progress; errors are exceptions and not said here.
        as_json: The result is JSON alone on stdout. Notes and progress go to stderr in any case.
    """

    quiet: bool = False
    as_json: bool = False

    @cached_property
    def _result(self) -> Console:
        return wide_console()

    @cached_property
    def _beside(self) -> Console:
        return wide_console(stderr=True)

    def show(self, shown: Any) -> None:
        """A table, or a sentence that is not broken into lines, for people."""
        if _kept_results.get() is None and not (self.quiet or self.as_json):
            self._result.print(shown, highlight=False, soft_wrap=isinstance(shown, str))

    def table(
        self, header: Sequence[str], rows: Iterable[Sequence[str]], title: str | None = None, lines: bool = False
    ) -> None:
        """A table for people, with `lines` between its rows if asked for; none without rows."""
        table = Table(*header, title=title, show_lines=lines)
        for row in rows:
            table.add_row(*row)
        if table.rows:
            self.show(table)

    def result(self, content: Any) -> None:
        """The result for programs, of plain data without NaN."""
        kept = _kept_results.get()
        if kept is not None:
            kept.append(content)
            return
        if self.as_json:
            typer.echo(printable(json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)))

    def note(self, sentence: str) -> None:
        """What a user should know beside the result."""
        if not self.quiet:
            self._beside.print(sentence, highlight=False, soft_wrap=True)

    @contextmanager
    def steps(self, first: str) -> Iterator[Callable[[str], None]]:
        """A function that says which step has begun: in place on a terminal, else a line each with the time since the start."""
        if self.quiet:
            yield lambda _: None
        elif self._beside.is_terminal:
            with self._beside.status(Text(printable(first))) as status:
                yield lambda step: status.update(Text(printable(step)))
        else:
            began = time.monotonic()

            def line(step: str) -> None:
                self.note(f"{time.monotonic() - began:7.1f} s  {step}")

            line(first)
            yield line

    @contextmanager
    def stages(self, name: str = "") -> Iterator[Callable[[Step], None]]:
        """A function that says how far a computation is, of this name where there are several: a bar on a terminal, else a line each, of
        JSON where the result is."""
        time_left = TimeLeft()
        if self.quiet:
            yield lambda step: None
        elif self._beside.is_terminal and not self.as_json:
            columns = BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), TextColumn("{task.fields[remark]}", markup=False)
            with Progress(TextColumn("{task.description:20}", markup=False), *columns, console=self._beside) as progress:
                row = progress.add_task(printable(name), total=1.0, remark="")

                def show(step: Step) -> None:
                    remark = printable(", ".join([*_remarks(step, time_left.of(step)[1]), *([step.said] if step.said else [])]))
                    progress.update(
                        row, completed=step.done, description=printable(f"{name} {step.stage}".strip()), remark=remark
                    )

                yield show
        else:
            yield lambda step: self._line(name, step, *time_left.of(step))

    def _line(self, name: str, step: Step, spent: float, left: float | None) -> None:
        if self.as_json:
            line = {"of": name, "stage": step.stage, "share_done": round(step.done, 3), "tried": step.tried}
            line |= {"total": step.total or None, "kind": step.kind, "said": step.said}
            line |= {"seconds": round(spent, 1), "seconds_left": None if left is None else round(left, 1)}
            typer.echo(printable(json.dumps(line, ensure_ascii=False)), err=True)
            return
        known = ", ".join([f"{step.done:.0%} done", *_remarks(step, left)])
        self.note(f"{spent:7.1f} s  {name}{': ' * bool(name)}{step.stage} ({known})  {step.said}".rstrip())

    @contextmanager
    def count(self, name: str, total: int | None = None) -> Iterator[Callable[[int, str], None]]:
        """A function of how many are done and a remark: a bar on a terminal, else a line now and then, and one for the last."""
        if self.quiet:
            yield lambda done, remark: None
        elif self._beside.is_terminal:
            columns = BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.fields[remark]}", markup=False)
            with Progress(TextColumn("{task.description:12}", markup=False), *columns, console=self._beside) as progress:
                row = progress.add_task(printable(name), total=total, remark="")
                yield lambda done, remark: progress.update(row, completed=done, remark=printable(remark))
        else:
            began, said = time.monotonic(), float("-inf")

            def line(done: int, remark: str) -> None:
                nonlocal said
                now = time.monotonic() - began
                if now - said >= LINE_EVERY or done == total:
                    said = now
                    self.note(f"{now:7.1f} s  {name}: {done}{'' if total is None else f' of {total}'} {remark}".rstrip())

            yield line

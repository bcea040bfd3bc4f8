"""The one error that a user can mend, and how a command ends: with one of `STATUSES`."""

import os
import re
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

T = TypeVar("T")
FAULT = 70  # exit status after an exception that nobody expected; of sysexits.h
INTERRUPTED = 130  # exit status after Ctrl-C
# What the exit statuses of all commands mean.
STATUSES = {
    0: "done",
    2: "input that cannot be used, with a sentence that says why",
    FAULT: "a fault of this program, with a sentence that names a log file for a report",
    INTERRUPTED: "interrupted by Ctrl-C",
}


# Characters that move a terminal's cursor, colour or hide what follows, or turn the direction of writing; lines and tabs are none
_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")

_ENDLESS = re.compile(r"\S{1000,}")  # longer than the paths that there are


def printable(text: str) -> str:
    """A text for a terminal: control characters, as names in files may have them, as \\u and their code."""
    return _CONTROLS.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


class UserError(Exception):
    """Input that cannot be used: says what was found and what is allowed. The command line exits with status 2.

    Words beyond any name or path, as damaged files have them, are told without their middle.
    """

    def __init__(self, said: str) -> None:
        super().__init__(_ENDLESS.sub(lambda word: f"{word[0][:100]}…{word[0][-50:]}", str(said)))


def entry_point(command: Callable[[], Any]) -> Callable[[], None]:
    """A command as its users run it: an error that they can mend is one sentence on stderr and exit status 2; of any other they get a log."""

    def run() -> None:
        try:
            command()
        except UserError as error:
            sys.stderr.write(f"Error: {printable(str(error))}\n")
            raise SystemExit(2) from None
        except KeyboardInterrupt:
            sys.stderr.write("Interrupted.\n")
            raise SystemExit(INTERRUPTED) from None
        except SystemExit as end:
            if end.code == INTERRUPTED:  # typer says nothing then
                sys.stderr.write("Interrupted.\n")
            raise
        except Exception as error:  # whatever nobody expected
            sys.stderr.write(f"Error: {printable(_logged(error))}\n")
            raise SystemExit(FAULT) from None

    return run


def meant(name: str, allowed: Iterable[str]) -> str:
    """A question behind a message on a wrong name: the allowed one that it is most like; nothing where there is none."""
    from difflib import get_close_matches  # a moment, that nobody waits for without a mistake

    known = list(allowed)
    by_folded = {one.casefold(): one for one in known}
    close = get_close_matches(name.casefold(), by_folded, 1)
    return f". Did you mean {by_folded[close[0]]!r}?" if close else ""


def reason(error: Exception) -> str:
    """Why something failed, in a line; of a fault of this program with the name of the exception."""
    said = str(error) if isinstance(error, UserError) else f"{type(error).__name__}{f': {error}' * bool(str(error))}"
    return " ".join(said.split())[:300]


@contextmanager
def noted(failed: dict[str, str], step: str) -> Iterator[None]:
    """Do a step without which all else stands: where it fails, of whatever cause, that is noted under its name, and no exception goes on.

    For the last steps of long computations alone, whose results a fault in a figure must not cost.
    """
    try:
        yield
    except Exception as error:
        failed[step] = reason(error)


def tried(step: str, function: Callable[..., T], *arguments: Any) -> tuple[list[T], dict[str, str]]:
    """The result of a call, in a list, or why there is none, as `noted` has it: for calls in other processes."""
    found, failed = list[T](), dict[str, str]()
    with noted(failed, step):
        found.append(function(*arguments))
    return found, failed


def _logged(error: Exception) -> str:
    """A sentence on a fault of this program, with the name of a new log file for a report."""
    import platform  # these take a moment, in which Ctrl-C would be a traceback
    import tempfile
    import traceback
    from importlib.metadata import distributions

    packages = sorted(f"{found.name} {found.version}" for found in distributions())
    text = "\n".join(
        [shlex.join(sys.argv), f"Python {sys.version}", platform.platform(), *packages, "", *traceback.format_exception(error)]
    )
    said = f"rrr-oc failed through a fault of its own, {type(error).__name__}{f' ({error})' * bool(str(error))}"
    said = " ".join(said.split())[:300]
    try:
        descriptor, path = tempfile.mkstemp(prefix="rrr-oc-fault-", suffix=".log")
        with os.fdopen(descriptor, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(text)
    except OSError:  # a full disk, perhaps the fault itself
        return f"{said}; no log file could be written, so here is its content:\n{text}"
    return f"{said}; {path} has what a report needs"


@contextmanager
def ends_at_once() -> Iterator[None]:
    """Ctrl-C ends this process with one line while modules are imported: compiled ones turn the exception into others, or lose it."""
    if (
        threading.current_thread() is not threading.main_thread()
        or signal.getsignal(signal.SIGINT) != signal.default_int_handler
    ):
        yield
        return

    def end(*_: Any) -> None:
        os.write(2, b"Interrupted.\n")
        os._exit(INTERRUPTED)

    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


class Patience:
    """Ctrl-C that waits for what is nearly done: within `kept` it is noted, and `over` acts on it; another one acts at once.

    Attributes:
        asked: Whether there was one.
    """

    asked = False

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Where the first Ctrl-C only is noted."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def note(*_: Any) -> None:
            if self.asked:
                raise KeyboardInterrupt
            self.asked = True

        before = signal.signal(signal.SIGINT, note)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)

    def over(self) -> None:
        """Raises `KeyboardInterrupt` where there was one."""
        if self.asked:
            raise KeyboardInterrupt

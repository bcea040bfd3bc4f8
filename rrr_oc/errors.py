"""The one error that a user can mend, and how it ends a command."""

import sys
from collections.abc import Callable
from typing import Any

INTERRUPTED = 130  # exit status after Ctrl-C


class UserError(Exception):
    """Input that cannot be used: says what was found and what is allowed. The command line exits with status 2."""


def entry_point(command: Callable[[], Any]) -> Callable[[], None]:
    """A command as its users run it: an error that they can mend is one sentence on stderr and exit status 2."""

    def run() -> None:
        try:
            command()
        except UserError as error:
            sys.stderr.write(f"Error: {error}\n")
            raise SystemExit(2) from None
        except SystemExit as end:
            if end.code == INTERRUPTED:  # typer says nothing then
                sys.stderr.write("Interrupted.\n")
            raise

    return run

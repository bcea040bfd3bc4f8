"""The console that commands print to."""

from rich.console import Console


def wide_console(stderr: bool = False) -> Console:
    """A console that takes brackets literally, and is 160 columns wide where its output is no terminal, as in a log."""
    console = Console(markup=False, stderr=stderr)
    if not console.is_terminal:
        console.width = 160
    return console

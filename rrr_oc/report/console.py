"""The console that commands print to."""

from typing import Any

from rich.console import Console
from rich.text import Text

from rrr_oc.errors import printable


class PlainConsole(Console):
    """A console to which texts are texts: brackets are no markup, and control characters do not reach the terminal."""

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **options)


def wide_console(stderr: bool = False) -> Console:
    """A console that takes brackets literally, and is 160 columns wide where its output is no terminal, as in a log."""
    console = PlainConsole(markup=False, emoji=False, stderr=stderr)
    if not console.is_terminal:
        console.width = 160
    return console

"""Where the command `rrr-oc` starts: nothing but the handling of errors is imported before Ctrl-C is told from a failure."""

from rrr_oc.errors import ends_at_once, entry_point


def _command() -> None:
    with ends_at_once():
        from rrr_oc.commands import app
    app()


main = entry_point(_command)

"""Studies run as their users run them, but in this process."""

import signal
import sys
from types import ModuleType

import pytest

from rrr_oc import cli


def heeds_ctrl_c() -> None:
    """For `preexec_fn`: a process of its own heeds SIGINT also where the tests run in the background, where shells ignore it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def run(study: ModuleType, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """The exit status of a study's command line."""
    monkeypatch.setattr(sys, "argv", [str(study.__file__), *arguments])
    with pytest.raises(SystemExit) as stop:
        study.run()
    return int(stop.value.code or 0)


def rrr_oc(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """The exit status of the command line."""
    monkeypatch.setattr(sys, "argv", ["rrr-oc", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    return int(stop.value.code or 0)

"""Results that a command keeps in its folder as it finishes them, so that the same command goes on where it was.

They are hidden files beside the results that people see. A kept result is taken again if it is whole and was made with the same
settings, which include the version of the code and the content of what was read.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from rrr_oc.errors import UserError
from rrr_oc.progress import Step
from rrr_oc.storage import plain, read_utf8, write_json

VERSION = ("version", "code")  # settings that say which program made a result


class Listener(Protocol):
    """Who is told how a run goes on."""

    def show(self, shown: str, /) -> None:
        """A sentence."""
        ...

    def note(self, sentence: str, /) -> None:
        """A sentence beside the results."""
        ...

    def count(self, name: str, total: int | None = None) -> AbstractContextManager[Callable[[int, str], None]]:
        """A function that takes how many of a total are done, and a remark."""
        ...

    def stages(self, name: str = "") -> AbstractContextManager[Callable[[Step], None]]:
        """A function that takes how far a computation is, of this name where there are several."""
        ...


class Kept(Protocol):
    """What is known of a run whose results are kept."""

    @property
    def out(self) -> Path:
        """Folder of the results."""
        ...

    @property
    def asked(self) -> Mapping[str, Any]:
        """The settings on which a result depends, by what a user calls them; those of `VERSION` say which program made it."""
        ...

    @property
    def listener(self) -> Listener:
        """Who is told which results were taken."""
        ...


@dataclass(frozen=True)
class Keeping:
    """A run whose results are kept, see `Kept`."""

    out: Path
    asked: Mapping[str, Any]
    listener: Listener


def kept_motion(run: Kept, name: str) -> Path:
    """Where a run keeps a motion until its results are written as a whole, and for a run that goes on: beside an earlier run's results,
    of which it is no part."""
    return run.out / f".{name}.npz"


def once(run: Kept, name: str, make: Callable[[], dict[str, Any]], files: Sequence[str] | None = None) -> dict[str, Any]:
    """A result by name: the one in the folder if a run with the same settings wrote it, else that of `make`, which is saved at once
    unless it was interrupted. `files` are the motions that belong to it, by default that of its name."""
    files = [name] if files is None else files
    found = known(run, name, files)
    if found is not None:
        return found
    found = make()
    if not found.get("interrupted"):
        save(run, name, found, files)
    return found


def known(run: Kept, name: str, files: Sequence[str] = ()) -> dict[str, Any] | None:
    """As `taken`; that it is there is said."""
    found = taken(run, name, files)
    if found is not None:
        run.listener.note(f"{name}: taken from the interrupted or repeated run in {run.out}")
    return found


def taken(run: Kept, name: str, files: Sequence[str] = ()) -> dict[str, Any] | None:
    """The result in the folder if a run with the same settings wrote it, with its motions; else it is removed, and that is said."""
    saved = _file(run, name)
    if saved.exists():
        content = _read(saved)
        changed = [] if content is None else _changed(content["asked"], _settings(run))
        if content is None or (not changed and content["hash"] != _hash(run, content["found"], files)):
            run.listener.note(f"{name}: what is saved in {run.out} is damaged; it is made again")
        elif changed:
            others = ", ".join(changed)
            run.listener.note(f"{name}: begun anew; what is saved in {run.out} was made with other settings: {others}")
        else:
            return content["found"]
    saved.unlink(missing_ok=True)  # the motion beside it is about to change
    return None


def save(run: Kept, name: str, found: dict[str, Any], files: Sequence[str] = ()) -> None:
    """Keep a result in the folder, with the settings under which it was made, and a hash of it and of its motions."""
    write_json(_file(run, name), {"asked": _settings(run), "hash": _hash(run, found, files), "found": found})


def _file(run: Kept, name: str) -> Path:
    return run.out / f".{name}.json"


def _changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Which settings differ, the program's version as one of them."""
    keys = [key for key in now if before.get(key) != now[key]] + [key for key in before if key not in now]
    return list(dict.fromkeys("version of this program" if key in VERSION else key for key in keys))


def _read(saved: Path) -> dict[str, Any] | None:
    """A saved result with its settings and hash; None where it is damaged."""
    try:
        content = json.loads(read_utf8(saved))
        dict(content["asked"])
        return {key: content[key] for key in ("asked", "hash", "found")}
    except (UserError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _hash(run: Kept, found: dict[str, Any], files: Sequence[str]) -> str:
    """Of a result and of its motions, so that neither is taken for another's."""
    result = hashlib.sha256(json.dumps(found, sort_keys=True).encode())
    for path in (kept_motion(run, file) for file in files):
        result.update(path.read_bytes() if path.is_file() else b"missing")
    return result.hexdigest()


def _settings(run: Kept) -> dict[str, Any]:
    """The settings as they are read back from JSON."""
    return json.loads(json.dumps(plain(run.asked)))

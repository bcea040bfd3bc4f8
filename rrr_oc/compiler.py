"""C code compiled to shared libraries, which are kept in a cache on disk.

A library runs with the rights of whoever loads it, and one that is cut off kills the process. So one of the cache is taken only if
nobody else could have written it and its content is what was compiled; else it is compiled again.
"""

import hashlib
import os
import platform
import shlex
import shutil
import stat
import subprocess
from functools import cache
from pathlib import Path

from rrr_oc.errors import UserError
from rrr_oc.storage import new_files

_FLAGS = ("-fPIC", "-shared", "-fvisibility=hidden")
COMPILERS = ("cc", "gcc", "clang")
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def digest(*parts: str) -> str:
    """A hash of sources, flags and platform, as a name for the library that is compiled from them."""
    key = "\0".join([*parts, platform.system(), platform.machine(), *_FLAGS])
    return hashlib.sha256(key.encode()).hexdigest()[:24]


def library(name: str, source: str, flags: tuple[str, ...] = ()) -> Path:
    """The library of this name, compiled from C unless the cache has it; `name` must change with source and flags.

    Raises:
        UserError: There is no C compiler ($CC, cc, gcc or clang), it fails, or the cache cannot be written or belongs to somebody
            else.
    """
    command = _compiler()
    path = _own(cache_folder()) / f"{name}-{digest(_version(command))[:8]}.so"
    if not _sound(path):
        _compile(command, source, (*flags, *_FLAGS), path)
    return path


def available() -> bool:
    """Whether there is a C compiler, or $CC names one; without it, generated code is evaluated by CasADi's virtual machine."""
    return bool(os.environ.get("CC") or _found())


def cache_folder() -> Path:
    """Where compiled code is kept: `rrr_oc` in $XDG_CACHE_HOME (if that is an absolute path) or in ~/.cache."""
    home = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (home if home.is_absolute() else Path.home() / ".cache") / "rrr_oc"


def _own(folder: Path) -> Path:
    """The folder, made if need be and closed to others; raises `UserError` where it belongs to somebody else."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        found = folder.stat()
        if found.st_uid != os.geteuid():
            raise UserError(f"{folder} belongs to another user, whose compiled code is not run; XDG_CACHE_HOME chooses another")
        if found.st_mode & _OTHERS_WRITE:
            folder.chmod(stat.S_IMODE(found.st_mode) & ~_OTHERS_WRITE)
    except OSError as error:
        raise UserError(f"cannot keep compiled code in {folder}: {error}; XDG_CACHE_HOME chooses another") from None
    return folder


def _sound(path: Path) -> bool:
    """Whether a library is there, only its user could write it, and its content has the hash that stands beside it."""
    try:
        found, told = path.lstat(), _hash_file(path).read_text()
        ours = stat.S_ISREG(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & _OTHERS_WRITE
        return ours and told == hashlib.sha256(path.read_bytes()).hexdigest()
    except (OSError, ValueError):  # ValueError: no text
        return False


def _hash_file(path: Path) -> Path:
    return path.with_suffix(".sha256")


@cache
def _version(command: tuple[str, ...]) -> str:
    """Which compiler it is, in its own words."""
    done = subprocess.run([*command, "--version"], capture_output=True, text=True, errors="replace")
    return shlex.join(command) + done.stdout


def _found() -> str | None:
    """The first of the usual compilers that is on PATH."""
    return next((name for name in COMPILERS if shutil.which(name)), None)


def _compiler() -> tuple[str, ...]:
    chosen = os.environ.get("CC")
    command = shlex.split(chosen) if chosen else [name] if (name := _found()) else []
    if command and shutil.which(command[0]):
        return tuple(command)
    tried = f"$CC = {chosen!r} is not on PATH" if chosen else f"none of {', '.join(COMPILERS)} is on PATH"
    raise UserError(f"this needs a C compiler, but {tried}; install one{', or unset CC to do without' * bool(chosen)}")


def _compile(command: tuple[str, ...], source: str, flags: tuple[str, ...], path: Path) -> None:
    with new_files(path.parent, ()) as folder:
        code, built = folder / "code.c", folder / path.name
        code.write_text(source, encoding="utf-8")
        line = [*command, *flags, str(code), "-o", str(built), "-lm"]
        done = subprocess.run(line, capture_output=True, text=True, errors="replace")
        if done.returncode:
            raise UserError(f"{shlex.join(command)} cannot compile generated code: {done.stderr.strip()[:600]}")
        code.unlink()
        built.chmod(0o700)
        _hash_file(built).write_text(hashlib.sha256(built.read_bytes()).hexdigest())

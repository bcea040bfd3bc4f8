"""C code compiled to shared libraries, which are kept in a cache on disk."""

import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path

from rrr_oc.errors import UserError

_FLAGS = ("-fPIC", "-shared", "-fvisibility=hidden")


def digest(*parts: str) -> str:
    """A hash of sources, flags and platform, as a name for the library that is compiled from them."""
    key = "\0".join([*parts, platform.system(), platform.machine(), *_FLAGS])
    return hashlib.sha256(key.encode()).hexdigest()[:24]


def library(name: str, source: str, flags: tuple[str, ...] = (), otherwise: str = "") -> Path:
    """The library of this name, compiled from C unless the cache has it; `name` must change with source and flags.

    Raises:
        UserError: There is no C compiler ($CC, cc, gcc or clang), it fails, or the cache cannot be written. `otherwise` tells
            the user what works without.
    """
    path = cache_folder() / f"{name}.so"
    if not path.is_file():
        _compile(_compiler(otherwise), source, (*flags, *_FLAGS), path)
    return path


def cache_folder() -> Path:
    """Where compiled code is kept: `rrr_oc` in $XDG_CACHE_HOME (if that is an absolute path) or in ~/.cache."""
    home = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (home if home.is_absolute() else Path.home() / ".cache") / "rrr_oc"


def _compiler(otherwise: str) -> tuple[str, ...]:
    chosen = os.environ.get("CC")
    for command in [shlex.split(chosen)] if chosen else [["cc"], ["gcc"], ["clang"]]:
        if command and shutil.which(command[0]):
            return tuple(command)
    tried = f"$CC = {chosen!r} is not on PATH" if chosen else "none of cc, gcc, clang is on PATH"
    raise UserError(f"this needs a C compiler, but {tried}; install one{otherwise}")


def _compile(command: tuple[str, ...], source: str, flags: tuple[str, ...], path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            code, built = Path(folder) / "code.c", Path(folder) / "code.so"
            code.write_text(source)
            line = [*command, *flags, str(code), "-o", str(built), "-lm"]
            done = subprocess.run(line, capture_output=True, text=True)
            if done.returncode:
                raise UserError(f"{shlex.join(command)} cannot compile generated code: {done.stderr.strip()[:600]}")
            os.replace(built, path)
    except OSError as error:
        raise UserError(f"cannot keep compiled code in {path.parent}: {error}; XDG_CACHE_HOME chooses another") from None

"""Text files read as UTF-8; files and folders written whole or not at all: under a temporary name, then renamed.

What has its name is on the disk, so that a loss of power does not leave it empty. A process that is killed leaves its temporary file,
which the next one that writes there removes; a lock tells it from one that is still being written.
"""

import errno
import fcntl
import hashlib
import io
import json
import math
import os
import re
import secrets
import shutil
import stat
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np

from rrr_oc.errors import UserError

TEMPORARY = re.compile(r"\..*\.[0-9a-f]{8}\.rrr_oc", re.DOTALL)  # names of what is being written
RESULTS_DEPEND_ON = ("casadi", "cma", "mujoco", "numpy", "pin", "scipy")
SHOWN_BY = ("commands", "report")  # folders of this package that show results and compute none
LARGEST = 2_000_000_000  # [bytes] of a file that is read; doubled, a file of this size may take all memory of a small machine
NEW = partial(Path.touch, exist_ok=False)  # makes a file that must not be there yet


def resolved(path: Path) -> Path:
    """Where a path leads, with links followed; raises `UserError` where they lead in a circle, or no file can have the name."""
    try:
        path.stat()
    except OSError as error:
        if error.errno == errno.ELOOP:  # for which Python's own error depends on its version
            raise UserError(f"{path}: is, or lies behind, a link that leads in a circle") from None
    except ValueError as error:  # as of a null byte
        raise UserError(f"{path}: is no name of a file: {error}") from None
    return path.resolve()


def read_regular(path: str | Path) -> bytes:
    """The content of a regular file of at most `LARGEST` bytes; raises `UserError` for a missing one, a pipe or a device."""
    path = Path(path)
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):  # a pipe would be waited for, and a device may have no end
            raise UserError(
                f"{path}: is {'a folder' if stat.S_ISDIR(found.st_mode) else 'no regular file'}; a file is required"
            )
        if found.st_size > LARGEST:
            raise UserError(f"{path}: has {found.st_size / 1e9:.1f} GB; files up to {LARGEST / 1e9:g} GB are read")
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        raise UserError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def read_utf8(path: str | Path) -> bytes:
    """A text file in UTF-8, less a byte-order mark; raises `UserError` where it is missing or something else."""
    data = read_regular(path).removeprefix(b"\xef\xbb\xbf")
    try:
        if not data.isascii():
            data.decode()
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise UserError(f"{path}, line {line}: found byte 0x{data[error.start]:02x}; text in UTF-8 is required") from None
    return data


def read_npz(path: str | Path) -> dict[str, np.ndarray]:
    """The arrays of an npz file; raises `UserError` where it is missing, damaged, of objects or too large when unpacked."""
    data = io.BytesIO(read_regular(path))
    try:
        with zipfile.ZipFile(data) as file:
            size = sum(part.file_size for part in file.infolist())
        if size > LARGEST:
            raise UserError(f"{path}: has {size / 1e9:.1f} GB when unpacked; up to {LARGEST / 1e9:g} GB are read")
        data.seek(0)
        with np.load(data, allow_pickle=False) as file:
            return dict(file)
    except (OSError, ValueError, KeyError, EOFError, MemoryError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{path}: no readable npz file: {error}") from None


@cache
def code() -> str:
    """A hash of what results depend on: the sources of this package that compute, and versions of others."""
    found, root = hashlib.sha256(), Path(__file__).parent
    for file in sorted(root.rglob("*.py")):
        if file.relative_to(root).parts[0] not in SHOWN_BY:
            found.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    for package in RESULTS_DEPEND_ON:
        found.update(f"{package} {version(package)}\0".encode())
    return found.hexdigest()[:24]


def hash_of(paths: Iterable[Path]) -> str:
    """A hash of the content of files, and of all visible files in folders; a missing one counts as empty."""
    found = hashlib.sha256()
    for path in paths:
        inside = sorted(p for p in path.rglob("*") if "__pycache__" not in p.parts) if path.is_dir() else [path]
        for file in (p for p in inside if p.is_file() and not p.name.startswith(".")):
            found.update(f"{file.relative_to(path)}\0{file.stat().st_size}\0".encode() + file.read_bytes())
    return found.hexdigest()[:24]


@dataclass(frozen=True)
class Made:
    """Files that a study makes once: they are taken again if they are whole and were made with the same settings, code and inputs.

    Attributes:
        files: Paths; beside the first one a hidden file says how they were made.
        asked: Settings on which they depend, as plain data.
        read: Files and folders on which they depend: inputs, and code outside of this package.
    """

    files: Sequence[Path]
    asked: Any
    read: Sequence[Path]

    @property
    def there(self) -> bool:
        """Whether they need not be made again."""
        return self._mark.is_file() and self._mark.read_bytes() == self._written().encode()

    def keep(self) -> None:
        """Note that they have just been made."""
        write_text(self._mark, self._written())

    def once(self, make: Callable[[], Any]) -> None:
        """Have them made unless they are there."""
        if not self.there:
            make()
            self.keep()

    @property
    def _mark(self) -> Path:
        return self.files[0].with_name(f".{self.files[0].name}.made")

    def _written(self) -> str:
        asked = json.dumps(plain(self.asked), sort_keys=True)
        key = hashlib.sha256(f"{code()} {hash_of(self.read)} {asked}".encode()).hexdigest()[:24]
        return f"{key} {hash_of(self.files)}\n"


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text. Raises `UserError` where the path cannot be written, as all functions here do."""
    with new_file(path) as file:
        file.write(text.encode())


def write_json(path: str | Path, data: Any) -> None:
    """Write plain data; a NaN or infinity, which JSON lacks, raises ValueError."""
    write_text(path, json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def write_csv(path: str | Path, columns: Mapping[str, Any]) -> None:
    """Write columns (K,) under a header; `repr` of a float is the shortest text that reads back as the same number."""
    rows = np.column_stack(list(columns.values())).tolist()
    lines = (",".join(map(repr, row)) for row in rows)
    write_text(path, "\n".join([",".join(columns), *lines]) + "\n")


def number(value: float | None) -> float | None:
    """A number for JSON, which has neither NaN nor infinity: None in their place."""
    return None if value is None or not math.isfinite(value) else float(value)


def plain(value: Any) -> Any:
    """Plain data for JSON: numpy and structs to Python, NaN and infinity to null."""
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.asdict(value)
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays, compressed; an array of objects, which would need pickle, raises ValueError."""
    objects = [name for name, array in arrays.items() if np.asarray(array).dtype.hasobject]
    if objects:  # before numpy 2.3, `savez_compressed` has no `allow_pickle` that would refuse them
        raise ValueError(f"{', '.join(objects)}: arrays of objects need pickle, which is not used")
    with new_file(path) as file:
        np.savez_compressed(file, **dict[str, Any](arrays))


def check_file(path: str | Path) -> None:
    """Raise `UserError` where no file of this name could be written; for checks before a long computation."""
    path = Path(path).absolute()
    resolved(path)
    with _as_user_error(path):
        _check_replaceable(path)
        _check_place(path.parent)


def check_folder(path: str | Path) -> None:
    """Raise `UserError` where no files could be written into a folder of this name, existing or new."""
    path = Path(path).absolute()
    resolved(path)
    with _as_user_error(path):
        if (path.exists() or path.is_symlink()) and not path.is_dir():
            raise UserError(f"{path}: is {'a file' if path.exists() else 'a link to nothing'}; a folder is required")
        _check_place(path)


def _check_replaceable(path: Path) -> None:
    """Raise `UserError` where something other than a file has a name: what is written would take its place."""
    if path.is_dir():
        raise UserError(f"{path}: is a folder; the name of a file is required")
    if path.exists() and not path.is_file():
        raise UserError(f"{path}: is a device or a pipe; the name of a file is required")


def _check_place(folder: Path) -> None:
    while not folder.exists():
        folder = folder.parent
    _remove_stale(folder)
    with _temporary(folder / "probe", NEW):
        pass


@cache
def _remove_stale(folder: Path) -> None:
    """Remove what processes that were killed have left in a folder; once in this process, and as far as it can be done."""
    with suppress(OSError):
        for path in folder.iterdir():
            if TEMPORARY.fullmatch(path.name):
                _remove_unused(path)


def _remove_unused(path: Path) -> None:
    """Remove a temporary file or folder unless a process has its lock."""
    with suppress(OSError):  # that of others, or one that has just gone
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
        finally:
            os.close(descriptor)


@contextmanager
def _temporary(path: Path, make: Callable[[Path], Any]) -> Iterator[Path]:
    """A file or folder that `make` makes under an unused hidden name beside a path, so that renaming stays within one file system; what
    is left of it after the block is removed. Others see that it is in use, where the file system has locks."""
    while True:
        temporary = path.absolute().with_name(f".{path.name}.{secrets.token_hex(4)}.rrr_oc")
        make(temporary)
        descriptor = _locked(temporary)
        if descriptor is not None:
            break
    try:
        yield temporary
    finally:
        os.close(descriptor)
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            with suppress(OSError):
                temporary.unlink()


def _locked(path: Path) -> int | None:
    """A descriptor that holds the lock of a new file or folder; None where another process has removed it as unused before that."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return None
    with suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    if path.exists():
        return descriptor
    os.close(descriptor)
    return None


def _to_disk(folder: Path) -> None:
    """Have a folder's names on the disk, where its file system can."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def new_file(path: str | Path) -> Iterator[BinaryIO]:
    """A file to fill, which gets its name when the block ends without an error and is removed after an error."""
    path = Path(path)
    with _as_user_error(path):
        _check_replaceable(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_stale(path.absolute().parent)
        with _temporary(path, NEW) as temporary, temporary.open("r+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.replace(temporary, path)
        _to_disk(path.absolute().parent)


@contextmanager
def new_folder(folder: str | Path) -> Iterator[Path]:
    """A folder to fill, which gets its name when the block ends without an error and is removed after an error.

    Raises `UserError` where `folder` is a file or a folder with something in it.
    """
    folder = Path(folder)
    with _as_user_error(folder):
        if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
            raise UserError(f"{folder}: exists already; give a new or an empty folder")
        with _temporary(folder, partial(Path.mkdir, parents=True)) as temporary:
            _remove_stale(temporary.parent)
            yield temporary
            os.replace(temporary, folder)
        _to_disk(folder.absolute().parent)


@contextmanager
def new_files(folder: str | Path, patterns: Sequence[str]) -> Iterator[Path]:
    """A folder to fill with files that belong together. When the block ends without an error, all files of `folder` whose names have
    one of the patterns, such as *.png, are removed, and then the new ones put there: old ones are never beside new ones.

    Raises `UserError` where they cannot be written.
    """
    folder = Path(folder).absolute()
    with _as_user_error(folder):
        folder.mkdir(parents=True, exist_ok=True)
        _remove_stale(folder)
        with _temporary(folder / "new", Path.mkdir) as temporary:
            yield temporary
            new = sorted(temporary.iterdir())
            for path in new:
                _check_replaceable(folder / path.name)
            for path in {old for pattern in patterns for old in folder.glob(pattern) if old.is_file()}:
                path.unlink()
            _to_disk(folder)
            for path in new:
                os.replace(path, folder / path.name)
        _to_disk(folder)


@contextmanager
def _as_user_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror or error}") from None

"""Text files read as UTF-8; files and folders written whole or not at all: under a temporary name, then renamed."""

import json
import math
import os
import secrets
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from rrr_oc.errors import UserError

LARGEST = 2_000_000_000  # [bytes] of a file that is read; doubled, a file of this size may take all memory of a small machine


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
    """Plain data for JSON: numpy to Python, NaN and infinity to null."""
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
    with _as_user_error(path):
        _check_replaceable(path)
        _check_place(path.parent)


def check_folder(path: str | Path) -> None:
    """Raise `UserError` where no files could be written into a folder of this name, existing or new."""
    path = Path(path).absolute()
    with _as_user_error(path):
        if path.exists() and not path.is_dir():
            raise UserError(f"{path}: is a file; a folder is required")
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
    probe = _beside(folder / "probe")
    probe.open("xb").close()
    probe.unlink()


@contextmanager
def new_file(path: str | Path) -> Iterator[BinaryIO]:
    """A file to fill, which gets its name when the block ends without an error and is removed after an error."""
    path = Path(path)
    temporary = _beside(path)
    try:
        with _as_user_error(path):
            _check_replaceable(path)
            path.parent.mkdir(parents=True, exist_ok=True)
            with temporary.open("xb") as file:
                yield file
            os.replace(temporary, path)
    finally:
        with suppress(OSError):
            temporary.unlink()


@contextmanager
def new_folder(folder: str | Path) -> Iterator[Path]:
    """A folder to fill, which gets its name when the block ends without an error and is removed after an error.

    Raises `UserError` where `folder` is a file or a folder with something in it.
    """
    folder = Path(folder)
    with _as_user_error(folder):
        if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
            raise UserError(f"{folder}: exists already; give a new or an empty folder")
    temporary = _beside(folder)
    try:
        with _as_user_error(folder):
            temporary.mkdir(parents=True)
            yield temporary
            os.replace(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _beside(path: Path) -> Path:
    """An unused hidden name in the same folder, so that renaming stays within one file system."""
    path = path.absolute()
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")


@contextmanager
def _as_user_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror or error}") from None

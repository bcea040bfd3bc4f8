"""A store of runs, one folder each, from which interrupted work continues and every table is made.

A run's folder has `run.json` (settings and results) and `arrays.npz` when it has ended, and `checkpoint.npz` while it has not. The
settings are stored in both, so results of other settings are not taken for this run's. Workers on other machines need the store on a
shared file system.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.storage import code, hash_of, read_npz, read_utf8, write_json, write_npz

SHOWN_BY = "comparison*.py"  # files of this folder that sum up and show runs, and make none


@cache
def all_code() -> str:
    """A hash of what runs depend on: the code of the package and of this folder."""
    here = Path(__file__).parent
    return f"{code()} {hash_of(sorted({*here.glob('*.py')} - {*here.glob(SHOWN_BY)}))}"


@dataclass(frozen=True)
class Run:
    """One run of a store.

    Attributes:
        folder: Its folder.
        asked: Its settings, as plain data.
        code: Hash of the code that makes its results; those of other code are not taken for this run's.
    """

    folder: Path
    asked: Mapping[str, Any]
    code: str = field(default_factory=all_code)

    @property
    def found(self) -> dict[str, Any] | None:
        """Its results; None where it has not ended. Raises `UserError` for a damaged file."""
        content = _read(self.folder / "run.json")
        same = content is not None and (content["asked"], content["code"]) == (self._plain, self.code)
        return content["found"] if content is not None and same else None

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of a run that has ended."""
        return _load(self.folder / "arrays.npz")

    def finish(self, found: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Write the results, arrays first, and remove the checkpoint."""
        write_npz(self.folder / "arrays.npz", arrays)
        write_json(self.folder / "run.json", {"asked": self._plain, "code": self.code, "found": found})
        (self.folder / "checkpoint.npz").unlink(missing_ok=True)

    def save(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Replace the checkpoint."""
        write_npz(self.folder / "checkpoint.npz", {"asked": np.array(self._checkpoint), **arrays})

    def saved(self) -> dict[str, np.ndarray] | None:
        """The last checkpoint of this very run, or None."""
        path = self.folder / "checkpoint.npz"
        if not path.is_file():
            return None
        arrays = _load(path)
        return arrays if str(arrays.pop("asked", None)) == self._checkpoint else None

    @property
    def _checkpoint(self) -> str:
        return f"{self.code} {self._key}"

    @property
    def _key(self) -> str:
        return json.dumps(self.asked, sort_keys=True)

    @property
    def _plain(self) -> Any:
        return json.loads(self._key)


def all_runs(root: Path) -> list[Run]:
    """The runs of a store that have ended, with whatever code, in the order of their folders."""
    contents = [(path.parent, _read(path)) for path in sorted(root.rglob("run.json"))]
    return [Run(folder, content["asked"], content["code"]) for folder, content in contents if content is not None]


def _read(path: Path) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    try:
        content = json.loads(read_utf8(path))
        return {"asked": content["asked"], "code": content.get("code", ""), "found": content["found"]}
    except (ValueError, KeyError, TypeError, RecursionError, AttributeError):
        raise UserError(f"{path}: not a run's file; delete its folder, and the run is done anew") from None


def _load(path: Path) -> dict[str, np.ndarray]:
    try:
        return read_npz(path)
    except UserError as error:
        raise UserError(f"{error}; delete its folder, and the run is done anew") from None

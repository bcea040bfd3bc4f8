"""A store of runs, one folder each, from which interrupted work continues and every table is made.

A run's folder has `run.json` (settings and results) and `arrays.npz` when it has ended, and `checkpoint.npz` while it has not. The
settings are stored in both, so results of other settings are not taken for this run's. Workers on other machines need the store on a
shared file system.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.storage import write_json, write_npz


@dataclass(frozen=True)
class Run:
    """One run of a store.

    Attributes:
        folder: Its folder.
        asked: Its settings, as plain data.
    """

    folder: Path
    asked: Mapping[str, Any]

    @property
    def found(self) -> dict[str, Any] | None:
        """Its results; None where it has not ended. Raises `UserError` for a damaged file."""
        content = _read(self.folder / "run.json")
        return content["found"] if content is not None and content["asked"] == self._plain else None

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of a run that has ended."""
        return _load(self.folder / "arrays.npz")

    def finish(self, found: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Write the results, arrays first, and remove the checkpoint."""
        write_npz(self.folder / "arrays.npz", arrays)
        write_json(self.folder / "run.json", {"asked": self._plain, "found": found})
        (self.folder / "checkpoint.npz").unlink(missing_ok=True)

    def save(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Replace the checkpoint."""
        write_npz(self.folder / "checkpoint.npz", {"asked": np.array(self._key), **arrays})

    def saved(self) -> dict[str, np.ndarray] | None:
        """The last checkpoint of this very run, or None."""
        path = self.folder / "checkpoint.npz"
        if not path.is_file():
            return None
        arrays = _load(path)
        return arrays if str(arrays.pop("asked")) == self._key else None

    @property
    def _key(self) -> str:
        return json.dumps(self.asked, sort_keys=True)

    @property
    def _plain(self) -> Any:
        return json.loads(self._key)


def all_runs(root: Path) -> list[Run]:
    """The runs of a store that have ended, in the order of their folders."""
    contents = [(path.parent, _read(path)) for path in sorted(root.rglob("run.json"))]
    return [Run(folder, content["asked"]) for folder, content in contents if content is not None]


def _read(path: Path) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text())
        return {"asked": content["asked"], "found": content["found"]}
    except (ValueError, KeyError, TypeError):
        raise UserError(f"{path}: not a run's file; delete its folder, and the run is done anew") from None


def _load(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return dict(file)
    except (OSError, ValueError, KeyError):
        raise UserError(f"{path}: cannot be read; delete its folder, and the run is done anew") from None

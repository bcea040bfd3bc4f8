"""The stages of a diagnosis: how far it is, and what each has found, from which an interrupted diagnosis goes on.

A stage is kept as Python pickles it, with a hash, and only the program that wrote it reads it again (`rrr_oc.kept`). Of the names in it
classes of this package, NumPy's arrays and slices are known, so that a folder from others runs nothing.
"""

import base64
import io
import pickle
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.errors import UserError
from rrr_oc.kept import Kept, known, save
from rrr_oc.progress import Progress
from rrr_oc.recordings.recording import RecordingSet

# Share of the time of a diagnosis that each stage takes, by experience
SHARES = {
    "plain model": 0.06,
    "search": 0.5,
    "held-out check": 0.15,
    "search without parts": 0.2,
    "tracking": 0.08,
    "report": 0.01,
}
OF_NUMPY = ("ndarray", "dtype", "_reconstruct", "_frombuffer", "scalar")  # what a pickled array names
T = TypeVar("T")


@dataclass(frozen=True)
class Stages:
    """What a diagnosis has done so far.

    Attributes:
        recordings: What is diagnosed; it is kept in no stage.
        start: The model that calibration starts from.
        kept: Where the stages are kept; None where they are not.
        progress: Is told how far it is.
    """

    recordings: RecordingSet
    start: CalibratedModel
    kept: Kept | None = None
    progress: Progress = field(default_factory=lambda: Progress(SHARES))

    def saved(self, name: str) -> Any:
        """What a stage has found, if it is there already; else None."""
        content = None if self.kept is None else known(self.kept, name)
        return None if content is None else _Reader(io.BytesIO(base64.b64decode(content["pickle"])), self.recordings).load()

    def keep(self, name: str, found: T) -> T:
        """Save what a stage has found, and return it."""
        if self.kept is not None:
            file = io.BytesIO()
            _Writer(file, self.recordings).dump(found)
            save(self.kept, name, {"pickle": base64.b64encode(file.getvalue()).decode()})
        return found

    def once(self, name: str, make: Callable[[], T]) -> T:
        """What a stage has found, if it is there already; else what it finds now, which is saved."""
        found = self.saved(name)
        return self.keep(name, make()) if found is None else found


class _Writer(pickle.Pickler):
    def __init__(self, file: io.BytesIO, recordings: RecordingSet) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._recordings = recordings

    def persistent_id(self, obj: Any) -> str | None:
        return "recordings" if obj is self._recordings else None


class _Reader(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, recordings: RecordingSet) -> None:
        super().__init__(file)
        self._recordings = recordings

    def persistent_load(self, pid: str) -> RecordingSet:
        return self._recordings

    def find_class(self, module_name: str, global_name: str) -> Any:
        found = super().find_class(module_name, global_name) if module_name.split(".")[0] in ("rrr_oc", "numpy") else None
        of_numpy = module_name.startswith("numpy") and global_name in OF_NUMPY
        if (module_name, global_name) == ("builtins", "slice"):  # as segments of recordings are
            return slice
        if of_numpy or (module_name.startswith("rrr_oc.") and isinstance(found, type)):
            return found
        raise UserError(f"a kept stage names {module_name}.{global_name}, which no diagnosis has")

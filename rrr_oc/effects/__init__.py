"""The catalogue of effects: one piece of physics a file, in a folder for each place where physics acts.

Every concrete `Effect` that a file below this folder defines is in `CATALOGUE`, in the order of the names.
Imports `numerics` and `robot`.
"""

import importlib
import inspect
import pkgutil
from collections.abc import Iterator

from rrr_oc.effects.base import Body, Effect, Signals, Trial, View

for _module in pkgutil.walk_packages(__path__, f"{__name__}."):
    importlib.import_module(_module.name)


def _concrete(kind: type[Effect]) -> Iterator[type[Effect]]:
    """All concrete subclasses of a kind, however far below it."""
    for below in kind.__subclasses__():
        yield from _concrete(below)
        if not inspect.isabstract(below):
            yield below


CATALOGUE: dict[str, type[Effect]] = {kind.name: kind for kind in sorted(_concrete(Effect), key=lambda kind: kind.name)}

__all__ = ["CATALOGUE", "Body", "Effect", "Signals", "Trial", "View"]

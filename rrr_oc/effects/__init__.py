"""The catalogue of effects: every `Effect` defined by a file of this folder."""

import importlib
import pkgutil

from rrr_oc.effects.effect import Body, Effect, Signals, Trial, View

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")

CATALOGUE: dict[str, type[Effect]] = {kind.name: kind for kind in Effect.__subclasses__()}

__all__ = ["CATALOGUE", "Body", "Effect", "Signals", "Trial", "View"]

"""The catalogue of effects: one piece of physics a file, in a folder for each place where physics acts.

`CATALOGUE` holds, by name, every concrete `Effect` of this folder, of installed packages with a module in the entry point group
`rrr_oc.effects`, and those that `register` adds. Imports `numerics` and `robot`.
"""

import importlib
import pkgutil
from collections.abc import Iterator
from importlib.metadata import entry_points
from typing import TypeVar

from rrr_oc.effects.base import Effect, Prior, Signals, Trial, View
from rrr_oc.effects.capabilities import (
    BlackBox,
    Body,
    BodyChange,
    Delay,
    ExportTwin,
    FollowsLoad,
    LateCommand,
    LoopChange,
    MotionShift,
    MovesLink,
    NativeTwin,
    OfEach,
    OnlyRecorded,
    SpringChange,
    WithStates,
)
from rrr_oc.effects.springs import Clutched, DesignSpring, LinkSpring, ListedSpring, Wound
from rrr_oc.errors import UserError

CATALOGUE: dict[str, type[Effect]] = {}
Kind = TypeVar("Kind", bound=type[Effect])


def register(kind: Kind) -> Kind:
    """Add an effect to the catalogue; usable as a decorator of its class.

    Other processes know it only if they import its module, as from an entry point. Raises `UserError` for a name that is taken.
    """
    if CATALOGUE.get(kind.name, kind) is not kind:
        raise UserError(f"there are two effects of the name {kind.name!r}: {CATALOGUE[kind.name]} and {kind}")
    CATALOGUE[kind.name] = kind
    for name in sorted(CATALOGUE):
        CATALOGUE[name] = CATALOGUE.pop(name)
    return kind


def plain_effects(recorded: str = "motor") -> tuple[type[Effect], ...]:
    """The effects of every calibrated model where such torques are recorded, friction first and sensors last.

    A recorded load torque does not depend on the drives.
    """
    plain = [k for k in CATALOGUE.values() if k.role == "plain" and recorded in k.recorded_as]
    plain = [k for k in plain if not (recorded == "load" and k.side == "drive")]
    return tuple(sorted(plain, key=lambda k: (k.side == "sensor", k.provides != "friction", k.name)))


def listed_springs() -> dict[str, type[ListedSpring]]:
    """The springs that a recording set may list, by their key in its header, those of one joint first."""
    return {kind.listing.key: kind for kind in _one_joint_first() if issubclass(kind, ListedSpring)}


def design_forms() -> dict[str, type[DesignSpring]]:
    """The springs that a co-design may use, by the label of the configuration that has them alone, those of one joint first."""
    return {kind.design.label: kind for kind in _one_joint_first() if issubclass(kind, DesignSpring)}


def _one_joint_first() -> list[type[Effect]]:
    """All kinds, those of one joint first, and of these first what recordings may show."""
    return sorted(CATALOGUE.values(), key=lambda kind: (kind.placement == "pair", kind.role == "design", kind.name))


def _concrete(kind: type[Effect]) -> Iterator[type[Effect]]:
    """All subclasses of a kind, direct or not, that have a name; a family of effects may share a base without one."""
    for below in kind.__subclasses__():
        yield from _concrete(below)
        if hasattr(below, "name"):
            yield below


for _module in pkgutil.walk_packages(__path__, f"{__name__}."):
    importlib.import_module(_module.name)
for _point in entry_points(group=__name__):
    _point.load()
for _kind in _concrete(Effect):
    register(_kind)

__all__ = [
    "CATALOGUE",
    "BlackBox",
    "Body",
    "BodyChange",
    "Clutched",
    "Delay",
    "DesignSpring",
    "Effect",
    "ExportTwin",
    "FollowsLoad",
    "LateCommand",
    "LinkSpring",
    "ListedSpring",
    "LoopChange",
    "MotionShift",
    "MovesLink",
    "NativeTwin",
    "OfEach",
    "OnlyRecorded",
    "Prior",
    "Signals",
    "SpringChange",
    "Trial",
    "View",
    "WithStates",
    "Wound",
    "design_forms",
    "listed_springs",
    "plain_effects",
    "register",
]

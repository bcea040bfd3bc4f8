"""Two designs side by side: costs, durations and springs of each configuration."""

from collections.abc import Mapping
from dataclasses import dataclass

from rrr_oc.codesign.design_file import Configuration, DesignFile
from rrr_oc.errors import UserError


@dataclass(frozen=True)
class Pair:
    """A configuration in two designs; None where one of them does not have it.

    Attributes:
        cost: In the unit of the designs.
        seconds: Duration of all phases of all tasks [s].
        springs: By a designer's names, in SI units and radians.
    """

    cost: tuple[float | None, float | None]
    seconds: tuple[float | None, float | None]
    springs: Mapping[str, tuple[float | None, float | None]]


def compare_designs(a: DesignFile, b: DesignFile) -> dict[str, Pair]:
    """By configuration, those of the first design first; raises `UserError` where they minimise different costs."""
    if a.quantity != b.quantity:
        raise UserError(f"one design minimises {a.quantity.title}, the other {b.quantity.title}; the same cost is required")
    result = {}
    for name in dict.fromkeys([*a.configurations, *b.configurations]):
        both = a.configurations.get(name), b.configurations.get(name)
        springs = dict.fromkeys(spring for one in both if one for spring in one.springs)
        result[name] = Pair(
            (both[0] and both[0].cost, both[1] and both[1].cost),
            (both[0] and _seconds(both[0]), both[1] and _seconds(both[1])),
            {s: (both[0] and both[0].springs.get(s), both[1] and both[1].springs.get(s)) for s in springs},
        )
    return result


def _seconds(one: Configuration) -> float:
    return sum(sum(moved.durations.values()) for moved in one.tasks.values())

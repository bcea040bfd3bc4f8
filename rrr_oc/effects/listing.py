"""How a spring is listed in the header of a recording set."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Listing:
    """The entry of a spring in a header; `Effect.from_entry` and `Effect.entry` translate it.

    Attributes:
        key: Key of the springs of this kind among those of a recording.
        quantities: Keys of the numbers, all required; the ending of a key is its unit: `_Nm_per_rad`, `_rad` or `_m`.
        zero: Keys of the lengths that may be 0.
        options: Keys that may be left out, with the values allowed.
        counts: Number of values of an option that is a list.
    """

    key: str
    quantities: tuple[str, ...]
    zero: tuple[str, ...] = ()
    options: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)

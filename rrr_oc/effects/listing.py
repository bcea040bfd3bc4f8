"""How a spring is listed in the header of a recording set."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Listing:
    """The entry of a spring in a header, beside its options; `Effect.from_entry` and `Effect.entry` translate it.

    Attributes:
        key: Key of the springs of this kind among those of a recording.
        quantities: Keys of the numbers, all required; the ending of a key is its unit: `_Nm_per_rad`, `_rad` or `_m`.
        zero: Keys of the lengths that may be 0.
    """

    key: str
    quantities: tuple[str, ...]
    zero: tuple[str, ...] = ()

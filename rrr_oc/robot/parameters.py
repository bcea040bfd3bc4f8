"""Parameters: names with units, bounds and a nominal value."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.errors import UserError


@dataclass(frozen=True)
class Parameter:
    """One scalar of a physical law.

    Attributes:
        name: Key in files and tables.
        unit: Unit of `nominal`, `lower` and `upper` (SI and radians; "1" for a ratio).
        nominal: Value where nothing is known of it.
        lower, upper: Bounds that physics or the law's derivation imposes; a task may narrow them.
        factor: By which it changes at most in one step of a fit; for positive ones whose inverse the law is nearly linear in.
    """

    name: str
    unit: str
    nominal: float = 0.0
    lower: float = -math.inf
    upper: float = math.inf
    factor: float = math.inf

    def __post_init__(self) -> None:
        if not self.lower <= self.upper:
            raise UserError(f"{self.name}: lower bound {self.lower:g} is above upper bound {self.upper:g} [{self.unit}]")
        if not self.lower <= self.nominal <= self.upper:
            object.__setattr__(self, "nominal", min(max(self.nominal, self.lower), self.upper))

    def bounded(self, lower: float, upper: float) -> "Parameter":
        """This parameter within narrower bounds; raises `UserError` if they are crossed or leave its own."""
        if lower < self.lower or upper > self.upper:
            raise UserError(
                f"{self.name}: bounds {lower:g} … {upper:g} reach outside {self.lower:g} … {self.upper:g} [{self.unit}]"
            )
        return replace(self, lower=lower, upper=upper)


def check_names(found: Mapping[str, object], allowed: tuple[str, ...], where: str) -> None:
    """Raise `UserError` if `found` has a key that is not in `allowed`."""
    unknown = sorted(set(found) - set(allowed))
    if unknown:
        raise UserError(f"{where}: unknown key {unknown[0]!r}; allowed are {', '.join(allowed)}")


def read_number(where: str, key: str, value: object, lowest: float = -math.inf) -> float:
    """A finite number of at least `lowest` from a file; raises `UserError` that says what was found."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not lowest <= value < math.inf:
        allowed = "a finite number" if lowest == -math.inf else f"a finite number of {lowest:g} or more"
        raise UserError(f"{where}: {key} must be {allowed}, got {value!r}")
    return float(value)


def read_vector(where: str, key: str, values: object, size: int) -> np.ndarray:
    """So many finite numbers from a file, (size,); raises `UserError`."""
    if not isinstance(values, list | tuple | np.ndarray) or len(values) != size:
        raise UserError(f"{where}: {key} must be {size} numbers, got {values!r}")
    return np.array([read_number(where, key, float(v) if isinstance(v, np.floating) else v) for v in values])


def read_object(where: str, key: str, value: object, allowed: tuple[str, ...], required: tuple[str, ...] = ()) -> dict:
    """An object with known keys from a file; raises `UserError`."""
    if not isinstance(value, Mapping):
        raise UserError(f"{where}: {key} must be an object with {', '.join(allowed)}, got {value!r}")
    check_names(value, allowed, f"{where}: {key}")
    missing = [k for k in required if k not in value]
    if missing:
        raise UserError(f"{where}: {key} lacks {missing[0]!r}")
    return dict(value)

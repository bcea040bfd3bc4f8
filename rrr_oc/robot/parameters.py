"""Parameters: names with units, bounds and a nominal value."""

import math
from dataclasses import dataclass

from rrr_oc.errors import UserError


@dataclass(frozen=True)
class Parameter:
    """One scalar of a physical law.

    Attributes:
        name: Key in files and tables.
        unit: Unit of `nominal`, `lower` and `upper` (SI and radians; "1" for a ratio).
        nominal: Value used where no other is known.
        lower, upper: Bounds that physics or the law's derivation imposes; a task may narrow them.
        factor: Largest ratio by which one step of a fit may change it; for positive parameters whose inverse enters nearly linearly.
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

"""How a spring is part of a co-design: what a task bounds, what is fixed, and what can be bought."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

Bounds = Mapping[str, tuple[float, float]]  # (least, greatest) by symbol, in SI units


@dataclass(frozen=True)
class Quantity:
    """A number that a task bounds.

    Attributes:
        symbol: Its name in designs.
        key: Its key in a task's file, which ends with the unit there.
        si: SI unit.
        unit: The file's unit in SI units.
        lowest: Least value of its lower bound, in the file's unit.
        free: Whether it is adjusted, not bought.
    """

    symbol: str
    key: str
    si: str
    unit: float = 1.0
    lowest: float = -np.inf
    free: bool = False


def about_a_joint(rate: str, rest: str) -> tuple[Quantity, Quantity]:
    """Rate and equilibrium of a spring about a joint, by these symbols."""
    return Quantity(rate, "stiffness_Nm_per_rad", "Nm/rad", lowest=0.0), angle(rest, "equilibrium_deg")


def angle(symbol: str, key: str) -> Quantity:
    """An angle that is adjusted."""
    return Quantity(symbol, key, "rad", np.pi / 180, free=True)


@dataclass(frozen=True)
class Axis:
    """Where a spring of a design sits, and what it does there.

    Attributes:
        rate: Its rate about this axis [Nm/rad].
        slack: Angle of this axis where its torque is zero [rad].
        ratio: Its turn there over its deflection (`Elastic.stretch`) [1].
        radius: Of the pulley from which its cable goes on [m]; None where the axis is its joint's.
    """

    rate: float
    slack: float
    ratio: float = 1.0
    radius: float | None = None


@dataclass(frozen=True)
class DesignForm:
    """A spring whose parameters are the quantities that a task bounds, in their order.

    Attributes:
        label: Name of the configuration that has these springs alone.
        words: What they are, as a phrase.
        quantities: What a task bounds.
        shop: Key of these springs in a catalogue of purchasable hardware, or "". If one quantity is bought, the catalogue has a list
            for each joint; if several are, a list for each quantity.
        tables: Keys of tables that describe the spring in a task's file, with the names of their columns. The rows, in the file's
            units, are the effect's field of that name.
    """

    label: str
    words: str
    quantities: tuple[Quantity, ...]
    shop: str = ""
    tables: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    limits = ()  # for each inequality of `exists`, the bounds that are active where it is
    derived = (
        False  # whether the effect's parameters are functions of the quantities; a design then keeps the quantities' bounds
    )

    @property
    def bought(self) -> tuple[Quantity, ...]:
        """The quantities that are bought."""
        return tuple(q for q in self.quantities if not q.free)

    def name(self, quantity: Quantity, joints: tuple[int, ...]) -> str:
        """A quantity of the spring on these joints, as in `k_p2`."""
        return f"{quantity.symbol}{joints[0] + 1}"

    def free_names(self, joints: tuple[int, ...]) -> tuple[str, ...]:
        """Names of the quantities that are adjusted."""
        return tuple(self.name(q, joints) for q in self.quantities if q.free)

    def wrong(self, bounds: Bounds) -> str | None:
        """What is wrong with a task's bounds, in words; None if nothing is."""
        for q in self.quantities:
            low, high = (b / q.unit for b in bounds[q.symbol])
            if low < q.lowest:
                return f"{q.key} must be {q.lowest:g} or more, got {low:g} … {high:g}"
        return None

    def box(self, bounds: Bounds) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the effect's parameters, in their order."""
        low, high = zip(*(bounds[q.symbol] for q in self.quantities), strict=True)
        return np.array(low), np.array(high)

    def parameters(self, numbers: Sequence[Any] | np.ndarray) -> np.ndarray:
        """The effect's parameters (p, ...) from the quantities (number, ...) in their order."""
        return np.asarray(numbers, float)

    def axis(self, hardware: Mapping[str, float], joints: tuple[int, ...]) -> Axis:
        """Where a spring with this hardware, by `name`, sits."""
        return Axis(*(hardware[self.name(q, joints)] for q in self.quantities[:2]))

    def inverse_radii(self, theta: Sequence[Any], bounds: Bounds, fixed: Mapping[str, float]) -> tuple[Any, ...]:
        """1/m: the force of a spring's cable is at least its torque on its first joint times each of these, whatever hardware within
        bounds, or with some fixed, it has; empty without a cable."""
        return ()

    def with_largest_pulleys(self, theta: Sequence[float], bounds: Bounds) -> Bounds:
        """Bounds of the hardware, if `derived`, that leave what has the least force in its cable."""
        return bounds

    def exists(self, theta: Sequence[Any], bounds: Mapping[str, tuple[Any, Any]]) -> ca.SX:
        """Inequalities ≤ 0 on the parameters that hold exactly where quantities within bounds exist, if they are `derived`."""
        return ca.SX(0, 1)

    def strongest(self, lower: np.ndarray, upper: np.ndarray, bounds: Bounds) -> np.ndarray:
        """Greatest amplitude of springs whose other parameters lie in boxes, from the bounds of all parameters (parameters, P), if they
        are `derived`; negative where there is no such spring; (P,)."""
        return np.full(lower.shape[1], np.inf)

    def named(
        self, joints: tuple[int, ...], theta: Mapping[str, float], bounds: Bounds, fixed: Mapping[str, float]
    ) -> dict[str, float]:
        """The quantities by `name`, from the effect's parameters; if `derived`, within bounds or with some fixed."""
        return {self.name(q, joints): value for q, value in zip(self.quantities, theta.values(), strict=True)}

    def held(
        self,
        joints: tuple[int, ...],
        box: tuple[np.ndarray, np.ndarray],
        bounds: Bounds,
        hardware: Mapping[str, float],
        keep_free,
    ) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
        """Bounds of the parameters with all quantities fixed to `hardware` but those in `keep_free`; if `derived`, those fixed."""
        lower, upper = box[0].copy(), box[1].copy()
        for i, q in enumerate(self.quantities):
            name = self.name(q, joints)
            if name not in keep_free:
                lower[i] = upper[i] = hardware[name]
        return lower, upper, {}

"""The lightest spring of standard wire that does what a design needs."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from rrr_oc.codesign.parts.fatigue import safeties
from rrr_oc.codesign.parts.helical import MAKES, Helical
from rrr_oc.codesign.parts.limits import SpringLimits
from rrr_oc.codesign.parts.wire import steel, wire

Make = Literal["torsion", "extension", "compression"]
INDICES = 200  # that are tried for each wire; doubled, springs get lighter by 1 % at most
HARDLY = 1.05  # [1] of the least mass, within which the smaller spring is better; doubled, springs are smaller and heavier
ROUNDED = 1e-4  # [m] to which the diameter of a coil is rounded


@dataclass(frozen=True)
class Demand:
    """What a spring has to do.

    Attributes:
        make: One of `MAKES`.
        rate: [Nm/rad] of a torsion spring, [N/m] of others.
        least, greatest: Deflection in use, from where the load is zero [rad] or [m].
        pulley: Radius of the pulley from which a cable pulls the spring [m]; None without one.
    """

    make: Make
    rate: float
    least: float
    greatest: float
    pulley: float | None = None

    @property
    def loads(self) -> tuple[float, float]:
        """Least and greatest load [Nm] or [N]."""
        return self.rate * self.least, self.rate * self.greatest

    @property
    def energy(self) -> float:
        """Greatest energy that it stores [J]."""
        return self.rate * self.greatest**2 / 2


@dataclass(frozen=True, eq=False)
class Sized:
    """Springs that meet a demand but for limits; arrays where several are compared.

    Attributes:
        demand: What they have to do.
        limits: What they may be.
        spring: The springs.
    """

    demand: Demand
    limits: SpringLimits
    spring: Helical

    @cached_property
    def safeties(self) -> dict:
        """Safety of each stress [1], by what it is."""
        return safeties(self.spring, self.demand.loads, self.limits.cycles)

    @property
    def safety(self):
        """The least of them [1]."""
        return np.min([*self.safeties.values()], axis=0)

    @property
    def initial_tension(self):
        """Load at which the coils part [N]; 0 where they do not touch."""
        return self.spring.initial_tension(self.demand.loads[0])

    @property
    def length(self):
        """Greatest length in use [m]."""
        return self.spring.length(self.demand.greatest - self.initial_tension / self.demand.rate)

    @property
    def excesses(self) -> dict:
        """By how much each limit is exceeded, as a factor: 1 or less where it is met."""
        spring, limits = self.spring, self.limits
        return {
            "safety": limits.safety / self.safety,
            "outside diameter": spring.outside / (limits.outside_mm / 1e3),
            "length": self.length / (limits.length_mm / 1e3),
            "number of coils": limits.coils / np.minimum(spring.n, spring.coils),
        }

    def one(self, at: tuple) -> "Sized":
        """One of the springs."""
        old = self.spring
        d = np.broadcast_to(old.wire.d, old.D.shape)
        return replace(self, spring=type(old)(wire(d[at]), old.D[at], old.n[at]))


def lightest(demand: Demand, limits: SpringLimits) -> Sized:
    """The spring of least mass within limits, or the smallest of those that are hardly heavier; where there is none, the one that
    exceeds the fewest limits, and those by the least."""
    d = np.array(steel().diameters_mm)[:, None] / 1e3
    D = np.round(np.linspace(*limits.index, INDICES) * d / ROUNDED) * ROUNDED
    tried = Sized(demand, limits, MAKES[demand.make].of_rate(wire(d), D, demand.rate))
    excess = np.stack(np.broadcast_arrays(*tried.excesses.values()))
    excess = np.where((excess > 0) & np.isfinite(excess), excess, np.inf)  # hooks alone may be softer than the rate
    within = (excess <= 1).all(axis=0)
    if not within.any():
        order = np.lexsort([a.ravel() for a in (np.maximum(excess, 1).max(axis=0), (excess > 1).sum(axis=0))])
        return tried.one(np.unravel_index(order[0], D.shape))
    mass, size = tried.spring.mass, np.hypot(tried.spring.outside, tried.length)
    light = within & (mass <= HARDLY * mass[within].min())
    return tried.one(np.unravel_index(np.argmin(np.where(light, size, np.inf)), D.shape))

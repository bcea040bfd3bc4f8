"""Helical springs of round wire: rate, stress, size and mass of three makes, by Shigley's Mechanical Engineering Design, chapter 10.

C = D/d is the index of a spring of wire d and mean diameter D. All of it may be arrays, of springs that are compared. Numbers in
brackets are sections there.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rrr_oc.codesign.parts.wire import Wire, steel

FRICTION = 10.8 / (64 / (2 * np.pi))  # [1] by which coils that rub make a torsion spring softer (10-12: 10.8 for 10.2)
BEND = 4.0  # [1] index of the bend between body and hook, the tightest that is recommended (10-11)
CLASH = 1.15  # [1] deflection until the coils touch, over the greatest one in use (10-4)


def wahl(C):
    """Factor of the shear stress for curvature and direct shear, (4C − 1)/(4C − 4) + 0.615/C (10-2)."""
    return (4 * C - 1) / (4 * C - 4) + 0.615 / C


def curvature(C):
    """Factor of the bending stress on the inside of the coil, (4C² − C − 1)/(4C (C − 1)) (10-12)."""
    return (4 * C**2 - C - 1) / (4 * C * (C - 1))


@dataclass(frozen=True, eq=False)
class Helical:
    """A helical spring.

    Attributes:
        wire: Its wire.
        D: Mean diameter of the coil [m].
        n: Number of active coils.
    """

    wire: Wire
    D: np.ndarray
    n: np.ndarray

    turns: ClassVar[bool] = False  # whether it is twisted: its rate in [Nm/rad], its load in [Nm]; else [N/m], [N]
    overload: ClassVar[float] = 1.0  # load that it must stand once, over the greatest one in use

    @classmethod
    def of_rate(cls, wire: Wire, D, rate: float) -> "Helical":
        """The spring of this rate, [Nm/rad] or [N/m]."""
        return cls(wire, D, cls(wire, D, np.ones_like(D)).rate / rate)

    @property
    def C(self):
        """Index."""
        return self.D / self.wire.d

    @property
    def outside(self):
        """Outside diameter [m]."""
        return self.D + self.wire.d

    @property
    def mass(self):
        """[kg]."""
        return steel().density_kg_per_m3 * np.pi * self.wire.d**2 / 4 * self.wire_length

    @property
    def wire_length(self):
        """Length of its wire [m]."""
        raise NotImplementedError

    @property
    def coils(self):
        """Coils that are wound."""
        raise NotImplementedError

    @property
    def rate(self):
        """[Nm/rad] or [N/m]; k = G d⁴/(8 D³ n) (10-3)."""
        return self.wire.G * self.wire.d**4 / (8 * self.D**3 * self.n)

    def stresses(self, load) -> dict:
        """Greatest stress of the wire under a load [Pa], by its kind; K 8 F D/(π d³) in the body, K by Wahl (10-2)."""
        return {"shear": wahl(self.C) * 8 * load * self.D / (np.pi * self.wire.d**3)}

    def length(self, deflection):
        """Greatest length of the body, and of hooks, in use up to a deflection [m]."""
        raise NotImplementedError

    def initial_tension(self, least):
        """Load at which its coils part [N], of a spring that is never loaded less than `least` [N]."""
        return np.zeros_like(self.D)


class TorsionSpring(Helical):
    """A spring that is twisted in the sense in which it is wound, with two straight legs as long as the coil is wide.

    Each leg of length l counts as l/(3π D) active coils (10-12).
    """

    turns = True
    legs = 2.0  # both together, in mean diameters

    @property
    def rate(self):
        """M/θ = d⁴E/(64 D n) and a share of friction [Nm/rad] (10-12)."""
        return self.wire.E * self.wire.d**4 / (64 * FRICTION * self.D * self.n)

    @property
    def coils(self):
        return self.n - self.legs / (3 * np.pi)

    @property
    def wire_length(self):
        return np.pi * self.D * self.coils + self.legs * self.D

    def stresses(self, load):
        """K_i 32 M/(π d³) (10-12)."""
        return {"bending": curvature(self.C) * 32 * load / (np.pi * self.wire.d**3)}

    def length(self, deflection):
        """The turn adds coils to the body."""
        return self.wire.d * (self.coils + 1 + deflection / (2 * np.pi))

    def rod(self, deflection):
        """Diameter of the rod that it would touch [m]: the coil gets narrower as it is turned (10-12)."""
        return self.D * self.coils / (self.coils + deflection / (2 * np.pi)) - self.wire.d


class ExtensionSpring(Helical):
    """A spring with a hook of the coil's own radius at each end; the hooks count as G/E active coils (10-11)."""

    @property
    def coils(self):
        return self.n - self.wire.G / self.wire.E

    @property
    def wire_length(self):
        return np.pi * self.D * (self.coils + 2)

    def stresses(self, load):
        """Also of the hooks: bending F (K 16 D/(π d³) + 4/(π d²)) and shear K 8 F D/(π d³) with K = (4·4 − 1)/(4·4 − 4) (10-11)."""
        one, area = load * self.D / (np.pi * self.wire.d**3), np.pi * self.wire.d**2 / 4
        hook = {"bending of the hook": 16 * curvature(self.C) * one + load / area}
        return super().stresses(load) | hook | {"shear of the hook": 8 * (4 * BEND - 1) / (4 * BEND - 4) * one}

    def length(self, deflection):
        """Over the hooks, drawn out (10-11)."""
        return self.free_length + deflection

    @property
    def free_length(self):
        """Over the hooks, its coils touching [m]."""
        return 2 * (self.D - self.wire.d) + (self.coils + 1) * self.wire.d

    def initial_tension(self, least):
        """As much of the least load as can be wound in: between stresses of 231/exp(0.105 C) ± 6.9 (4 − (C − 3)/6.5) MPa (10-11), or
        none, and the coils do not touch."""
        middle, half = 231 / np.exp(0.105 * self.C), 6.9 * (4 - (self.C - 3) / 6.5)
        low, high = (1e6 * stress * np.pi * self.wire.d**3 / (8 * self.D) for stress in (middle - half, middle + half))
        return np.where(least >= low, np.minimum(least, high), 0.0)


class CompressionSpring(Helical):
    """A spring with closed and ground ends, around a cable that presses it, on a rod or in a tube (10-4)."""

    overload = CLASH

    @property
    def coils(self):
        return self.n + 2

    @property
    def wire_length(self):
        return np.pi * self.D * self.coils

    def length(self, deflection):
        """Free."""
        return self.wire.d * self.coils + CLASH * deflection


MAKES = {"torsion": TorsionSpring, "extension": ExtensionSpring, "compression": CompressionSpring}

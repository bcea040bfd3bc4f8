"""How far a spring that is wound may be off, in the middle one of three grades of quality.

The formulae are those of EN 15800 (compression springs) and DIN 2194 (torsion springs) as the free program SpringONE by M. Caruso has
them; they were not compared with the standards themselves. It has k_F with either sign of its first term, which matters little from 4
coils on; the minus is taken. DIN 2097 (extension springs) gives diagrams: EN 15800 stands in for it. The formulae say by how much loads and
angles may be off; the rate's tolerance is derived here. Lengths within are in mm.
"""

import numpy as np

from rrr_oc.codesign.parts.helical import Helical
from rrr_oc.codesign.parts.wire import steel

PROPORTIONAL = 0.015  # [1] share of the tolerance of a load that grows with it (EN 15800)


def tolerances(spring: Helical) -> tuple[float, float]:
    """By how much the rate may be off [1], and the deflection at which the load is zero [rad] or [m]."""
    return _twisted(spring) if spring.turns else _pulled(spring)


def _twisted(spring: Helical) -> tuple[float, float]:
    """The rate by the tolerances of wire, fourth power, and of the coil; the angle between the legs by DIN 2194."""
    d, D = 1e3 * float(spring.wire.d), 1e3 * float(spring.D)
    up_to, off = np.array(steel().tolerance_mm).T
    wire, coil = off[np.searchsorted(up_to, d)] / d, 0.025 / d**0.17
    angle = 2.4 * float(spring.coils) ** 0.76 * np.sqrt(D / d)
    return float(np.hypot(4 * wire, coil)), float(np.radians(angle))


def _pulled(spring: Helical) -> tuple[float, float]:
    """Of A_F = a_F k_F + 0.015 F the part that grows with the load is the rate's, the other one the length's."""
    d, D, w, n = 1e3 * float(spring.wire.d), 1e3 * float(spring.D), float(spring.C) / 10, float(spring.n)
    a = 65.92 * d**3.3 / D**1.6 * (-0.84 * w**3 + 3.781 * w**2 - 4.244 * w + 2.274)  # [N]
    k = -1 / (3 * n**2) + 8 / (5 * n) + 0.803
    return PROPORTIONAL, float(a * k / spring.rate)

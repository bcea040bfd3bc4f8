"""How often a spring stands its stress."""

import numpy as np

from rrr_oc.codesign.parts.helical import Helical
from rrr_oc.codesign.parts.wire import Drawn, Wire, steel


def endurance(wire: Wire, stress: str, cycles: float) -> np.ndarray:
    """Stress up to which one may go from zero and back so often [Pa], (...): between the numbers of cycles of the table straight over
    their logarithm, below the first and above the last as there."""

    def share(kind: Drawn) -> float:
        shares = kind.endures[stress]
        return float(np.interp(np.log10(cycles), np.log10(steel().cycles[: len(shares)]), shares))

    return wire.of_kind(share) * wire.tensile


def goodman(least, greatest, strength, from_zero):
    """Safety of a stress that goes from `least` to `greatest` and back, 1/(σ_a/S_e + σ_m/S_u) (Goodman; Shigley, 6-12 and 10-9).

    Args:
        strength: S_u, at which the wire breaks.
        from_zero: S_r, up to which the stress may go from zero. Goodman's line through it has S_e = (S_r/2)/(1 − S_r/(2 S_u)).
    """
    reversed_ = (from_zero / 2) / (1 - from_zero / 2 / strength)
    return 1 / ((greatest - least) / 2 / reversed_ + (greatest + least) / 2 / strength)


def safeties(spring: Helical, loads: tuple[float, float], cycles: float) -> dict:
    """Safety of each stress of a spring [1], against a permanent set and over so many cycles between two loads, by what it is."""
    wire, found = spring.wire, {}
    least, greatest, once = (spring.stresses(load) for load in (*loads, spring.overload * loads[1]))
    for kind, stress in greatest.items():
        strength = wire.tensile * (steel().shear_strength if "shear" in kind else 1.0)
        found[f"{kind}, set"] = wire.of_kind(lambda w, kind=kind: w.yields[kind]) * wire.tensile / once[kind]
        found[f"{kind}, life"] = goodman(least[kind], stress, strength, endurance(wire, kind, cycles))
    return found

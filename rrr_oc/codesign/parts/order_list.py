"""The parts of a design: what a maker of springs needs to know of each, in every way in which it can be made."""

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from rrr_oc.codesign.parts.helical import TorsionSpring
from rrr_oc.codesign.parts.limits import SpringLimits
from rrr_oc.codesign.parts.sizing import Demand, Make, Sized, lightest
from rrr_oc.codesign.parts.tolerances import tolerances
from rrr_oc.codesign.parts.wire import steel
from rrr_oc.effects.design_form import Axis

PULLEYS = 6  # radii that are tried for a cable on a joint; doubled, springs get lighter by some per cent


class Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A spring as it can be ordered; or the nearest one, where none is within the limits.

    Attributes:
        label: Which spring of the design it is.
        make: How it is made: "torsion" on the axis of its joint or pulley, "extension" or "compression" pulled by a cable.
        pulley_m: Radius of the pulley of that cable; null for a torsion spring.
        rate: [Nm/rad] of a torsion spring, [N/m] of others.
        slack_rad: Angle of its joint or pulley at which the load is zero.
        least: Deflection in use at least, from where the load is zero, [rad] or [m].
        greatest: The same at most.
        load: Greatest torque [Nm] or force [N].
        energy_J: Greatest energy that it stores.
        wire: Kind of wire.
        d_m: Diameter of the wire.
        D_m: Mean diameter of the coil.
        coils: Coils that are wound, in the body.
        outside_m: Outside diameter.
        length_m: Greatest length in use.
        rod_m: Diameter of the rod that a torsion spring would touch when turned most; null for others.
        initial_tension_N: Force at which the coils of an extension spring part; 0 where they must not touch, null for others.
        mass_kg: Its mass.
        stresses: Greatest stress of the wire by its kind [Pa].
        safeties: Safety of each, against a permanent set and over the cycles [1].
        rate_tolerance: By how much the rate may be off [1].
        rest_tolerance: By how much the deflection may be off at which the load is zero, [rad] or [m].
        why_not: Limits that it exceeds, in words; empty where it can be built.
    """

    label: str
    make: Make
    pulley_m: float | None
    rate: float
    slack_rad: float
    least: float
    greatest: float
    load: float
    energy_J: float
    wire: str
    d_m: float
    D_m: float
    coils: float
    outside_m: float
    length_m: float
    rod_m: float | None
    initial_tension_N: float | None
    mass_kg: float
    stresses: dict[str, float]
    safeties: dict[str, float]
    rate_tolerance: float
    rest_tolerance: float
    why_not: tuple[str, ...] = ()

    @property
    def safety(self) -> float:
        """The least of all [1]."""
        return min(self.safeties.values())


def order_list(axes: Mapping[str, Axis], turns: Mapping[str, tuple[float, float]], limits: SpringLimits) -> list[Part]:
    """The parts of a design, of each spring in every way to make it: those that can be built first, the lightest first.

    Args:
        axes: Where each spring sits, by its label.
        turns: Least and greatest deflection of each in use, as in `Elastic.stretch` [rad].
    """
    found = []
    for label, axis in axes.items():
        least, greatest = (axis.ratio * turn for turn in turns[label])
        if axis.rate * greatest > 0:
            made = [_part(label, axis.slack, _lightest(some, limits)) for some in _demands(axis, (least, greatest), limits)]
            found += sorted(made, key=lambda part: (bool(part.why_not), part.mass_kg))
    return found


def _demands(axis: Axis, turn: tuple[float, float], limits: SpringLimits) -> list[list[Demand]]:
    """What a spring must do on its axis, and what in a cable on each pulley that may be there, make by make."""
    radii = [axis.radius] if axis.radius is not None else np.linspace(*limits.pulley_mm, PULLEYS) / 1e3
    pulled = [
        [Demand(make, axis.rate / r**2, turn[0] * r, turn[1] * r, float(r)) for r in radii]
        for make in ("extension", "compression")
    ]
    return [[Demand("torsion", axis.rate, *turn)], *pulled]


def _lightest(demands: Sequence[Demand], limits: SpringLimits) -> Sized:
    """The best of several pulleys."""

    def rank(sized: Sized) -> tuple[int, float]:
        over = [float(x) for x in sized.excesses.values() if x > 1]
        return len(over), max(over, default=float(sized.spring.mass))

    return min((lightest(demand, limits) for demand in demands), key=rank)


def _part(label: str, slack: float, sized: Sized) -> Part:
    demand, spring = sized.demand, sized.spring
    off, rest = tolerances(spring)
    return Part(
        label=label,
        make=demand.make,
        pulley_m=demand.pulley,
        rate=demand.rate,
        slack_rad=slack,
        least=demand.least,
        greatest=demand.greatest,
        load=demand.loads[1],
        energy_J=demand.energy,
        wire=steel().wires[int(spring.wire.kind)].name,
        d_m=float(spring.wire.d),
        D_m=float(spring.D),
        coils=float(spring.coils),
        outside_m=float(spring.outside),
        length_m=float(sized.length),
        rod_m=float(spring.rod(demand.greatest)) if isinstance(spring, TorsionSpring) else None,
        initial_tension_N=float(sized.initial_tension) if demand.make == "extension" else None,
        mass_kg=float(spring.mass),
        stresses={kind: float(stress) for kind, stress in spring.stresses(demand.loads[1]).items()},
        safeties={kind: float(safety) for kind, safety in sized.safeties.items()},
        rate_tolerance=off,
        rest_tolerance=rest,
        why_not=tuple(_exceeded(sized)),
    )


def _exceeded(sized: Sized) -> list[str]:
    """Limits that a spring exceeds, in words."""
    limits, spring = sized.limits, sized.spring
    told = {
        "safety": f"its stress has a safety of {sized.safety:.2f}, {limits.safety:g} is required",
        "outside diameter": f"it is {1e3 * spring.outside:.0f} mm wide, {limits.outside_mm:g} mm are allowed",
        "length": f"it is {1e3 * sized.length:.0f} mm long in use, {limits.length_mm:g} mm are allowed",
        "number of coils": f"it has {min(spring.n, spring.coils):.1f} coils, {limits.coils:g} are required",
    }
    return [told[name] for name, excess in sized.excesses.items() if not excess <= 1]

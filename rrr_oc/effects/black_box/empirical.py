"""A torque that no law of the catalogue explains, as a smooth function of the variables that it was found to depend on."""

import itertools
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from rrr_oc.effects.base import SIGN_WIDTH, Prior
from rrr_oc.effects.capabilities import BlackBox
from rrr_oc.errors import UserError
from rrr_oc.numerics.smooth import cos, fabs, fmax, fmin, log, sign
from rrr_oc.robot.parameters import Parameter

EDGES = (0.5, 0.65, 0.8, 0.9, 0.95)  # of the trials, as a share of the variable's range
STRAIGHT = ((1, 0.0, 1), (-1, 1.0, 1))  # the edges of a straight line over a whole range
Direction = Literal["either", "turned", "upwards", "downwards"]
KINDS = ("q", "dq", "speed", "ddq", "load", "motor", "time")  # of variables
SLOW = 0.01  # speed [rad/s] from which on the scale of ("speed", joint) is logarithmic
HIGHEST = 60  # order of a series; a diagnosis tries lower ones
EITHER: tuple[Direction, ...] = ("either", "turned")
ONE_WAY: tuple[Direction, ...] = ("upwards", "downwards")


@dataclass(frozen=True)
class Empirical(BlackBox):
    """tau = d Σ c_kl cos(k π x) cos(l π y) of one or two variables x, y, scaled from their range to [0, 1].

    Or, of one variable, a torque that begins at an edge, as of an end stop or saturation: tau = d Σ c (±(x − edge))₊^p; two edges
    at the ends of the range make a straight line. The factor d depends on the joint's direction of motion, see `direction`. Beyond
    its range of validity a variable is held at the range's end. The torque is linear in the coefficients.

    Attributes:
        variables: What it depends on: ("q", joint), ("dq", joint), ("ddq", joint), ("load", joint), ("motor", joint) for the load
            with plain friction, ("time", −1), or ("speed", joint) for log(1 + |dq| / `SLOW`), on whose scale friction at slow speeds
            is as wide as at fast ones.
        low, high: Range of validity of each [rad, rad/s, 1, rad/s², Nm or s].
        orders: Highest k (and l).
        direction: Factor d: "either" 1, "turned" sgn(dq), "upwards" and "downwards" (1 ± sgn(dq))/2.
        edges: (±1, edge in [0, 1], power) of a torque that begins at an edge, above or below it.
        largest: Bound of a series' coefficients [Nm], against large terms that cancel within the recorded range.
        constant: Whether a constant is part of a series in either direction; in one direction it always is.
        on_link: Whether it acts on the link, not in the drive, as where the load torque was recorded; it then depends on positions
            and speeds only.
    """

    name = "empirical"
    equation = "tau = sum of c_kl cos(k pi x) cos(l pi y)"
    width = SIGN_WIDTH
    side = "drive"
    prior = Prior(
        0.005,
        {"coefficient": (0.2, "torque")},
        "what laws leave is a minor share of the torque, and smooth; the catalogue comes first",
    )

    variables: tuple[tuple[str, int], ...] = ()
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    orders: tuple[int, ...] = ()
    direction: Direction = "either"
    edges: tuple[tuple[int, float, int], ...] = ()
    largest: float = 1e6
    on_link: bool = False
    constant: bool = False

    def __post_init__(self) -> None:
        if self.on_link:
            object.__setattr__(self, "side", "link")

    def check_options(self, n):
        ranges = [*zip(self.low, self.high, strict=False)]
        of_one = len(self.variables) == 1 and all(s in (-1, 1) and 0 <= e <= 1 and 0 <= p <= 9 for s, e, p in self.edges)
        known = all(kind in KINDS and j >= -(kind == "time") for kind, j in self.variables)
        orders = len(self.orders) == len(self.variables) and all(0 <= order <= HIGHEST for order in self.orders)
        if not (known and len(self.low) == len(self.high) == len(self.variables) and all(low < high for low, high in ranges)):
            raise UserError(
                f"found variables {self.variables} from {self.low} to {self.high}; a rising range for each is required"
            )
        if self.variables and not (of_one if self.edges else orders):
            raise UserError(
                f"found orders {self.orders} and edges {self.edges} for {len(self.variables)} variables, which do not fit"
            )
        super().check_options(n)

    @cached_property
    def powers(self) -> list[tuple[int, ...]]:
        """(k,) or (k, l) of each coefficient."""
        every = itertools.product(*(range(o + 1) for o in self.orders))
        return [p for p in every if any(p) or self.constant or self.direction in ONE_WAY]

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        if self.edges:
            return tuple(Parameter("c_above" if side > 0 else "c_below", "Nm", 0.0) for side, _, _ in self.edges)
        bounds = -self.largest, self.largest
        return tuple(Parameter("c_" + "_".join(map(str, p)), "Nm", 0.0, *bounds) for p in self.powers)

    @cached_property
    def amplitudes(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return tuple(p.name for p in self.parameters)

    def renumbered(self, numbers):
        variables = tuple((kind, numbers[j] if j >= 0 else j) for kind, j in self.variables)
        return replace(self, joints=tuple(numbers[j] for j in self.joints), variables=variables)

    def torque(self, signals, theta, width):
        pairs = zip((theta[name] for name in self.amplitudes), self.basis(signals, width), strict=True)
        return (sum((c * value for c, value in pairs if not (isinstance(c, float) and c == 0.0)), 0.0),)

    def basis(self, signals, width) -> list:
        """Torque for each coefficient being 1 [Nm]."""
        scaled = []
        for (kind, j), low, high in zip(self.variables, self.low, self.high, strict=True):
            x = signals.time if kind == "time" else getattr(signals, {"motor": "load", "speed": "dq"}.get(kind, kind))[j]
            if kind == "motor":
                x = x - signals.friction[j]
            if kind == "speed":
                x = log(1 + fabs(x) / SLOW)
            scaled.append(fmin(fmax((x - low) / (high - low), 0.0), 1.0))
        turned = 1.0 + 0.0 * scaled[0] if self.direction == "either" else sign(signals.dq[self.joints[0]], width)
        if self.direction in ONE_WAY:
            turned = (1 + turned) / 2 if self.direction == "upwards" else (1 - turned) / 2
        if self.edges:
            return [turned * fmax(side * (scaled[0] - edge), 0.0) ** power for side, edge, power in self.edges]
        cosines = [_cosines(x, order) for x, order in zip(scaled, self.orders, strict=True)]
        return [
            math.prod((row[k] for row, k in zip(cosines, powers, strict=True) if k), start=turned) for powers in self.powers
        ]

    @cached_property
    def inputs(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        kinds = [kind for kind, _ in self.variables]
        return ("load", "friction") if "motor" in kinds else ("load",) if "load" in kinds else ()

    @property
    def resembles(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return "friction_over_speed" if {("dq", self.joints[0]), ("speed", self.joints[0])} & set(self.variables) else ""

    def scales(self, view, trial, prior=None):
        """Of a series smaller the finer its cosines; of a torque that begins at an edge what it is at the range's end."""
        number, unit = (prior or self.prior).typical["coefficient"]
        typical = number * view.unit(unit, self.joints)
        if self.edges:
            return np.array([typical / (1 - edge if side > 0 else edge) ** power for side, edge, power in self.edges])
        return np.array([typical / (1 + sum(p)) for p in self.powers])

    @property
    def depends_on(self):
        named = (("dq", j) if kind == "speed" else (kind, j) for kind, j in self.variables)
        return (*named, *([("sign", self.joints[0])] if self.direction != "either" else []))

    @property
    def validity(self):
        every = zip(self.variables, self.low, self.high, strict=True)
        return tuple((("dq", v[1]), 0.0, SLOW * math.expm1(b)) if v[0] == "speed" else (v, a, b) for v, a, b in every)

    def words(self, theta):
        way = f" while the joint moves {self.direction}" if self.direction in ONE_WAY else ""
        if not self.edges:
            return f"a sum of {len(self.amplitudes)} cosines{way}"
        low, high = self.low[0], self.high[0]
        if self.edges == STRAIGHT:
            at_high, at_low = theta["c_above"], theta["c_below"]
            slope = (at_high - at_low) / (high - low)
            return f"a line, {at_low:.3g} Nm at {low:.3g} rad and {slope:+.3g} Nm/rad from there{way}"
        where = " and ".join(
            f"{'above' if side > 0 else 'below'} {low + edge * (high - low):.4g}, power {power}"
            for side, edge, power in self.edges
        )
        return f"something that begins {where}"

    def without_range(self):
        return replace(self, low=(), high=(), largest=0.0)

    @classmethod
    def black_box_trials(cls, view, j, ranges, torque):
        """Of one variable, coarse and fine, or beginning at an edge; and of two."""
        on_link, largest = torque == "load", max(map(abs, ranges["motor", j]))
        for effect in cls._shapes(view.n, j, ranges, largest, on_link):
            if not on_link or all(kind in ("q", "dq", "speed") for kind, _ in effect.variables):
                yield effect.trial(view)

    @classmethod
    def _shapes(cls, n, j, ranges, largest, on_link):

        def one(variables, orders=(), direction: Direction = "either", edges=()):
            low, high = zip(*(ranges[v] for v in variables), strict=True)
            constant = direction == "either" and not edges
            return cls((j,), tuple(variables), low, high, tuple(orders), direction, tuple(edges), largest, on_link, constant)

        fastest = max(map(abs, ranges["dq", j]))
        ranges = {**ranges, ("speed", j): (0.0, math.log1p(fastest / SLOW))}
        for v in ranges:
            if v == ("motor", j):
                continue  # its own gain is in the catalogue; what is not linear, edges find
            for order in (3, 8, 20, 45) if v == ("q", j) else (3, 8):
                for direction in _directions(v, j):
                    yield one([v], [order], direction)
        for direction in ONE_WAY:
            yield one([("q", j)], edges=STRAIGHT, direction=direction)
            yield one([("q", j)], [3], direction)
        for v in (("q", j), ("dq", j), ("motor", j)):
            for at in EDGES:
                for power in (3,) if v[0] == "q" else (1, 3):  # straight beyond a position, it is a spring
                    above, below = (1, at, power), (-1, 1 - at, power)
                    for edges in ([above], [below], [above, below]):
                        yield one([v], edges=edges)
        for i in range(n):
            for direction in EITHER:
                if i != j:
                    yield one([("q", j), ("q", i)], [3, 3], direction)
                    yield one([("dq", j), ("q", i)], [3, 3], direction)
            yield one([("dq", j), ("q", j)], [3, 3])
            yield one([("motor", j), ("dq", i)], [1, 2])
            if i != j:
                yield one([("dq", j), ("dq", i)], [3, 3])
        yield one([("motor", j), ("time", -1)], [1, 1])
        yield one([("motor", j), ("time", -1)], [3, 3])
        yield one([("motor", j), ("dq", j)], [3, 3])


def _directions(v: tuple[str, int], j: int) -> tuple[Direction, ...]:
    """Of a series over one variable: the own speed has a direction already, what is over its size is friction."""
    if v == ("speed", j):
        return ("turned",)
    return ("either",) if v[0] == "motor" or v == ("dq", j) else EITHER


def _cosines(x, order: int) -> list:
    """cos(k π x) for k up to the order, by Chebyshev's recurrence: one cosine for all."""
    first = cos(np.pi * x)
    found = [1.0, first]
    while len(found) <= order:
        found.append(2 * first * found[-1] - found[-2])
    return found

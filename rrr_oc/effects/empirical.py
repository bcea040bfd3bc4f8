"""A torque that no law of the catalogue explains, as a smooth function of what it was found to depend on."""

import itertools
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from rrr_oc.effects.effect import Effect, Trial
from rrr_oc.parameters import Parameter
from rrr_oc.smooth import cos, fmax, fmin, sign


@dataclass(frozen=True)
class Empirical(Effect):
    """tau = sgn(dq)^s Σ c_kl cos(k π x) cos(l π y) of one or two variables x, y, scaled from their range to [0, 1].

    Beyond its range of validity a variable stays at the range's end. Cosines on an interval are smooth everywhere, converge fast
    for smooth functions, and each coefficient is linear.

    Attributes:
        variables: What it depends on: ("q", joint), ("dq", joint), ("load", joint) or ("time", −1).
        low, high: Range of validity of each [rad, rad/s, Nm or s].
        orders: Highest k (and l).
        signed: Whether it turns with the direction of its own joint.
    """

    name = "empirical"
    equation = "tau = sum of c_kl cos(k pi x) cos(l pi y)"
    width = Parameter("width", "rad/s", 0.05, lower=0.0)
    side = "drive"

    variables: tuple[tuple[str, int], ...] = field(default=())
    low: tuple[float, ...] = field(default=())
    high: tuple[float, ...] = field(default=())
    orders: tuple[int, ...] = field(default=())
    signed: bool = field(default=False)

    @cached_property
    def powers(self) -> list[tuple[int, ...]]:
        """(k,) or (k, l) of each coefficient; the constant is no effect of a variable unless it turns with the direction."""
        return [p for p in itertools.product(*(range(o + 1) for o in self.orders)) if any(p)]

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return tuple(Parameter("c_" + "_".join(map(str, p)), "Nm", 0.0) for p in self.powers)

    @cached_property
    def amplitudes(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return tuple(p.name for p in self.parameters)

    def torque(self, signals, theta, width):
        scaled = []
        for (kind, j), low, high in zip(self.variables, self.low, self.high, strict=True):
            x = signals.time if kind == "time" else getattr(signals, kind)[j]
            scaled.append(fmin(fmax((x - low) / (high - low), 0.0), 1.0))
        total = 0.0
        for name, powers in zip(self.amplitudes, self.powers, strict=True):
            value = theta[name]
            if isinstance(value, float) and value == 0.0:
                continue
            for x, k in zip(scaled, powers, strict=True):
                value = value * cos(np.pi * k * x) if k else value
            total = total + value
        if self.signed:
            total = total * sign(signals.dq[self.joints[0]], width)
        return (total,)

    @property
    def load_dependent(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return any(kind == "load" for kind, _ in self.variables)

    @property
    def depends_on(self) -> list[tuple[str, int]]:
        """The variables, and ("sign", own joint) where it turns with the direction."""
        return [*self.variables, *([("sign", self.joints[0])] if self.signed else [])]

    @classmethod
    def trials(cls, view):
        """None: the catalogue goes first, and what is left over asks for these by `surfaces`."""
        return iter(())

    @classmethod
    def surfaces(cls, view, j: int, load: tuple[np.ndarray, np.ndarray]):
        """Trials for one joint: of one variable, coarse and fine, and of two."""
        n = view.n
        ranges = {("q", i): (view.low[i], view.high[i]) for i in range(n)}
        ranges |= {("dq", i): (-view.speed[i], view.speed[i]) for i in range(n)}
        ranges |= {("load", j): (load[0][j], load[1][j]), ("time", -1): (0.0, view.duration)}

        def one(variables, orders, signed):
            low, high = zip(*(ranges[v] for v in variables), strict=True)
            effect = cls((j,), tuple(variables), tuple(map(float, low)), tuple(map(float, high)), tuple(orders), signed)
            zero = dict.fromkeys(effect.amplitudes, 0.0)
            return Trial(effect, tuple(zero | {a: 1.0} for a in effect.amplitudes), width=effect.sign_width(view))

        for v in ranges:
            for order in (3, 8, 20, 45) if v == ("q", j) else (3, 8):
                for signed in (False, True):
                    if not (signed and v == ("dq", j)):
                        yield one([v], [order], signed)
        for i in range(n):
            for signed in (False, True):
                if i != j:
                    yield one([("q", j), ("q", i)], [3, 3], signed)
                    yield one([("dq", j), ("q", i)], [3, 3], signed)
            yield one([("dq", j), ("q", j)], [3, 3], False)
            if i != j:
                yield one([("dq", j), ("dq", i)], [3, 3], False)

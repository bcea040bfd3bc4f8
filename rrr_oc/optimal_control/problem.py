"""Optimal-control problems of several phases: cost, dynamics, bounds, and starting points."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import casadi as ca
import numpy as np

from rrr_oc.errors import UserError

Side = Literal["start", "end"]  # of a phase


@dataclass(frozen=True, eq=False)
class Bounded:
    """Quantities with bounds along a phase.

    Attributes:
        names: Their names, for messages (n).
        lower, upper: Their bounds (n,).
        scale: Typical magnitudes, by which the solver's variables are scaled (n,).
        easing: Factors on the tolerance of an excess of their bounds between the nodes of a mesh, (n,) or one for all.
    """

    names: tuple[str, ...] = ()
    lower: np.ndarray = field(default_factory=lambda: np.zeros(0))
    upper: np.ndarray = field(default_factory=lambda: np.zeros(0))
    scale: np.ndarray = field(default_factory=lambda: np.zeros(0))
    easing: np.ndarray | float = 1.0

    @property
    def easings(self) -> np.ndarray:
        """The factors on the tolerance (n,)."""
        return np.broadcast_to(np.asarray(self.easing, float), len(self))

    def __len__(self) -> int:
        return len(self.names)

    def check(self, where: str, kind: str) -> None:
        """Raise `UserError` for wrong shapes, crossed bounds and scales that are not above 0; messages begin with `where`."""
        _check_bounds(where, kind, self.names, self.lower, self.upper)
        if np.shape(self.scale) != (len(self),) or not np.all(np.asarray(self.scale) > 0):
            raise UserError(f"{where}{kind} scales must be {len(self)} numbers above 0, got {self.scale}")


@dataclass(frozen=True, eq=False)
class Boundary:
    """Conditions at an end of a phase, or at a node within it.

    Attributes:
        end: At which end, or after which share of the phase's time, between 0 and 1; every mesh needs a node there.
        function: casadi Function (x, p, d) -> what is 0 there; it takes the data of the phase.
        names: Of the conditions.
    """

    end: Side | float
    function: ca.Function
    names: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Phase:
    """One phase of motion, whose time starts at 0.

    Attributes:
        name: Name for messages.
        rates: casadi Function (x, u, p, d) -> (dx/dt (nx,), cost rates (nc,), path (ng,)): states, controls, the problem's
            parameters and its data.
        x: The states (nx).
        u: The controls (nu).
        start, end: States at both ends (nx,); NaN leaves a state free there.
        duration: Bounds of the duration [s]; equal bounds fix it.
        path: What `rates` returns beside rates (ng).
        data: Indices of the problem's data that `rates` takes; None for all.
        costs: For each cost rate, the index of the problem's cost that its integral adds to.
        weight: Factor on the cost rates [1].
        boundaries: Further conditions at its ends.

    Raises `UserError` for wrong shapes and for bounds that contradict each other.
    """

    name: str
    rates: ca.Function
    x: Bounded
    u: Bounded
    start: np.ndarray
    end: np.ndarray
    duration: tuple[float, float]
    path: Bounded = field(default_factory=Bounded)
    data: np.ndarray | None = None
    costs: tuple[int, ...] = (0,)
    weight: float = 1.0
    boundaries: tuple[Boundary, ...] = ()

    def __post_init__(self) -> None:
        nx, ng, where = len(self.x), len(self.path), f"phase {self.name!r}: "
        for kind in ("x", "u", "path"):
            getattr(self, kind).check(where, kind)
        for name, values in (("start", self.start), ("end", self.end)):
            if np.shape(values) != (nx,):
                raise UserError(f"{where}{name} has shape {np.shape(values)}, not ({nx},)")
            for i in np.flatnonzero((values < self.x.lower) | (values > self.x.upper)):
                outside = f"outside {self.x.lower[i]:g} … {self.x.upper[i]:g}"
                raise UserError(f"{where}{name} of {self.x.names[i]} is {values[i]:g}, {outside}")
        found = tuple(self.rates.numel_out(i) for i in range(self.rates.n_out()))
        if found != (nx, len(self.costs), ng):
            raise UserError(f"{where}rates returns sizes {found}, not (dx/dt {nx}, cost rate {len(self.costs)}, path {ng})")
        for boundary in self.boundaries:
            if boundary.function.numel_out(0) != len(boundary.names):
                raise UserError(f"{where}a boundary does not return one number for each of {boundary.names}")
            if not isinstance(boundary.end, str) and not 0 < boundary.end < 1:
                raise UserError(f"{where}a boundary at the share {boundary.end:g} of its time; one between 0 and 1 is required")
        if not 0 < self.duration[0] <= self.duration[1] < np.inf:
            raise UserError(f"{where}durations {self.duration} must be positive, finite and not crossed")

    @property
    def shares(self) -> list[float]:
        """Shares of its time with a boundary, in their order."""
        return sorted({b.end for b in self.boundaries if not isinstance(b.end, str)})


@dataclass(frozen=True)
class Link:
    """States that are the same at the end of one phase and at the start of another, or of the same one, which makes it periodic.

    Attributes:
        before, after: Indices of the phases.
        states: Indices of the states.
    """

    before: int
    after: int
    states: tuple[int, ...]


@dataclass(frozen=True)
class Cycle:
    """Phases whose durations together have bounds.

    Attributes:
        phases: Their indices.
        duration: Least and greatest sum of their durations [s].
    """

    phases: tuple[int, ...]
    duration: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Problem:
    """Minimise a cost: the integral of the cost rates, summed over the phases.

    Of several costs in a group, the greatest counts; of several groups, the sum.

    Attributes:
        phases: The phases in their order; they share the parameters.
        parameters: Names of the decision parameters p (np,).
        p_lower, p_upper, p_scale: Their bounds and typical magnitudes.
        data: Values of d (nd,), fixed in a solve; `Kkt.data_gradient` is the sensitivity of the optimal cost to them.
        design: (p, d) -> inequalities ≤ 0 on the parameters, or None.
        designs: Names of these inequalities.
        cost_scale: Typical magnitude of the cost.
        groups: For each cost the index of its group.
        links: States that phases have in common.
        cycles: Durations that phases have together.
    """

    phases: tuple[Phase, ...]
    parameters: tuple[str, ...] = ()
    p_lower: np.ndarray = field(default_factory=lambda: np.zeros(0))
    p_upper: np.ndarray = field(default_factory=lambda: np.zeros(0))
    p_scale: np.ndarray = field(default_factory=lambda: np.zeros(0))
    data: np.ndarray = field(default_factory=lambda: np.zeros(0))
    design: ca.Function | None = None
    designs: tuple[str, ...] = ()
    cost_scale: float = 1.0
    groups: tuple[int, ...] = (0,)
    links: tuple[Link, ...] = ()
    cycles: tuple[Cycle, ...] = ()

    @property
    def chains(self) -> tuple[tuple[int, ...], ...]:
        """Indices of the phases that links and cycles join, directly or through others; two chains share nothing but the parameters."""
        chain = list(range(len(self.phases)))
        for together in [*((link.before, link.after) for link in self.links), *(cycle.phases for cycle in self.cycles)]:
            joined = {chain[i] for i in together}
            chain = [min(joined) if c in joined else c for c in chain]
        return tuple(tuple(i for i, c in enumerate(chain) if c == first) for first in sorted(set(chain)))

    def alone(self, chain: tuple[int, ...]) -> "Problem":
        """The problem of one chain, without the inequalities on the parameters."""
        own = [link for link in self.links if link.before in chain]
        links = tuple(Link(chain.index(link.before), chain.index(link.after), link.states) for link in own)
        cycles = tuple(
            replace(c, phases=tuple(chain.index(i) for i in c.phases)) for c in self.cycles if set(c.phases) <= set(chain)
        )
        phases = tuple(self.phases[i] for i in chain)
        return replace(self, phases=phases, links=links, cycles=cycles, design=None, designs=())

    def cost(self, costs: np.ndarray) -> float:
        """What is minimised, from the costs: the sum over the groups of the greatest in each."""
        groups = np.array(self.groups)
        return float(sum(np.max(np.asarray(costs)[groups == g]) for g in np.unique(groups)))

    def __post_init__(self) -> None:
        if set(self.groups) != set(range(len(set(self.groups)))):
            raise UserError(f"groups of the costs are {self.groups}; numbers from 0 without a gap are required")
        for phase in self.phases:
            if unknown := [k for k in phase.costs if not 0 <= k < len(self.groups)]:
                raise UserError(f"phase {phase.name!r} adds to cost {unknown[0]}; there are {len(self.groups)}, from 0")
        for link in self.links:
            self._check_link(link)
        for cycle in self.cycles:
            self._check_cycle(cycle)
        if np.shape(self.p_scale) != (len(self.parameters),):
            raise UserError(f"p_scale has shape {np.shape(self.p_scale)}, and there are {len(self.parameters)} parameters")
        _check_bounds("", "p", self.parameters, self.p_lower, self.p_upper)
        if self.design is not None and self.design.numel_out(0) != len(self.designs):
            raise UserError(f"design returns {self.design.numel_out(0)} inequalities, and there are {len(self.designs)} names")

    def _check_cycle(self, cycle: Cycle) -> None:
        if not cycle.phases or not all(0 <= i < len(self.phases) for i in cycle.phases):
            raise UserError(f"a cycle has the phases {cycle.phases}; there are {len(self.phases)}, from 0")
        least, most = (sum(self.phases[i].duration[side] for i in cycle.phases) for side in (0, 1))
        if not cycle.duration[0] <= cycle.duration[1] or cycle.duration[1] < least or cycle.duration[0] > most:
            raise UserError(f"a cycle takes {cycle.duration} s, and its phases {least:g} … {most:g} s")

    def _check_link(self, link: Link) -> None:
        for i in (link.before, link.after):
            if not 0 <= i < len(self.phases):
                raise UserError(f"a link names phase {i}; there are {len(self.phases)}, from 0")
            for state in link.states:
                if not 0 <= state < len(self.phases[i].x):
                    raise UserError(
                        f"a link names state {state} of phase {self.phases[i].name!r}, which has {len(self.phases[i].x)}"
                    )


def _check_bounds(where: str, kind: str, names: tuple[str, ...], lower: np.ndarray, upper: np.ndarray) -> None:
    size = len(names)
    if np.shape(lower) != (size,) or np.shape(upper) != (size,):
        raise UserError(f"{where}{kind} bounds have shapes {np.shape(lower)}, {np.shape(upper)}, not ({size},)")
    for i in np.flatnonzero(~(lower <= upper)):
        raise UserError(f"{where}bounds of {names[i]} are crossed: {lower[i]:g} … {upper[i]:g}")


@dataclass(frozen=True, eq=False)
class PhaseGuess:
    """Starting point of a phase: states and controls over normalised time s in [0, 1].

    Attributes:
        duration: Its duration [s].
        states: s (K,) -> (nx, K).
        controls: s (K,) -> (nu, K).
    """

    duration: float
    states: Callable[[np.ndarray], np.ndarray]
    controls: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Guess:
    """Starting point of a solve: the motion of each phase, and the parameters (np,)."""

    phases: tuple[PhaseGuess, ...]
    parameters: np.ndarray

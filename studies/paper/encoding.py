"""The paper's parametrisation of a co-design, and the cost of a population in the analytic model.

A candidate is a vector in [0, 1]: the springs' hardware, the durations of both phases, and five points a phase and joint between the
ends, each uniform within its bounds. The path through the points is Akima's spline (`numerics.akima`). Where the design is at rest at
the ends of a phase, the path's slope is zero there; where it is not, Akima's own slopes are used, as in the authors' code.

Limits are penalties: cost = E1 + `WEIGHT` · (magnitude of E1) · excess. The excess is the sum, over joints and phases, of the largest
violations of the limits of angle [rad], speed and acceleration (relative to their limits), exact along the path, and of load torque
(relative) and of depths below the floor and in keep-outs [m], at the nodes of the quadrature. The penalty is exact if the weight exceeds the
limits' multipliers.
"""

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.springs import drawn_bounds, from_drawn
from rrr_oc.codesign.task import PHASES
from rrr_oc.errors import UserError
from rrr_oc.numerics.along import along
from studies.paper import akima

VIA = 5  # path points per phase and joint in the paper
# [1] of the range from start to release by which the region of initial path points is wider, as in the authors' code
MARGIN = 0.25
WEIGHT = 5.0  # [1] of the penalty; doubled, optima stay and the landscape outside the limits is steeper
NODES = 12  # Gauss–Legendre points an interval


@dataclass(frozen=True)
class Scores:
    """Costs of K candidates.

    Attributes:
        E1: ∫ load torque² dt over both phases [N²m²s], (K,).
        excess: Sum of the violations of limits, (K,); 0 where all are kept.
        cost: E1 with the penalty, (K,).
    """

    E1: np.ndarray
    excess: np.ndarray
    cost: np.ndarray


@dataclass(frozen=True, eq=False)
class Candidates:
    """K decoded candidates.

    Attributes:
        theta: Parameters of the springs (p, K).
        durations: Durations of the phases [s], (2, K).
        cubics: Coefficients [rad] (4, phases, intervals, m, K), for s from 0 to 1 in every interval.
    """

    theta: np.ndarray
    durations: np.ndarray
    cubics: np.ndarray

    @property
    def h(self) -> np.ndarray:
        """Duration of an interval [s], (phases, 1, 1, K)."""
        return self.durations[:, None, None] / self.cubics.shape[2]

    def motion(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, dq, ddq at the points s (G,) of every interval, (m, phases, intervals, G, K) each."""
        cubic = tuple(self.cubics[:, :, :, :, None])
        found = akima.motion(cubic, np.asarray(s)[:, None], self.h[..., None, :])
        q, dq, ddq = (np.moveaxis(x, 2, 0) for x in found)
        return q, dq, ddq


@dataclass(frozen=True, eq=False)
class Encoding:
    """A co-design as vectors in [0, 1].

    Raises `UserError` for costs other than load torque².
    """

    design: CoDesign
    via: int = VIA

    def __post_init__(self) -> None:
        if self.design.cost != "load":
            raise UserError(f"the paper's parametrisation knows the cost 'load' only, got {self.design.cost!r}")
        if self.via < 1:
            raise UserError(f"a path needs at least 1 point between its ends, got {self.via}")

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of all decoded numbers: springs' hardware, durations [s], path points [rad] (phase, joint, point)."""
        task, low_high = self.design.task, drawn_bounds(self.design.springs)
        angles = [np.tile(np.repeat(b, self.via), len(PHASES)) for b in (task.lower, task.upper)]
        lower, upper = (
            np.concatenate([b, np.full(len(PHASES), d), a]) for b, d, a in zip(low_high, task.duration, angles, strict=True)
        )
        return lower, upper

    @cached_property
    def free(self) -> np.ndarray:
        """Indices of the numbers that bounds do not fix: these are the elements of a vector."""
        lower, upper = self.bounds
        return np.flatnonzero(upper > lower)

    @cached_property
    def region(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of initial means, (size,) in [0, 1] each: path points within the range from start to release, widened
        by `MARGIN` on each side as in the authors' code; everything else within its bounds. Means over the whole joint range give
        paths with large penalties, and a search from there converges before it reduces the load torque."""
        task, (lower, upper) = self.design.task, self.bounds
        ends, low, high = np.array([task.start, task.release]), lower.copy(), upper.copy()
        widened = MARGIN * np.ptp(ends, axis=0)
        count = len(PHASES) * len(task.moving) * self.via
        low[-count:] = np.maximum(low[-count:], np.tile(np.repeat(ends.min(axis=0) - widened, self.via), len(PHASES)))
        high[-count:] = np.minimum(high[-count:], np.tile(np.repeat(ends.max(axis=0) + widened, self.via), len(PHASES)))
        extent = np.where(upper > lower, upper - lower, 1.0)
        return ((low - lower) / extent)[self.free], ((high - lower) / extent)[self.free]

    @property
    def size(self) -> int:
        """Length of a vector."""
        return len(self.free)

    def values(self, x: np.ndarray) -> np.ndarray:
        """Decoded numbers (all, K) of vectors (K, size)."""
        lower, upper = self.bounds
        values = np.repeat(lower[:, None], len(x), axis=1)
        values[self.free] += ((upper - lower)[self.free] * np.clip(x, 0, 1)).T
        return values

    def decode(self, x: np.ndarray) -> Candidates:
        """Candidates of vectors (K, size)."""
        drawn, durations, via = self.split(self.values(np.atleast_2d(x)))
        points = self._with_ends(via)
        cubics = [akima.cubics(list(phase), self.design.task.at_rest) for phase in points]
        return Candidates(
            from_drawn(self.design.springs, drawn), durations, np.moveaxis(np.array(cubics), 2, 0)
        )  # (phases, intervals, 4, m, K)

    def split(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Springs as drawn (·, K), durations (2, K) and points (phases, m, via, K) of `values`."""
        n = len(values) - len(PHASES) * (1 + len(self.design.task.moving) * self.via)
        via = values[n + len(PHASES) :].reshape(len(PHASES), len(self.design.task.moving), self.via, -1)
        return values[:n], values[n : n + len(PHASES)], via

    def encode(self, parameters: np.ndarray, durations: np.ndarray, via: np.ndarray) -> np.ndarray:
        """The vector of a design: its parameters, durations [s] and points [rad] (phases, m, via), cut off at the bounds."""
        hardware, drawn, at = self.design.hardware(parameters), [], 0
        for spring in self.design.springs:
            own = parameters[at : at + len(spring.lower)]
            drawn += [hardware[h] for h in spring.hardware] if spring.hardware else own.tolist()
            at += len(spring.lower)
        lower, upper = self.bounds
        values = np.concatenate([drawn, durations, np.ravel(via)])
        return np.clip((values - lower)[self.free] / (upper - lower)[self.free], 0, 1)

    def _with_ends(self, via: np.ndarray) -> np.ndarray:
        """Points with the ends of each phase, (phases, via + 2, m, K)."""
        phases = []
        for i in range(len(PHASES)):
            ends = [np.repeat(np.reshape(end, (1, -1, 1)), via.shape[-1], axis=2) for end in self.design.task.ends(i)]
            phases.append(np.concatenate([ends[0], np.swapaxes(via[i], 0, 1), ends[1]]))
        return np.array(phases)


@dataclass(frozen=True, eq=False)
class Analytic:
    """The cost of candidates by the analytic model, with exact springs: E1 by Gauss–Legendre quadrature between the points."""

    encoding: Encoding
    nodes: int = NODES

    def __call__(self, x: np.ndarray) -> Scores:
        """Cost of vectors (K, size)."""
        return self.score(self.encoding.decode(x))

    def score(self, candidates: Candidates) -> Scores:
        """Cost of decoded candidates."""
        nodes, weights = np.polynomial.legendre.leggauss(self.nodes)
        q, dq, ddq = candidates.motion((nodes + 1) / 2)
        tau = load_torque(self.encoding.design, candidates.theta, q, dq, ddq)
        E1 = np.einsum("mpigk,g,pk->k", tau**2, weights / 2, candidates.h[:, 0, 0])
        return scores(self.encoding.design, candidates, E1, q, tau)


def load_torque(design: CoDesign, theta: np.ndarray, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """Load torque of the moving joints with exact springs [Nm], of motions (m, phases, …, K) and parameters (p, K)."""
    m, shape = q.shape[0], q.shape[1:]
    count = int(np.prod(shape[1:]))
    payload = np.repeat(design.task.payloads, count)[None]
    per_sample = np.tile(theta, (1, len(PHASES) * count // shape[-1]))
    widths = np.zeros(design.model.widths.size)
    tau = along(design.torques, *(x.reshape(m, -1) for x in (q, dq, ddq)), payload, per_sample, widths)[0]
    return tau.reshape(q.shape)


def scores(design: CoDesign, candidates: Candidates, E1: np.ndarray, q: np.ndarray, tau: np.ndarray) -> Scores:
    """Scores from E1 (K,) and from angles and load torques (m, phases, …, K) at the nodes of its quadrature."""
    total = excesses(design, candidates).sum(axis=(0, 1, 2)) + _sampled_excess(design, q, tau)
    with np.errstate(invalid="ignore"):
        cost = E1 + WEIGHT * design.problem.cost_scale * total
    return Scores(E1, total, np.where(np.isfinite(cost), cost, np.inf))


def excesses(design: CoDesign, candidates: Candidates) -> np.ndarray:
    """By how much candidates exceed their limits of angle [rad], speed and acceleration (relative), (3, phases, m, K); 0 inside."""
    task = design.task
    reach = akima.extremes(tuple(candidates.cubics), candidates.h)  # (·, phases, intervals, m, K)
    found = []
    limits = ((task.lower, task.upper, np.ones_like(task.upper)), *((-v, v, v) for v in (task.speed, task.acceleration)))
    for values, (lower, upper, scale) in zip(reach, limits, strict=True):
        over = np.maximum(values.max(axis=(0, 2)) - upper[:, None], lower[:, None] - values.min(axis=(0, 2)))
        known = np.isfinite(scale)[:, None]
        found.append(np.where(known, np.maximum(over, 0) / np.where(known, scale[:, None], 1.0), 0.0))
    return np.array(found)


def _sampled_excess(design: CoDesign, q: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """The same of load torque and of distances that the arm keeps, where there are such limits."""
    task, total = design.task, np.zeros(q.shape[-1])
    for j in np.flatnonzero(np.isfinite(task.torque)):
        over = np.abs(tau[j]) / task.torque[j] - 1
        total += np.maximum(over, 0).max(axis=tuple(range(1, over.ndim - 1))).sum(axis=0)
    if task.kept(task.full(task.start)):
        for missing in along(_missing(design), q.reshape(len(q), -1))[0]:
            short = missing.reshape(q.shape[1:])
            total += np.maximum(short, 0).max(axis=tuple(range(1, short.ndim - 1))).sum(axis=0)
    return total


def _missing(design: CoDesign) -> ca.Function:
    """Angles of the moving joints (m,) -> what the distances that the arm keeps lack [m]."""
    q = ca.SX.sym("q", len(design.task.moving))
    full = ca.SX.zeros(design.task.robot.n)
    for row, joint in enumerate(design.task.moving):
        full[joint] = q[row]
    return ca.Function("missing", [q], [ca.vertcat(*[one.least - one.value for one in design.task.kept(full)])])

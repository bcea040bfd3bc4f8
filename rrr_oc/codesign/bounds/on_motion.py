"""A lower bound of E1 over all springs that a design allows, on a given motion.

Let tau be the torque that the motion needs without springs, and ⟨x, y⟩ = Σ_phases ∫ xᵀy dt. A spring with an amplitude a, in which
its torque is linear, and other parameters theta gives the torque a φ(theta). Let C be the sum over the springs' places of the convex
hulls of all these torques within bounds. Single springs are points of C, and so are mixtures of several in one place, whose shares add
up to one spring. For every r

    min over x in C of |tau − x|²  ≥  (⟨r, tau⟩ − max over x in C of ⟨r, x⟩)² / |r|²,  if the bracket is positive.

With r = tau − x of the best mixture both sides are equal; any other r gives a lower bound as well. It needs the maximum of
⟨r, a φ(theta)⟩ over all theta, which is not looked up on a grid but enclosed: boxes of theta are halved until their intervals of
⟨r, a φ⟩ exclude a greater value.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct
from scipy.optimize import nnls

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.springs import SpringBounds, acting
from rrr_oc.codesign.task import PHASES
from rrr_oc.effects import Signals
from rrr_oc.numerics.enclosure import NotEnclosed, enclosed, enclosures
from rrr_oc.optimal_control.solver import Solution

TOLERANCE = 1e-3  # [1] of the best mixture's cost, by which the bound may be below it; doubled, it is found in fewer rounds
ROUNDS = 60  # of better mixtures; doubled, a bound that does not get there takes twice as long
BOXES = 20_000  # examined at most, in all rounds but the last; doubled, as above
COARSE = 20.0  # [1] of that tolerance, by which maxima are bounded too high in the first round; doubled, more rounds follow
GRID = 2000  # springs a place of which the first mixtures are made; doubled, fewer maxima must be enclosed
CHUNK = 40_000  # boxes times instants that are examined at once; doubled, they leave the processor's cache
INSTANTS = 400  # of quadrature, as far as `POINTS` allow; doubled, a bound takes twice as long
POINTS = (3, 9)  # of Gauss quadrature in an interval of the mesh; with fewer, kinks of springs are missed
FLOOR = 1e-5  # [1] of the cost without springs, below which a mixture's cost counts as that; doubled, it is reached sooner
SHAPES = 2_000_000  # values of the torques of these springs at most, for the memory; doubled, it takes twice as much
NEAR = 300  # springs that come near a maximum and are added to the grid; doubled, the grid grows faster
MARGINS = 50.0  # below the maximum, within which these are; doubled, they are further from it
EQUAL = 1e3  # weight of the rows by which the shares of a place add up to 1; doubled, they do so more closely before they are scaled


class SpringBound(Struct, frozen=True):
    """What springs can reach on a motion: E1 by quadrature, with exact springs.

    Attributes:
        lower: No springs within bounds cost less on this motion [N²m²s].
        mixture: Cost of the best mixture that was found; the best possible `lower` lies between both [N²m²s].
        cost: Cost of the design itself [N²m²s].
        excess: `cost` relative to `lower`, less 1; null where `lower` is 0 [1].
        boxes: Number of boxes of parameters that were examined.
    """

    lower: float
    mixture: float
    cost: float
    excess: float | None
    boxes: int


@dataclass(frozen=True, eq=False)
class Needed:
    """What a motion needs without springs; time is the last axis.

    Attributes:
        q: Positions of all joints [rad], (n, K).
        tau: Load torque of the moving joints without springs [Nm], (m, K).
        moving: Indices of the moving joints (m).
        weights: Of the quadrature [s], (K,).
        phase: Name of the phase of each instant, (K,).
    """

    q: np.ndarray
    tau: np.ndarray
    moving: tuple[int, ...]
    weights: np.ndarray
    phase: np.ndarray

    def product(self, x: np.ndarray, y: np.ndarray) -> float:
        """⟨x, y⟩ [N²m²s] of torques (m, K)."""
        return float(((x * y) @ self.weights).sum())


@dataclass(frozen=True, eq=False)
class SpringPlace:
    """One spring of a design along the motion, its parameters open within their bounds."""

    spring: SpringBounds
    needed: Needed

    @property
    def amplitude(self) -> int:
        """Index of the one parameter in which the torque is linear."""
        effect = self.spring.effect
        if len(effect.amplitudes) != 1:
            raise NotEnclosed(f"{effect.name} is linear in {len(effect.amplitudes)} parameters; one is required")
        return [p.name for p in effect.parameters].index(effect.amplitudes[0])

    @property
    def others(self) -> np.ndarray:
        """Indices of the other parameters, (d,)."""
        return np.delete(np.arange(len(self.spring.lower)), self.amplitude)

    @property
    def least(self) -> float:
        """Least amplitude."""
        return float(self.spring.lower[self.amplitude])

    def strongest(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Greatest amplitude of a spring whose other parameters lie in boxes (d, P); -infinity where there is none, (P,)."""
        spring, size = self.spring, lower.shape[1]
        low, high = (np.repeat(b[:, None], size, axis=1) for b in (spring.lower, spring.upper))
        low[self.others], high[self.others] = lower, upper
        allowed = spring.form.strongest(low, high, spring.hardware) if spring.hardware else np.full(size, np.inf)
        return np.where(allowed < self.least, -np.inf, np.minimum(allowed, spring.upper[self.amplitude]))

    def shape(self, others: Any, q: Any = None) -> tuple:
        """Torque with an amplitude of 1 on each of the spring's joints, from the other parameters, (P, 1) each or enclosures; by default
        at the motion's angles, where it is zero in the phases in which the spring does not act."""
        effect = self.spring.effect
        theta = {effect.parameters[i].name: values for i, values in zip(self.others, others, strict=True)}
        torque = effect.torque(Signals(self.needed.q if q is None else q), theta | dict.fromkeys(effect.amplitudes, 1.0), 0.0)
        if q is not None or len(phases := acting(effect)) == len(PHASES):
            return torque
        acts = np.isin(self.needed.phase, [PHASES[i] for i in phases]).astype(float)
        return tuple(part * acts for part in torque)

    def shapes(self, others: np.ndarray) -> np.ndarray:
        """The same from numbers (d, P), one joint after the other: (P, number of joints × K)."""
        size = others.shape[1], self.needed.weights.size
        return np.hstack([np.broadcast_to(part, size) for part in self.shape(others[:, :, None])])

    def torque(self, amplitude: float, others: np.ndarray) -> np.ndarray:
        """Torque of one spring on the moving joints [Nm], (m, K)."""
        torque = np.zeros_like(self.needed.tau)
        torque[self.rows] = amplitude * self.shapes(others[:, None]).reshape(len(self.rows), -1)
        return torque

    @property
    def rows(self) -> list[int]:
        """Rows of its joints among the moving ones."""
        return [self.needed.moving.index(j) for j in self.spring.effect.joints]

    def pulls(self, residual: np.ndarray) -> np.ndarray:
        """What multiplies the torque of each of the spring's joints in ⟨r, a φ⟩, (number of joints, K)."""
        return residual[self.rows] * self.needed.weights

    def scaled(self, strongest: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The amplitudes that make the most of ⟨r, φ⟩, and ⟨r, a φ⟩, (P,) each."""
        amplitudes = np.where((values > 0) | (strongest < self.least), strongest, self.least)
        return amplitudes, np.where(amplitudes < 0, -np.inf, np.maximum(amplitudes, 0.0) * values)


class _Grid:
    """Springs of a place with given other parameters (d, P)."""

    def __init__(self, place: SpringPlace, others: np.ndarray) -> None:
        self.place, self.others = place, others
        self._strongest = place.strongest(others, others)
        self._shapes = place.shapes(others)

    def best(self, residual: np.ndarray) -> tuple[float, np.ndarray]:
        """The greatest ⟨r, a φ⟩ of these springs, and the torque a φ of that spring [Nm], (m, K)."""
        amplitudes, values = self.place.scaled(self._strongest, self._shapes @ self.place.pulls(residual).ravel())
        i = int(np.argmax(values))
        return float(values[i]), self.place.torque(float(amplitudes[i]), self.others[:, i])

    def extended(self, others: np.ndarray) -> "_Grid":
        """The grid with more springs."""
        return _Grid(self.place, np.hstack([self.others, others]))


def _grid(place: SpringPlace) -> _Grid:
    """Springs all over the bounds of a place."""
    lower, upper = (b[place.others] for b in (place.spring.lower, place.spring.upper))
    count = int(min(GRID, SHAPES / place.needed.weights.size) ** (1 / max(len(lower), 1)))
    axes = [np.linspace(a, b, count if b > a else 1) for a, b in zip(lower, upper, strict=True)]
    return _Grid(place, np.array(list(itertools.product(*axes))).T)


class _Greatest(NamedTuple):
    """The greatest ⟨r, a φ⟩ [N²m²s] of all springs of a place: an upper bound of it, other parameters (d, P) of springs that come
    near, and the number of boxes that were examined."""

    bound: float
    near: np.ndarray
    boxes: int


def _greatest(place: SpringPlace, residual: np.ndarray, margin: float) -> _Greatest:
    """The bound is at most a margin above what a spring reaches, unless there are too many boxes for that."""
    lower, upper = (b[place.others][:, None] for b in (place.spring.lower, place.spring.upper))
    reached = bound = -np.inf
    examined, boxes = [], 0
    while lower.shape[1]:
        chunks = range(0, lower.shape[1], max(1, CHUNK // residual.shape[1]))
        parts = [_examined(place, residual, lower[:, i : i + chunks.step], upper[:, i : i + chunks.step]) for i in chunks]
        bounds, values, influence = (np.concatenate(p, axis=-1) for p in zip(*parts, strict=True))
        examined.append(np.vstack([values, (lower + upper) / 2]))
        boxes, reached = boxes + len(bounds), max(reached, float(values.max()))
        halved = (bounds > reached + margin) & (influence.max(axis=0, initial=0.0) > 0) & (boxes < BOXES)
        bound = max(bound, reached, float(bounds[~halved].max(initial=-np.inf)))
        lower, upper = _halved(lower[:, halved], upper[:, halved], influence[:, halved])
    values, *others = np.hstack(examined)
    near = np.flatnonzero(values >= reached - MARGINS * margin)
    return _Greatest(bound, np.array(others).reshape(-1, values.size)[:, near[:: len(near) // NEAR + 1]], boxes)


def _halved(lower: np.ndarray, upper: np.ndarray, influence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (d, P) halved across the parameter with the most influence, (d, 2 P)."""
    if not lower.size:
        return lower, upper
    across, columns = influence.argmax(axis=0), np.arange(lower.shape[1])
    below, above = upper.copy(), lower.copy()
    below[across, columns] = above[across, columns] = ((lower + upper) / 2)[across, columns]
    return np.hstack([lower, above]), np.hstack([below, upper])


def _examined(place: SpringPlace, residual: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, ...]:
    """Of boxes of the other parameters (d, P): an upper bound of ⟨r, a φ⟩ (P,), its value in the middle (P,), and how much each
    parameter may add to ⟨r, φ⟩ from there to the sides (d, P).

    The bound is the lower one of two: by the intervals of the torque, and by those of its derivatives, from the middle.
    """
    middle, pulls = (lower + upper) / 2, place.pulls(residual)
    value = place.shapes(middle) @ pulls.ravel()
    parts = zip(place.shape(enclosures(lower, upper)), pulls, strict=True)
    total = enclosed(sum(enclosed(part).total(pull) for part, pull in parts))
    steepest = 0.0 if total.slopes is None else np.maximum(total.slopes[1], -total.slopes[0])
    influence = steepest * (upper - lower) / 2
    _, bounds = place.scaled(place.strongest(lower, upper), np.minimum(total.value[1], value + influence.sum(axis=0)))
    _, values = place.scaled(place.strongest(middle, middle), value)
    return bounds, values, influence


class _Mixture:
    """A point x of C, made of springs and of their shares.

    Attributes:
        residual: r = tau − x [Nm], (m, K).
        cost: |r|² [N²m²s].
    """

    def __init__(self, places: Sequence[SpringPlace], needed: Needed) -> None:
        self._places, self._needed = places, needed
        self._springs: list[tuple[int, np.ndarray]] = []  # index of the place, torque (m, K)
        self.residual = needed.tau
        self.cost = self._whole = needed.product(needed.tau, needed.tau)

    @property
    def tolerance(self) -> float:
        """By which the bound may be below the cost [N²m²s]."""
        return TOLERANCE * max(self.cost, FLOOR * self._whole)

    def lower(self, greatest: float) -> float:
        """The lower bound by this r, from the greatest ⟨r, x⟩ of all x in C."""
        reach = self._needed.product(self.residual, self._needed.tau) - greatest
        return max(reach, 0.0) ** 2 / self.cost if self.cost > 0 else 0.0

    def improve(self, grids: Sequence[_Grid]) -> None:
        """Add the best springs of grids, and optimise all shares, until little is left to be gained. Springs without a share are left
        out again (Frank and Wolfe's method, fully corrective)."""
        for _ in range(ROUNDS):
            best = [grid.best(self.residual) for grid in grids]
            whole = self._springs or all(
                place.least == 0 for place in self._places
            )  # else a spring that must be there is missing
            if whole and self.cost - self.lower(sum(value for value, _ in best)) <= self.tolerance / 4:
                break
            springs = [*self._springs, *enumerate(torque for _, torque in best)]
            shares = self._shares(springs)
            self._springs = [spring for spring, share in zip(springs, shares, strict=True) if share > 0]
            mixed = sum((share * torque for (_, torque), share in zip(springs, shares, strict=True)), np.zeros(()))
            self.residual = self._needed.tau - mixed
            self.cost = self._needed.product(self.residual, self.residual)

    def _shares(self, springs: Sequence[tuple[int, np.ndarray]]) -> np.ndarray:
        """Shares of springs in the best mixture. Those of a place add up to 1, or to less where no spring is allowed, too."""
        scale, owners, places = np.sqrt(self._needed.weights), np.array([i for i, _ in springs]), np.arange(len(self._places))
        slack = np.array([i for i, place in enumerate(self._places) if place.least == 0], int)
        torques = np.column_stack([(torque * scale).ravel() for _, torque in springs])
        target = (self._needed.tau * scale).ravel()
        weight = EQUAL * np.linalg.norm(target)
        sums = weight * np.hstack([places[:, None] == owners, places[:, None] == slack])
        matrix = np.vstack([np.hstack([torques, np.zeros((target.size, slack.size))]), sums])
        shares = nnls(matrix, np.r_[target, np.full(places.size, weight)], maxiter=100 * matrix.shape[1])[0][: len(springs)]
        totals = np.bincount(owners, shares, places.size)
        totals[slack] = np.maximum(totals[slack], 1.0)
        return shares / totals[owners]


def bound_on_motion(springs: Sequence[SpringBounds], needed: Needed, cost: float) -> SpringBound:
    """The bound for springs on a motion, and the excess over it of a design with this cost.

    Raises `NotEnclosed` for springs whose torque has no interval form.
    """
    places = [SpringPlace(spring, needed) for spring in springs]
    mixture, grids, lower, boxes = _Mixture(places, needed), [_grid(place) for place in places], 0.0, 0
    share = np.array([max(place.others.size, 1) ** 2 for place in places])  # of the margin: boxes of more parameters are more
    for turn in range(ROUNDS):
        mixture.improve(grids)
        margins = max(1 / 4, COARSE / 8**turn) * mixture.tolerance * share / share.sum()
        greatest = [_greatest(place, mixture.residual, margin) for place, margin in zip(places, margins, strict=True)]
        lower, boxes = max(lower, mixture.lower(sum(g.bound for g in greatest))), boxes + sum(g.boxes for g in greatest)
        if mixture.cost - lower <= mixture.tolerance or boxes >= BOXES:
            break
        grids = [grid.extended(g.near) for grid, g in zip(grids, greatest, strict=True)]
    return SpringBound(lower, mixture.cost, cost, cost / lower - 1 if lower > 0 else None, boxes)


def solution_bound(solution: Solution, design: CoDesign, offered: CoDesign | None = None) -> SpringBound | None:
    """The bound for the springs of `offered`, by default of the design itself, on the motion of one of the design's solutions.

    None where the cost is not E1, or where the torque of a spring has no interval form.
    """
    if design.cost != "load":
        return None
    springs = [spring for spring in (offered or design).springs if not spring.known]
    try:
        return bound_on_motion(springs, *needed_by(solution, design))
    except NotEnclosed:
        return None


def needed_by(solution: Solution, design: CoDesign) -> tuple[Needed, float]:
    """What a solution's motion needs without springs, and its E1 with the design's own, exact ones [N²m²s]."""
    intervals = sum(mesh.size for mesh in solution.transcription.mesh)
    points, weights = np.polynomial.legendre.leggauss(int(np.clip(np.ceil(INSTANTS / intervals), *POINTS)))
    task, m, theta, slack = design.task, len(design.task.moving), solution.parameters, solution.parameters.copy()
    names = [(spring, p.name) for spring in design.springs for p in spring.effect.parameters]
    slack[[not spring.known and name in spring.effect.amplitudes for spring, name in names]] = 0.0
    widths, rows, cost = np.zeros(design.model.widths.size), [], 0.0
    for phase, payload in enumerate(task.payloads):
        _, x, _, u = solution.sample(phase, (points + 1) / 2)
        q, dq, ddq = (v.reshape(m, -1) for v in (x[:m], x[m : 2 * m], design.accelerations(x, u)))
        step = np.outer(solution.transcription.mesh[phase] * solution.durations[phase], weights / 2).ravel()
        without, own = (
            np.array(design.torques(q, dq, ddq, payload, design.engaged(phase, p), widths)[0]) for p in (slack, theta)
        )
        rows.append((task.full(q), without, step, np.full(step.size, PHASES[phase])))
        cost += float((own**2 @ step).sum())
    q, tau, step, phases = (np.concatenate(parts, axis=-1) for parts in zip(*rows, strict=True))
    return Needed(q, tau, task.moving, step, phases), cost

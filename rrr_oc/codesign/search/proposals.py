"""Starting points of a multistart: springs, durations and coarse paths from Sobol points or from CMA-ES."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cma
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.stats import qmc

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.springs import drawn_bounds, from_drawn
from rrr_oc.codesign.task import Task
from rrr_oc.errors import UserError
from rrr_oc.optimal_control.problem import Guess, PhaseGuess
from rrr_oc.optimal_control.refinement import Refinement

LAYERS = ("sobol", "cma-es")
BESIDE = 0.05  # [1] of a path, within which a proposed point gives way to one of the task; doubled, paths are smoother


@dataclass(frozen=True)
class SearchOptions:
    """Settings of a multistart. Raises `UserError` for unknown layers and for no starts.

    Attributes:
        starts: Number of starting points that IPOPT polishes, half of them from each layer.
        layers: Sources of the starting points, of `LAYERS`.
        seed: Seed of both layers.
        scheme, stages: Collocation scheme.
        coarse: Intervals a phase of the mesh on which starts are polished.
        fine: Intervals a phase of the first mesh of the optima that are kept.
        width: Smoothing width of the springs on the coarse mesh [rad].
        widths: Smoothing widths that follow on the fine mesh; the last one is reported [rad].
        kept: Number of distinct optima that are solved on the fine mesh.
        within: Of those, every one within this relative distance of the best is refined to the mesh tolerance.
        motions: Proposed motions of each phase alone, for springs that starts led to; 0 leaves this out.
        springs: Number of different springs for which some of these motions are solved on the coarse mesh; twice as many where there are
            several ways to mount them.
        rounds: Largest number of times that motions are searched for the springs found last.
        via: Points of a proposed path, per phase and joint.
        population: Population of CMA-ES.
        sigma: Initial step size of CMA-ES, on variables in [0, 1].
        refinement: Mesh tolerance.
    """

    starts: int = 20
    layers: tuple[str, ...] = LAYERS
    seed: int = 0
    scheme: str = "lobatto"
    stages: int = 4
    coarse: int = 16
    fine: int = 40
    width: float = 0.1
    widths: tuple[float, ...] = (0.03, 0.01, 0.003)
    kept: int = 6
    within: float = 0.005
    motions: int = 48
    springs: int = 24
    rounds: int = 4
    via: int = 2
    population: int = 8
    sigma: float = 0.3
    refinement: Refinement = field(default_factory=Refinement)

    def __post_init__(self) -> None:
        if self.starts < 1:
            raise UserError(f"a search needs 1 start or more, got starts={self.starts}")
        if self.layers not in (LAYERS, *((layer,) for layer in LAYERS)):
            raise UserError(f"a search's layers are {LAYERS}, or one of them, got {self.layers}")

    def on(self, intervals: int) -> "SearchOptions":
        """The same with so many intervals a phase on the first fine mesh, and in proportion on the coarse one."""
        return replace(self, fine=intervals, coarse=intervals * self.coarse // self.fine)

    @property
    def narrow(self) -> "SearchOptions":
        """The same for starts that are optima of springs with the smallest smoothing width: wider ones would lose their swings."""
        return replace(self, width=self.widths[-1], widths=())


def sobol_points(size: int, count: int, seed: int) -> np.ndarray:
    """`count` points of a scrambled Sobol sequence in [0, 1], (count, size)."""
    return qmc.Sobol(size, rng=seed).random(2 ** int(np.ceil(np.log2(max(count, 1)))))[:count]


def cma_strategy(size: int, options: SearchOptions, left: int) -> cma.CMAEvolutionStrategy:
    """A CMA-ES with a random mean, for `left` more evaluations; each restart has another seed."""
    seed = options.seed * 1000 + left + 1
    settings = {"bounds": [0, 1], "seed": seed, "popsize": min(options.population, max(left, 2)), "verbose": -9}
    settings |= {"tolfun": 1e-4, "tolflatfitness": 3}
    return cma.CMAEvolutionStrategy(np.random.default_rng(seed).uniform(0.2, 0.8, size), options.sigma, settings)


def dimensions(design: CoDesign, via: int) -> int:
    """Length of the vectors that `decode` takes."""
    return len(drawn_bounds(design.springs)[0]) + 2 * _phase_dimensions(design.task, via)


def _phase_dimensions(task: Task, via: int) -> int:
    return 2 + len(task.moving) * via


def decode(design: CoDesign, vector: np.ndarray, via: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parameters (np,), durations [s] (2,) and path points [rad] (2, m, via) of a vector in [0, 1].

    Biarticular springs are drawn as hardware, uniformly within its bounds, and then reduced to kappa, rho and phi.
    """
    low, high = drawn_bounds(design.springs)
    springs, *motions = np.split(np.clip(vector, 0, 1), len(low) + np.arange(2) * _phase_dimensions(design.task, via))
    times, points = zip(*(_decoded(design.task, motion) for motion in motions), strict=True)
    return from_drawn(design.springs, low + (high - low) * springs), np.array(times), np.array(points)


def _decoded(task: Task, vector: np.ndarray) -> tuple[float, np.ndarray]:
    """Duration [s] and path points [rad] (m, via) of one phase from a vector in [0, 1]: duration, reach, points.

    The points lie within the joints' ranges, at most a share, the reach, of the way from the ends of the motion to the limits.
    """
    shortest, longest = task.duration
    ends = np.array([task.start, task.release])
    least, most = ends.min(axis=0), ends.max(axis=0)
    lower = least + vector[1] * (task.lower - least)
    upper = most + vector[1] * (task.upper - most)
    points = vector[2:].reshape(len(task.moving), -1)
    return shortest + (longest - shortest) * vector[0], lower[:, None] + (upper - lower)[:, None] * points


def proposed_guess(design: CoDesign, vector: np.ndarray, via: int) -> Guess:
    """The springs and the motion that a vector in [0, 1] stands for."""
    return motion_guess(design, *decode(design, vector, via))


def motion_guess(
    design: CoDesign, parameters: np.ndarray, durations: Sequence[float] | np.ndarray, via: np.ndarray | None = None
) -> Guess:
    """A motion at rest at both ends of each phase: a cubic spline through points, run through with minimum jerk.

    Args:
        design: The problem.
        parameters: Its parameters (np,).
        durations: Durations of the phases [s].
        via: Points at equal fractions of the path [rad], (phases, m, K); default none, a straight line in joint space.
    """
    via = np.empty((len(durations), len(design.task.moving), 0)) if via is None else via
    phases = tuple(_phase_guess(design.task, i, T, via[i]) for i, T in enumerate(durations))
    return design.lifted(Guess(phases, np.asarray(parameters, float)))


def phase_guess(task: Task, index: int, vector: np.ndarray) -> PhaseGuess:
    """The motion of one phase that a vector in [0, 1] stands for: duration, reach, and points of the path (m via)."""
    return _phase_guess(task, index, *_decoded(task, vector))


def _phase_guess(task: Task, index: int, T: float, via: np.ndarray) -> PhaseGuess:
    start, end = task.ends(index)
    shares, points = np.linspace(0, 1, via.shape[1] + 2), np.column_stack([start, via, end])
    passed = [one for one in task.via if one.phase == index]
    if passed:  # points beside those that the task passes give way to them
        own = _minimum_jerk(np.array([one.share for one in passed]))
        kept = [s in (0, 1) or bool(np.all(np.abs(s - own) > BESIDE)) for s in shares]
        shares, points = np.r_[shares[kept], own], np.column_stack([points[:, kept], *(one.angles for one in passed)])
        order = np.argsort(shares)
        shares, points = shares[order], points[:, order]
    path = CubicSpline(shares, points, axis=1)

    def progress(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Share of the path behind at a share s of the time, and its rate [1/s]: minimum jerk."""
        return _minimum_jerk(s), 30 * s**2 * (1 - s) ** 2 / T

    def states(s: np.ndarray) -> np.ndarray:
        sigma, rate = progress(s)
        q = np.clip(path(sigma), task.lower[:, None], task.upper[:, None])
        return np.vstack([q, np.clip(path(sigma, 1) * rate, -task.speed[:, None], task.speed[:, None])])

    def controls(s: np.ndarray) -> np.ndarray:
        sigma, rate = progress(s)
        curve = 60 * s * (1 - s) * (1 - 2 * s) / T**2
        limit = task.acceleration[:, None]
        return np.clip(path(sigma, 2) * rate**2 + path(sigma, 1) * curve, -limit, limit)

    return PhaseGuess(T, states, controls)


def _minimum_jerk(s: np.ndarray) -> np.ndarray:
    """Share of a path that is behind at a share of the time."""
    return s**3 * (10 - 15 * s + 6 * s**2)

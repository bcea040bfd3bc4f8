"""Global search: CMA-ES proposes springs, durations and coarse paths, IPOPT polishes each; Sobol points are its rival."""

import uuid
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace

import cma
import numpy as np
from scipy.stats import qmc

from rrr_oc.codesign.design_problem import CoDesign, drawn_bounds, from_drawn, motion_guess
from rrr_oc.errors import UserError
from rrr_oc.optimal_control.optimality import Kkt
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.refinement import Refinement, mesh_row, refine
from rrr_oc.optimal_control.scheme import scheme, uniform_mesh
from rrr_oc.optimal_control.solver import Options, Solution, Solver, SolverFailure, continue_in
from rrr_oc.optimal_control.transcription import Transcription
from rrr_oc.parallel import ordered, unordered

LAYERS = ("sobol", "cma-es")


@dataclass(frozen=True)
class SearchOptions:
    """How an optimum is searched for. Raises `UserError` for layers that there are not.

    Attributes:
        starts: Proposals that IPOPT polishes, as many from each layer.
        layers: Who proposes, of `LAYERS`.
        seed: Of both layers.
        jobs: Processes.
        scheme, stages: Collocation scheme.
        coarse: Intervals a phase while searching.
        fine: Intervals a phase of the first mesh of the optima that are kept.
        width: Springs' smoothing width while searching [rad].
        widths: The widths that follow, down to the reported one [rad].
        kept: Number of distinct optima that are solved on the fine mesh.
        within: Of those, all are refined to the mesh tolerance that lie within this relative distance of the best.
        hops: Rounds of basin hopping over the durations, from the best of the fine mesh.
        via: Points of a proposed path, per phase and joint.
        population: Of CMA-ES.
        sigma: Initial step size of CMA-ES, on variables in [0, 1].
        refinement: Mesh tolerance.
    """

    starts: int = 20
    layers: tuple[str, ...] = LAYERS
    seed: int = 0
    jobs: int = -1
    scheme: str = "lobatto"
    stages: int = 4
    coarse: int = 16
    fine: int = 40
    width: float = 0.1
    widths: tuple[float, ...] = (0.03, 0.01, 0.003)
    kept: int = 6
    within: float = 0.005
    hops: int = 2
    via: int = 2
    population: int = 8
    sigma: float = 0.3
    refinement: Refinement = field(default_factory=Refinement)

    def __post_init__(self) -> None:
        if self.layers not in (LAYERS, *((layer,) for layer in LAYERS)):
            raise UserError(f"a search's layers are {LAYERS}, or one of them, got {self.layers}")


@dataclass(frozen=True)
class Start:
    """One proposal and what became of it.

    Attributes:
        layer: Who proposed it (`LAYERS`).
        proposed: Cost of the proposal itself, as it stands (its motion may break limits).
        polished: Cost after IPOPT, on the coarse mesh; infinite where IPOPT found no optimum.
        message: IPOPT's word.
        seconds: Wall time of the polish.
        w: Scaled variables of the polished optimum on the coarse mesh (empty where there is none).
    """

    layer: str
    proposed: float
    polished: float
    message: str
    seconds: float
    w: np.ndarray


@dataclass(frozen=True, eq=False)
class Optimum:
    """A local optimum on a fine mesh.

    Attributes:
        solution: On its last mesh, with the smallest width.
        meshes: A row a mesh, as `refine` returns them; one row where it was not refined.
        reached: Number of starts that ended here; 0 where it was found on the way from another optimum (`hops`, `continued`).
    """

    solution: Solution
    meshes: list[dict]
    reached: int


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What a search found.

    Attributes:
        design: The problem.
        optima: Distinct ones, best first.
        starts: All proposals, in order.
        interrupted: Whether it was stopped early.
    """

    design: CoDesign
    optima: tuple[Optimum, ...]
    starts: tuple[Start, ...]
    interrupted: bool

    @property
    def best(self) -> Optimum:
        """The best optimum found."""
        return self.optima[0]

    def whole(self) -> "SearchResult":
        """The result; an interrupt where it was stopped early, for what is kept must not look whole."""
        if self.interrupted:
            raise KeyboardInterrupt
        return self

    def layers(self) -> dict[str, dict[str, float]]:
        """What each layer contributed: polishes, failures, best and median cost, and the best before IPOPT."""
        rows = {}
        for layer in LAYERS:
            starts = [s for s in self.starts if s.layer == layer]
            costs = np.array([s.polished for s in starts if np.isfinite(s.polished)])
            if starts:
                rows[layer] = {
                    "starts": len(starts),
                    "failed": len(starts) - costs.size,
                    "best": float(costs.min()) if costs.size else float("inf"),
                    "median": float(np.median(costs)) if costs.size else float("inf"),
                    "best_proposal": min(s.proposed for s in starts),
                    "seconds": float(sum(s.seconds for s in starts)),
                }
        return rows


class Polisher:
    """Turns a vector in [0, 1] into a start and lets IPOPT polish it on the coarse mesh. Built once a process."""

    def __init__(self, design: CoDesign, options: SearchOptions) -> None:
        self.design, self.options = design, options
        transcription = transcribed(design, options, options.coarse)
        self.solver = Solver(transcription, Options(tolerance=1e-6, iterations=200))
        self.data = design.data(options.width)

    def __call__(self, layer: str, vector: np.ndarray) -> Start:
        """Polish one proposal."""
        transcription = self.solver.transcription
        w = transcription.pack(motion_guess(self.design, *decode(self.design, vector, self.options.via)))
        cost = float(transcription.functions["nlp"](w, self.data)[0]) * self.design.problem.cost_scale
        try:
            solution = self.solver.solve(w, self.data)
        except SolverFailure as failure:
            return Start(layer, cost, float("inf"), str(failure), 0.0, np.empty(0))
        return Start(layer, cost, solution.cost, solution.status, solution.seconds, solution.w)


def dimensions(design: CoDesign, via: int) -> int:
    """Length of the vectors that `decode` takes."""
    return len(drawn_bounds(design.springs)[0]) + 2 + 2 * len(design.task.moving) * via


def decode(design: CoDesign, vector: np.ndarray, via: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parameters, durations [s] and path points [rad] (2, m, via) of a vector in [0, 1].

    Biarticular springs are drawn as hardware, uniform within its bounds, and then reduced; a fixed parameter stays fixed.
    """
    numbers, task, m = iter(np.clip(vector, 0, 1)), design.task, len(design.task.moving)
    drawn = [lo + (hi - lo) * next(numbers) for lo, hi in zip(*drawn_bounds(design.springs), strict=True)]
    parameters = from_drawn(design.springs, np.array(drawn))
    low, high = task.duration
    durations = np.array([low + (high - low) * next(numbers) for _ in range(2)])
    ends = np.array([task.start, task.release])
    margin = 0.4 * np.ptp(ends, axis=0) + 0.05
    lower = np.maximum(task.lower, ends.min(axis=0) - margin)[:, None]
    upper = np.minimum(task.upper, ends.max(axis=0) + margin)[:, None]
    points = np.array([next(numbers) for _ in range(2 * m * via)]).reshape(2, m, via)
    return parameters, durations, lower + (upper - lower) * points


def search(
    design: CoDesign, options: SearchOptions | None = None, progress: Callable[[Start], None] | None = None
) -> SearchResult:
    """Search the best co-design.

    All proposals are polished on a coarse mesh, the distinct optima solved on a fine one, and the best of them refined.

    Ctrl-C ends the search early with what it has found so far.

    Raises:
        SolverFailure: No start led to an optimum; the failure of the start that came nearest.
    """
    options = options or SearchOptions()
    _ = transcribed(design, options, options.coarse).functions  # compiled here once, not by each process
    starts: list[Start] = []
    interrupted = False
    try:
        for start in _proposals(design, options):
            starts.append(start)
            if progress:
                progress(start)
    except KeyboardInterrupt:
        interrupted = True
    if not any(s.w.size for s in starts):
        _explain(design, options, starts)
    optima = _keep(design, options, starts, interrupted)
    return SearchResult(design, optima, tuple(starts), interrupted)


def _proposals(design: CoDesign, options: SearchOptions) -> Iterator[Start]:
    key, size = uuid.uuid4().hex, dimensions(design, options.via)
    half = (options.starts + 1) // 2 if options.layers == LAYERS else options.starts if LAYERS[0] in options.layers else 0

    def polish(layer: str, vectors: Iterable[np.ndarray]) -> Iterator[tuple[int, Start]]:
        return unordered(_polish, [(key, design, options, layer, i, v) for i, v in enumerate(vectors)], options.jobs)

    for _, start in polish("sobol", sobol_points(size, half, options.seed)):
        yield start
    left = options.starts - half
    while left > 0:
        strategy = _strategy(size, options, left)
        while left > 0 and not strategy.stop():
            vectors = strategy.ask()
            costs = np.full(len(vectors), np.inf)
            for i, start in polish("cma-es", vectors[:left]):
                costs[i] = start.polished
                yield start
            left -= len(vectors)
            worst = costs[np.isfinite(costs)].max(initial=1e6)
            strategy.tell(vectors, np.where(np.isfinite(costs), costs, 2 * worst).tolist())


def sobol_points(size: int, count: int, seed: int) -> np.ndarray:
    """Points in [0, 1] (count, size) that fill it evenly."""
    return qmc.Sobol(size, rng=seed).random(2 ** int(np.ceil(np.log2(max(count, 1)))))[:count]


def reach(design: CoDesign, options: SearchOptions, target: float) -> tuple[int, Solution | None]:
    """Sobol starts one after the other, each polished and followed to the fine mesh and the smallest smoothing width, until one costs
    no more than `target`.

    Returns:
        How many starts that took, and the solution; None where `options.starts` did not do.
    """
    polish, count = Polisher(design, options), 0
    for vector in sobol_points(dimensions(design, options.via), options.starts, options.seed):
        count += 1
        start = polish(LAYERS[0], vector)
        if not start.w.size or start.polished > 2 * target:  # the coarse mesh and the wide springs are off by far less
            continue
        coarse = Solution(polish.solver.transcription, start.w, np.empty(0), np.empty(0), start.polished, start.message, 0, 0.0)
        packed = _follow(design, options, coarse.guess())
        if packed is not None and packed.numbers[0] <= target:
            return count, _unpack(design, options, packed)
    return count, None


def _strategy(size: int, options: SearchOptions, left: int) -> cma.CMAEvolutionStrategy:
    """A CMA-ES with a random mean; begun anew, elsewhere, when the last one has converged."""
    seed = options.seed * 1000 + left + 1
    mean = np.random.default_rng(seed).uniform(0.2, 0.8, size)
    settings = {
        "bounds": [0, 1],
        "seed": seed,
        "popsize": min(options.population, max(left, 2)),
        "verbose": -9,
        "tolfun": 1e-4,
        "tolflatfitness": 3,
    }
    return cma.CMAEvolutionStrategy(mean, options.sigma, settings)


_polishers: dict[str, Polisher] = {}  # of the search that is running, by its name


def _polish(key: str, design: CoDesign, options: SearchOptions, layer: str, index: int, vector: np.ndarray):
    if key not in _polishers:
        _polishers.clear()
        _polishers[key] = Polisher(design, options)
    return index, _polishers[key](layer, vector)


def transcribed(design: CoDesign, options: SearchOptions, intervals: int) -> Transcription:
    """The problem on a uniform mesh with the search's scheme, its functions compiled."""
    problem = design.problem
    return Transcription(problem, scheme(options.scheme, options.stages), uniform_mesh(problem, intervals), compiled=True)


def _explain(design: CoDesign, options: SearchOptions, starts: list[Start]) -> None:
    """No start succeeded: solve the simplest one again and let its failure be raised."""
    if not starts:
        raise KeyboardInterrupt
    middle = motion_guess(design, *decode(design, np.full(dimensions(design, options.via), 0.5), options.via)[:2])
    Solver(transcribed(design, options, options.coarse)).solve(middle, design.data(options.width))


def _keep(design: CoDesign, options: SearchOptions, starts: list[Start], interrupted: bool) -> tuple[Optimum, ...]:
    """The distinct optima on a fine mesh, the best of them refined, in parallel."""
    coarse = transcribed(design, options, options.coarse)
    groups: list[Optimum] = []
    for start in sorted((s for s in starts if s.w.size), key=lambda s: s.polished):
        solution = Solution(coarse, start.w, np.empty(0), np.empty(0), start.polished, start.message, 0, 0.0)
        _join(groups, Optimum(solution, [], 1))
    kept = groups[: 1 if interrupted else options.kept]
    followed = ordered(_follow, [(design, options, g.solution.guess()) for g in kept], options.jobs)
    optima: list[Optimum] = []
    for group, packed in zip(kept, followed, strict=True):
        if packed is not None:
            _join(optima, Optimum(_unpack(design, options, packed), packed.rows, group.reached))
    if not optima:
        raise SolverFailure("lost on the fine mesh", 0, 0.0, "")
    optima.sort(key=lambda o: o.solution.cost)
    if not interrupted:
        _join(optima, _hopped(design, options, optima[0]))
        optima.sort(key=lambda o: o.solution.cost)
    limit = optima[0].solution.cost * (1 + options.within)
    chosen = [o for o in optima if o.solution.cost <= limit]
    refined: list[Optimum] = []
    for optimum, packed in zip(
        chosen, ordered(_refine, [(design, options, _pack(o)) for o in chosen], options.jobs), strict=True
    ):
        _join(refined, Optimum(_unpack(design, options, packed), packed.rows, optimum.reached))
    refined.sort(key=lambda o: o.solution.cost)
    return (*refined, *optima[len(chosen) :])


def _hopped(design: CoDesign, options: SearchOptions, optimum: Optimum) -> Optimum:
    """Basin hopping over the durations: near-equal optima differ in the number of swings, so the best one is stretched or
    shortened, phase by phase, and solved again, as long as that lowers the cost."""
    for _ in range(options.hops):
        packed, best = _pack(optimum), optimum
        tries = [(design, options, packed, i, f, mu) for i in range(2) for f in (0.85, 0.92, 1.08, 1.15) for mu in (1e-2, 1e-6)]
        for found in ordered(_hop, tries, options.jobs):
            if found is not None and found.numbers[0] < best.solution.cost * (1 - 1e-5):
                best = Optimum(_unpack(design, options, found), found.rows, 0)
        if best is optimum:
            break
        optimum = best
    return replace(optimum, reached=0)


def _hop(design: CoDesign, options: SearchOptions, packed: "_Packed", phase: int, factor: float, barrier: float):
    guess = _unpack(design, options, packed).guess()
    motions = list(guess.phases)
    motions[phase] = replace(motions[phase], duration=float(np.clip(factor * motions[phase].duration, *design.task.duration)))
    solver = Solver(transcribed(design, options, options.fine), Options(barrier=barrier, iterations=200))
    found = solver.solve(Guess(tuple(motions), guess.parameters), packed.data, check=False)
    if found.status != "Solve_Succeeded":
        return None
    return _pack(Optimum(found, [mesh_row(found)], 0))


def continued(starts: list[tuple[CoDesign, Guess]], options: SearchOptions) -> list[tuple[int, Optimum]]:
    """Optima near given starts, each of a problem of its own: on the fine mesh, the best one refined.

    Returns:
        (index of the start, optimum), best first; starts that led nowhere are missing.
    """
    packed = ordered(_follow, [(design, options, guess) for design, guess in starts], options.jobs)
    found = [(i, Optimum(_unpack(starts[i][0], options, p), p.rows, 0)) for i, p in enumerate(packed) if p is not None]
    found.sort(key=lambda pair: pair[1].solution.cost)
    if found:
        index, optimum = found[0]
        p = _refine(starts[index][0], options, _pack(optimum))
        found[0] = index, Optimum(_unpack(starts[index][0], options, p), p.rows, 0)
    return found


@dataclass(frozen=True)
class _Packed:
    """A solution as plain arrays, to pass between processes."""

    mesh: tuple[np.ndarray, ...]
    data: np.ndarray
    arrays: tuple[np.ndarray, np.ndarray, np.ndarray]
    numbers: tuple[float, str, int, float]
    rows: list[dict]


def _pack(optimum: Optimum) -> _Packed:
    s = optimum.solution
    return _Packed(
        s.transcription.mesh,
        s.problem.data,
        (s.w, s.lam_g, s.lam_w),
        (s.cost, s.status, s.iterations, s.seconds),
        optimum.meshes,
    )


def _unpack(design: CoDesign, options: SearchOptions, packed: _Packed) -> Solution:
    problem = replace(design.problem, data=packed.data)
    transcription = Transcription(problem, scheme(options.scheme, options.stages), packed.mesh, compiled=True)
    return Solution(transcription, *packed.arrays, *packed.numbers)


def _follow(design: CoDesign, options: SearchOptions, guess: Guess) -> _Packed | None:
    """The optimum near a guess on the fine mesh, followed to the smallest smoothing width; None where it is lost."""
    solver = Solver(transcribed(design, options, options.fine), Options(barrier=1e-6))
    try:
        followed = solver.solve(guess, design.data(options.width))
        widths = options.widths if design.springs else options.widths[-1:]
        followed = continue_in(solver, followed, [design.data(width) for width in widths])
        followed = _descend(solver, followed)
    except SolverFailure:
        return None
    return _pack(Optimum(followed, [mesh_row(followed)], 0))


def _descend(solver: Solver, solution: Solution, rounds: int = 3) -> Solution:
    """Leave a saddle: where the curvature is negative along some direction, go both ways along it and solve again."""
    for _ in range(rounds):
        conditions = Kkt(solution)
        if conditions.verdict() != "violated":
            break
        direction = conditions.second_order()[2]
        step = 0.1 * direction / np.abs(direction).max()
        found = []
        for sign in (1, -1):
            away = solver.solve(solution.w + sign * step, solution.problem.data, check=False)
            if away.status == "Solve_Succeeded" and away.cost < solution.cost * (1 - 1e-6):
                found.append(away)
        if not found:
            break
        solution = min(found, key=lambda s: s.cost)
    return solution


def _refine(design: CoDesign, options: SearchOptions, packed: _Packed) -> _Packed:
    try:
        solution, rows = refine(_unpack(design, options, packed), options.refinement)
        left = _descend(Solver(solution.transcription, Options(barrier=1e-6)), solution)
        if left is not solution:
            solution, more = refine(left, options.refinement)
            rows += more
    except SolverFailure:  # a finer mesh was lost: what was found before stands, with its error
        return packed
    return _pack(Optimum(solution, rows, 0))


def _join(optima: list[Optimum], found: Optimum) -> None:
    """Count an optimum with the one it equals, which keeps the lower cost, or add it."""
    for i, other in enumerate(optima):
        if same(found.solution, other.solution):
            better = min(found, other, key=lambda o: o.solution.cost)
            optima[i] = replace(better, reached=found.reached + other.reached)
            return
    optima.append(found)


def same(a: Solution, b: Solution) -> bool:
    """Whether two solutions are one optimum: cost within 0.2 %, springs within 1 % of their range, durations within 0.03 s and
    paths within 0.03 rad. Springs are compared in kappa, rho, phi: equivalent hardware is one design.
    """
    if abs(a.cost - b.cost) > 2e-3 * abs(b.cost) or np.abs(a.durations - b.durations).max() > 0.03:
        return False
    if np.any(np.abs(a.parameters - b.parameters) > 0.01 * a.problem.p_scale):
        return False
    s = np.linspace(0, 1, 41)
    half = len(a.problem.phases[0].states) // 2
    return all(np.abs(a.at(i, s)[0][:half] - b.at(i, s)[0][:half]).max() < 0.03 for i in range(len(a.durations)))

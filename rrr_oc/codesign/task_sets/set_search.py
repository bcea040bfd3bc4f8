"""Global search for the springs of a set of tasks: one nonlinear program for all tasks, from the springs of each task alone and others."""

import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.local_optima import (
    SOLVED,
    Optimum,
    attached,
    distinct,
    follow_to_fine_mesh,
    refined,
    transcribed,
)
from rrr_oc.codesign.search.motions import MotionSearch, combined
from rrr_oc.codesign.search.proposals import SearchOptions, sobol_points
from rrr_oc.codesign.search.starts import CoarseSolver, Start
from rrr_oc.codesign.springs import drawn_bounds, from_drawn
from rrr_oc.codesign.task_sets.task_set import SetDesign
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.refinement import mesh_row
from rrr_oc.optimal_control.solver import Options, Solution, Solver, SolverFailure
from rrr_oc.parallel import once_per_process, ordered, unordered
from rrr_oc.progress import Progress, Step

# Share of the time of a search that each of its stages takes, by experience
SHARES = {
    "starts": 0.3,
    "fine mesh": 0.1,
    "motions and springs in turn": 0.3,
    "springs of the first task": 0.15,
    "refined meshes": 0.15,
}
LAYERS = ("alone", "sobol")  # sources of starting springs: tasks alone, and the whole of their bounds
# Initial barrier parameters of a start: from the middle of all bounds, and nearer to the tasks' own motions.
BARRIERS = (0.1, 1e-2)
ITERATIONS = 300  # of a start at most; doubled, starts that lead nowhere take twice as long
# From motions that are good, and where others may be better; to a tolerance that the solve on refined meshes makes up for.
THOROUGH = (Options(tolerance=1e-6, barrier=1e-6), Options(tolerance=1e-6, barrier=BARRIERS[1]))
QUICK = (Options(tolerance=1e-6, barrier=BARRIERS[0]),)  # for one of many sets of springs
AGAIN = 100  # iterations at most of the joint solve on refined meshes, which starts at its optimum but for the meshes
CHEAPER = 1e-6  # [1] by which a cost must be lower to count as another optimum's; doubled, a little is left
GAIN = 1e-4  # [1] of the objective that a round of better motions must promise for another one; doubled, fewer rounds are made
FEW = 12  # proposed motions of each phase at most for one of many sets of springs; doubled, the front of a price takes longer
ROUNDS = 4  # in which motions found for held springs and springs for these motions improve each other, at most


@dataclass(frozen=True, eq=False)
class SetResult:
    """The result of a search for a set.

    Attributes:
        design: The problem.
        parameters: The springs (np,).
        motions: The optimum of each task with these springs held (T).
        alone: The optimum of each task with springs of its own (T).
        first: The optimum of each task with the springs of the first (T).
        starts: All starts; none without springs.
        change: Relative decrease of the objective when the springs were optimised again on the refined meshes [1]; None where IPOPT
            did not solve that problem.
    """

    design: SetDesign
    parameters: np.ndarray
    motions: tuple[Optimum, ...]
    alone: tuple[Optimum, ...]
    first: tuple[Optimum, ...]
    starts: tuple[Start, ...]
    change: float | None

    @classmethod
    def of_one(cls, design: SetDesign, optimum: Optimum) -> "SetResult":
        """The result of a set of one task, from an optimum of that."""
        return cls(design, optimum.solution.parameters, (optimum,), (optimum,), (optimum,), (), 0.0)

    @property
    def total(self) -> float:
        """The objective."""
        return self.design.total([o.cost for o in self.motions])


@dataclass(frozen=True, eq=False)
class FrontPoint:
    """The best springs where the first task weighs more than in the set.

    Attributes:
        share: Share of the objective that is the first task's cost alone [1]; 0 is the set's own objective.
        costs: Of the tasks (T).
        total: The set's own objective.
        springs: By a designer's names, in SI units.
    """

    share: float
    costs: list[float]
    total: float
    springs: dict[str, float]


def solve_set(
    design: SetDesign,
    alone: Sequence[Optimum],
    options: SearchOptions,
    report: Callable[[Step], None] = lambda _: None,
) -> SetResult:
    """The best springs for a set of tasks.

    Every start is solved on a coarse mesh, the distinct best on a fine one, all tasks jointly. Then each task looks for a better
    motion while the springs are held, and the springs are solved for again, until neither helps. Meshes are refined task by task.

    Args:
        alone: The optimum of each task with springs of its own (T), on its design of `design.designs`.
        report: Is told how far the search is.

    Raises:
        SolverFailure: No start led to an optimum.
    """
    alone, progress = tuple(alone), Progress(SHARES, report)
    if not design.sprung:
        return SetResult(design, alone[0].solution.parameters, alone, alone, alone, (), 0.0)
    starts = _polished(design, alone, options, progress)
    progress.tell("fine mesh")
    fine = _fine(design, starts, options)
    progress.tell("motions and springs in turn", 0.0, f"best so far {fine.cost:.5g}")
    best = _improved(design, fine, alone, options)
    progress.tell("springs of the first task", 0.0, f"best so far {best.cost:.6g}")
    first = _with_first(design, best, alone, options)
    if design.total([o.cost for o in first]) < best.cost * (1 - CHEAPER):
        best = _improved(design, _rejoined(design, first, first[0].solution.parameters, options) or best, alone, options)
    progress.tell("refined meshes", 0.0, f"best so far {best.cost:.6g}")
    return _compared(design, best, alone, first, options, tuple(starts))


def _compared(
    design: SetDesign,
    best: Optimum,
    alone: Sequence[Optimum],
    first: Sequence[Optimum],
    options: SearchOptions,
    starts: tuple[Start, ...],
) -> SetResult:
    """The result of a joint optimum, on refined meshes, beside the tasks alone and the springs of the first."""
    parameters, motions, change = _refined(design, best, options)
    better = tuple(ordered(_better_alone, [(*one, options) for one in zip(design.designs, alone, motions, strict=True)]))
    if better[0].cost < alone[0].cost:
        first = _with_first(design, best, better, options)
    refine = [(one, options, o) for one, o in zip(design.held(better[0].solution.parameters), first, strict=True)]
    return SetResult(design, parameters, motions, better, tuple(ordered(_refined_alone, refine)), starts, change)


def solve_chosen(design: SetDesign, start: Guess, options: SearchOptions) -> SetResult:
    """The best springs for a set of tasks near springs and motions of the joint problem that are known to be good.

    The optima of the tasks alone are those near the motions of the set, too.

    Raises:
        SolverFailure: The start leads to no optimum, or a task has no motion.
    """
    motions = held_motions(design, start.parameters, [[m] for m in design.motions(start)], options)
    if not design.sprung:
        calls = [(one, options, o) for one, o in zip(design.designs, motions, strict=True)]
        return solve_set(design, ordered(_refined_alone, calls), options)
    joint = _rejoined(design, motions, start.parameters, options)
    if joint is None:
        raise SolverFailure("the chosen springs led to no optimum of the set", 0, 0.0, "")
    near = ordered(
        follow_to_fine_mesh, [(one, options, m) for one, m in zip(design.designs, _motions(design, joint), strict=True)]
    )
    alone = [a or m for a, m in zip(near, motions, strict=True)]
    alone = ordered(_refined_alone, [(one, options, o) for one, o in zip(design.designs, alone, strict=True)])
    best = _improved(design, joint, alone, options)
    return _compared(design, best, alone, _with_first(design, best, alone, options), options, ())


def solve_bought(design: SetDesign, joint: Optimum, options: SearchOptions) -> SetResult:
    """The result of a joint optimum with hardware of a catalogue, on refined meshes; compared with itself alone."""
    parameters, motions, change = _refined(design, joint, options)
    return SetResult(design, parameters, motions, motions, motions, (), change)


def _with_first(design: SetDesign, joint: Optimum, alone: Sequence[Optimum], options: SearchOptions) -> list[Optimum]:
    """The best motion of each task with the springs of the first task alone."""
    starts = [[o.solution.guess(), m] for o, m in zip(alone, _motions(design, joint), strict=True)]
    return held_motions(design, alone[0].solution.parameters, starts, options)


def held_motions(
    design: SetDesign, parameters: np.ndarray, starts: Sequence[Sequence[Guess]], options: SearchOptions, skip: int = 0
) -> list[Optimum]:
    """The best motion of each task (T) with the springs held (np,), from one or several motions each and from proposed ones.

    Args:
        skip: Number of proposed motions that earlier calls have used.

    Raises `SolverFailure` where a task has none.
    """
    calls = [(one, options, list(own), skip) for one, own in zip(design.held(parameters), starts, strict=True)]
    found = ordered(_held, calls)
    for one, task in zip(found, design.tasks.tasks, strict=True):
        if one is None:
            raise SolverFailure(f"no motion of task {task.name!r} with these springs", 0, 0.0, "")
    return found


def _held(design: CoDesign, options: SearchOptions, starts: list[Guess], skip: int) -> Optimum | None:
    springs = design.problem.p_lower
    followed = [follow_to_fine_mesh(design, options, replace(guess, parameters=springs)) for guess in starts]
    if options.motions:
        together = combined(MotionSearch(design, options).best(springs, skip), springs, 0)
        followed += [follow_to_fine_mesh(design, options.narrow, guess) for guess in together]
    return min((one for one in followed if one is not None), key=lambda o: o.cost, default=None)


def _motions(design: SetDesign, joint: Optimum) -> list[Guess]:
    return design.motions(joint.solution.guess())


def _springs(design: SetDesign, alone: Sequence[Optimum], options: SearchOptions) -> list[tuple[str, np.ndarray]]:
    """Starting springs: half of them those of tasks alone, the first one's and others evenly spaced; the rest Sobol points."""
    of_tasks = min(len(alone), max(options.starts // 2, 1))
    picked = np.unique(np.linspace(0, len(alone), of_tasks, endpoint=False).astype(int))
    low, high = drawn_bounds(design.springs)
    points = sobol_points(len(low), options.starts - len(picked), options.seed) if options.starts > len(picked) else []
    drawn = [("sobol", from_drawn(design.springs, low + (high - low) * point)) for point in points]
    return [("alone", alone[t].solution.parameters) for t in picked] + drawn


def _polished(design: SetDesign, alone: Sequence[Optimum], options: SearchOptions, progress: Progress) -> list[Start]:
    """All starts on the coarse mesh, with the motions of the tasks alone, cheapest first."""
    transcription, key = transcribed(design, options, options.coarse), uuid.uuid4().hex
    springs = _springs(design, alone, options)
    packed = transcription.pack(design.guess([o.solution.guess() for o in alone], springs[0][1]))
    calls = []
    for layer, parameters in springs:
        w = packed.copy()
        w[: len(parameters)] = parameters / design.problem.p_scale
        calls.append((key, design, options, layer, w))
    starts = []
    for start in unordered(_polish, calls):
        starts.append(start)
        best = min(s.polished for s in starts)
        said = f"about {best:.4g} on the coarse mesh" if np.isfinite(best) else ""
        progress.count("starts", len(starts), len(calls), said, "starts")
    return sorted(starts, key=lambda s: (s.polished, s.layer))


def _polish(key: str, design: SetDesign, options: SearchOptions, layer: str, w: np.ndarray) -> Start:
    solver = once_per_process(key, lambda: CoarseSolver(design, options, BARRIERS, ITERATIONS))
    return solver.started(layer, w, BARRIERS)


def _fine(design: SetDesign, starts: Sequence[Start], options: SearchOptions) -> Optimum:
    """The best joint optimum on the fine mesh from the distinct best starts; raises `SolverFailure` where there is none."""
    transcription, empty = transcribed(design, options, options.coarse), np.empty(0)
    coarse = [Solution(transcription, s.w, empty, empty, s.polished, SOLVED, 0, 0.0) for s in starts if s.w.size]
    if not coarse:
        raise SolverFailure("no start led to an optimum of the set", 0, 0.0, "")
    kept = distinct(Optimum(s, [], 1) for s in coarse)[: max(options.kept // 3, 1)]
    followed = ordered(follow_to_fine_mesh, [(design, options, o.solution.guess()) for o in kept])
    found = [attached(design, options, o) for o in followed if o is not None]
    if not found:
        raise SolverFailure("every optimum of the set was lost on the fine mesh", 0, 0.0, "")
    return min(found, key=lambda o: o.cost)


def _improved(design: SetDesign, joint: Optimum, alone: Sequence[Optimum], options: SearchOptions) -> Optimum:
    """Motions for held springs and springs for these motions in turn, as long as that lowers the objective."""
    others = [[o.solution.guess()] for o in alone]  # tried once; later the motions at hand are those that were found best
    for number in range(ROUNDS):
        starts = [[motion, *more] for motion, more in zip(_motions(design, joint), others, strict=True)]
        motions = held_motions(design, joint.solution.parameters, starts, options, number * options.motions)
        others = [[] for _ in alone]
        if design.total([o.cost for o in motions]) >= joint.cost * (1 - GAIN):
            break
        better = _rejoined(design, motions, joint.solution.parameters, options)
        if better is None or better.cost >= joint.cost:
            break
        joint = better
    return joint


def _rejoined(design: SetDesign, motions: Sequence[Optimum], parameters: np.ndarray, options: SearchOptions) -> Optimum | None:
    """The joint optimum on the fine mesh near motions for held springs, springs free again; None where IPOPT finds none."""
    return joint_optimum(design, design.guess([o.solution.guess() for o in motions], parameters), options)


def searched_optimum(design: SetDesign, start: Guess, options: SearchOptions) -> Optimum | None:
    """As `joint_optimum`; then, where the options have proposed motions, better motions are looked for."""
    found = joint_optimum(design, start, options, QUICK)
    if found is None or not options.motions:
        return found
    few = replace(options, motions=min(options.motions, FEW))
    try:
        motions = held_motions(design, found.solution.parameters, [[m] for m in _motions(design, found)], few)
    except SolverFailure:
        return found
    better = _rejoined(design, motions, found.solution.parameters, options)
    return found if better is None else min(found, better, key=lambda o: o.cost)


def joint_optimum(
    design: SetDesign, start: Guess, options: SearchOptions, settings: Sequence[Options] = THOROUGH
) -> Optimum | None:
    """The joint optimum on the fine mesh near springs and motions, the best with some settings; None where IPOPT finds none."""
    transcription, data = transcribed(design, options, options.fine), design.data(options.widths[-1])
    found = [s for one in settings if (s := Solver(transcription, one).solve(start, data, check=False)).status == SOLVED]
    return Optimum(best, [mesh_row(best)]) if (best := min(found, key=lambda s: s.cost, default=None)) else None


def _refined(design: SetDesign, joint: Optimum, options: SearchOptions) -> tuple[np.ndarray, tuple[Optimum, ...], float | None]:
    """Each task's mesh refined with the springs held, then springs and motions once more on these meshes.

    Returns the springs, the motions, and the relative decrease of the objective by the latter, as `SetResult.change`.
    """
    parameters = joint.solution.parameters
    starts = [[motion] for motion in _motions(design, joint)]
    motions = held_motions(design, parameters, starts, replace(options, motions=0))
    motions = ordered(_refined_alone, [(one, options, o) for one, o in zip(design.held(parameters), motions, strict=True)])
    before = design.total([o.cost for o in motions])
    mesh = tuple(fractions for o in motions for fractions in o.solution.transcription.mesh)
    everywhere = any(o.solution.transcription.scheme.everywhere for o in motions)
    transcription = replace(transcribed(design, options, 1, everywhere), mesh=mesh)
    settings = Options(barrier=1e-8, tolerance=min(1e-8, 1e-3 * options.refinement.tolerance))
    start = design.guess([o.solution.guess() for o in motions], parameters)
    again = Solver(transcription, replace(settings, iterations=AGAIN)).solve(
        start, design.data(options.widths[-1]), check=False
    )
    if again.status != SOLVED or again.cost >= before:
        return parameters, tuple(motions), 0.0 if again.status == SOLVED else None
    held = design.held(again.parameters)
    calls = [(one, settings, o, m) for one, o, m in zip(held, motions, design.motions(again.guess()), strict=True)]
    moved = tuple(ordered(_on_mesh, calls))
    after = design.total([o.cost for o in moved])
    return (again.parameters, moved, 1 - after / before) if after < before else (parameters, tuple(motions), 0.0)


def _refined_alone(design: CoDesign, options: SearchOptions, optimum: Optimum) -> Optimum:
    return refined(design, options, [optimum])[0]


def _on_mesh(design: CoDesign, settings: Options, old: Optimum, start: Guess) -> Optimum:
    """A motion on the mesh of an old one, with other springs held."""
    problem = replace(design.problem, data=old.solution.problem.data)
    transcription = replace(old.solution.transcription, problem=problem)
    found = Solver(transcription, settings).solve(replace(start, parameters=design.problem.p_lower))
    checked = {key: old.meshes[-1][key] for key in ("change", "converged") if key in old.meshes[-1]}
    return Optimum(found, [*old.meshes, mesh_row(found) | checked])


def _better_alone(one: CoDesign, alone: Optimum, found: Optimum, options: SearchOptions) -> Optimum:
    """The optimum of a task alone; where the set's motion costs less, the one near that, its springs free."""
    if found.cost >= alone.cost * (1 - CHEAPER):
        return alone
    followed = follow_to_fine_mesh(one, options, found.solution.guess())
    tried = [alone] if followed is None else [alone, _refined_alone(one, options, followed)]
    return min(tried, key=lambda o: o.cost)


def front(result: SetResult, options: SearchOptions, count: int) -> list[FrontPoint]:
    """The set's optimum, `count` optima that favour the first task more and more, and that of the first task alone.

    The objective is (1 − share) Σ w_t V_t + share Σ w_t V_0; the optima between the ends are on the fine mesh, each found from the one
    before.
    """
    design, weights = result.design, result.design.tasks.weights

    def point(share: float, motions: Sequence[Optimum]) -> FrontPoint:
        costs = [o.cost for o in motions]
        return FrontPoint(share, costs, design.total(costs), design.first.hardware(motions[0].solution.parameters))

    points, motions = [point(0.0, result.motions)], list(result.motions)
    for share in np.linspace(0, 1, count + 2)[1:-1]:
        weighed = (1 - share) * weights
        weighed[0] += share * weights.sum()
        leaning = replace(design, tasks=replace(design.tasks, weights=weighed))
        found = _rejoined(leaning, motions, motions[0].solution.parameters, options)
        if found is not None:
            starts = [[motion] for motion in _motions(leaning, found)]
            motions = held_motions(leaning, found.solution.parameters, starts, replace(options, motions=0))
            points.append(point(float(share), motions))
    return [*points, point(1.0, result.first)]

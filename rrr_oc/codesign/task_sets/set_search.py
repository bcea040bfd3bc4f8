"""Global search for the springs of a set of tasks: one nonlinear program for all tasks, from the springs of each task alone and others.

A task is a set of one: then its own optimum is the result.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.codesign.design_file import Compromise
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.coarse import coarse_cost
from rrr_oc.codesign.search.local_optima import SOLVED, Optimum, follow_to_fine_mesh, followed, refined, transcribed
from rrr_oc.codesign.search.motions import Covered, MotionSearch, combined
from rrr_oc.codesign.search.proposals import SearchOptions, sobol_points
from rrr_oc.codesign.search.starts import Polisher, Start, polish
from rrr_oc.codesign.springs import drawn_bounds, from_drawn
from rrr_oc.codesign.task_sets.task_set import SetDesign
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.refinement import mesh_row
from rrr_oc.optimal_control.solver import Options, Solver, SolverFailure
from rrr_oc.parallel import ordered, unordered
from rrr_oc.progress import Progress, Step

# Share of the time of a search that each of its stages takes, by experience
SHARES = {
    "starts": 0.3,
    "fine mesh": 0.1,
    "motions and springs in turn": 0.3,
    "springs of the first task": 0.15,
    "refined meshes": 0.15,
}
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
        starts: All starts; of several tasks none without springs.
        change: Relative decrease of the objective when the springs were optimised again on the refined meshes [1]; None where IPOPT
            did not solve that problem.
        optima: Of one task the distinct local optima, cheapest first.
        covered: Of one task what the search for motions of held springs has solved.
        interrupted: Whether Ctrl-C ended the search early.
    """

    design: SetDesign
    parameters: np.ndarray
    motions: Sequence[Optimum]
    alone: Sequence[Optimum]
    first: Sequence[Optimum]
    starts: Sequence[Start] = ()
    change: float | None = 0.0
    optima: Sequence[Optimum] = ()
    covered: Covered | None = None
    interrupted: bool = False

    @classmethod
    def apart(cls, design: SetDesign, alone: Sequence[Optimum]) -> "SetResult":
        """The result where the tasks share nothing: one task, or no springs to be designed."""
        return cls(design, alone[0].solution.parameters, alone, alone, alone)

    @property
    def total(self) -> float:
        """The objective."""
        return self.design.total([o.cost for o in self.motions])


def solve_set(
    design: SetDesign,
    alone: Sequence[Optimum],
    options: SearchOptions,
    report: Callable[[Step], None] = lambda _: None,
    joint: Optimum | None = None,
) -> SetResult:
    """The best springs for a set of tasks.

    Every start is solved on a coarse mesh, the distinct best on a fine one, all tasks jointly. Then each task looks for a better
    motion while the springs are held, and the springs are solved for again, until neither helps. Meshes are refined task by task.

    Args:
        alone: The optimum of each task with springs of its own (T), on its design of `design.designs`.
        report: Is told how far the search is.
        joint: An optimum of the joint problem that is known to be good, in the place of those to which starts lead.

    Raises:
        SolverFailure: No start led to an optimum.
    """
    progress, starts = Progress(SHARES, report), list[Start]()
    if joint is None:
        if len(alone) == 1 or not design.sprung:
            return SetResult.apart(design, alone)
        joint, starts = _joint(design, alone, options, progress)
    progress.tell("motions and springs in turn", 0.0, f"best so far {joint.cost:.5g}")
    best = _improved(design, joint, alone, options)
    progress.tell("springs of the first task", 0.0, f"best so far {best.cost:.6g}")
    first = _with_first(design, best, alone, options)
    if design.total([o.cost for o in first]) < best.cost * (1 - CHEAPER):
        best = _improved(design, _rejoined(design, first, first[0].solution.parameters, options) or best, alone, options)
    progress.tell("refined meshes", 0.0, f"best so far {best.cost:.6g}")
    parameters, motions, change = _refined(design, best, options)
    better = ordered(_better_alone, [(*one, options) for one in zip(design.designs, alone, motions, strict=True)])
    if better[0].cost < alone[0].cost:
        first = _with_first(design, best, better, options)
    first = _refined_each(design.held(better[0].solution.parameters), first, options)
    return SetResult(design, parameters, motions, better, first, starts, change)


def solve_chosen(design: SetDesign, start: Guess, options: SearchOptions) -> SetResult:
    """The best springs for a set of tasks near springs and motions of the joint problem that are known to be good.

    The optima of the tasks alone are those near the motions of the set, too.

    Raises:
        SolverFailure: The start leads to no optimum, or a task has no motion.
    """
    motions = held_motions(design, start.parameters, [[m] for m in design.motions(start)], options)
    if not design.sprung:
        return SetResult.apart(design, _refined_each(design.designs, motions, options))
    joint = _rejoined(design, motions, start.parameters, options)
    if joint is None:
        raise SolverFailure("the chosen springs led to no optimum of the set")
    near = followed([(one, options, m) for one, m in zip(design.designs, _motions(design, joint), strict=True)])
    alone = [a or m for a, m in zip(near, motions, strict=True)]
    return solve_set(design, _refined_each(design.designs, alone, options), options, joint=joint)


def solve_bought(design: SetDesign, joint: Optimum, options: SearchOptions) -> SetResult:
    """The result of a joint optimum with hardware of a catalogue, on refined meshes; compared with itself alone."""
    if len(design.designs) == 1:
        return SetResult.apart(design, [joint])
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
            raise SolverFailure(f"no motion of task {task.name!r} with these springs")
    return found


def _held(design: CoDesign, options: SearchOptions, starts: list[Guess], skip: int) -> Optimum | None:
    springs = design.problem.p_lower
    ends = [follow_to_fine_mesh(design, options, replace(guess, parameters=springs)) for guess in starts]
    if options.motions:
        together = combined(MotionSearch(design, options).best(springs, skip), springs, 0)
        ends += [follow_to_fine_mesh(design, options.narrow, guess) for guess in together]
    return min((one for one in ends if one is not None), key=lambda o: o.cost, default=None)


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


def _joint(
    design: SetDesign, alone: Sequence[Optimum], options: SearchOptions, progress: Progress
) -> tuple[Optimum, list[Start]]:
    """The best joint optimum on the fine mesh from all starts, which have the motions of the tasks alone, and these, cheapest first;
    raises `SolverFailure` where there is none."""
    polisher, springs = Polisher(design, options, BARRIERS, ITERATIONS), _springs(design, alone, options)
    packed = polisher.transcription.pack(design.guess([o.solution.guess() for o in alone], springs[0][1]))
    size, scale, starts = len(springs[0][1]), design.problem.p_scale, list[Start]()
    calls = [polisher.call(np.r_[parameters / scale, packed[size:]], layer, BARRIERS) for layer, parameters in springs]
    for start in unordered(polish, calls):
        starts.append(start)
        progress.count("starts", len(starts), len(calls), coarse_cost(starts), "starts")
    starts.sort(key=lambda s: (s.polished, s.layer))
    progress.tell("fine mesh")
    if not (coarse := polisher.optima(starts)):
        raise SolverFailure("no start led to an optimum of the set")
    kept = coarse[: max(options.kept // 3, 1)]
    found = [o for o in followed([(design, options, o.solution.guess()) for o in kept]) if o is not None]
    if not found:
        raise SolverFailure("every optimum of the set was lost on the fine mesh")
    return min(found, key=lambda o: o.cost), starts


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


def _refined(design: SetDesign, joint: Optimum, options: SearchOptions) -> tuple[np.ndarray, list[Optimum], float | None]:
    """Each task's mesh refined with the springs held, then springs and motions once more on these meshes.

    Returns the springs, the motions, and the relative decrease of the objective by the latter, as `SetResult.change`.
    """
    parameters = joint.solution.parameters
    starts = [[motion] for motion in _motions(design, joint)]
    motions = held_motions(design, parameters, starts, replace(options, motions=0))
    motions = _refined_each(design.held(parameters), motions, options)
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
        return parameters, motions, 0.0 if again.status == SOLVED else None
    held = design.held(again.parameters)
    calls = [(one, settings, o, m) for one, o, m in zip(held, motions, design.motions(again.guess()), strict=True)]
    moved = ordered(_on_mesh, calls)
    after = design.total([o.cost for o in moved])
    return (again.parameters, moved, 1 - after / before) if after < before else (parameters, motions, 0.0)


def _refined_each(designs: Sequence[CoDesign], optima: Sequence[Optimum], options: SearchOptions) -> list[Optimum]:
    return refined([(one, options, o) for one, o in zip(designs, optima, strict=True)])


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
    near = follow_to_fine_mesh(one, options, found.solution.guess())
    tried = [alone] if near is None else [alone, *refined([(one, options, near)])]
    return min(tried, key=lambda o: o.cost)


def front(result: SetResult, options: SearchOptions, count: int) -> list[Compromise]:
    """The set's optimum, `count` optima that favour the first task more and more, and that of the first task alone.

    The objective is (1 − share) Σ w_t V_t + share Σ w_t V_0; the optima between the ends are on the fine mesh, each found from the one
    before.
    """
    design, weights = result.design, result.design.tasks.weights

    def point(share: float, motions: Sequence[Optimum]) -> Compromise:
        costs = [o.cost for o in motions]
        return Compromise(share, costs[0], design.total(costs), design.first.hardware(motions[0].solution.parameters))

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

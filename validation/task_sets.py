"""How does one set of springs for many tasks compare with another way to find it, and how does the time grow with the tasks?

Tasks of the paper's arm, with payloads and ends drawn at random, share parallel springs or both kinds. Three questions:

- `ways`: the joint nonlinear program of the package against a decomposition that shares no solver with it: an outer descent in the
  springs alone, with each task's best motion for held springs inside, exact derivatives of its cost by the springs (envelope and
  implicit function theorem), quadratic models and a trust region. Both start from the same springs and motions.
- `tasks`: processor time of the whole search, and of one joint solve, for 1 to 32 tasks.
- `processes`: wall and processor time of the whole search with one process and with two.

    python validation/task_sets.py [--out results/task_sets] [--parts ways,tasks,processes]
"""

import argparse
import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import msgspec
import numpy as np
import scipy.sparse
from scipy.sparse.linalg import splu

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.local_optima import Optimum, transcribed
from rrr_oc.codesign.search.multistart import solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import End, read_task, task_of
from rrr_oc.codesign.task_sets.set_search import solve_set
from rrr_oc.codesign.task_sets.task_set import Objective, SetDesign, TaskSet
from rrr_oc.optimal_control.optimality import Kkt
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.optimal_control.solver import Options, Solution, Solver
from rrr_oc.parallel import unordered, workers
from rrr_oc.report.tables import markdown
from rrr_oc.storage import write_json, write_text

WIDTH = 0.003  # [rad]
OPTIONS = SearchOptions(
    starts=2, motions=0, kept=2, coarse=10, fine=20, widths=(0.03, WIDTH), refinement=Refinement(1e-3), within=0.0
)
BARRIERS = (1e-6, 1e-3)  # of a motion for held springs
FIRST, SMALLEST, STEPS, TOLERANCE = 0.05, 1e-7, 60, 1e-8  # radii of the trust region [1], steps, relative decrease at the end


def random_set(count: int, configuration: str, objective: Objective = "sum") -> SetDesign:
    """The paper's task and others with its arm, limits and springs."""
    where, given = read_task("paper")
    rng, tasks = np.random.default_rng(1), [task_of(where, given, "paper")]
    for i in range(1, count):
        start = End(position_m=(float(rng.uniform(0.15, 0.25)), 0.0, float(rng.uniform(0.0, 0.15))))
        release = End(position_m=(float(rng.uniform(0.3, 0.45)), 0.0, float(rng.uniform(0.0, 0.2))))
        payload = float(rng.uniform(2, 8))
        changed = msgspec.structs.replace(given, name=f"task {i + 1}", payload_kg=payload, start=start, release=release)
        tasks.append(task_of(where, changed, "paper"))
    springs = spring_bounds(tasks[0], configuration)
    together = TaskSet("random", tuple(tasks), np.ones(count), objective)
    return SetDesign(together, tuple(CoDesign(task, springs) for task in tasks))


def solved_alone(design: CoDesign) -> Optimum:
    """The optimum of one task with springs of its own."""
    return solve_multistart(design, OPTIONS).best


def all_alone(design: SetDesign) -> list[Optimum]:
    """The optimum of each task with springs of its own; in any order within, as many at once as there are processes."""
    found = dict(unordered(_numbered, [(t, one) for t, one in enumerate(design.designs)]))
    return [found[t] for t in range(len(found))]


def _numbered(number: int, design: CoDesign) -> tuple[int, Optimum]:
    return number, solved_alone(design)


@dataclass(frozen=True, eq=False)
class Held:
    """A task's best motion for held springs, the derivatives of its cost by the scaled springs, and of its variables."""

    solution: Solution
    gradient: np.ndarray
    hessian: np.ndarray
    along: np.ndarray


def derivatives(solution: Solution) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gradient and Hessian of the optimal cost by the scaled parameters, and the change of the scaled variables with them.

    The gradient is that of the Lagrangian (envelope theorem). The variables follow the parameters as the optimality conditions of the
    active set say (implicit function theorem), and the Hessian is the Lagrangian's along them.
    """
    kkt, n, scale = Kkt(solution), len(solution.problem.parameters), solution.problem.cost_scale
    slope = np.array(solution.transcription.functions["grad_f"](solution.w, kkt.d)[1]).ravel() + kkt.jacobian.T @ solution.lam_g
    free, rows = n + np.flatnonzero(~kkt.at_bound[n:]), np.flatnonzero(kkt.active_rows)
    H, A = kkt.hessian[free][:, free], kkt.jacobian[rows][:, free]
    K = scipy.sparse.block_array([[H, A.T], [A, -1e-10 * scipy.sparse.eye_array(rows.size)]]).tocsc()
    right = -np.vstack([kkt.hessian[free][:, :n].toarray(), kkt.jacobian[rows][:, :n].toarray()])
    along = np.zeros((solution.w.size, n))
    along[:n], along[free] = np.eye(n), splu(K).solve(right)[: free.size]
    return slope[:n] * scale, along.T @ (kkt.hessian @ along) * scale, along


class HeldSprings:
    """Each task's best motion for given springs, on the search's first fine mesh."""

    def __init__(self, design: SetDesign) -> None:
        self.design, self.solvers = design, []
        for one in design.designs:
            problem = replace(one.problem, design=None, designs=(), data=one.data(WIDTH))
            transcription = replace(transcribed(one, OPTIONS, OPTIONS.fine), problem=problem)
            self.solvers.append([Solver(transcription, Options(iterations=200, barrier=barrier)) for barrier in BARRIERS])

    def __call__(self, parameters: np.ndarray, starts: Sequence[Held | Guess]) -> list[Held] | None:
        """The motions near some starts; None where a task has none."""
        found = [self._one(solvers, parameters, start) for solvers, start in zip(self.solvers, starts, strict=True)]
        return None if any(one is None for one in found) else [one for one in found if one is not None]

    def _one(self, solvers: list[Solver], parameters: np.ndarray, start: Held | Guess) -> Held | None:
        begin: Guess | Solution = start if isinstance(start, Guess) else start.solution
        if isinstance(start, Held):
            step = parameters / self.design.problem.p_scale - start.solution.w[: len(parameters)]
            begin = replace(start.solution, w=start.solution.w + start.along @ step)
        for solver in solvers if isinstance(start, Held) else solvers[::-1]:
            found = solver.solve(begin, check=False, parameters=(parameters, parameters))
            if found.status == "Solve_Succeeded":
                return Held(found, *derivatives(found))
        return None


class Models:
    """Quadratic models of all tasks' costs, whose objective is minimised within a box around the springs."""

    def __init__(self, design: SetDesign) -> None:
        problem, count, n = design.problem, len(design.designs), len(design.problem.parameters)
        p, level, at, value = (ca.SX.sym(*one) for one in (("p", n), ("level", 1), ("at", n), ("value", count)))
        slope, bend = ca.SX.sym("slope", n, count), ca.SX.sym("bend", n, n * count)
        costs = [
            value[t] + ca.dot(slope[:, t], p - at) + ca.bilin(bend[:, n * t : n * t + n], p - at) / 2 for t in range(count)
        ]
        weighted = ca.vertcat(*[float(w) * c for w, c in zip(design.tasks.weights, costs, strict=True)])
        exists = ca.SX(0, 1) if problem.design is None else problem.design(p * problem.p_scale, problem.data)
        total = design.tasks.objective == "sum"
        rows = exists if total else ca.vertcat(exists, weighted - level)
        program = {"x": ca.vertcat(p, level), "p": ca.vertcat(at, value, ca.vec(slope), ca.vec(bend)), "g": rows}
        program["f"] = ca.sum1(weighted) if total else level
        quiet = {"print_level": 0, "sb": "yes", "tol": 1e-10, "bound_relax_factor": 0.0, "max_iter": 200}
        self.design, self.rows = design, rows.numel()
        self.solver = ca.nlpsol("model", "ipopt", program, {"ipopt": quiet, "print_time": False})
        self.range = (problem.p_upper - problem.p_lower) / problem.p_scale

    def best(self, parameters: np.ndarray, held: Sequence[Held], radius: float) -> tuple[np.ndarray, float]:
        """The springs within the trust region that the models like best, and the decrease that they promise."""
        problem, now = self.design.problem, parameters / self.design.problem.p_scale
        lower = np.maximum(problem.p_lower / problem.p_scale, now - radius * self.range)
        upper = np.minimum(problem.p_upper / problem.p_scale, now + radius * self.range)
        costs = np.array([one.solution.cost for one in held])
        known = [costs, *(one.gradient for one in held), *(one.hessian.ravel() for one in held)]
        unit, highest = self.design.total(costs), np.inf
        found = self.solver(
            x0=np.r_[now, 1.0], p=np.r_[now, np.concatenate(known) / unit], lbx=np.r_[lower, -highest], ubx=np.r_[upper, highest],
            lbg=np.full(self.rows, -np.inf), ubg=np.zeros(self.rows),
        )  # fmt: skip
        new = np.clip(np.array(found["x"]).ravel()[:-1], lower, upper)
        step = new - now
        modelled = [one.solution.cost + float(one.gradient @ step + step @ one.hessian @ step / 2) for one in held]
        return new * problem.p_scale, unit - self.design.total(modelled)


def descend(design: SetDesign, parameters: np.ndarray, held: list[Held], solve: Callable) -> tuple[float, int]:
    """The objective at springs from which no step promises a relevant decrease (Nocedal & Wright, algorithm 4.1), and the steps."""

    def total(some: Sequence[Held]) -> float:
        return design.total([one.solution.cost for one in some])

    models, radius = Models(design), FIRST
    for step in range(STEPS):
        trial, promised = models.best(parameters, held, radius)
        if promised <= TOLERANCE * total(held) or radius < SMALLEST:
            return total(held), step
        tried = solve(trial, held)
        lower = -np.inf if tried is None else total(held) - total(tried)
        ratio = lower / promised
        radius = radius / 4 if ratio < 0.25 else min(2 * radius, 1.0) if ratio > 0.75 else radius
        if tried is not None and ratio > 1e-3:
            parameters, held = trial, tried
    return total(held), STEPS


def processor() -> float:
    """Processor time of this process [s]."""
    return time.process_time()


def compare_ways() -> list[dict]:
    """The joint program and the decomposition, from the springs of the first task and the best motions for them."""
    rows = []
    cases: list[tuple[str, Objective, int]] = [(c, "sum", n) for c in ("PEA", "PEA+BPEA") for n in (2, 4, 8)]
    for configuration, objective, count in [*cases, ("PEA", "worst", 4), ("PEA+BPEA", "worst", 4)]:
        design = random_set(count, configuration, objective)
        alone = all_alone(design)
        springs, solve = alone[0].solution.parameters, HeldSprings(design)
        held = solve(springs, [replace(o.solution.guess(), parameters=springs) for o in alone])
        if held is None:
            raise SystemExit(f"{configuration}, {count} tasks: no motion with the springs of the first task")
        row = {"configuration": configuration, "objective": objective, "tasks": count}
        began = processor()
        total, steps = descend(design, springs, held, solve)
        row |= {"decomposed": total, "decomposed_s": processor() - began, "steps": steps}
        began = processor()
        found = joint(design, design.guess([one.solution.guess() for one in held], springs))
        row |= {"joint": found.cost, "joint_s": processor() - began, "iterations": found.iterations, "status": found.status}
        rows.append(row)
        print(row, flush=True)
    return rows


def joint(design: SetDesign, guess: Guess) -> Solution:
    """One joint solve on the first fine mesh, with the time to build it."""
    solver = Solver(transcribed(design, OPTIONS, OPTIONS.fine), Options(barrier=1e-2, iterations=1000))
    return solver.solve(guess, design.data(WIDTH), check=False)


def compare_tasks() -> list[dict]:
    """Processor time of a search on one process, for more and more tasks."""
    rows = []
    for count in (1, 2, 4, 8, 16, 32):
        design = random_set(count, "PEA")
        began = processor()
        alone = all_alone(design)
        row = {"tasks": count, "alone_s": processor() - began}
        began = processor()
        result = solve_set(design, alone, OPTIONS)
        row |= {"set_s": processor() - began, "total": result.total}
        guess = design.guess([o.solution.guess() for o in alone], alone[0].solution.parameters)
        began = processor()
        found = joint(design, guess)
        row |= {"solve_s": processor() - began, "iterations": found.iterations, "variables": found.transcription.size}
        row |= {"iteration_s": found.seconds / found.iterations}
        rows.append(row)
        print(row, flush=True)
    return rows


def compare_processes() -> list[dict]:
    """Wall time, and processor time of all processes, of a search for eight tasks with one process and with two."""
    rows, design = [], random_set(8, "PEA")
    for jobs in (1, 2):
        with workers(jobs):
            list(unordered(time.sleep, [(0.1,)] * 2))  # the processes are there
            began, used = time.perf_counter(), _all_processes()
            result = solve_set(design, all_alone(design), replace(OPTIONS, starts=4))
            rows.append({"jobs": jobs, "wall_s": time.perf_counter() - began, "total": result.total})
        from joblib.externals.loky import get_reusable_executor

        get_reusable_executor().shutdown(wait=True)  # the time of children counts once they have ended
        rows[-1]["processor_s"] = _all_processes() - used
        print(rows[-1], flush=True)
    return rows


def _all_processes() -> float:
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


PARTS = {"ways": compare_ways, "tasks": compare_tasks, "processes": compare_processes}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/task_sets"))
    parser.add_argument("--parts", default=",".join(PARTS))
    arguments = parser.parse_args()
    for part in arguments.parts.split(","):
        rows = PARTS[part]()
        write_json(arguments.out / f"{part}.json", rows)
        cells = [[f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
        write_text(arguments.out / f"{part}.md", markdown(list(rows[0]), cells))


if __name__ == "__main__":
    main()

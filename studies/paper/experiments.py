"""The paper's seven experiments, and one run of each way to solve them, kept in a store (`run_store`).

Ways: "evolution" (the paper's protocol, in MuJoCo or in the analytic model), "multistart" (IPOPT from Sobol points), "cma-ipopt"
(CMA-ES over IPOPT), "restricted" (IPOPT within the paper's parametrisation), "again" (evolution from the restricted optimum), "race"
(time that IPOPT needs to reach evolution's cost), "fixed" (springs alone on a given motion).
"""

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.codesign.certificate import exact_cost
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import SAVED, SampledMotion, describe, describe_simulation, sample_motion
from rrr_oc.codesign.search.local_optima import follow_to_fine_mesh
from rrr_oc.codesign.search.multistart import solve_multistart
from rrr_oc.codesign.search.proposals import LAYERS, SearchOptions, dimensions, motion_guess, sobol_points
from rrr_oc.codesign.search.starts import Polisher, Start, polish
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import PHASES, Speed, Task, load_task
from rrr_oc.data.published import published_springs
from rrr_oc.errors import UserError
from rrr_oc.optimal_control.solver import Solution
from studies.paper.encoding import Encoding, load_torque
from studies.paper.evolution import Protocol, evolve
from studies.paper.fixed_motion import best_springs
from studies.paper.parametrised import RestrictedDesign, proposals
from studies.paper.run_store import Run

EXPERIMENTS = ("SA", "PEA", "BPEA", "PEA+BPEA", "PEA*", "BPEA*", "PEA+BPEA*")
ENDS: tuple[Speed, ...] = ("rest", "free")
GRADIENT = {"multistart": (LAYERS[0],), "cma-ipopt": (LAYERS[1],)}
PER_INTERVAL = 30  # samples of a candidate's motion between two path points


def experiment(task: Task, name: str, ends: Speed = "rest") -> CoDesign:
    """One of the paper's experiments.

    A starred one has the stiffnesses and pulleys that the paper bought (Table 4); equilibria, motion and durations are free.

    Args:
        ends: "rest" at the ends of each phase, or "free" as in the authors' code.
    """
    if name not in EXPERIMENTS or ends not in ENDS:
        raise UserError(
            f"there is no experiment {name!r} with ends {ends!r}; there are {', '.join(EXPERIMENTS)}, and {', '.join(ENDS)}"
        )
    design = CoDesign(replace(task, speeds=(ends, ends)), spring_bounds(task, name.rstrip("*")))
    if not name.endswith("*"):
        return design
    bought = published_springs(name)
    return design.with_fixed(bought, [key for key in bought if key.startswith("q_")])


def folder_of(store: Path, labels: Mapping[str, Any], seed: int) -> Path:
    """Where a run of these labels lies in a store."""
    way = labels["way"] + (f"-{labels['model']}" if "model" in labels else "")
    return store / labels["experiment"] / labels["ends"] / way / str(seed)


def run_evolution(store: Path, labels: Mapping[str, Any], protocol: Protocol, seed: int, start: list[float] | None = None):
    """One trial of the paper's protocol; returns `labels` (preset, experiment, ends, way and model) and the trial's results."""
    design = experiment(load_task(labels["preset"]), labels["experiment"], labels["ends"])
    at = None if start is None else np.array(start)
    return labels, evolve(design, protocol, seed, folder_of(store, labels, seed), labels, at)


def run_gradient(store: Path, labels: Mapping[str, Any], starts: int, seed: int):
    """Multistart with the starts of one layer, on one core; the best motion is kept in the run's arrays."""
    run = Run(folder_of(store, labels, seed), {**labels, "starts": starts, "seed": seed})
    if (found := run.found) is not None:
        return labels, found
    design = experiment(load_task(labels["preset"]), labels["experiment"], labels["ends"])
    began, wall, rows = time.process_time(), time.perf_counter(), []

    def show(start: Start) -> None:
        rows.append((time.process_time() - began, start.polished))

    result = solve_multistart(design, SearchOptions(starts=starts, layers=GRADIENT[labels["way"]], seed=seed), show).whole()
    core_s = time.process_time() - began
    solution = result.best.solution
    motion, engine = sample_motion(design, solution), None
    if labels["ends"] == "rest":  # a payload that is let go in full motion has no engine run of two phases in one
        engine = describe_simulation(design, solution, motion)["exact_springs"]["E1"]
    found = {
        "E1": exact_cost(design, solution),
        "engine": engine,
        **_described(design, solution.parameters, motion),
        "parameters": solution.parameters.tolist(),
        "durations": solution.durations.tolist(),
        "optima": [o.solution.cost for o in result.optima],
        "starts": len(result.starts),
        "failed": sum(not np.isfinite(s.polished) for s in result.starts),
        "core_s": core_s,
        "wall_s": time.perf_counter() - wall,
    }
    columns = np.array(rows).reshape(-1, 2).T
    run.finish(found, {"core_s": columns[0], "polished": columns[1], **motion.arrays})
    return labels, found


def run_restricted(store: Path, labels: Mapping[str, Any], starts: int, seed: int):
    """IPOPT within the paper's parametrisation, from Sobol points, on one core."""
    run = Run(folder_of(store, labels, seed), {**labels, "starts": starts, "seed": seed})
    if (found := run.found) is not None:
        return labels, found
    design = experiment(load_task(labels["preset"]), labels["experiment"], labels["ends"])
    began, wall = time.process_time(), time.perf_counter()
    encoding = Encoding(design)
    program = RestrictedDesign(encoding)
    rows, best = [], None
    for guess in proposals(encoding, starts, seed):
        optimum = program.solve(program.start(guess))
        rows.append((time.process_time() - began, np.inf if optimum is None else optimum.cost))
        if optimum is not None and (best is None or optimum.cost < best.cost):
            best = optimum
    if best is None:
        raise UserError(
            f"{labels['experiment']}: none of {starts} starts led to an optimum within the parametrisation; give more"
        )
    columns = np.array(rows).T
    candidate = encoding.decode(best.x[None])
    found = {
        "E1": best.cost,
        "smooth": best.smooth,
        "x": best.x.tolist(),
        **_described(design, candidate.theta[:, 0], candidate_motion(encoding, best.x)),
        "parameters": candidate.theta[:, 0].tolist(),
        "durations": candidate.durations[:, 0].tolist(),
        "optima": sorted(c for c in columns[1].tolist() if np.isfinite(c)),
        "starts": starts,
        "failed": int(np.sum(~np.isfinite(columns[1]))),
        "core_s": columns[0, -1],
        "wall_s": time.perf_counter() - wall,
    }
    run.finish(found, {"core_s": columns[0], "polished": columns[1]})
    return labels, found


def starts_to_reach(design: CoDesign, options: SearchOptions, target: float) -> tuple[int, Solution | None]:
    """Solve from one Sobol point after the other, each on the fine mesh with the smallest smoothing width, until one costs no more
    than `target`.

    Returns:
        The number of starts, and the solution; None where `options.starts` were not enough.
    """
    polisher = Polisher(design, options)
    for index, vector in enumerate(sobol_points(dimensions(design, options.via), options.starts, options.seed)):
        start = polish(*polisher.proposal(LAYERS[0], vector, index))
        if not start.w.size or start.polished > 2 * target:  # the coarse mesh and the wide springs change the cost by far less
            continue
        found = follow_to_fine_mesh(design, options, polisher.solution(start).guess())
        if found is not None and found.cost <= target:
            return index + 1, found.solution
    return options.starts, None


def run_race(store: Path, labels: Mapping[str, Any], target: float, starts: int, seed: int):
    """Processor time until IPOPT, from one Sobol point after the other, costs at most `target` on the fine mesh with narrow springs.

    A start before the clock fills the cache of compiled C; everything else counts.
    """
    run = Run(folder_of(store, labels, seed), {**labels, "target": target, "starts": starts, "seed": seed})
    if (found := run.found) is not None:
        return labels, found
    task = load_task(labels["preset"])
    options = SearchOptions(starts=starts, seed=seed)
    starts_to_reach(experiment(task, labels["experiment"], labels["ends"]), SearchOptions(starts=1, seed=seed + 1), np.inf)
    began, wall = time.process_time(), time.perf_counter()
    needed, solution = starts_to_reach(experiment(task, labels["experiment"], labels["ends"]), options, target)
    found = {
        "reached": None if solution is None else solution.cost,
        "starts": needed,
        "core_s": time.process_time() - began,
        "wall_s": time.perf_counter() - wall,
    }
    run.finish(found, {})
    return labels, found


def run_fixed(store: Path, labels: Mapping[str, Any], duration: float, seed: int):
    """The best springs for a straight motion of minimum jerk in joint space that takes `duration` [s] a phase."""
    run = Run(folder_of(store, labels, seed), {**labels, "duration_s": duration, "seed": seed})
    if (found := run.found) is not None:
        return labels, found
    design = experiment(load_task(labels["preset"]), labels["experiment"], labels["ends"])
    began = time.process_time()
    alone = best_springs(design, motion_guess(design, np.zeros(0), [duration, duration]).phases, seed=seed)
    hardware = {k: float(v) for k, v in design.hardware(alone.parameters).items()}
    found = {"E1": alone.E1, "hardware": hardware, "core_s": time.process_time() - began}
    run.finish(found, {})
    return labels, found


def stored_motion(run: Run) -> SampledMotion:
    """The motion in the arrays of a multistart's run."""
    arrays: dict[str, Any] = run.arrays
    return SampledMotion(**{name: arrays[name] for name in SAVED})


def candidate_motion(encoding: Encoding, x: np.ndarray) -> SampledMotion:
    """A candidate's motion with exact springs, sampled densely; where the acceleration jumps, both values stand at one time."""
    design, candidate = encoding.design, encoding.decode(x[None])
    bare = CoDesign(design.task, ())
    m, s = len(design.task.moving), np.linspace(1e-9, 1 - 1e-9, PER_INTERVAL)
    q, dq, ddq = candidate.motion(s)
    load = load_torque(design, candidate.theta, q, dq, ddq)
    spring = load_torque(bare, np.zeros((0, 1)), q, dq, ddq) - load
    h = candidate.h[:, 0, 0, 0]
    starts = np.cumsum(np.r_[0, candidate.durations[:-1, 0]])
    t = starts[:, None] + h[:, None] * (np.arange(encoding.via + 1)[:, None] + s).ravel()
    phase = np.repeat(np.arange(len(PHASES)), t.shape[1])
    q, dq, ddq, load, spring = (values.reshape(m, -1) for values in (q, dq, ddq, load, spring))
    payload = np.array(design.task.payloads)[phase]
    return SampledMotion(
        t.ravel(), q, dq, ddq, payload, tau_load=load, tau_spring=spring, phase=phase, twist=np.zeros((3, *q.shape))
    )


def spring_torques(design: CoDesign, parameters: np.ndarray, motion: SampledMotion) -> dict[str, np.ndarray]:
    """Torque of each spring along a motion, by its label, on all joints (n, K) [Nm]; exact laws."""
    found, at, q = {}, 0, design.task.full(motion.q)
    for spring in design.springs:
        theta = parameters[at : at + len(spring.lower)]
        at += len(spring.lower)
        alone = design.task.model([spring.effect])
        found[design.model.label(spring.effect)] = np.array(
            alone.inverse(q, 0 * q, 0 * q, 0.0, theta, np.zeros(len(alone.widths)))[1]
        )
    return found


def roles(design: CoDesign, parameters: np.ndarray, motion: SampledMotion) -> dict[str, dict[str, float]]:
    """∫ Σ_joints |torque of a spring| dt in each phase [Nm s], by the spring's label and the phase's name."""
    return {
        label: {
            name: float(np.trapezoid(np.abs(torque[:, k]).sum(axis=0), motion.t[k]))
            for name, k in zip(PHASES, motion.phases(), strict=True)
        }
        for label, torque in spring_torques(design, parameters, motion).items()
    }


def _described(design: CoDesign, parameters: np.ndarray, motion: SampledMotion) -> dict[str, Any]:
    figures = describe(design, motion.metrics())
    hardware = {k: float(v) for k, v in design.hardware(parameters).items()}
    return {k: figures[k] for k in ("E1_joint", "rms", "peak")} | {
        "hardware": hardware,
        "roles": roles(design, parameters, motion),
    }

"""A study of a set of tasks: one set of springs for all of them in every configuration, each saved as soon as it is solved.

Beside the set's springs stand those tuned to each task alone, and those tuned to the first task, with the best motions for both.
Every optimum is certified, simulated in MuJoCo and, where a calibrated model is given, tracked in that.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc import __version__
from rrr_oc.codesign.certificate import certify
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import (
    SampledMotion,
    beyond_known,
    check_simulation,
    describe,
    describe_simulation,
    idle_springs,
    mounted,
    resimulate,
    restart_arrays,
    restored,
    sample_motion,
)
from rrr_oc.codesign.search.local_optima import Optimum
from rrr_oc.codesign.search.multistart import SearchResult, arranged_costs, solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import SpringBounds, arrangements, holding, offered, ways_to_mount
from rrr_oc.codesign.study import Request, Twin
from rrr_oc.codesign.task import PHASES, Task
from rrr_oc.codesign.task_sets.set_search import SetResult, front, solve_chosen, solve_set
from rrr_oc.codesign.task_sets.spring_choice import SpringFront, chosen, spring_front
from rrr_oc.codesign.task_sets.task_set import SetDesign, TaskSet, load_task_set, with_uncertainty
from rrr_oc.codesign.transfer import check_transfer, describe_transfer, repaired
from rrr_oc.effects import Clutched
from rrr_oc.errors import UserError
from rrr_oc.kept import Listener, kept_motion, once, save, taken
from rrr_oc.model.metrics import measure
from rrr_oc.optimal_control.solver import Solution, SolverFailure
from rrr_oc.parallel import ordered, unordered
from rrr_oc.robot.drives import load_actuators
from rrr_oc.storage import check_folder, code, plain, read_npz, read_utf8, write_npz


@dataclass(frozen=True, eq=False)
class SetStudy:
    """What all configurations of a run share.

    Attributes:
        out: Folder of the results.
        tasks: The set.
        designs: By configuration, in every way in which the tasks let its springs be mounted.
        asked: The settings on which a result depends.
        options: Of every search.
        twin: The calibrated model, if there is one.
        points: Number of optima between that of the set and that of the first task.
        price: Of a spring, in the unit of the objective; None if all offered springs are used.
        cost: Of `COSTS`.
        listener: Who is told how it goes on.
    """

    out: Path
    tasks: TaskSet
    designs: Mapping[str, Sequence[SetDesign]]
    asked: dict[str, Any]
    options: SearchOptions
    twin: Twin | None
    points: int
    price: float | None
    cost: str
    listener: Listener

    def results(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Configurations by name, each as soon as it is saved."""
        for name, ways in self.designs.items():
            files = [file_of(name, t) for t in range(len(self.tasks.tasks))]
            yield name, once(self, name, partial(_solve, self, name, ways), files)


def file_of(name: str, task: int) -> str:
    """Name of the npz with the motion of a task, by its index, in a configuration."""
    return f"{name}_{task + 1}"


def prepared_set(request: Request, points: int, price: float | None, listener: Listener) -> SetStudy:
    """A study of a set whose results are ready to be solved; raises `UserError` for whatever would end it later."""
    tasks = load_task_set(request.task)
    check_folder(request.out)
    if request.catalogue is not None:
        raise UserError(f"--catalogue is {request.catalogue!r}; for a set of tasks only 'none' is allowed")
    if points and tasks.objective != "sum":
        raise UserError(f"--front needs a set whose objective is 'sum'; that of {tasks.name!r} is {tasks.objective!r}")
    _check_price(price, tasks)
    joints = tasks.tasks[0].joints
    drives = None if request.actuators is None else load_actuators(joints, request.actuators)
    twin = None if request.model is None else Twin.of(request.model, tasks.tasks[0], drives, listener)
    model = None if twin is None else twin.model
    like = CoDesign(tasks.tasks[0], (), request.cost, None if request.cost == "load" else drives)
    designs: dict[str, list[SetDesign]] = {}
    names = offered(tasks.tasks[0])
    for task in tasks.tasks:
        names = holding(task, request.configurations, names, listener)
    for name in names:
        designs[name] = []
        _check_clutches(tasks, name)
        for springs in _ways(tasks.tasks[0], name, price is not None):
            alone = tuple(replace(like, task=task, springs=springs) for task in tasks.tasks)
            if price is not None and alone[0].series.rows:
                raise UserError(
                    f"--price chooses among springs that can be left out; in {name}, those between drives and links cannot"
                )
            if model is not None and request.repaired:
                alone = tuple(repaired(one, model, ("", "")) for one in alone)
            known = model if request.repaired else None
            designs[name].append(SetDesign(tasks, tuple(with_uncertainty(one, tasks, known) for one in alone)))
    first = next(iter(designs.values()))[0].first
    if model is not None:
        check_transfer(first, model)
    for way, *_ in designs.values():
        check_simulation(replace(way.first, springs=_one_a_place(way.first)))
    asked = {"set": tasks.contents, "cost": request.cost, "options": asdict(request.search), "front": points, "price": price}
    read = [None if request.cost == "load" else request.actuators, request.model]
    asked |= {"files": [read_utf8(f).decode() for f in read if f is not None and Path(f).is_file()]}
    robot = first.task.robot
    asked |= {"robot": [robot.placements, robot.axes, robot.inertial], "repaired": request.repaired, "version": __version__}
    asked |= {"limits": [[t.lower, t.upper, t.speed, t.acceleration, t.torque] for t in tasks.tasks], "code": code()}
    return SetStudy(request.out, tasks, designs, asked, request.search, twin, points, price, request.cost, listener)


def _check_price(price: float | None, tasks: TaskSet) -> None:
    """Raise `UserError` where springs cannot have this price."""
    if price is None:
        return
    if not (np.isfinite(price) and price >= 0):
        raise UserError(f"--price is {price:g}; a finite number of 0 or more is required, in the unit of the cost")
    if tasks.objective != "sum" or tasks.payload or tasks.model:
        found = "something uncertain" if tasks.objective == "sum" else f"the objective {tasks.objective!r}"
        raise UserError(f"--price needs a set whose objective is 'sum', without 'uncertain'; {tasks.name!r} has {found}")


def _check_clutches(tasks: TaskSet, name: str) -> None:
    """Raise `UserError` where a spring with a clutch cannot keep its energy in all tasks."""
    first, *others = (
        [np.r_[s.lower, s.upper] for way in arrangements(task, name) for s in way if isinstance(s.effect, Clutched)]
        for task in tasks.tasks
    )
    for task, other in zip(tasks.tasks[1:], others, strict=True):
        if len(other) != len(first) or not all(map(np.allclose, first, other)):
            raise UserError(
                f"set {tasks.name!r}: no spring with a clutch keeps its energy both in task {tasks.tasks[0].name!r} and in "
                f"{task.name!r}; the joints' ways between start and release decide its parameters, and must be the same"
            )


def _ways(task: Task, name: str, each: bool) -> list[tuple[SpringBounds, ...]]:
    """Every way to mount all springs of a configuration; with `each`, one that has every way to mount each spring."""
    if not each:
        return arrangements(task, name)
    return [tuple(way for ways in ways_to_mount(task, name) for way in ways)]


def _one_a_place(design: CoDesign) -> tuple[SpringBounds, ...]:
    """The springs of a design in the first way to mount each."""
    first = {(s.effect.name, s.effect.joints): s for s in reversed(design.springs)}
    return tuple(s for s in design.springs if s.known or first[s.effect.name, s.effect.joints] is s)


def _solve(study: SetStudy, name: str, ways: Sequence[SetDesign]) -> dict[str, Any]:
    """The entry of a configuration in summary.json; first writes the motions of the tasks."""
    began = time.perf_counter()
    if study.price is not None:
        return _solve_priced(study, name, ways[0], began)
    design = ways[0] if len(ways) == 1 else _best_arranged(study, name, ways)
    alone = _alone(study, name, design)
    with study.listener.stages(name) as report:
        result = solve_set(design, alone, study.options, report)
    return _described(study, name, result, None, began)


def _solve_priced(study: SetStudy, name: str, offered: SetDesign, began: float) -> dict[str, Any]:
    """As `_solve`, with those springs of the offered ones that are worth their price."""
    assert study.price is not None
    bare = offered.with_springs(tuple(s for s in offered.springs if s.known))
    few = replace(study.options, refinement=replace(study.options.refinement, rounds=0))  # the choice has its own mesh
    stiff = _alone(replace(study, options=few), f"{name} stiff", bare) if offered.sprung else _alone(study, name, bare)
    if not offered.sprung:
        return _described(study, name, solve_set(bare, stiff, study.options), None, began)
    with study.listener.count(f"{name} choice") as count:
        found = spring_front(offered, stiff, study.options, lambda left, _: count(left, "springs left"))
    result = solve_chosen(*chosen(offered, study.options, found.at(study.price)), study.options)
    return _described(study, name, result, _choice(study, offered, found), began)


def _choice(study: SetStudy, offered: SetDesign, found: SpringFront) -> dict[str, Any]:
    """The front of the number of springs, as it is saved."""
    assert study.price is not None
    points = []
    for point in found.points:
        design, start = chosen(offered, study.options, point)
        points.append(
            {
                "count": len(point.springs),
                "cost": point.total,
                "priced": point.total + study.price * len(point.springs),
                "springs": design.first.hardware(start.parameters),
                "mounted": mounted(design.first),
            }
        )
    at = found.points.index(found.at(study.price))
    places = len({(s.effect.name, s.effect.joints) for s in offered.springs if not s.known})
    return {"price": study.price, "offered": places, "chosen": at, "solved": found.solved, "points": points}


def _described(study: SetStudy, name: str, result: SetResult, choice: dict[str, Any] | None, began: float) -> dict[str, Any]:
    """The entry of a result in summary.json; first writes the motions of the tasks."""
    design = result.design
    calls = [
        (own, held, o, study.twin)
        for own, held, o in zip(design.designs, design.held(result.parameters), result.motions, strict=True)
    ]
    tasks = {}
    for t, (task, (found, arrays)) in enumerate(zip(study.tasks.tasks, ordered(_describe, calls), strict=True)):
        write_npz(kept_motion(study, file_of(name, t)), arrays)
        compared = {"alone": result.alone[t].cost, "with_first": result.first[t].cost}
        own = design.designs[t].hardware(result.alone[t].solution.parameters)
        tasks[task.name] = found | compared | {"springs_alone": own}
    return plain(_of_set(study, result) | {"choice": choice, "tasks": tasks, "wall_s": time.perf_counter() - began})


def _of_set(study: SetStudy, result: SetResult) -> dict[str, Any]:
    design, parameters = result.design, result.parameters
    points = front(result, study.options, study.points) if study.points and design.sprung else []
    return {
        "cost": result.total,
        "alone": design.total([o.cost for o in result.alone]),
        "with_first": design.total([o.cost for o in result.first]),
        "springs": design.first.hardware(parameters),
        "mounted": mounted(design.first),
        "parameters": design.first.model.values(parameters),
        "change": result.change,
        "starts": [{"layer": start.layer, "polished": start.polished} for start in result.starts],
        "front": [{"share": p.share, "first": p.costs[0], "total": p.total, "springs": p.springs} for p in points],
        "interrupted": False,
    }


def _best_arranged(study: SetStudy, name: str, ways: Sequence[SetDesign]) -> SetDesign:
    """Of ways to mount the springs the one in which the tasks alone cost least."""
    study.listener.show(f"{name}: the tasks leave {len(ways)} ways to mount the springs open; each is tried")
    costs = [arranged_costs(of_task, study.options) for of_task in zip(*(way.designs for way in ways), strict=True)]
    return ways[int(np.argmin([way.total(of_way) for way, of_way in zip(ways, zip(*costs, strict=True), strict=True)]))]


def _alone(study: SetStudy, name: str, design: SetDesign) -> list[Optimum]:
    """The optimum of each task with springs of its own; each is saved as soon as it is solved, for a run that is interrupted."""
    names = [f"{name} alone {t + 1}" for t in range(len(design.designs))]
    open_ = [t for t, one in enumerate(names) if taken(study, one, [one]) is None]
    with study.listener.count(f"{name} alone", len(names)) as count:
        count(len(names) - len(open_), "tasks alone")
        calls = [(t, design.designs[t], study.options) for t in open_]
        for done, (t, optimum) in enumerate(unordered(_search, calls), len(names) - len(open_) + 1):
            if isinstance(optimum, SolverFailure):
                task = design.designs[t].task.name
                raise UserError(f"no motion of task {task!r} was found within its limits: {optimum}")
            multipliers = {"lam_g": optimum.solution.lam_g, "lam_w": optimum.solution.lam_w}
            write_npz(kept_motion(study, names[t]), restart_arrays(optimum.solution) | multipliers)
            save(study, names[t], plain({"meshes": optimum.meshes}), [names[t]])
            count(done, "tasks alone")
    return [_restored(study, one, own) for one, own in zip(names, design.designs, strict=True)]


def _search(task: int, design: CoDesign, options: SearchOptions) -> tuple[int, Optimum | SolverFailure]:
    try:
        return task, solve_multistart(design, options).whole().best
    except SolverFailure as failure:
        return task, failure


def _restored(study: SetStudy, name: str, design: CoDesign) -> Optimum:
    found = taken(study, name, [name])
    assert found is not None
    file = read_npz(kept_motion(study, name))
    solution = replace(restored(design, study.options, file), lam_g=file["lam_g"], lam_w=file["lam_w"])
    return Optimum(solution, found["meshes"])


def _describe(
    own: CoDesign, held: CoDesign, optimum: Optimum, twin: Twin | None
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The entry of a task, and the arrays of its motion.

    Args:
        own: The task's problem with the bounds of the springs.
        held: The same with the springs held.
    """
    solution = optimum.solution
    motion = sample_motion(held, solution)
    found = describe(held, motion.metrics()) | {
        "cost": solution.cost,
        "durations": dict(zip(PHASES, solution.durations.tolist(), strict=True)),
        "lowest_tool_m": min(float(held.model.tool_height(q)) for q in held.task.full(motion.q).T[::7]),
        "idle": idle_springs(own, motion, solution.parameters),
        "beyond": beyond_known(own, motion, solution.parameters),
        "certificate": asdict(certify(SearchResult(held, (optimum,), (), False), optimum)),
        "meshes": optimum.meshes,
        "mujoco": describe_simulation(held, solution, motion),
        "scenarios": [_in_scenario(held, solution, motion, i) for i in range(len(held.scenarios))],
        "calibrated": twin
        and describe_transfer(held, motion, solution.parameters, twin.model, twin.drives) | {"uncalibrated": twin.unknown},
    }
    return plain(found), motion.arrays | {"joints": np.array(held.task.joints)} | restart_arrays(solution)


def _in_scenario(design: CoDesign, solution: Solution, motion: SampledMotion, index: int) -> dict[str, Any]:
    """E1 of a motion in one scenario, as planned and in MuJoCo, which knows the scenario."""
    scenario, task = design.scenarios[index], design.task
    w, names = solution.w.copy(), solution.problem.parameters
    for at, value in scenario.theta:
        w[at] = value / solution.problem.p_scale[at]
    case = replace(solution, w=w)
    there = replace(design, task=replace(task, payload=task.payload * scenario.payload), scenarios=design.scenarios[:1])
    widths = design.widths(solution.problem.data)
    payloads = there.task.payloads
    thetas = [there.engaged(i, case.parameters) for i in range(len(PHASES))]
    torques = [
        (motion.t[k], np.array(there.torques(motion.q[:, k], motion.dq[:, k], motion.ddq[:, k], m, theta, widths)[0]))
        for k, m, theta in zip(motion.phases(), payloads, thetas, strict=True)
    ]
    return {
        "payload_kg": there.task.payload,
        "parameters": {names[at]: value for at, value in scenario.theta},
        "E1": measure(torques).E1_total,
        "mujoco": describe(there, resimulate(there, case, motion).metrics, task.moving)["E1"],
    }

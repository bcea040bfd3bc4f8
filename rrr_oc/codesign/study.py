"""A study: one task, or several that share the springs, designed with every configuration of springs, each saved when it is solved.

For each configuration the cost is minimised over springs and motions by `multistart`, and of several tasks by `solve_set`; beside the
shared springs then stand those tuned to each task alone, and those tuned to the first. The best purchasable hardware is searched in a
catalogue (the starred designs); published springs are given the best motion on the same model; every optimum is certified, simulated in
MuJoCo and, where a calibrated model is given, tracked in that. What can be checked is checked before the first solve.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np

from rrr_oc import __version__
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.model_file import load_model
from rrr_oc.codesign.catalogue import Catalogue, can_be_bought, check_offers, load_catalogue
from rrr_oc.codesign.certificate import certify
from rrr_oc.codesign.design_file import COMPARISON, Configuration, Foreseen, Transferred, data, typed
from rrr_oc.codesign.design_problem import CoDesign, Scenario
from rrr_oc.codesign.optimum import (
    SAVED,
    SampledMotion,
    beyond_known,
    check_simulation,
    describe,
    describe_motors,
    describe_simulation,
    embedded,
    idle_springs,
    mounted,
    parts,
    resimulate,
    restart_arrays,
    restored,
    sample_motion,
    turns,
)
from rrr_oc.codesign.posterior.foreseen import foreseen
from rrr_oc.codesign.posterior.members import Member, members
from rrr_oc.codesign.posterior.scenarios import Over, over_members
from rrr_oc.codesign.purchasable import search_catalogue
from rrr_oc.codesign.search.coarse import coarse_search
from rrr_oc.codesign.search.comparisons import at_cycle_times, balancing_springs, best_motion, cycle_times, freed
from rrr_oc.codesign.search.local_optima import Optimum
from rrr_oc.codesign.search.multistart import SHARES, continue_from, solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.search.starts import layers
from rrr_oc.codesign.springs import (
    SpringBounds,
    allowed_configurations,
    arrangements,
    holding,
    mounting,
    offered,
    ways_to_mount,
)
from rrr_oc.codesign.task import PHASES, PRESETS, Task
from rrr_oc.codesign.task_sets.set_search import SetResult, front, joint_optimum, solve_bought, solve_chosen, solve_set
from rrr_oc.codesign.task_sets.spring_choice import SpringFront, chosen, spring_front
from rrr_oc.codesign.task_sets.task_set import SetDesign, TaskSet, load_tasks, with_uncertainty
from rrr_oc.codesign.transfer import (
    check_transfer,
    describe_transfer,
    motors_of,
    of_all_joints,
    uncalibrated,
    unknown_joints,
)
from rrr_oc.effects import Clutched
from rrr_oc.errors import Patience, UserError
from rrr_oc.kept import Keeping, Listener, kept_motion, once, save, taken
from rrr_oc.model.metrics import measure
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.solver import Solution, SolverFailure
from rrr_oc.parallel import ordered, unordered
from rrr_oc.progress import Progress, Step
from rrr_oc.robot.drives import Actuators, actuators_of, load_actuators
from rrr_oc.storage import check_folder, code, plain, read_npz, read_utf8, write_npz

OF_MODEL = "model"  # the actuators that a calibrated model describes
CHEAPER = 1e-4  # [1] share by which a design with idle springs must be cheaper for the stiff arm to be solved from its motion
Published = Callable[[str], Mapping[str, float]]  # hardware that was published for a configuration, empty where none was


@dataclass(frozen=True)
class Request:
    """What is asked of a study.

    Attributes:
        task: A bundled task or set of tasks, or the path of a file of either.
        out: Folder of the results.
        configurations: Names as in `rrr_oc.codesign.springs.configurations`; None for all that the tasks offer.
        search: Options of every search.
        cost: Of `COSTS`.
        actuators: A JSON file, "prototype", "model" for those of `model`, or "none"; by default the task's own, or the prototype's for the
            bundled tasks.
        catalogue: A JSON file, "prototype" or "none"; by default the prototype's for the bundled tasks and none for others, and none where
            springs have a price.
        model: The file of a calibrated model, in which every optimum is tracked.
        repaired: Whether designs are made for the arm as this model has it.
        front: Number of optima between that of a set of tasks and that of its first task.
        price: Of a spring, in the unit of the objective; None if all offered springs are used.
        over: Whether the cost on the calibrated arm is minimised, or the "mean" or the "worst" over the members of its posterior.
        cycle_times: At which all configurations of a task are compared [s]; () for none, None for those of their optima.
    """

    task: str
    out: Path
    configurations: tuple[str, ...] | None = None
    search: SearchOptions = field(default_factory=SearchOptions)
    cost: str = "load"
    actuators: str | None = None
    catalogue: str | None = None
    model: Path | None = None
    repaired: bool = False
    front: int = 0
    price: float | None = None
    over: Over = "calibrated"
    cycle_times: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if self.configurations == ():
            raise UserError(f"--configurations names none; a configuration is {allowed_configurations()}")
        if self.repaired and self.model is None:
            raise UserError("--repaired needs --model, the file of the model that the designs are to be made for")
        if self.over not in get_args(Over):
            raise UserError(f"--over is {self.over!r}; allowed are {', '.join(get_args(Over))}")
        if self.over != "calibrated" and not self.repaired:
            raise UserError(f"--over {self.over} needs --model and --repaired, the model whose recordings leave something open")
        if self.over != "calibrated" and self.price is not None:
            raise UserError(f"--over is {self.over} and --price is {self.price:g}; only one of them is allowed")
        if self.price is not None and self.catalogue not in (None, "none"):
            raise UserError(f"--price is {self.price:g} and --catalogue is {self.catalogue!r}; only one of them is allowed")
        if self.actuators == OF_MODEL and self.model is None:
            raise UserError(f"--actuators {OF_MODEL} needs --model, the file of the model whose friction and rotors are meant")
        shop = "prototype" if self.bundled and self.price is None else None
        object.__setattr__(
            self, "catalogue", shop if self.catalogue is None else None if self.catalogue == "none" else self.catalogue
        )

    @property
    def bundled(self) -> bool:
        """Whether the task is one of the paper's."""
        return self.task in PRESETS


@dataclass(frozen=True)
class TwinRun:
    """A calibrated model in which optima are tracked, and the arm's drives where they are known.

    Attributes:
        model: Of all joints of the tasks' robot.
        drives: Of the moving joints.
        unknown: Joints of which no recording says anything: their links are as in the task, without friction.
        members: The model and the others that the recordings do not tell from it.
    """

    model: CalibratedModel
    drives: Actuators | None
    unknown: tuple[str, ...] = ()
    members: tuple[Member, ...] = ()

    @classmethod
    def of(cls, path: str | Path, task: Task, drives: Actuators | None, listener: Listener) -> "TwinRun":
        """The model of a file on a task's robot; raises `UserError` where it is of another."""
        model = load_model(path)
        unknown = unknown_joints(task, model)
        try:
            whole = of_all_joints(task, model)
        except UserError as error:
            raise UserError(f"{path}: {error}") from None
        if unknown:
            listener.show(uncalibrated(unknown))
        return cls(whole, drives, unknown, members(whole))


@dataclass(frozen=True, eq=False)
class Study:
    """What all configurations of a run share.

    Attributes:
        request: What was asked.
        tasks: The tasks, on the arm for which they are designed.
        designs: By configuration, in every way in which the tasks let its springs be mounted.
        asked: The settings on which a result depends; a result saved under the same ones is taken again.
        shop: The catalogue of the starred designs, if there is one.
        twin: The calibrated model, if there is one.
        published: Springs that were published for the task, if there are some.
        listener: Who is told how it goes on.
        described: The tasks as they were asked for, on the arm as its file describes it.
        ctrl_c: Ends the study; a design that was found is described and saved first.
    """

    request: Request
    tasks: TaskSet
    designs: Mapping[str, Sequence[SetDesign]]
    asked: dict[str, Any]
    shop: Catalogue | None
    twin: TwinRun | None
    published: Published | None
    listener: Listener
    described: TaskSet
    ctrl_c: Patience = field(default_factory=Patience)

    @property
    def out(self) -> Path:
        """Folder of the results."""
        return self.request.out

    @property
    def options(self) -> SearchOptions:
        """Options of every search."""
        return self.request.search

    @property
    def single(self) -> bool:
        """Whether there is one task alone."""
        return len(self.tasks.tasks) == 1

    def results(self) -> Iterator[tuple[str, Configuration]]:
        """Configurations and starred designs by name: each as soon as it is saved, and again with what is compared with it."""
        found: dict[str, Configuration] = {}
        for name, ways in self.designs.items():
            for key, result in _results(self, name, ways, found):
                found[key] = result
                yield key, result
        if self.single and "SA" in found:
            better = _with_idle_motion(self, found)
            found |= better
            yield from better.items()
        if self.single and self.request.price is None:
            yield from _beside_others(self, found).items()

    def unfinished(self, found: Mapping[str, Configuration]) -> tuple[str, ...]:
        """What is missing among the results of a study that has not come to its end."""
        done = [name for name in self.designs if name in found and not found[name].interrupted]
        missing = [name for name in self.designs if name not in done]
        if self.shop is not None:
            bought = (name for name in self.designs if can_be_bought(self.designs[name][0].first))
            missing += [f"{n}*" for n in bought if f"{n}*" not in found and (n not in done or found[n].not_bought is None)]
        compared = self.single and self.request.price is None and self.request.cycle_times != ()
        if compared and not any(found[name].at_cycle_times for name in done):
            missing.append(COMPARISON)
        return tuple(missing)


def files_of(name: str, tasks: int) -> list[str]:
    """Names of the npz with the motion of each task in a configuration."""
    return [name] if tasks == 1 else [f"{name}_{t + 1}" for t in range(tasks)]


def prepared(request: Request, published: Published | None, listener: Listener) -> Study:
    """A study whose results are ready to be solved; raises `UserError` for whatever would end it later."""
    tasks = load_tasks(request.task)
    check_folder(request.out)
    _check_combined(request, tasks)
    drives = _drives(request, tasks.first)
    twin = None if request.model is None else TwinRun.of(request.model, tasks.first, drives, listener)
    names = offered(tasks.first)
    for task in tasks.tasks:
        names = holding(task, request.configurations, names, listener)
    designs = {name: _designs(request, tasks, name, drives, twin) for name in names}
    shop = None if request.catalogue is None else load_catalogue(request.catalogue)
    own = replace(tasks, tasks=tuple(one.task for one in next(iter(designs.values()))[0].designs))
    study = Study(request, own, designs, _asked(request, own), shop, twin, published, listener, tasks)
    _check(study)
    return study


def _drives(request: Request, task: Task) -> Actuators | None:
    """The drives of the moving joints: those that were asked for, or the task's own, or the prototype's for a bundled task."""
    if request.actuators == OF_MODEL:
        assert request.model is not None
        return actuators_of({joint: one.drive for joint, one in motors_of(load_model(request.model), task).items()})
    if request.actuators == "none":
        return None
    if request.actuators is None and task.actuators:
        return actuators_of({joint: one.drive for joint, one in task.actuators.items()})
    source = request.actuators or ("prototype" if request.bundled else None)
    return None if source is None else load_actuators(task.joints, source)


def _designs(request: Request, tasks: TaskSet, name: str, drives: Actuators | None, twin: TwinRun | None) -> list[SetDesign]:
    """The problems of a configuration, one for each way to mount its springs; with a price, one with every way to mount each."""
    _check_clutches(tasks, name)
    ways = arrangements(tasks.first, name)
    if request.price is not None:
        ways = [tuple(way for each in ways_to_mount(tasks.first, name) for way in each)]
    arm = twin if request.repaired else None
    made, known = [], None if arm is None else arm.model
    unsure = tasks.payload or tasks.model
    if unsure and request.over != "calibrated":
        raise UserError(f"--over is {request.over} and set {tasks.name!r} has 'uncertain'; only one of them is allowed")
    for springs in ways:
        alone = [CoDesign(task, springs, request.cost, drives) for task in tasks.tasks]
        if request.price is not None and alone[0].series.rows:
            raise UserError(
                f"--price chooses among springs that can be left out; in {name}, those between drives and links cannot"
            )
        alone = alone if arm is None else [over_members(one, arm.members, request.over) for one in alone]
        made.append(SetDesign(tasks, tuple(with_uncertainty(one, tasks, known) if unsure else one for one in alone)))
    return made


def _asked(request: Request, tasks: TaskSet) -> dict[str, Any]:
    asked = {"tasks": tasks.contents, "cost": request.cost, "catalogue": request.catalogue}
    read = (request.catalogue, request.actuators)
    read += (str(request.model),) if request.repaired or request.actuators == OF_MODEL else ()
    files = [read_utf8(f).decode() for f in read if f is not None and Path(f).is_file()]
    asked |= {"options": asdict(request.search), "files": files, "front": request.front, "price": request.price}
    asked |= {"over": request.over}
    robot, tool = tasks.first.robot, tasks.first.tool
    asked["robot"] = [robot.placements, robot.axes, robot.inertial, robot.gravity, tool.joint, tool.position]
    return asked | {"version": __version__, "code": code()}


def _check_combined(request: Request, tasks: TaskSet) -> None:
    """Raise `UserError` for what cannot be asked together."""
    several, worst = len(tasks.tasks) > 1, tasks.objective != "sum"
    if request.front and not several:
        raise UserError(f"--front is {request.front}; it needs a set of tasks, and {request.task} is a task")
    if several and request.cycle_times:
        raise UserError(f"--cycle-times compares designs of one task; {request.task} is a set of {len(tasks.tasks)}")
    if not several:
        _check_cycle_times(request.cycle_times or (), tasks.first)
    if request.front and worst:
        raise UserError(f"--front needs a set whose objective is 'sum'; that of {tasks.name!r} is {tasks.objective!r}")
    if request.price is None:
        return
    if not (np.isfinite(request.price) and request.price >= 0):
        raise UserError(f"--price is {request.price:g}; a finite number of 0 or more is required, in the unit of the cost")
    if worst or tasks.payload or tasks.model:
        found = f"the objective {tasks.objective!r}" if worst else "something uncertain"
        raise UserError(f"--price needs a set whose objective is 'sum', without 'uncertain'; {tasks.name!r} has {found}")


def _check_cycle_times(times: Sequence[float], task: Task) -> None:
    """Raise `UserError` for a cycle time that the task does not allow."""
    least, most = (len(PHASES) * bound for bound in task.duration)
    if task.cycle is not None:
        least, most = max(least, task.cycle[0]), min(most, task.cycle[1])
    for seconds in times:
        if not least <= seconds <= most:
            allowed = f"{least:g} … {most:g} s for both ways together"
            raise UserError(f"--cycle-times has {seconds:g} s; task {task.name!r} allows {allowed}")


def _check_clutches(tasks: TaskSet, name: str) -> None:
    """Raise `UserError` where a spring with a clutch cannot keep its energy in all tasks."""
    first, *others = (
        [np.r_[s.lower, s.upper] for way in arrangements(task, name) for s in way if isinstance(s.effect, Clutched)]
        for task in tasks.tasks
    )
    for task, other in zip(tasks.tasks[1:], others, strict=True):
        if len(other) != len(first) or not all(map(np.allclose, first, other)):
            raise UserError(
                f"set {tasks.name!r}: no spring with a clutch keeps its energy both in task {tasks.first.name!r} and in "
                f"{task.name!r}; the joints' ways between start and release decide its parameters, and must be the same"
            )


def _check(study: Study) -> None:
    """Raise `UserError` for what would end the study after its first design was solved."""
    for design, *_ in study.designs.values():
        if study.shop is not None and can_be_bought(design.first):
            check_offers(design.first, study.shop)
        check_simulation(replace(design.first, springs=_one_a_place(design.first)))
    if study.twin is not None:
        check_transfer(next(iter(study.designs.values()))[0].first, study.twin.model)


def _one_a_place(design: CoDesign) -> tuple[SpringBounds, ...]:
    """The springs of a design in the first way to mount each."""
    first = {s.place: s for s in reversed(design.springs)}
    return tuple(s for s in design.springs if s.known or first[s.place] is s)


def _once(study: Study, name: str, make: Callable[[], Configuration]) -> Configuration:
    """A configuration by name: the saved one, or a new one, which is saved."""
    files = files_of(name, len(study.tasks.tasks))
    return msgspec.convert(once(study, name, lambda: data(make()), files), Configuration)


def _results(
    study: Study, name: str, ways: Sequence[SetDesign], before: Mapping[str, Configuration]
) -> Iterator[tuple[str, Configuration]]:
    """A configuration and its starred design by name: each as soon as it is saved, and again with what is compared with it."""
    solved = _once(study, name, partial(_solve, study, name, ways, before))
    yield name, solved
    study.ctrl_c.over()
    design = _chosen(ways, solved)
    solved = _compared(study, name, design, solved)
    yield name, solved
    if study.shop is None or not can_be_bought(design.first):
        return
    starred = f"{name}*"
    try:
        bought = _once(study, starred, partial(_buy, study, starred, design, solved))
    except SolverFailure as failure:
        study.listener.show(f"{starred}: no choice of the catalogue could be solved: {failure}")
        yield name, msgspec.structs.replace(solved, not_bought=str(failure))
        return
    yield starred, bought
    study.ctrl_c.over()
    yield starred, _compared(study, starred, design, bought)


def _chosen(ways: Sequence[SetDesign], solved: Configuration) -> SetDesign:
    """The design with the springs of a result alone, mounted as there."""

    def has(design: CoDesign, spring: SpringBounds) -> bool:
        return spring.known or solved.mounted.get(design.model.label(spring.effect)) == mounting(spring.effect)

    some = [way.with_springs(tuple(s for s in way.springs if has(way.first, s))) for way in ways]
    return next(design for design in some if mounted(design.first) == solved.mounted)


def _with_idle_motion(study: Study, found: dict[str, Configuration]) -> dict[str, Configuration]:
    """The stiff arm moved as a design whose springs do nothing, if that is cheaper than what its own search found; saved."""
    designs, stiff = study.designs, found["SA"]
    (design,) = designs["SA"]
    idle = [name for name in designs if name in found and found[name].does_nothing]
    cheapest = min(idle, key=lambda name: found[name].cost, default="SA")
    if stiff.interrupted or found[cheapest].cost >= stiff.cost * (1 - CHEAPER):
        return {}
    began = time.perf_counter()
    file = read_npz(kept_motion(study, cheapest))
    guess = restored(_chosen(designs[cheapest], found[cheapest]).first, study.options, file).guess()
    tried = continue_from([(design.first, replace(guess, parameters=design.first.known_parameters))], study.options)
    if not tried or tried[0][1].cost >= stiff.cost:
        return {}
    better = _described(study, "SA", SetResult.apart(design, [tried[0][1]]), began)
    better = msgspec.structs.replace(better, optima=stiff.optima, layers=stiff.layers, covered=stiff.covered)
    save(study, "SA", data(better), ["SA"])
    return {"SA": _compared(study, "SA", design, better)}


def _beside_others(study: Study, found: Mapping[str, Configuration]) -> dict[str, Configuration]:
    """The configurations with springs that balance the arm at rest, and at equal cycle times; starred designs are left out."""
    own = {name: c for name, c in found.items() if name in study.designs and not c.interrupted}
    asked = study.request.cycle_times
    run = Keeping(study.out, study.asked | {"configurations": list(own), "cycle times": asked}, study.listener)
    make = partial(_compared_at_times, study, own)
    made = once(run, "equal cycle times", make, files=()) if own and asked != () else {}
    return {name: typed(data(own[name]) | more, Configuration) for name, more in made.items()}


def _compared_at_times(study: Study, own: Mapping[str, Configuration]) -> dict[str, Any]:
    """`balancing` and `at_cycle_times` of each configuration."""
    made, inner, options = {}, [], study.options
    solved = {name: _saved_optimum(study, name, c) for name, c in own.items()}
    took = {name: float(solution.durations.sum()) for name, (_, solution) in solved.items()}
    asked, cheapest = study.request.cycle_times, min(own, key=lambda name: own[name].cost)
    times = cycle_times(took.get("SA"), took[cheapest]) if asked is None else tuple(sorted(set(asked)))
    with study.listener.count("equal cycle times", len(own)) as count:
        for name, (design, solution) in solved.items():
            costs = at_cycle_times(design, solution, times, inner, options)
            inner.append((design, costs))
            balancing, others = _balancing(study, name, design), dict[float, Solution]()
            if balancing is not None:
                held, best = balancing
                others = at_cycle_times(held, best, times, [(design, costs)], options)
                best = freed(held, best, others, options)
                told = {"springs": held.hardware(best.parameters), "cost": best.cost, "cycle_s": float(best.durations.sum())}
                made[name] = {"balancing": told}
            rows = [[time, *(of[time].cost if time in of else None for of in (costs, others))] for time in times]
            keys = ("cycle_s", "cost", "balancing")
            made[name] = made.get(name, {}) | {"at_cycle_times": [dict(zip(keys, row, strict=True)) for row in rows]}
            count(len(made), "configurations")
    return plain(made)


def _saved_optimum(study: Study, name: str, found: Configuration) -> tuple[CoDesign, Solution]:
    """The design of a configuration of one task with its springs as mounted, and the optimum that is kept."""
    design = _chosen(study.designs[name], found).first
    return design, restored(design, study.options, read_npz(kept_motion(study, name)))


def _balancing(study: Study, name: str, design: CoDesign) -> tuple[CoDesign, Solution] | None:
    """The design with its springs held as they balance the arm at rest, with its best motion; None where there is no such."""
    springs = balancing_springs(design)
    if springs is None:
        return None
    held = design.with_fixed(design.hardware(springs))
    best = _best_motion(study, name, held, "springs that balance the arm at rest")
    return best and (held, best)


def _best_motion(study: Study, name: str, held: CoDesign, springs: str) -> Solution | None:
    """The best motion for springs that are held; None where none is found, which is said."""
    try:
        return best_motion(held, study.options)
    except SolverFailure as failure:
        study.listener.show(f"{name}: no motion was found with {springs}: {failure}")
        return None


def _compared(study: Study, name: str, design: SetDesign, solved: Configuration) -> Configuration:
    """A saved result with what it is compared with: published springs on this model, and the motions in the calibrated model."""
    if study.published is not None:
        hardware = study.published(name)
        published = once(study, f"{name} published springs", lambda: _published(study, name, design.first, hardware), files=())
        solved = msgspec.structs.replace(solved, published_springs=published["cost"])
    if study.twin is None:
        return solved
    files = [read_npz(kept_motion(study, file)) for file in files_of(name, len(design.designs))]
    motions = [SampledMotion(**dict[str, Any]({key: file[key] for key in SAVED})) for file in files]
    theta, twin = design.first.model.theta(solved.parameters), study.twin
    calls = [(one, motion, theta, twin.model, twin.drives) for one, motion in zip(design.designs, motions, strict=True)]
    tracked = [typed(one | {"uncalibrated": twin.unknown}, Transferred) for one in ordered(describe_transfer, calls)]
    ranges = _foreseen(study, name, design, motions, theta)
    tasks = {
        task: msgspec.structs.replace(moved, calibrated=one, foreseen=other)
        for (task, moved), one, other in zip(solved.tasks.items(), tracked, ranges, strict=True)
    }
    return msgspec.structs.replace(solved, tasks=tasks)


def _foreseen(
    study: Study, name: str, design: SetDesign, motions: Sequence[SampledMotion], theta: np.ndarray
) -> list[Foreseen | None]:
    """Of each task what the recordings let one foresee of its motion with these springs."""
    assert study.twin is not None
    own, calls = tuple(s for s in design.springs if not s.known), []
    springs = theta[: sum(len(s.effect.parameters) for s in own)]
    for task, motion, file in zip(study.described.tasks, motions, files_of(name, len(motions)), strict=True):
        bare = replace(design.first, task=task, springs=own, scenarios=(Scenario(),))
        calls.append((bare, motion, springs, study.twin.members, f"{file}.npz"))
    return list(ordered(foreseen, calls))


def _solve(study: Study, name: str, ways: Sequence[SetDesign], before: Mapping[str, Configuration]) -> Configuration:
    """A configuration, its springs mounted in the best of some ways; writes its motions."""
    began = time.perf_counter()
    if study.request.price is not None:
        return _solve_priced(study, name, ways[0], began)
    if len(ways) > 1:
        study.listener.show(f"{name}: the tasks leave {len(ways)} ways to mount the springs open; each is tried")
    if not study.single:
        design = _best_mounted(study, name, ways)
        alone = _alone(study, name, design)
        with study.listener.stages(name) as report:
            result = solve_set(design, alone, study.options, report)
        return _described(study, name, result, began)
    with study.listener.stages(name) as report:
        result = _search(study, ways, before, report)
        Progress(SHARES, report).tell("certificate", 0.0, f"best {result.total:.6g}")
        return _described(study, name, result, began)


def _search(
    study: Study, ways: Sequence[SetDesign], before: Mapping[str, Configuration], report: Callable[[Step], None]
) -> SetResult:
    """The search of one task. It also starts from what was found before for configurations with fewer springs, so that it is not worse
    than these, and goes on in another way to mount the springs where these are cheaper."""
    known: list[list[Guess]] = [[] for _ in ways]
    costs = np.full(len(ways), np.inf)  # of the cheapest of what is known in each way
    for other, solved in before.items():
        if other in study.designs and not solved.interrupted:
            inner, optimum = _saved_optimum(study, other, solved)
            for w, way in enumerate(ways):
                if (guess := embedded(optimum, inner, way.first)) is not None:
                    known[w].append(guess)
                    costs[w] = min(costs[w], solved.cost)
    designs, options = [way.first for way in ways], study.options
    with _limits_told(designs[0].task):
        coarse = coarse_search(designs, options, Progress(SHARES, report), known if len(ways) > 1 else ())
        best, cheapest = coarse.way, int(np.argmin(costs))
        found = solve_multistart(designs[best], options, known=known[best], report=report, coarse=coarse)
        if cheapest != best and costs[cheapest] < found.best.cost and not found.interrupted:
            best = cheapest
            found = solve_multistart(designs[best], options, known=known[best], report=report)
    study.ctrl_c.asked |= found.interrupted
    of_task = {"starts": found.starts, "optima": found.optima, "covered": found.covered, "interrupted": found.interrupted}
    return replace(SetResult.apart(ways[best], [found.best]), **of_task)


def _solve_priced(study: Study, name: str, offered: SetDesign, began: float) -> Configuration:
    """As `_solve`, with those springs of the offered ones that are worth their price."""
    bare = offered.with_springs(tuple(s for s in offered.springs if s.known))
    few = replace(study.options, refinement=replace(study.options.refinement, rounds=0))  # the choice has its own mesh
    if not offered.sprung:
        return _described(study, name, solve_set(bare, _alone(study, name, bare), study.options), began)
    quick = replace(study, request=replace(study.request, search=few))
    stiff = _alone(quick, f"{name} stiff", bare)
    with study.listener.count(f"{name} choice") as count:
        found = spring_front(offered, stiff, study.options, lambda left, _: count(left, "springs left"))
    price = study.request.price or 0.0
    result = solve_chosen(*chosen(offered, study.options, found.at(price)), study.options)
    described = _described(study, name, result, began)
    return typed(data(described) | {"choice": _choice(study, offered, found, price)}, Configuration)


def _choice(study: Study, offered: SetDesign, found: SpringFront, price: float) -> dict[str, Any]:
    """The front of the number of springs, as it is saved."""
    points = []
    for point in found.points:
        design, start = chosen(offered, study.options, point)
        points.append(
            {
                "count": len(point.springs),
                "cost": point.total,
                "priced": point.total + price * len(point.springs),
                "springs": design.first.hardware(start.parameters),
                "mounted": mounted(design.first),
            }
        )
    at = found.points.index(found.at(price))
    places = len({s.place for s in offered.springs if not s.known})
    return {"price": price, "offered": places, "chosen": at, "solved": found.solved, "points": points}


def _buy(study: Study, name: str, design: SetDesign, made: Configuration) -> Configuration:
    """A starred design, from what is made for its tasks: the problem of all of them with hardware of the catalogue; writes its motions."""
    began, options = time.perf_counter(), study.options
    parameters, files = design.first.model.theta(made.parameters), files_of(name.rstrip("*"), len(design.designs))
    saved = [read_npz(kept_motion(study, file)) for file in files]
    if study.single:
        start = restored(design.first, options, saved[0])
    else:
        motions = [restored(one, options, file).guess() for one, file in zip(design.held(parameters), saved, strict=True)]
        joint = joint_optimum(design, design.guess(motions, parameters), options)
        if joint is None:
            raise SolverFailure("the springs to be made led to no optimum on the first mesh")
        start = joint.solution
    assert study.shop is not None
    with study.listener.count(name) as count:
        bought = search_catalogue(design, start, study.shop, options, lambda done: count(done, "problems solved"))
    found = _described(study, name, solve_bought(bought.design, bought.optimum, options), began, design.first)
    if not study.single:  # compared with the same as what is made
        tasks = {
            task: msgspec.structs.replace(moved, alone=own.alone, with_first=own.with_first, springs_alone=own.springs_alone)
            for (task, moved), own in zip(found.tasks.items(), made.tasks.values(), strict=True)
        }
        found = msgspec.structs.replace(found, tasks=tasks, alone=made.alone, with_first=made.with_first)
    catalogue = data(bought.coverage) | {"gap": found.cost / made.cost - 1, "runners_up": bought.runners_up}
    return typed(data(found) | {"catalogue": catalogue}, Configuration)


@contextmanager
def _limits_told(task: Task) -> Iterator[None]:
    """Raises `UserError` with the task's limits where no motion is found."""
    try:
        yield
    except SolverFailure as failure:
        raise _no_motion(task, failure) from None


def _no_motion(task: Task, failure: SolverFailure) -> UserError:
    rows = zip(task.joints, *np.degrees([task.lower, task.upper, task.speed, task.acceleration]), task.torque, strict=True)
    limits = "; ".join(f"{j}: {lo:.0f} … {hi:.0f}°, {v:.0f} °/s, {a:.0f} °/s², {tau:g} Nm" for j, lo, hi, v, a, tau in rows)
    limits += "".join(f"; springs' {key} {value:g}" for key, value in task.spring_limits.of_design.items())
    limits += "".join(f"; {task.joints[j]}: {np.degrees(task.jerk[j]):.0f} °/s³" for j in task.jerky)
    limits += f"; above {task.around.floor:g} m" * bool(np.isfinite(task.around.floor))
    limits += "".join(f"; outside of {one.name}" for one in task.around.keep_outs)
    limits += "".join(f"; via {i} at {passed.share:.0%} of {PHASES[passed.phase]}" for i, passed in enumerate(task.via))
    return UserError(
        f"no motion of task {task.name!r} was found within its limits ({limits}; "
        f"{task.duration[0]:g} … {task.duration[1]:g} s a phase): {failure}"
    )


def _best_mounted(study: Study, name: str, ways: Sequence[SetDesign]) -> SetDesign:
    """Of ways to mount the springs the one in which the tasks alone cost least."""
    if len(ways) == 1:
        return ways[0]
    costs = []
    for t, task in enumerate(study.tasks.tasks):
        with study.listener.stages(f"{name} mounting, task {task.name}") as report, _limits_told(task):
            costs.append(coarse_search([way.designs[t] for way in ways], study.options, Progress(SHARES, report)).costs)
    return ways[int(np.argmin([way.total(of_way) for way, of_way in zip(ways, zip(*costs, strict=True), strict=True)]))]


def _alone(study: Study, name: str, design: SetDesign) -> list[Optimum]:
    """The optimum of each task with springs of its own; each is saved as soon as it is solved, for a run that is interrupted."""
    names = [f"{name} alone {t + 1}" for t in range(len(design.designs))]
    open_ = [t for t, one in enumerate(names) if taken(study, one, [one]) is None]
    with study.listener.count(f"{name} alone", len(names)) as count:
        count(len(names) - len(open_), "tasks alone")
        calls = [(t, design.designs[t], study.options) for t in open_]
        for done, (t, optimum) in enumerate(unordered(_search_alone, calls), len(names) - len(open_) + 1):
            multipliers = {"lam_g": optimum.solution.lam_g, "lam_w": optimum.solution.lam_w}
            write_npz(kept_motion(study, names[t]), restart_arrays(optimum.solution) | multipliers)
            save(study, names[t], plain({"meshes": optimum.meshes}), [names[t]])
            count(done, "tasks alone")
    return [_restored(study, one, own) for one, own in zip(names, design.designs, strict=True)]


def _search_alone(task: int, design: CoDesign, options: SearchOptions) -> tuple[int, Optimum]:
    with _limits_told(design.task):
        return task, solve_multistart(design, options).whole().best


def _restored(study: Study, name: str, design: CoDesign) -> Optimum:
    found = taken(study, name, [name])
    assert found is not None
    file = read_npz(kept_motion(study, name))
    solution = replace(restored(design, study.options, file), lam_g=file["lam_g"], lam_w=file["lam_w"])
    return Optimum(solution, found["meshes"])


def _described(study: Study, name: str, result: SetResult, began: float, compared: CoDesign | None = None) -> Configuration:
    """The entry of a result; first keeps the motions of its tasks. The springs of one task are compared with those of `compared`, by
    default with the design's own."""
    design, parameters = result.design, result.parameters
    free = study.single and study.request.price is None  # else the springs were found first, and held for the motions
    held = design.designs if free else design.held(parameters)
    compared = (compared or design.first) if study.single else None
    calls = [(own, one, o, compared) for own, one, o in zip(design.designs, held, result.motions, strict=True)]
    tasks, files = {}, files_of(name, len(held))
    with study.ctrl_c.kept():
        described = ordered(_moved, calls)
    for t, (moved, arrays) in enumerate(described):
        write_npz(kept_motion(study, files[t]), arrays)
        own = design.designs[t].hardware(result.alone[t].solution.parameters)
        others = {"alone": result.alone[t].cost, "with_first": result.first[t].cost, "springs_alone": own}
        tasks[study.tasks.tasks[t].name] = moved | others
    leaning = study.request.front and design.sprung and not name.endswith("*")
    found = {
        "cost": result.total,
        "alone": design.total([o.cost for o in result.alone]),
        "with_first": design.total([o.cost for o in result.first]),
        "springs": design.first.hardware(parameters),
        "mounted": mounted(design.first),
        "parameters": design.first.model.values(parameters),
        "parts": parts(design.first, parameters, _turned([*tasks.values()])),
        "tasks": tasks,
        "layers": layers(result.starts),
        "optima": [_optimum(design.first, o) for o in result.optima],
        "covered": result.covered,
        "interrupted": result.interrupted,
        "change": result.change,
        "front": front(result, study.options, study.request.front) if leaning else [],
        "wall_s": time.perf_counter() - began,
    }
    return typed(found, Configuration)


def _optimum(design: CoDesign, optimum: Optimum) -> dict[str, Any]:
    """The entry of a local optimum."""
    return {
        "cost": optimum.cost,
        "reached": optimum.reached,
        "refined": len(optimum.meshes) > 1,
        "durations": dict(zip(PHASES, optimum.solution.durations.tolist(), strict=True)),
        "springs": design.hardware(optimum.solution.parameters),
    }


def _turned(tasks: Sequence[Mapping[str, Any]]) -> dict[str, tuple[float, float]]:
    """Least and greatest deflection in all tasks of each spring that does something in one, by its label."""
    used = [label for label in tasks[0]["turns"] if not all(label in moved["idle"] for moved in tasks)]
    ranges = {label: [moved["turns"][label] for moved in tasks] for label in used}
    return {label: (min(low for low, _ in some), max(high for _, high in some)) for label, some in ranges.items()}


def _moved(
    own: CoDesign, held: CoDesign, optimum: Optimum, compared: CoDesign | None
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What is saved of the motion of a task, and its arrays.

    Args:
        own: The task's problem with the bounds of the springs.
        held: The problem that the optimum is one of: where tasks share the springs, with these held.
        compared: See `certify`.
    """
    solution = optimum.solution
    motion, cases = sample_motion(held, solution), len(held.scenarios)
    *links, tool = held.task.heights(motion.q)
    found = describe(held, motion.metrics()) | {
        "cost": solution.cost,
        "durations": dict(zip(PHASES, solution.durations.tolist(), strict=True)),
        "start": dict(zip(held.task.joints, motion.q[:, 0].tolist(), strict=True)),
        "release": dict(zip(held.task.joints, motion.q[:, motion.segments[0].stop - 1].tolist(), strict=True)),
        "motors": describe_motors(held, motion),
        "lowest_tool_m": float(tool.min()),
        "lowest_link_m": min(float(heights.min()) for heights in (*links, tool)),
        "turns": turns(own, motion, solution.parameters),
        "idle": idle_springs(own, motion, solution.parameters),
        "beyond": beyond_known(own, motion, solution.parameters),
        "certificate": certify(held, optimum, compared),
        "meshes": optimum.meshes,
        "mujoco": describe_simulation(held, solution, motion),
        "scenarios": [_in_scenario(held, solution, motion, i) for i in range(cases)] if cases > 1 else [],
    }
    if held.cost == "load" and cases == 1:
        found["E1"] = solution.cost
    return found, motion.arrays | {"joints": np.array(held.task.joints)} | restart_arrays(solution)


def _in_scenario(design: CoDesign, solution: Solution, motion: SampledMotion, index: int) -> dict[str, Any]:
    """E1 of a motion in one scenario, as planned and in MuJoCo, which knows the scenario."""
    scenario, task = design.scenarios[index], design.task
    w, names = solution.w.copy(), solution.problem.parameters
    for at, value in scenario.theta:
        w[at] = value / solution.problem.p_scale[at]
    case = replace(solution, w=w)
    there = replace(design, task=scenario.task(task), scenarios=(Scenario(),))
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
        "says": scenario.says,
    }


def _published(study: Study, name: str, design: CoDesign, hardware: Mapping[str, float]) -> dict[str, float | None]:
    """The cost of published springs on this model, motion and durations re-optimised; None where there are none, or no motion is
    found."""
    best = _best_motion(study, name, design.with_fixed(hardware), "the published springs") if hardware else None
    return {"cost": best and best.cost}

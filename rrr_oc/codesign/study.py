"""A study: one task designed with every configuration of springs, each design saved as soon as it is solved.

For each configuration the cost is minimised over springs and motion by `multistart`; the best purchasable hardware is searched in a
catalogue (the starred designs); published springs are given the best motion on the same model; every optimum is certified, simulated in
MuJoCo and, where a calibrated model is given, tracked in that. What can be checked is checked before the first solve.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc import __version__
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.model_file import load_model
from rrr_oc.codesign.catalogue import Catalogue, can_be_bought, check_offers, load_catalogue
from rrr_oc.codesign.certificate import certify
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import (
    SAVED,
    SampledMotion,
    beyond_known,
    check_simulation,
    describe,
    describe_simulation,
    embedded,
    idle_springs,
    mounted,
    restart_arrays,
    restored,
    sample_motion,
)
from rrr_oc.codesign.purchasable import search_catalogue
from rrr_oc.codesign.search.multistart import SHARES, SearchResult, best_arranged, continue_from, solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import allowed_configurations, arrangements, holding, offered
from rrr_oc.codesign.task import PHASES, PRESETS, Task, load_task
from rrr_oc.codesign.transfer import check_transfer, describe_transfer, of_all_joints, repaired
from rrr_oc.errors import UserError
from rrr_oc.kept import Listener, kept_motion, once, save
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.solver import SolverFailure
from rrr_oc.progress import Progress, Step
from rrr_oc.robot.drives import Actuators, load_actuators
from rrr_oc.storage import check_folder, code, plain, read_npz, read_utf8, write_npz

CHEAPER = 1e-4  # [1] share by which a design with idle springs must be cheaper for the stiff arm to be solved from its motion
Published = Callable[[str], Mapping[str, float]]  # hardware that was published for a configuration, empty where none was


@dataclass(frozen=True)
class Request:
    """What is asked of a study.

    Attributes:
        task: A bundled task, or the path of a task file.
        out: Folder of the results.
        configurations: Names as in `rrr_oc.codesign.springs.configurations`; None for all that the task offers.
        search: Options of every search.
        cost: Of `COSTS`.
        actuators, catalogue: A JSON file, "prototype" or "none"; by default the prototype's for the bundled tasks and none for others.
        model: The file of a calibrated model, in which every optimum is tracked.
        repaired: Whether designs are made for the arm as this model has it.
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

    def __post_init__(self) -> None:
        if self.configurations == ():
            raise UserError(f"--configurations names none; a configuration is {allowed_configurations()}")
        if self.repaired and self.model is None:
            raise UserError("--repaired needs --model, the file of the model that the designs are to be made for")
        for name in ("actuators", "catalogue"):
            given = getattr(self, name)
            bundled = "prototype" if self.bundled else None
            object.__setattr__(self, name, bundled if given is None else None if given == "none" else given)

    @property
    def bundled(self) -> bool:
        """Whether the task is one of the paper's."""
        return self.task in PRESETS


@dataclass(frozen=True)
class Twin:
    """A calibrated model in which optima are tracked, and the arm's drives where they are known.

    Attributes:
        model: Of all joints of the tasks' robot.
        drives: Of the moving joints.
        unknown: Joints of which no recording says anything: their links are as in the task, without friction.
    """

    model: CalibratedModel
    drives: Actuators | None
    unknown: tuple[str, ...] = ()

    @classmethod
    def of(cls, path: str | Path, task: Task, drives: Actuators | None, listener: Listener) -> "Twin":
        """The model of a file on a task's robot; raises `UserError` where it is of another."""
        model = load_model(path)
        unknown = tuple(joint for joint in task.robot.joints if joint not in model.joints)
        try:
            whole = of_all_joints(task, model)
        except UserError as error:
            raise UserError(f"{path}: {error}") from None
        if unknown:
            listener.show(uncalibrated(unknown))
        return cls(whole, drives, unknown)


def uncalibrated(joints: Sequence[str]) -> str:
    """A sentence on joints that a calibrated model says nothing of."""
    return f"the model says nothing of {', '.join(joints)}: links as the task has them, without friction and rotor inertia"


@dataclass(frozen=True, eq=False)
class Study:
    """What all configurations of a run share.

    Attributes:
        out: Folder of the results.
        task: The task, on the arm for which it is designed.
        designs: By configuration, in every way in which the task lets its springs be mounted.
        asked: The settings on which a result depends; a result saved under the same ones is taken again.
        options: Of every search.
        shop: The catalogue of the starred designs, if there is one.
        twin: The calibrated model, if there is one.
        published: Springs that were published for the task, if there are some.
        listener: Who is told how it goes on.
    """

    out: Path
    task: Task
    designs: Mapping[str, Sequence[CoDesign]]
    asked: dict[str, Any]
    options: SearchOptions
    shop: Catalogue | None
    twin: Twin | None
    published: Published | None
    listener: Listener

    def results(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Configurations and starred designs by name: each as soon as it is saved, and again with what is compared with it."""
        found: dict[str, Any] = {}
        for name, ways in self.designs.items():
            for key, result in _results(self, name, ways, found):
                found[key] = result
                yield key, result
        if "SA" in found:
            yield from _with_idle_motion(self, found).items()


def prepared(request: Request, published: Published | None, listener: Listener) -> Study:
    """A study whose results are ready to be solved; raises `UserError` for whatever would end it later."""
    task = load_task(request.task)
    check_folder(request.out)
    drives = None if request.actuators is None else load_actuators(task.joints, request.actuators)
    twin = None if request.model is None else Twin.of(request.model, task, drives, listener)
    needed = None if request.cost == "load" else drives
    designs = {}
    for name in holding(task, request.configurations, offered(task), listener):
        ways = [CoDesign(task, springs, request.cost, needed) for springs in arrangements(task, name)]
        designs[name] = ways if twin is None or not request.repaired else [repaired(way, twin.model, ("", "")) for way in ways]
    own, shop = next(iter(designs.values()))[0].task, None if request.catalogue is None else load_catalogue(request.catalogue)
    asked = _asked(request, own)
    study = Study(request.out, own, designs, asked, request.search, shop, twin, published, listener)
    _check(study)
    return study


def _asked(request: Request, task: Task) -> dict[str, Any]:
    asked = {"preset": request.task, "cost": request.cost, "catalogue": request.catalogue}
    read = (request.task, request.catalogue, None if request.cost == "load" else request.actuators)
    read += (str(request.model),) if request.repaired else ()
    files = [read_utf8(f).decode() for f in read if f is not None and Path(f).is_file()]
    asked |= {"options": asdict(request.search), "files": files}
    robot = [
        task.robot.placements,
        task.robot.axes,
        task.robot.inertial,
        task.robot.gravity,
        task.tool.joint,
        task.tool.position,
    ]
    limits = [task.lower, task.upper, task.speed, task.acceleration, task.torque]  # some may be the robot's
    return asked | {"robot": robot, "limits": limits, "springs": task.springs, "version": __version__, "code": code()}


def _check(study: Study) -> None:
    """Raise `UserError` for what would end the study after its first design was solved."""
    for design, *_ in study.designs.values():
        if study.shop is not None and can_be_bought(design):
            check_offers(design, study.shop)
        check_simulation(design)
    if study.twin is not None:
        check_transfer(next(iter(study.designs.values()))[0], study.twin.model)


def does_nothing(found: Mapping[str, Any]) -> bool:
    """Whether a design has springs and none of them does anything."""
    return bool(found.get("idle")) and set(found["idle"]) == set(found["mounted"])


def _results(
    study: Study, name: str, ways: Sequence[CoDesign], before: Mapping[str, Any]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """A configuration and its starred design by name: each as soon as it is saved, and again with what is compared with it."""
    solved = once(study, name, partial(_solve, study, name, ways, before))
    yield name, solved
    design = _chosen(ways, solved)
    if not solved["interrupted"]:
        solved |= _compared(study, name, design)
        yield name, solved
    if study.shop is None or not can_be_bought(design) or solved["interrupted"]:
        return
    starred = f"{name}*"
    try:
        bought = once(study, starred, partial(_buy, study, starred, design))
    except SolverFailure as failure:
        study.listener.show(f"{starred}: no choice of the catalogue could be solved: {failure}")
        yield name, solved | {"not_bought": str(failure)}
        return
    yield starred, bought
    yield starred, bought | _compared(study, starred, design)


def _chosen(ways: Sequence[CoDesign], solved: dict[str, Any]) -> CoDesign:
    """The design with the springs mounted as in a result."""
    return next(design for design in ways if plain(mounted(design)) == solved["mounted"])


def _with_idle_motion(study: Study, found: dict[str, Any]) -> dict[str, Any]:
    """The stiff arm moved as a design whose springs do nothing, if that is cheaper than what its own search found; saved."""
    designs, stiff = study.designs, found["SA"]
    (design,) = designs["SA"]
    idle = [name for name in designs if name in found and does_nothing(found[name])]
    cheapest = min(idle, key=lambda name: found[name]["cost"], default="SA")
    if stiff["interrupted"] or found[cheapest]["cost"] >= stiff["cost"] * (1 - CHEAPER):
        return {}
    began = time.perf_counter()
    file = read_npz(kept_motion(study, cheapest))
    guess = restored(_chosen(designs[cheapest], found[cheapest]), study.options, file).guess()
    tried = continue_from([(design, replace(guess, parameters=np.zeros(0)))], study.options)
    if not tried or tried[0][1].cost >= stiff["cost"]:
        return {}
    better = _describe(study, "SA", SearchResult(design, (tried[0][1],), (), False), began)
    better |= {key: stiff[key] for key in ("optima", "layers")}
    save(study, "SA", better, ["SA"])
    return {"SA": better | _compared(study, "SA", design)}


def _compared(study: Study, name: str, design: CoDesign) -> dict[str, Any]:
    """What a saved optimum is compared with: published springs on this model, and the optimum in the calibrated twin."""
    published = {"published_springs_E1": None}
    if study.published is not None:
        hardware = study.published(name)
        published = once(study, f"{name} published springs", lambda: _published(study, name, design, hardware), files=())
    return published | {"calibrated": None if study.twin is None else _transferred(study, name, design, study.twin)}


def _solve(study: Study, name: str, ways: Sequence[CoDesign], before: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration, its springs mounted in the best of some ways; writes its motion. The search also starts from what was found
    before for configurations with fewer springs, so that it is not worse than these."""
    began = time.perf_counter()
    if len(ways) > 1:
        study.listener.show(f"{name}: the task leaves {len(ways)} ways to mount the springs open; each is tried")
    design, known = best_arranged(ways, study.options), []
    for other, result in before.items():
        if other in study.designs and not result["interrupted"]:
            inner = _chosen(study.designs[other], result)
            file = read_npz(kept_motion(study, other))
            known.append(embedded(restored(inner, study.options, file), inner, design))
    with study.listener.stages(name) as report:
        result = _search(study, design, [guess for guess in known if guess is not None], report)
        Progress(SHARES, report).tell("certificate", 0.0, f"best {result.best.cost:.6g}")
        return _describe(study, name, result, began)


def _buy(study: Study, name: str, design: CoDesign) -> dict[str, Any]:
    """A starred design, from the saved optimum of its configuration; writes its motion."""
    began = time.perf_counter()
    start = restored(design, study.options, read_npz(kept_motion(study, name.rstrip("*"))))
    assert study.shop is not None
    with study.listener.count(name) as count:
        bought = search_catalogue(design, start, study.shop, study.options, lambda done: count(done, "problems solved"))
    found = _describe(study, name, SearchResult(bought.design, (bought.optimum,), (), False), began, design)
    gap = bought.optimum.cost / start.cost - 1
    left = {key: value for key, value in found.items() if key not in ("optima", "layers")}
    return left | {"catalogue": plain(asdict(bought.coverage) | {"gap": gap, "runners_up": bought.runners_up})}


def _search(study: Study, design: CoDesign, known: Sequence[Guess], report: Callable[[Step], None]) -> SearchResult:
    try:
        return solve_multistart(design, study.options, known=known, report=report)
    except SolverFailure as failure:
        task = design.task
        rows = zip(task.joints, *np.degrees([task.lower, task.upper, task.speed, task.acceleration]), task.torque, strict=True)
        limits = "; ".join(f"{j}: {lo:.0f} … {hi:.0f}°, {v:.0f} °/s, {a:.0f} °/s², {tau:g} Nm" for j, lo, hi, v, a, tau in rows)
        raise UserError(
            f"no motion of task {task.name!r} was found within its limits ({limits}; "
            f"{task.duration[0]:g} … {task.duration[1]:g} s a phase): {failure}"
        ) from None


def _describe(study: Study, name: str, result: SearchResult, began: float, offered: CoDesign | None = None) -> dict[str, Any]:
    """The entry of a configuration in summary.json; first keeps its motion. Its springs are compared with those of
    `offered`, by default with the design's own."""
    design, solution = result.design, result.best.solution
    motion = sample_motion(design, solution)
    joints = {"joints": np.array(design.task.joints)}
    write_npz(kept_motion(study, name), motion.arrays | joints | restart_arrays(solution))
    described = describe(design, motion.metrics()) | {
        "cost": solution.cost,
        "lowest_tool_m": min(float(design.model.tool_height(q)) for q in design.task.full(motion.q).T[::7]),
        "springs": design.hardware(solution.parameters),
        "mounted": mounted(design),
        "idle": idle_springs(design, motion, solution.parameters),
        "beyond": beyond_known(design, motion, solution.parameters),
        "parameters": design.model.values(solution.parameters),
        "durations": dict(zip(PHASES, solution.durations.tolist(), strict=True)),
        "certificate": asdict(certify(result, result.best, offered)),
        "meshes": result.best.meshes,
        "mujoco": describe_simulation(design, solution, motion),
        "optima": [
            {
                "cost": o.solution.cost,
                "reached": o.reached,
                "refined": len(o.meshes) > 1,
                "durations": dict(zip(PHASES, o.solution.durations.tolist(), strict=True)),
                "springs": design.hardware(o.solution.parameters),
            }
            for o in result.optima
        ],
        "layers": result.layers(),
        "interrupted": result.interrupted,
    }
    if design.cost == "load":
        described["E1"] = solution.cost
    return plain(described | {"wall_s": time.perf_counter() - began})


def _transferred(study: Study, name: str, design: CoDesign, twin: Twin) -> dict[str, Any]:
    """Metrics of a saved optimum in the calibrated twin."""
    saved = read_npz(kept_motion(study, name))
    motion, values = (
        SampledMotion(**dict[str, Any]({key: saved[key] for key in SAVED})),
        restored(design, study.options, saved).parameters,
    )
    return plain(describe_transfer(design, motion, values, twin.model, twin.drives) | {"uncalibrated": twin.unknown})


def _published(study: Study, name: str, design: CoDesign, hardware: Mapping[str, float]) -> dict[str, float | None]:
    """The cost of published springs on this model, motion and durations re-optimised; None where there are none, or no motion is
    found."""
    options = study.options
    if not hardware:
        return {"published_springs_E1": None}
    few = replace(options, starts=max(4, options.starts // 4), kept=3, motions=0)
    try:
        return {"published_springs_E1": solve_multistart(design.with_fixed(hardware), few).whole().best.cost}
    except SolverFailure as failure:
        study.listener.show(f"{name}: no motion was found with the published springs: {failure}")
        return {"published_springs_E1": None}

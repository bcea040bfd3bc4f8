"""`rrr-oc design`: springs and motion of a task, designed together; each result is saved as soon as it is found."""

import json
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from rich.markdown import Markdown
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from rrr_oc import __version__
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.model_file import load_model
from rrr_oc.codesign.catalogue import Catalogue, check_offers, load_catalogue
from rrr_oc.codesign.certificate import certify
from rrr_oc.codesign.design_problem import COST_UNITS, CoDesign
from rrr_oc.codesign.multistart import SearchResult, Start, best_arranged, continue_from, solve_multistart
from rrr_oc.codesign.optimum import (
    SAVED,
    SampledMotion,
    check_simulation,
    describe,
    describe_simulation,
    idle_springs,
    mounted,
    restart_arrays,
    restored,
    sample_motion,
)
from rrr_oc.codesign.proposals import SearchOptions
from rrr_oc.codesign.purchasable import METHODS, search_catalogue
from rrr_oc.codesign.springs import CONFIGURATIONS, arrangements
from rrr_oc.codesign.task import PHASES, PRESETS, Task, load_task
from rrr_oc.codesign.transfer import check_transfer, describe_transfer, transfer_table
from rrr_oc.errors import UserError
from rrr_oc.optimal_control.solver import SolverFailure
from rrr_oc.paper.published import published_springs
from rrr_oc.parallel import check_jobs
from rrr_oc.report.console import wide_console
from rrr_oc.report.design_figures import draw_all
from rrr_oc.report.design_report import does_nothing, report
from rrr_oc.robot.drives import Actuators, load_actuators
from rrr_oc.storage import check_folder, write_json, write_npz, write_text

COSTS = {"load": "load torque² (Eq. 13)", "motor": "motor torque²", "energy": "electrical energy (Eq. 11)"}
CHEAPER = 1e-4  # [1] share by which a design with idle springs must be cheaper for the stiff arm to be solved from its motion
QUANTITIES = {"load": "E1", "motor": "motor torque²", "energy": "energy"}  # names of the costs in tables and figures
PACKAGES = ("casadi", "pin", "mujoco", "numpy", "scipy", "cma")
console = wide_console()


@dataclass(frozen=True)
class Request:
    """What is asked for, as `rrr-oc design` declares it.

    Attributes:
        task: A bundled task, or the path of a task file.
        out: Folder of the results.
        cost: One of `COSTS`.
        configurations: Of `CONFIGURATIONS`, comma-separated; all if None.
        actuators, catalogue: Path, "prototype", "none", or None for the default of the task.
        catalogue_search: One of `METHODS`.
        model: model.json of the arm, in which optima are tracked.
        search: Of every configuration.
    """

    task: str
    out: Path
    cost: str
    configurations: str | None
    actuators: str | None
    catalogue: str | None
    catalogue_search: str
    model: Path | None
    search: SearchOptions


def run(asked_for: Request) -> None:
    """Co-design for each configuration; writes tables, figures, summary.json and one npz a configuration."""
    began, task = time.perf_counter(), load_task(asked_for.task)
    for note in task.robot.notes:
        console.print(f"Note: {note}.", highlight=False, soft_wrap=True)
    study, designs = _study(asked_for, task)
    _check(study, designs)
    found: dict[str, Any] = {}
    try:
        for name, ways in designs.items():
            for key, result in _results(study, name, ways):
                found[key] = result
        if "SA" in found:
            found |= _with_idle_motion(study, designs, found)
    finally:  # whatever ends the study, the designs that are finished are reported
        if found:
            settings = {"cost": asked_for.cost, "paper": study.paper, "options": study.options}
            _write(study.out, task, settings | {"wall_s": time.perf_counter() - began}, found)


def _study(asked_for: Request, task: Task) -> tuple["Study", dict[str, list[CoDesign]]]:
    """What all configurations share, and each configuration with the ways in which its springs may be mounted."""
    check_jobs(asked_for.search.jobs)
    check_folder(asked_for.out)
    names = list(CONFIGURATIONS)
    if asked_for.configurations is not None:
        names = [n.strip() for n in asked_for.configurations.split(",") if n.strip()]
    if not names:
        raise UserError(f"--configurations names none; there are {', '.join(CONFIGURATIONS)}")
    method, cost = asked_for.catalogue_search, asked_for.cost
    if method not in METHODS:
        raise UserError(f"--catalogue-search is {method!r}; allowed are {', '.join(METHODS)}")
    actuators, catalogue = (_source(given, asked_for.task) for given in (asked_for.actuators, asked_for.catalogue))
    drives = None if actuators is None else load_actuators(task.joints, actuators)
    needed = None if cost == "load" else drives
    designs = {name: [CoDesign(task, springs, cost, needed) for springs in arrangements(task, name)] for name in names}
    asked = {"preset": asked_for.task, "cost": cost, "catalogue": catalogue, "catalogue_search": method}
    files = [
        f for f in (asked_for.task, catalogue, None if cost == "load" else actuators) if f is not None and Path(f).is_file()
    ]
    asked |= {"options": asdict(asked_for.search), "files": [Path(f).read_text(encoding="utf-8") for f in files]}
    asked |= {"robot": [task.robot.placements, task.robot.axes, task.robot.inertial], "version": __version__}
    shop = None if catalogue is None else load_catalogue(catalogue)
    twin = None if asked_for.model is None else Twin(load_model(asked_for.model), drives)
    return Study(asked_for.out, asked, asked_for.search, shop, method, twin, asked_for.task in PRESETS), designs


@dataclass(frozen=True)
class Twin:
    """A calibrated model in which optima are tracked, and the arm's drives where they are known."""

    model: CalibratedModel
    drives: Actuators | None


@dataclass(frozen=True, eq=False)
class Study:
    """What all configurations of a run share.

    Attributes:
        out: Folder of the results.
        asked: The settings on which a result depends; a result saved under the same ones is taken again.
        options: Of every search.
        shop, method: The catalogue of the starred designs, if there is one, and how it is searched.
        twin: The calibrated model, if there is one.
        paper: Whether the task is one of the paper's, for which it published springs.
    """

    out: Path
    asked: dict[str, Any]
    options: SearchOptions
    shop: Catalogue | None
    method: str
    twin: Twin | None
    paper: bool


def _source(given: str | None, preset: str) -> str | None:
    """The file, or bundled name, of an option whose default is the prototype's for the bundled tasks; None for none."""
    if given is None:
        return "prototype" if preset in PRESETS else None
    return None if given == "none" else given


def _check(study: Study, designs: Mapping[str, Sequence[CoDesign]]) -> None:
    """Raise `UserError` for what would end the study after its first design was solved."""
    for design, *_ in designs.values():
        if study.shop is not None:
            check_offers(design, study.shop)
        check_simulation(design)
    if study.twin is not None:
        check_transfer(next(iter(designs.values()))[0], study.twin.model)


def _results(study: Study, name: str, ways: Sequence[CoDesign]) -> Iterator[tuple[str, dict[str, Any]]]:
    """A configuration and its starred design by name: each as soon as it is saved, and again with what is compared with it."""
    solved = _once(study, name, partial(_solve, study, name, ways))
    yield name, solved
    design = _chosen(ways, solved)
    if not solved["interrupted"]:
        solved |= _compared(study, name, design)
        yield name, solved
    if study.shop is None or not design.springs or solved["interrupted"]:
        return
    starred = f"{name}*"
    try:
        bought = _once(study, starred, partial(_buy, study, starred, design))
    except SolverFailure as failure:
        console.print(f"{starred}: no choice of the catalogue could be solved: {failure}", highlight=False, soft_wrap=True)
        yield name, solved | {"not_bought": str(failure)}
        return
    yield starred, bought
    yield starred, bought | _compared(study, starred, design)


def _chosen(ways: Sequence[CoDesign], solved: dict[str, Any]) -> CoDesign:
    """The design with the springs mounted as in a result."""
    return next(design for design in ways if plain(mounted(design)) == solved["mounted"])


def _with_idle_motion(study: Study, designs: Mapping[str, Sequence[CoDesign]], found: dict[str, Any]) -> dict[str, Any]:
    """The stiff arm moved as a design whose springs do nothing, if that is cheaper than what its own search found; saved."""
    stiff, (design,) = found["SA"], designs["SA"]
    idle = [name for name in designs if name in found and does_nothing(found[name])]
    cheapest = min(idle, key=lambda name: found[name]["cost"], default="SA")
    if stiff["interrupted"] or found[cheapest]["cost"] >= stiff["cost"] * (1 - CHEAPER):
        return {}
    began = time.perf_counter()
    with np.load(study.out / f"{cheapest}.npz") as file:
        guess = restored(_chosen(designs[cheapest], found[cheapest]), study.options, file).guess()
    tried = continue_from([(design, replace(guess, parameters=np.zeros(0)))], study.options)
    if not tried or tried[0][1].cost >= stiff["cost"]:
        return {}
    better = _describe(study.out, "SA", SearchResult(design, (tried[0][1],), (), False), began)
    better |= {key: stiff[key] for key in ("optima", "layers")}
    _save(study, "SA", better)
    return {"SA": better | _compared(study, "SA", design)}


def _compared(study: Study, name: str, design: CoDesign) -> dict[str, Any]:
    """What a saved optimum is compared with: the paper's springs on this model, and the optimum in the calibrated twin."""
    published = {"published_springs_E1": None}
    if study.paper:
        published = _once(study, f"{name} published springs", lambda: _published(study, name, design), files=())
    return published | {"calibrated": None if study.twin is None else _transferred(study, name, design, study.twin)}


def _write(out: Path, task: Task, settings: dict[str, Any], found: dict[str, Any]) -> None:
    """summary.json, report.md and the figures."""
    options = settings["options"]
    names = sorted(found, key=lambda name: (name.endswith("*"), list(CONFIGURATIONS).index(name.rstrip("*"))))
    summary = {
        "preset": task.name,
        "cost": COSTS[settings["cost"]],
        "quantity": [QUANTITIES[settings["cost"]], COST_UNITS[settings["cost"]]],
        "paper": settings["paper"],
        "joints": list(task.robot.joints),
        "seed": options.seed,
        "starts": options.starts,
        "wall_s": settings["wall_s"],
        "versions": {"rrr_oc": __version__, "python": platform.python_version()} | {p: version(p) for p in PACKAGES},
        "options": plain(asdict(options)),
        "configurations": {name: found[name] for name in names},
    }
    write_json(out / "summary.json", summary)
    text = report(summary) + transfer_table(summary["configurations"])
    write_text(out / "report.md", text)
    draw_all(out, task)
    console.print(Markdown(text.split("## Certificates")[0]))
    console.print(f"Everything is in {out}: report.md, summary.json, figures, one npz a configuration.")


def _once(study: Study, name: str, solve: Callable[[], dict[str, Any]], files: Sequence[str] | None = None) -> dict[str, Any]:
    """A result by name: the one in the folder if a run with the same settings wrote it, else that of `solve`, which is saved at once
    unless it was interrupted. `files` are the npz files that belong to it, by default that of its name."""
    saved = study.out / f".{name}.json"
    if saved.is_file():
        content = json.loads(saved.read_text())
        if content["asked"] == _key(study) and all(
            (study.out / f"{n}.npz").is_file() for n in ([name] if files is None else files)
        ):
            console.print(f"{name}: taken from the interrupted or repeated run in {study.out}")
            return content["found"]
    saved.unlink(missing_ok=True)  # the motion beside it is about to change
    found = solve()
    if not found.get("interrupted"):
        _save(study, name, found)
    return found


def _save(study: Study, name: str, found: dict[str, Any]) -> None:
    write_json(study.out / f".{name}.json", {"asked": _key(study), "found": found})


def _key(study: Study) -> dict[str, Any]:
    """The settings as they are read back from JSON."""
    return json.loads(json.dumps(plain(study.asked)))


def _solve(study: Study, name: str, ways: Sequence[CoDesign]) -> dict[str, Any]:
    """A configuration, its springs mounted in the best of some ways; writes its motion."""
    began = time.perf_counter()
    if len(ways) > 1:
        console.print(f"{name}: the task leaves {len(ways)} ways to mount the springs open; each is tried", highlight=False)
    return _describe(study.out, name, _search(name, best_arranged(ways, study.options), study.options), began)


def _buy(study: Study, name: str, design: CoDesign) -> dict[str, Any]:
    """A starred design, from the saved optimum of its configuration; writes its motion."""
    began = time.perf_counter()
    with np.load(study.out / f"{name.rstrip('*')}.npz") as file:
        start = restored(design, study.options, file)
    assert study.shop is not None
    with _progress() as progress:
        row = progress.add_task(name, total=None, best="choices solved")
        bought = search_catalogue(
            design, start, study.shop, study.options, study.method, lambda done: progress.update(row, completed=done)
        )
    found = _describe(study.out, name, SearchResult(bought.design, (bought.optimum,), (), False), began)
    gap = bought.optimum.cost / start.cost - 1
    left = {key: value for key, value in found.items() if key not in ("optima", "layers")}
    return left | {"catalogue": plain(asdict(bought.coverage) | {"gap": gap, "runners_up": bought.runners_up})}


def _search(name: str, design: CoDesign, options: SearchOptions) -> SearchResult:
    best = float("inf")
    with _progress() as progress:
        row = progress.add_task(name, total=options.starts, best="")

        def show(start: Start) -> None:
            nonlocal best
            best = min(best, start.polished)
            progress.update(row, advance=1, best=f"best so far {best:.3f}")

        try:
            return solve_multistart(design, options, show)
        except SolverFailure as failure:
            task = design.task
            rows = zip(
                task.joints, *np.degrees([task.lower, task.upper, task.speed, task.acceleration]), task.torque, strict=True
            )
            limits = "; ".join(
                f"{j}: {lo:.0f} … {hi:.0f}°, {v:.0f} °/s, {a:.0f} °/s², {tau:g} Nm" for j, lo, hi, v, a, tau in rows
            )
            raise UserError(
                f"no motion of task {task.name!r} was found within its limits ({limits}; "
                f"{task.duration[0]:g} … {task.duration[1]:g} s a phase): {failure}"
            ) from None


def _progress() -> Progress:
    columns = BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.fields[best]}")
    return Progress(TextColumn("{task.description:12}"), *columns, console=console)


def _describe(out: Path, name: str, result: SearchResult, began: float) -> dict[str, Any]:
    """The entry of a configuration in summary.json; first writes its motion to an npz."""
    design, solution = result.design, result.best.solution
    motion = sample_motion(design, solution)
    joints = {"joints": np.array(design.task.joints)}
    write_npz(out / f"{name}.npz", motion.arrays | joints | restart_arrays(solution))
    described = describe(design, motion.metrics()) | {
        "cost": solution.cost,
        "lowest_tool_m": min(float(design.model.tool_height(q)) for q in design.task.full(motion.q).T[::7]),
        "springs": design.hardware(solution.parameters),
        "mounted": mounted(design),
        "idle": idle_springs(design, motion, solution.parameters),
        "parameters": design.model.values(solution.parameters),
        "durations": dict(zip(PHASES, solution.durations.tolist(), strict=True)),
        "certificate": asdict(certify(result, result.best)),
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
    with np.load(study.out / f"{name}.npz") as saved:
        motion, values = SampledMotion(**{key: saved[key] for key in SAVED}), restored(design, study.options, saved).parameters
    return plain(describe_transfer(design, motion, values, twin.model, twin.drives))


def _published(study: Study, name: str, design: CoDesign) -> dict[str, float | None]:
    """The cost of Table 4's springs on this model, motion and durations re-optimised; None where the table has none, or no motion is
    found."""
    springs, options = published_springs(name), study.options
    if not springs:
        return {"published_springs_E1": None}
    few = replace(options, starts=max(4, options.starts // 4), kept=3, hops=0)
    try:
        return {"published_springs_E1": solve_multistart(design.with_fixed(springs), few).whole().best.cost}
    except SolverFailure as failure:
        console.print(f"{name}: no motion was found with the published springs: {failure}", highlight=False, soft_wrap=True)
        return {"published_springs_E1": None}


def plain(value: Any) -> Any:
    """Plain data for JSON: numpy to Python, NaN and infinity to null."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value

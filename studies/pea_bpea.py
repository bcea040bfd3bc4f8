"""Springs and motion of the pick-and-place task, designed together.

    python studies/pea_bpea.py --out results/paper

An RRR arm carries 5 kg to a release position and comes back empty. Which springs, in parallel with its joints (PEA), across
two of them (BPEA) or both, and which motion, need the least load torque? For each configuration the integral of the squared
load torques (Eq. 13) is minimised by direct collocation and IPOPT from starts that CMA-ES and Sobol points propose; the best
purchasable hardware is searched in a catalogue (the starred designs); the paper's own springs are given the best motion on the
same model; every optimum comes with a certificate and is simulated again in MuJoCo. Results stand beside the paper's.
"""

import json
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.markdown import Markdown
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from rrr_oc import __version__
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.model_file import load_model
from rrr_oc.codesign.catalogue import load_catalogue
from rrr_oc.codesign.certificate import certify
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.multistart import SearchResult, Start, solve_multistart
from rrr_oc.codesign.optimum import SAVED, SampledMotion, describe, describe_simulation, sample_motion
from rrr_oc.codesign.proposals import SearchOptions
from rrr_oc.codesign.purchasable import METHODS, CatalogueResult, search_catalogue
from rrr_oc.codesign.springs import CONFIGURATIONS, spring_bounds
from rrr_oc.codesign.task import PHASES, PRESETS, Task, load_task
from rrr_oc.codesign.transfer import check_transfer, describe_transfer, transfer_table
from rrr_oc.errors import UserError, entry_point
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.optimal_control.solver import SolverFailure
from rrr_oc.paper.published import published_springs
from rrr_oc.parallel import check_jobs
from rrr_oc.report.console import wide_console
from rrr_oc.report.design_figures import draw_all
from rrr_oc.report.design_report import report
from rrr_oc.robot.drives import load_actuators
from rrr_oc.storage import check_folder, write_json, write_npz, write_text

COSTS = {"load": "load torque² (Eq. 13)", "motor": "motor torque²", "energy": "electrical energy (Eq. 11)"}
PACKAGES = ("casadi", "pin", "mujoco", "numpy", "scipy", "cma")
console = wide_console()


def main(
    preset: Annotated[str, typer.Option(help=f"{', '.join(PRESETS)}, or the path of a task file")] = "paper",
    configurations: Annotated[str, typer.Option(help="comma-separated, of " + ", ".join(CONFIGURATIONS))] = ",".join(
        CONFIGURATIONS
    ),
    starts: Annotated[int, typer.Option(min=1, help="starts a configuration, half from CMA-ES, half from Sobol points")] = 40,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    hops: Annotated[int, typer.Option(min=0, help="rounds of basin hopping over the durations of the best optimum")] = 2,
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("results/pea_bpea"),
    cost: Annotated[str, typer.Option(help="load (Eq. 13), motor (motor torque squared, Eq. 7) or energy (Eq. 11)")] = "load",
    actuators: Annotated[str, typer.Option(help="'prototype' or a JSON file, for the costs motor and energy")] = "prototype",
    catalogue: Annotated[
        str, typer.Option(help="'prototype', a JSON file, or 'none' to leave the starred designs out")
    ] = "prototype",
    catalogue_search: Annotated[str, typer.Option(help="for BPEA*: " + " or ".join(METHODS))] = "exhaustive",
    tolerance: Annotated[float, typer.Option(min=1e-10, max=1e-2, help="mesh tolerance, relative")] = 1e-6,
    model: Annotated[
        Path | None, typer.Option(help="model.json of `rrr-oc calibrate`: every optimum is tracked in it too")
    ] = None,
    jobs: Annotated[int, typer.Option(help="processes; -1 for all cores")] = -1,
) -> None:
    """Co-design for each configuration; writes tables, figures, summary.json and one npz a configuration."""
    began, task = time.perf_counter(), load_task(preset)
    names = [n.strip() for n in configurations.split(",") if n.strip()]
    if not names:
        raise UserError(f"--configurations names none; there are {', '.join(CONFIGURATIONS)}")
    if catalogue_search not in METHODS:
        raise UserError(f"--catalogue-search is {catalogue_search!r}; allowed are {', '.join(METHODS)}")
    check_jobs(jobs)
    check_folder(out)
    drives = load_actuators(task.joints, actuators) if cost != "load" else None
    designs = {name: CoDesign(task, spring_bounds(task, name), cost, drives) for name in names}
    calibrated = None if model is None else load_model(model)
    if calibrated is not None:
        check_transfer(next(iter(designs.values())), calibrated)
    shop = None if catalogue == "none" else load_catalogue(catalogue)
    options = SearchOptions(starts=starts, seed=seed, jobs=jobs, hops=hops, refinement=Refinement(tolerance))
    asked = {"preset": preset, "cost": cost, "catalogue": catalogue, "catalogue_search": catalogue_search}
    files = [f for f in (preset, catalogue, actuators if drives else None) if f is not None and Path(f).is_file()]
    asked |= {"options": asdict(options), "files": [Path(f).read_text(encoding="utf-8") for f in files]}
    asked |= {"robot": [task.robot.placements, task.robot.axes, task.robot.inertial], "version": __version__}
    found: dict[str, Any] = {}
    for name, design in designs.items():
        found |= _once(out, name, asked, partial(_solve, name, design, options, shop, catalogue_search, out))
    for name, c in found.items():
        c["calibrated"] = None if calibrated is None else _transferred(out, name, c, designs[name.rstrip("*")], calibrated)
    _write(out, task, {"cost": cost, "options": options, "wall_s": time.perf_counter() - began}, found)


def _write(out: Path, task: Task, settings: dict[str, Any], found: dict[str, Any]) -> None:
    """summary.json, report.md and the figures."""
    options = settings["options"]
    names = sorted(found, key=lambda name: (name.endswith("*"), list(CONFIGURATIONS).index(name.rstrip("*"))))
    summary = {
        "preset": task.name,
        "cost": COSTS[settings["cost"]],
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


def _once(out: Path, name: str, asked: dict, solve: Callable[[], tuple[dict[str, Any], bool]]) -> dict[str, Any]:
    """The results of a configuration: those in the folder if a run with the same settings has written them, else those of `solve`."""
    saved = out / f".{name}.json"
    key = json.loads(json.dumps(plain(asked)))
    if saved.is_file():
        content = json.loads(saved.read_text())
        if content["asked"] == key and all((out / f"{n}.npz").is_file() for n in content["found"]):
            console.print(f"{name}: taken from the interrupted or repeated run in {out}")
            return content["found"]
    saved.unlink(missing_ok=True)  # the motions beside it are about to change
    found, interrupted = solve()
    if not interrupted:
        write_json(saved, {"asked": key, "found": found})
    return found


def _solve(name: str, design: CoDesign, options: SearchOptions, shop, method: str, out: Path) -> tuple[dict[str, Any], bool]:
    """A configuration, its published springs, and its starred design; writes their motions."""
    began = time.perf_counter()
    result = _search(name, design, options)
    found = {name: _describe(name, result, out, options, began)}
    if shop is not None and design.springs and not result.interrupted:
        began, starred = time.perf_counter(), f"{name}*"
        bought = _buy(starred, design, result, shop, options, method)
        held = SearchResult(bought.design, (bought.optimum,), result.starts, False)
        found[starred] = _describe(starred, held, out, options, began)
        gap = bought.optimum.solution.cost / result.best.solution.cost - 1
        found[starred]["catalogue"] = plain(asdict(bought.coverage) | {"gap": gap, "runners_up": bought.runners_up})
        found[starred].pop("optima")
        found[starred].pop("layers")
    return found, result.interrupted


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


def _buy(name: str, design: CoDesign, result: SearchResult, shop, options: SearchOptions, method: str) -> CatalogueResult:
    with _progress() as progress:
        row = progress.add_task(name, total=None, best="choices solved")
        return search_catalogue(
            design, result.best.solution, shop, options, method, lambda done: progress.update(row, completed=done)
        )


def _progress() -> Progress:
    columns = BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.fields[best]}")
    return Progress(TextColumn("{task.description:12}"), *columns, console=console)


def _describe(name: str, result: SearchResult, out: Path, options: SearchOptions, began: float) -> dict[str, Any]:
    """The entry of a configuration in summary.json; writes its motion to an npz."""
    design, solution = result.design, result.best.solution
    motion = sample_motion(design, solution)
    described = describe(design, motion.metrics()) | {
        "cost": solution.cost,
        "lowest_tool_m": min(float(design.model.tool_height(q)) for q in design.task.full(motion.q).T[::7]),
        "springs": design.hardware(solution.parameters),
        "parameters": design.model.values(solution.parameters),
        "durations": dict(zip(PHASES, solution.durations.tolist(), strict=True)),
        "certificate": asdict(certify(result, result.best)),
        "meshes": result.best.meshes,
        "mujoco": describe_simulation(design, solution, motion),
        "published_springs_E1": _published(name, design, options),
        "optima": [
            {
                "E1": o.solution.cost,
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
    write_npz(out / f"{name}.npz", motion.arrays | {"joints": np.array(design.task.joints)})
    return plain(described | {"wall_s": time.perf_counter() - began})


def _transferred(out: Path, name: str, found: dict[str, Any], design: CoDesign, calibrated: CalibratedModel) -> dict[str, Any]:
    """Metrics of a saved optimum in the calibrated twin."""
    saved = np.load(out / f"{name}.npz")
    motion, theta = SampledMotion(**{key: saved[key] for key in SAVED}), design.model.theta(found["parameters"])
    return plain(describe_transfer(design, motion, theta, calibrated, load_actuators(design.task.joints)))


def _published(name: str, design: CoDesign, options: SearchOptions) -> float | None:
    """The cost of Table 4's springs on this model, motion and durations re-optimised; None where the table has none."""
    springs = published_springs(name)
    task: Task = design.task
    if not springs or not {"joint2", "joint3"} <= set(task.joints):
        return None
    held = CoDesign(task, spring_bounds(task, name.rstrip("*")), design.cost, design.actuators).with_fixed(springs)
    few = replace(options, starts=max(4, options.starts // 4), kept=3, hops=0)
    return solve_multistart(held, few).whole().best.cost


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


run = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    run()

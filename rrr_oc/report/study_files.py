"""The files of a study: its summary as JSON, its report in Markdown and as a page, and its figures."""

import glob
import platform
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc import __version__
from rrr_oc.codesign.design_problem import COST_UNITS, CoDesign
from rrr_oc.codesign.optimum import profiles
from rrr_oc.codesign.springs import configurations, saved_springs
from rrr_oc.codesign.study import Study
from rrr_oc.codesign.task import Task
from rrr_oc.codesign.task_sets.set_study import SetStudy, file_of
from rrr_oc.kept import kept_motion
from rrr_oc.report import set_report
from rrr_oc.report.design_figures import draw_all
from rrr_oc.report.design_report import report
from rrr_oc.report.pages.design_page import write_design_page
from rrr_oc.report.pages.set_page import write_set_page
from rrr_oc.report.set_figures import draw_set
from rrr_oc.storage import new_files, plain, write_csv, write_json, write_text

COSTS = {"load": "load torque²", "motor": "motor torque²", "energy": "electrical energy"}  # in the summary
QUANTITIES = {"load": "E1", "motor": "motor torque²", "energy": "energy"}  # names of the costs in tables and figures
FILES = (
    "summary.json",
    "report.md",
    "report.html",
    "torques.png",
    "landscape.png",
    "trajectory_*.png",
    "arm_*.png",
)  # of a task
SET_FILES = ("summary.json", "report.md", "report.html", "tasks.png", "front.png", "choice.png")  # of a set of tasks
PACKAGES = ("casadi", "pin", "mujoco", "numpy", "scipy", "cma")  # whose versions a result may depend on


def write_study(study: Study, found: Mapping[str, Any], wall_s: float, command: str) -> tuple[dict[str, Any], str]:
    """Write summary.json, report.md, the figures and report.html of the results found, all in one step, in place of those of an
    earlier run; returns the first two's content.

    Args:
        wall_s: How long it took [s].
        command: What makes the study again.
    """
    order = list(configurations())
    names = sorted(found, key=lambda name: (name.endswith("*"), order.index(name.rstrip("*"))))
    cost = study.asked["cost"]
    summary = {
        "preset": study.task.name,
        "cost": cost_in_words(next(iter(study.designs.values()))[0]),
        "quantity": [QUANTITIES[cost], COST_UNITS[cost]],
        "paper": study.published is not None,
        "joints": list(study.task.robot.joints),
        "limits": plain(limits(study.task)),
        "speeds": dict(zip(("start", "release"), study.task.speeds, strict=True)),
        "command": command,
        "seed": study.options.seed,
        "starts": study.options.starts,
        "wall_s": wall_s,
        "versions": _versions(),
        "options": plain(asdict(study.options)),
        "configurations": {name: found[name] for name in names},
    }
    text = report(summary)
    with _new_files(study, FILES, summary, text, {name: kept_motion(study, name) for name in names}) as made:
        draw_all(made, study.task)
        write_design_page(made)
    return summary, text


def write_set_study(study: SetStudy, found: Mapping[str, Any], wall_s: float, command: str) -> tuple[dict[str, Any], str]:
    """As `write_study`, for a set of tasks."""
    tasks, first = study.tasks, study.tasks.tasks[0]
    of_tasks = [
        {"name": task.name, "weight": float(w), "payload_kg": task.payload, "duration_s": task.duration, "limits": limits(task)}
        | {end: dict(zip(task.joints, getattr(task, end), strict=True)) for end in ("start", "release")}
        for task, w in zip(tasks.tasks, tasks.weights, strict=True)
    ]
    summary = {
        "set": tasks.name,
        "tasks": plain(of_tasks),
        "objective": tasks.objective,
        "uncertain": {"payload": tasks.payload, "model": list(tasks.model)},
        "cost": cost_in_words(next(iter(study.designs.values()))[0].first),
        "quantity": [QUANTITIES[study.cost], COST_UNITS[study.cost]],
        "joints": list(first.robot.joints),
        "moving": list(first.joints),
        "command": command,
        "seed": study.options.seed,
        "starts": study.options.starts,
        "wall_s": wall_s,
        "versions": _versions(),
        "options": plain(asdict(study.options)),
        "configurations": dict(found),
    }
    text = set_report.report(summary)
    files = [file_of(name, t) for name in found for t in range(len(tasks.tasks))]
    with _new_files(study, SET_FILES, summary, text, {name: kept_motion(study, name) for name in files}) as made:
        draw_set(made)
        write_set_page(made)
    return summary, text


def cost_in_words(design: CoDesign) -> str:
    """What a study minimises, and of energy how much of the power that flows back is kept."""
    if design.cost != "energy" or design.actuators is None:
        return COSTS[design.cost]
    kept = zip(design.actuators.joints, design.actuators.regeneration, strict=True)
    shares = ", ".join(f"{100 * share:g} % ({joint})" for joint, share in kept)
    return f"{COSTS['energy']}, of power that flows back {shares} kept"


@contextmanager
def _new_files(
    study: Study | SetStudy, names: Sequence[str], summary: dict[str, Any], text: str, motions: Mapping[str, Path]
) -> Iterator[Path]:
    """A folder with the motions, the summary, the report and the profiles of springs, for figures and pages; when the block ends, all
    takes the place of the earlier run's files in the study's folder."""
    task = study.tasks.tasks[0] if isinstance(study, SetStudy) else study.task
    with new_files(study.out, [*names, *_of_configurations()]) as made:
        for name, kept in motions.items():
            shutil.copyfile(kept, made / f"{name}.npz")
        write_json(made / "summary.json", summary)
        write_text(made / "report.md", text)
        for name in summary["configurations"]:
            for label, columns in profiles(task, saved_springs(made / "summary.json", name, task).mounted).items():
                file = f"{name}_{label.replace('[', '_').rstrip(']')}"
                write_csv(made / f"{file}.csv", columns)
                if "outline_x_mm" in columns:
                    write_text(made / f"{file}.dxf", outline_dxf(columns["outline_x_mm"], columns["outline_y_mm"]))
        yield made


def outline_dxf(x: np.ndarray, y: np.ndarray) -> str:
    """A drawing (DXF R12) of a closed polyline through points (K,) [mm], of which the last is the first again."""
    groups: list[tuple[int, Any]] = [(0, "SECTION"), (2, "ENTITIES"), (0, "POLYLINE"), (8, "0"), (66, 1), (70, 1)]
    for point in zip(x[:-1], y[:-1], strict=True):
        groups += [(0, "VERTEX"), (8, "0"), *((code, f"{value:.6f}") for code, value in zip((10, 20), point, strict=True))]
    groups += [(0, "SEQEND"), (0, "ENDSEC"), (0, "EOF")]
    return "".join(f"{code}\n{value}\n" for code, value in groups)


def _of_configurations() -> list[str]:
    """Patterns of the names of motions and profiles."""
    patterns = []
    for name, effects in configurations().items():
        for own in (name, glob.escape(f"{name}*")):
            patterns += [
                f"{own}.npz",
                f"{own}_[0-9]*.npz",
                *(f"{own}_{effect}_*.{kind}" for effect in effects for kind in ("csv", "dxf")),
            ]
    return patterns


def _versions() -> dict[str, str]:
    return {"rrr_oc": __version__, "python": platform.python_version()} | {p: version(p) for p in PACKAGES}


def limits(task: Task) -> dict[str, dict[str, Any]]:
    """Limits of the moving joints by name, in SI units; infinite where there is none."""
    rows = zip(task.joints, task.lower, task.upper, task.speed, task.acceleration, task.torque, strict=True)
    keys = ("range_rad", "speed_rad_per_s", "acceleration_rad_per_s2", "torque_Nm")
    return {joint: dict(zip(keys, ([low, high], *others), strict=True)) for joint, low, high, *others in rows}

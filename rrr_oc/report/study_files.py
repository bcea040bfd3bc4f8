"""The files of a study: its summary as JSON, its report in Markdown and as a page, its motions and its figures."""

import glob
import platform
import shutil
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

import numpy as np
from msgspec.structs import replace

from rrr_oc import __version__
from rrr_oc.codesign.design_file import Configuration, DesignFile, QuantityEntry, TaskAsked, Unsure, data, typed
from rrr_oc.codesign.design_problem import COSTS, CoDesign
from rrr_oc.codesign.optimum import profiles
from rrr_oc.codesign.springs import configurations, saved_springs
from rrr_oc.codesign.study import Study, files_of
from rrr_oc.codesign.task import PHASES, Task
from rrr_oc.kept import kept_motion
from rrr_oc.report.design_figures import ARM, draw_all, read_motions, write_arm
from rrr_oc.report.design_report import report
from rrr_oc.report.pages.design_page import write_design_page
from rrr_oc.storage import new_files, plain, write_csv, write_json, write_text

FIGURES = ("torques", "landscape", "trajectory_*", "arm_*", "tasks", "front", "choice", "cycle_times")
FILES = ("summary.json", "report.md", "report.html", ARM, *(f"{name}.png" for name in FIGURES))
PACKAGES = ("casadi", "pin", "mujoco", "numpy", "scipy", "cma")  # whose versions a result may depend on


def write_study(
    study: Study, found: Mapping[str, Configuration], wall_s: float, command: str, unfinished: tuple[str, ...] = ()
) -> tuple[dict[str, Any], str]:
    """Write summary.json, report.md, the motions, the profiles of springs, the figures and report.html of the results found, all in
    one step, in place of those of an earlier run; returns the first two's content.

    Args:
        wall_s: How long it took [s].
        command: What makes the study again.
        unfinished: What is missing, where the study was ended before.
    """
    content = replace(summary(study, found, wall_s, command), unfinished=unfinished)
    text, task = report(content), study.tasks.first
    with new_files(study.out, [*FILES, *_of_configurations()]) as made:
        for file in (file for name in found for file in files_of(name, len(study.tasks.tasks))):
            shutil.copyfile(kept_motion(study, file), made / f"{file}.npz")
        write_json(made / "summary.json", data(content))
        write_text(made / "report.md", text)
        for name in content.configurations:
            for label, columns in profiles(task, saved_springs(made / "summary.json", name, task).mounted).items():
                file = f"{name}_{label.replace('[', '_').rstrip(']')}"
                write_csv(made / f"{file}.csv", columns)
                if "outline_x_mm" in columns:
                    write_text(made / f"{file}.dxf", outline_dxf(columns["outline_x_mm"], columns["outline_y_mm"]))
        write_arm(made, read_motions(made, content), study.tasks.tasks)
        draw_all(made, content)
        write_design_page(made)
    return data(content), text


def summary(study: Study, found: Mapping[str, Configuration], wall_s: float, command: str) -> DesignFile:
    """The content of summary.json; see `write_study`."""
    order, tasks, first = list(configurations()), study.tasks, study.tasks.first
    names = sorted(found, key=lambda name: (name.endswith("*"), order.index(name.rstrip("*"))))
    cost = COSTS[study.request.cost]
    return DesignFile(
        name=tasks.name,
        tasks=tuple(_asked(task, float(weight)) for task, weight in zip(tasks.tasks, tasks.weights, strict=True)),
        objective=tasks.objective,
        uncertain=Unsure(tasks.payload, tasks.model, study.request.over),
        cost=cost_in_words(next(iter(study.designs.values()))[0].first),
        quantity=QuantityEntry(cost.name, cost.unit),
        paper=study.published is not None,
        joints=first.robot.joints,
        moving=tuple(first.joints),
        command=command,
        seed=study.options.seed,
        starts=study.options.starts,
        wall_s=wall_s,
        versions={"rrr_oc": __version__, "python": platform.python_version()} | {p: version(p) for p in PACKAGES},
        options=plain(asdict(study.options)),
        configurations={name: found[name] for name in names},
    )


def _asked(task: Task, weight: float) -> TaskAsked:
    rows = zip(task.joints, task.lower, task.upper, task.speed, task.acceleration, task.torque, task.jerk, strict=True)
    keys = ("range_rad", "speed_rad_per_s", "acceleration_rad_per_s2", "torque_Nm", "jerk_rad_per_s3")
    asked = {
        "name": task.name,
        "weight": weight,
        "payload_kg": task.payload,
        "duration_s": task.duration,
        "cycle_s": task.cycle,
        "speeds": dict(zip(("start", "release"), task.speeds, strict=True)),
        "spring_limits": task.spring_limits,
        "floor_m": task.around.floor,
        "keep_outs": task.around.keep_outs,
        "link_radius_m": task.around.link_radius,
        "via": [{"phase": PHASES[one.phase], "time_share": one.share} for one in task.via],
        "limits": {joint: dict(zip(keys, ([low, high], *others), strict=True)) for joint, low, high, *others in rows},
    }
    ends = {
        end: dict(zip(task.joints, getattr(task, end), strict=True)) if goal is None else None
        for end, goal in zip(("start", "release"), task.goals, strict=True)
    }
    return typed(asked | ends, TaskAsked)


def cost_in_words(design: CoDesign) -> str:
    """What a study minimises, and of energy how much of the power that flows back is kept."""
    if design.cost != "energy" or design.actuators is None:
        return COSTS[design.cost].words
    kept = zip(design.actuators.joints, design.actuators.regeneration, strict=True)
    shares = ", ".join(f"{100 * share:g} % ({joint})" for joint, share in kept)
    return f"{COSTS['energy'].words}, of power that flows back {shares} kept"


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

"""The page of a co-design study, made from its saved files alone: summary.json, the npz of each motion, and the arm's pictures."""

import base64
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.codesign.design_file import Configuration, DesignFile, LimitsEntry, QuantityEntry
from rrr_oc.codesign.study import files_of
from rrr_oc.effects.words import joint_words
from rrr_oc.report import design_words as say
from rrr_oc.report.design_report import FRONT, sections
from rrr_oc.report.pages.page import Curve, Figure, columns, key, render, thinned
from rrr_oc.schema import read_json
from rrr_oc.storage import write_text

POINTS = (2000, 500)  # of a curve, at most: of one task, and of several, which have many
NEAR = 0.4  # [1] of a curve's range within which a limit is drawn
GOOD = 1.1  # [1] of the cost with springs of its own that a task may have with those of the set to be counted as near
QUANTITIES = {"q": "range_rad", "dq": "speed_rad_per_s", "tau_load": "torque_Nm"}  # rows of an npz with their limits
RELEASE = Curve("release", "{}_span", "limit", "payload released", dash="dot", width=1.5)
SIDES = ("lower", "upper")  # of a limit
LIMITS = tuple(Curve("ends", f"{{}}_{side}", "limit", "limit", dash="dash", width=1.5) for side in SIDES)
Arrays = Mapping[str, np.ndarray]


def write_design_page(folder: Path) -> Path:
    """Write report.html from the files in the folder of a study; nothing is solved. Raises `UserError` where it cannot be written."""
    study = read_json(folder / "summary.json", DesignFile)
    motions: dict[str, list[Arrays]] = {}
    for name in study.configurations:
        motions[name] = [dict(np.load(folder / f"{file}.npz")) for file in files_of(name, len(study.tasks))]
    pictures = {name: folder / f"arm_{name}.png" for name in motions}
    drawn = {name: base64.b64encode(path.read_bytes()).decode() for name, path in pictures.items() if path.is_file()}
    write_text(folder / "report.html", design_page(study, motions, drawn))
    return folder / "report.html"


def design_page(study: DesignFile, motions: Mapping[str, list[Arrays]], pictures: Mapping[str, str]) -> str:
    """The page as HTML.

    Args:
        study: The content of summary.json.
        motions: Arrays of the npz of each task, by configuration.
        pictures: PNG of the arm's motion in base64, of configurations that have one.
    """
    found, single = study.configurations, study.single
    best, by = say.best_of(found) or next(iter(found)), ("configuration", *["task"] * (not single), "joint")
    shown = {
        key(name, *[t] * (not single), j): joint_columns(m, j, study.tasks[t].limits.get(joint), POINTS[not single])
        for name, of_tasks in motions.items()
        for t, m in enumerate(of_tasks)
        for j, joint in enumerate(m["joints"].tolist())
    }
    figures = motion_figures(by, {k: captions_of(c) for k, c in shown.items()})
    tables = {"motion": {k: columns(c) for k, c in shown.items()}}
    for figure, table in _of_costs(study):
        figures.append(figure)
        tables[figure.data] = table
    choices = [("configuration", "Configuration", [(name, name) for name in found], best)]
    if not single:
        choices.append(("task", "Task", [(str(t), task.name) for t, task in enumerate(study.tasks)], "0"))
    choices.append(("joint", "Joint", [(str(j), joint_words(joint)) for j, joint in enumerate(study.moving)], "0"))
    return render(
        "design.html",
        figures,
        tables,
        study=study,
        best=best,
        title=say.title(study),
        minimised=say.minimised(study),
        kinds=say.kinds_of_springs(found),
        verdict=say.verdict(study),
        cautions=say.cautions(study),
        sections=sections(study),
        choices=choices,
        pictures=pictures,
    )


def _of_costs(study: DesignFile) -> list[tuple[Figure, dict[str, dict[str, list[Any]]]]]:
    """The figures of costs that a study has, each with its data by configuration."""
    found, made = study.configurations, []
    if not study.single:
        made.append((_tasks(study), {name: _costs(c) for name, c in found.items()}))
    if any(c.choice for c in found.values()):
        made.append((_choice(found, study.quantity), {name: _choices(c) for name, c in found.items()}))
    if any(c.at_cycle_times for c in found.values()):
        made.append((_cycle_times(found, study.quantity), {name: _times(found, name) for name in found}))
    if any(c.front for c in found.values()):
        made.append((_front(found, study.quantity), {name: _points(c) for name, c in found.items()}))
    return made


def _costs(c: Configuration) -> dict[str, list[Any]]:
    rows = {k: np.array([getattr(m, k) for m in c.tasks.values()]) for k in ("cost", "alone", "with_first")}
    return columns(rows | {"task": np.array([escape(task, quote=False) for task in c.tasks])})  # plotly reads markup


def _tasks(study: DesignFile) -> Figure:
    captions = {}
    for name, c in study.configurations.items():
        near = sum(m.cost <= GOOD * m.alone for m in c.tasks.values())
        said = (
            f"With {name} the set's springs need {near} of {len(c.tasks)} tasks within 10 % of what springs of their own need."
        )
        captions[name] = said if c.springs else "Without springs nothing is shared."
    curves = (
        Curve("with_first", "task", "spring", "springs of the first task", "markers", 9),
        Curve("cost", "task", "load", "springs of the set", "markers", 9),
        Curve("alone", "task", "needed", "springs of its own", "markers", 9),
    )
    height = 140 + 26 * len(study.tasks)
    layout = {"height": height, "xaxis": {"type": "log"}, "yaxis": {"autorange": "reversed", "automargin": True}}
    axes = (study.quantity.title, "")
    return Figure("tasks", "The cost of each task", "tasks", ("configuration",), axes, curves, captions, layout)


def _choices(c: Configuration) -> dict[str, list[Any]]:
    rows = [(0, c.cost, c.cost)] if c.choice is None else [(p.count, p.cost, p.priced) for p in c.choice.points]
    return columns(dict(zip(("count", "cost", "priced"), map(np.array, zip(*rows, strict=True)), strict=True)))


def _choice(found: say.Found, quantity: QuantityEntry) -> Figure:
    curves = (
        Curve("count", "cost", "load", "without the price"),
        Curve("count", "cost", "load", "without the price", "markers", 9),
        Curve("count", "priced", "spring", "with the price", dash="dash"),
        Curve("count", "priced", "spring", "with the price", "markers", 7),
    )
    axes = ("number of springs", quantity.title)
    said = "The least cost that was found for each number of springs, without and with their price."
    captions = {name: said if c.choice else "This configuration offers no springs." for name, c in found.items()}
    layout = {"xaxis": {"dtick": 1}, "yaxis": {"type": "log"}}
    return Figure("choice", "The cost for each number", "choice", ("configuration",), axes, curves, captions, layout)


def _times(found: say.Found, name: str) -> dict[str, list[Any]]:
    c, stiff = found[name], found.get("SA")
    rows = {"time": [at.cycle_s for at in c.at_cycle_times], "cost": [at.cost for at in c.at_cycle_times]}
    if c.balancing is not None:
        rows["balancing"] = [at.balancing for at in c.at_cycle_times]
    if stiff is not None and name != "SA" and c.at_cycle_times:
        rows["stiff"] = [at.cost for at in stiff.at_cycle_times]
    return columns({key: np.array(values, float) for key, values in rows.items()})


def _cycle_times(found: say.Found, quantity: QuantityEntry) -> Figure:
    curves = [
        Curve("time", key, role, label, mode, width)
        for key, role, label in (
            ("stiff", "needed", "stiff actuation"),
            ("balancing", "spring", "springs that balance the arm at rest"),
            ("cost", "load", "designed springs"),
        )
        for mode, width in (("lines", 2.0), ("markers", 8))
    ]
    said = "What is needed where both phases together take the same time."
    captions = {name: said if c.at_cycle_times else "This configuration was not compared." for name, c in found.items()}
    axes = ("cycle time [s]", quantity.title)
    layout = {"yaxis": {"type": "log"}}
    return Figure(
        "cycle_times", "The cost over the cycle time", "cycle_times", ("configuration",), axes, tuple(curves), captions, layout
    )


def _points(c: Configuration) -> dict[str, list[Any]]:
    rows = [(p.first, p.total) for p in c.front] or [(c.first.cost, c.cost)]
    return columns(dict(zip(("first", "total"), map(np.array, zip(*rows, strict=True)), strict=True)))


def _front(found: say.Found, quantity: QuantityEntry) -> Figure:
    curves = (Curve("first", "total", "load", ""), Curve("first", "total", "load", "", "markers", 9))
    axes = (f"{quantity.title} of the first task", f"{quantity.title} of the set")
    captions = {name: FRONT if c.front else "Without springs there is nothing in between." for name, c in found.items()}
    layout = {"showlegend": False}
    return Figure("front", "The set against its first task", "front", ("configuration",), axes, curves, captions, layout)


def joint_columns(m: Arrays, j: int, limits: LimitsEntry | None, points: int) -> dict[str, np.ndarray]:
    """What the figures of one joint show, in degrees and Nm; the two phases meet at the instant of "release".

    Args:
        m: Arrays of a motion's npz.
        j: Row of the joint.
        limits: The joint's.
        points: Of a curve, at most.
    """
    rows = {"t": m["t"], "q": np.degrees(m["q"][j]), "dq": np.degrees(m["dq"][j])}
    rows |= {"tau_load": m["tau_load"][j], "tau_spring": m["tau_spring"][j], "needed": m["tau_load"][j] + m["tau_spring"][j]}
    every = np.array(list(rows.values()))
    shown = dict(zip(rows, every[:, thinned(every, points, range(1, len(rows)))], strict=True))
    released = float(m["t"][m["phase"] == 0][-1])
    shown |= {"release": np.array([released, released]), "ends": m["t"][[0, -1]]}
    if not m["tau_spring"].any():  # without springs there is nothing to tell apart
        del shown["tau_spring"], shown["needed"]
    for name, of in QUANTITIES.items():
        values = [shown[n] for n in (name, "needed") if n in shown and (n == name or name == "tau_load")]
        low, high = float(np.min(values)), float(np.max(values))
        shown[f"{name}_span"] = np.array([low, high])
        bound, unit = limits and getattr(limits, of), 1.0 if name == "tau_load" else 180 / np.pi
        both = bound if isinstance(bound, tuple) else [None, None] if bound is None else [-bound, bound]
        for side, value in zip(SIDES, both, strict=True):
            if value is not None and low - NEAR * (high - low) <= value * unit <= high + NEAR * (high - low):
                shown[f"{name}_{side}"] = np.full(2, value * unit)
    return shown


def motion_figures(by: tuple[str, ...], captions: Mapping[str, Mapping[str, str]]) -> list[Figure]:
    """The figures of one joint; the data "motion" has its columns by the choices `by`, and `captions` what `captions_of` says."""

    def over_time(name: str, title: str, axis: str, row: str, *curves: Curve) -> Figure:
        marks = (RELEASE, *LIMITS)
        around = tuple(Curve(c.x, c.y.format(row), c.role, c.name, width=c.width, dash=c.dash) for c in marks)
        own = {k: c[name] for k, c in captions.items()}
        return Figure(name, title, "motion", by, ("time [s]", axis), (*curves, *around), own)

    return [
        over_time("angle", "Angle", "angle [°]", "q", Curve("t", "q", "load", "angle")),
        over_time("speed", "Speed", "speed [°/s]", "dq", Curve("t", "dq", "load", "speed")),
        over_time(
            "torque", "Load torque with and without the springs", "torque [Nm]", "tau_load",
            Curve("t", "needed", "needed", "without the springs, same motion"),
            Curve("t", "tau_spring", "spring", "springs"),
            Curve("t", "tau_load", "load", "load torque", width=2.5),
        ),
        Figure(
            "spring", "Torque of the springs over the angle", "motion", by, ("angle [°]", "torque [Nm]"),
            (
                Curve("q", "needed", "needed", "needed for the motion"),
                Curve("q", "tau_spring", "spring", "springs", width=2.5),
                Curve("q", "tau_load", "load", "load torque", width=1.2),
            ),
            {k: c["spring"] for k, c in captions.items()},
        ),
    ]  # fmt: skip


def captions_of(c: Arrays) -> dict[str, str]:
    """What to see in each figure of one joint."""
    t, load, fastest = c["t"], c["tau_load"], float(np.max(np.abs(c["dq"])))
    touched = any(f"dq_{side}" in c and fastest > 0.99 * abs(c[f"dq_{side}"][0]) for side in SIDES)
    said = {
        "angle": f"The joint moves from {c['q'][0]:.0f}° to {c['q'][np.searchsorted(t, c['release'][0])]:.0f}° in {c['release'][0]:.2f} s "
        f"with the payload and returns in {t[-1] - c['release'][0]:.2f} s without it, between {c['q'].min():.0f}° and {c['q'].max():.0f}°.",
        "speed": f"The joint turns with up to {fastest:.0f} °/s{', its limit' if touched else ''}, and rests at both ends of each phase.",
    }
    if "tau_spring" not in c:
        alone = f"No spring acts on this joint: its drive gives the whole torque, {_size(t, load)}."
        loop = "A spring would have to give the torque that this loop shows; where the loop is narrow, one spring can."
        return said | {"torque": alone, "spring": loop}
    needed, spring = c["needed"], c["tau_spring"]
    return said | {
        "torque": f"The same motion without the springs needs {_size(t, needed)}; with them the drive gives {_size(t, load)}.",
        "spring": f"The springs give {spring.min():.1f} to {spring.max():.1f} Nm; the drive gives only what is left between them and the "
        "torque that the motion needs.",
    }


def _size(t: np.ndarray, tau: np.ndarray) -> str:
    rms = np.sqrt(np.trapezoid(tau**2, t) / np.ptp(t))
    return f"{rms:.1f} Nm rms and {np.abs(tau).max():.1f} Nm at most"

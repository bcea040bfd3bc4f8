"""The page of a study of a set of tasks, made from its saved files alone: summary.json and one npz a configuration and task."""

import json
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.codesign.task_sets.set_study import file_of
from rrr_oc.effects.words import joint_words
from rrr_oc.report import set_report as tell
from rrr_oc.report.design_report import Quantity
from rrr_oc.report.pages import design_words as say
from rrr_oc.report.pages.design_page import captions_of, figures_of, joint_columns
from rrr_oc.report.pages.page import Curve, Figure, columns, key, render
from rrr_oc.storage import write_text

POINTS = 500  # of a curve, at most; a set has many
BY = ("configuration", "task", "joint")


def write_set_page(folder: Path) -> Path:
    """Write report.html from the files in the folder of a study; nothing is solved. Raises `UserError` where it cannot be written."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    data = {}
    for name in summary["configurations"]:
        for t, task in enumerate(summary["tasks"]):
            with np.load(folder / f"{file_of(name, t)}.npz") as file:
                motion = {n: file[n] for n in file.files}
            for j, joint in enumerate(motion["joints"].tolist()):
                data[key(name, t, j)] = joint_columns(motion, j, task["limits"].get(joint, {}), POINTS)
    write_text(folder / "report.html", set_page(summary, data))
    return folder / "report.html"


def set_page(summary: Mapping[str, Any], data: Mapping[str, Mapping[str, np.ndarray]]) -> str:
    """The page as HTML, from the content of summary.json and the columns of each configuration, task and joint."""
    content, found, quantity = dict(summary), summary["configurations"], Quantity(*summary["quantity"])
    best = best_of(found)
    figures = [_tasks(summary, quantity), *figures_of(BY, {k: captions_of(c) for k, c in data.items()})]
    choices = any(c["choice"] for c in found.values())
    fronts = any(c["front"] for c in found.values())
    tables = {"motion": {k: columns(c) for k, c in data.items()}, "tasks": {n: _costs(summary, n) for n in found}}
    tables["choice"] = {name: _choices(c) for name, c in found.items()}
    tables["front"] = {name: _points(c) for name, c in found.items()}
    return render(
        "set.html",
        [*figures, *([_choice(found, quantity)] if choices else []), *([_front(found, quantity)] if fronts else [])],
        tables,
        summary=summary,
        quantity=quantity,
        best=best,
        verdict=verdict(summary),
        kinds=say.kinds_of_springs(found),
        minimised=tell.minimised(content),
        cautions=tell.cautions(content),
        configurations=[(name, name) for name in found],
        tasks=[(str(t), task["name"]) for t, task in enumerate(summary["tasks"])],
        joints=[(str(j), joint_words(joint)) for j, joint in enumerate(summary["moving"])],
        totals=tell.totals_table(content),
        words=tell.WORDS,
        of_tasks={name: tell.tasks_table(content, name) for name in found},
        springs=tell.springs_table(content),
        symbols=say.symbols(found),
        choices={
            name: (tell.choice_sentence(c, quantity), tell.choice_table(c, quantity))
            for name, c in found.items()
            if c["choice"]
        },
        fronts={name: tell.front_table(c, quantity) for name, c in found.items() if c["front"]},
        scenarios={name: tell.scenarios_table(content, name) for name in found if _robust(summary)},
        certificates={name: (tell.set_sentences(content, name), tell.certificates_table(c)) for name, c in found.items()},
    )


def best_of(found: Mapping[str, Any]) -> str:
    """The configuration of least objective."""
    return min(found, key=lambda name: found[name]["cost"])


def verdict(summary: Mapping[str, Any]) -> str:
    """Which springs are best for the set, what sharing them costs, and what the first task's would cost."""
    found, quantity = summary["configurations"], Quantity(*summary["quantity"])
    best = best_of(found)
    c, stiff = found[best], found.get("SA")
    what = "in the worst task" if summary["objective"] == "worst" else "for all tasks together"
    said = f"{best} is best: {quantity.name} is {c['cost']:.4g} {quantity.unit} {what}"
    if stiff is not None and best != "SA":
        said += f", {100 * (1 - c['cost'] / stiff['cost']):.1f} % less than the {stiff['cost']:.4g} {quantity.unit} of stiff actuation"
    if not c["springs"]:
        return f"{said}."
    said += f". Springs of its own for each task would need {100 * (1 - c['alone'] / c['cost']):.1f} % less"
    said += f"; the springs of “{summary['tasks'][0]['name']}” need {100 * (c['with_first'] / c['cost'] - 1):.1f} % more. "
    return said + f"To be made: {say.hardware(c, summary['joints'])}."


def _robust(summary: Mapping[str, Any]) -> bool:
    return bool(summary["uncertain"]["payload"] or summary["uncertain"]["model"])


def _costs(summary: Mapping[str, Any], name: str) -> dict[str, list[Any]]:
    tasks = summary["configurations"][name]["tasks"]
    rows = {k: np.array([c[k] for c in tasks.values()]) for k in ("cost", "alone", "with_first")}
    return columns(rows | {"task": np.array([escape(task, quote=False) for task in tasks])})  # plotly reads markup


def _tasks(summary: Mapping[str, Any], quantity: Quantity) -> Figure:
    captions = {
        name: f"With {name} the set's springs need {len(_near(c))} of {len(c['tasks'])} tasks within 10 % of what springs of their own need."
        if c["springs"]
        else "Without springs nothing is shared."
        for name, c in summary["configurations"].items()
    }
    curves = (
        Curve("with_first", "task", "spring", "springs of the first task", "markers", 9),
        Curve("cost", "task", "load", "springs of the set", "markers", 9),
        Curve("alone", "task", "needed", "springs of its own", "markers", 9),
    )
    height = 140 + 26 * len(summary["tasks"])
    layout = {"height": height, "xaxis": {"type": "log"}, "yaxis": {"autorange": "reversed", "automargin": True}}
    return Figure("tasks", "The cost of each task", "tasks", BY[:1], (quantity.title, ""), curves, captions, layout)


def _near(c: Mapping[str, Any]) -> list[str]:
    return [task for task, found in c["tasks"].items() if found["cost"] <= 1.1 * found["alone"]]


def _choices(c: Mapping[str, Any]) -> dict[str, list[Any]]:
    points = c["choice"]["points"] if c["choice"] else [{"count": 0, "cost": c["cost"], "priced": c["cost"]}]
    return columns({k: np.array([p[k] for p in points]) for k in ("count", "cost", "priced")})


def _choice(found: Mapping[str, Any], quantity: Quantity) -> Figure:
    curves = (
        Curve("count", "cost", "load", "without the price"),
        Curve("count", "cost", "load", "without the price", "markers", 9),
        Curve("count", "priced", "spring", "with the price", dash="dash"),
        Curve("count", "priced", "spring", "with the price", "markers", 7),
    )
    axes = ("number of springs", f"{quantity.title} of the set")
    captions = {
        name: "The least cost that was found for each number of springs, without and with their price."
        if c["choice"]
        else "This configuration offers no springs."
        for name, c in found.items()
    }
    layout = {"xaxis": {"dtick": 1}, "yaxis": {"type": "log"}}
    return Figure("choice", "Which springs are worth their price", "choice", BY[:1], axes, curves, captions, layout)


def _points(c: Mapping[str, Any]) -> dict[str, list[Any]]:
    own = {"first": next(iter(c["tasks"].values()))["cost"], "total": c["cost"]}
    return columns({k: np.array([p[k] for p in c["front"] or [own]]) for k in own})


def _front(found: Mapping[str, Any], quantity: Quantity) -> Figure:
    curves = (Curve("first", "total", "load", ""), Curve("first", "total", "load", "", "markers", 9))
    axes = (f"{quantity.title} of the first task", f"{quantity.title} of the set")
    captions = {name: tell.FRONT if c["front"] else "Without springs there is nothing in between." for name, c in found.items()}
    return Figure("front", "Between the set and its first task", "front", BY[:1], axes, curves, captions, {"showlegend": False})

"""The figures of a co-design study, made from its saved files alone: once as data, drawn into files and on the page."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.codesign.design_file import Configuration, DesignFile, LimitsEntry
from rrr_oc.codesign.study import files_of
from rrr_oc.codesign.task import PHASES, Task
from rrr_oc.effects.words import joint_words
from rrr_oc.report.design_report import FRONT
from rrr_oc.report.figures import Columns, Curve, Figure, Panel, draw, key, save_figure, thinned
from rrr_oc.report.moving.scene import chain
from rrr_oc.storage import read_npz, write_npz

POINTS = (2000, 500)  # of a curve, at most: of one task, and of several, which have many
FRAMES = 60  # pictures of a motion of the arm
NEAR = 0.4  # [1] of a curve's range within which a limit is drawn
GOOD = 1.1  # [1] of the cost with springs of its own that a task may have with those of the set to be counted as near
ONE_JOINT = ("k_p", "k_v", "k_t")  # stiffnesses of springs across one joint
ARM = "arm.npz"  # points of the arm in each picture of each motion, (FRAMES, n + 2, 2) [m]
# Rows of an npz with the unit in which they are shown, and their limits
QUANTITIES = {
    "q": (180 / np.pi, "range_rad"),
    "dq": (180 / np.pi, "speed_rad_per_s"),
    "ddq": (180 / np.pi, "acceleration_rad_per_s2"),
    "tau_load": (1.0, "torque_Nm"),
}
TWISTED = ("q", "dq", "ddq")  # in which drives and links may differ
SIDES = ("lower", "upper")  # of a limit
Arrays = Mapping[str, np.ndarray]
Motions = Mapping[str, Sequence[Arrays]]  # arrays of the npz of each task, by configuration


def read_motions(folder: Path, study: DesignFile) -> Motions:
    """The motions of a study."""
    count = len(study.tasks)
    return {name: [read_npz(folder / f"{file}.npz") for file in files_of(name, count)] for name in study.configurations}


def write_arm(folder: Path, motions: Motions, tasks: Sequence[Task]) -> None:
    """Write the points of the arm in its plane x–z, base first and tool last, at equal times of each motion."""
    points = {}
    for name, of_tasks in motions.items():
        for t, (m, task) in enumerate(zip(of_tasks, tasks, strict=True)):
            at = np.linspace(m["t"][0], m["t"][-1], FRAMES)
            angles = task.full(np.array([np.interp(at, m["t"], row) for row in m["q"]]))
            points[key(name, t)] = np.array([chain(task.robot, task.tool, q)[:, [0, 2]] for q in angles.T])
    write_npz(folder / ARM, points)


def draw_all(folder: Path, study: DesignFile) -> list[Path]:
    """Every figure of a run's folder; returns their paths."""
    motions = read_motions(folder, study)
    figures = {f.name: f for f in design_figures(study, motions, read_npz(folder / ARM))}
    drawn: dict[str, Any] = {
        name: draw([[Panel(figures[name], one, one) for one in figures[name].data]], (4.4, 3.6), share=figures[name].names)
        for name in ("tasks", "front", "choice", "cycle_times")
        if name in figures
    }
    if study.single:
        found, joints = study.configurations, range(len(study.moving))
        drawn["torques"] = draw_torques(study, motions)
        starts = [figures[f"starts_{phase}"] for phase in PHASES if f"starts_{phase}" in figures]
        if starts:
            drawn["landscape"] = draw([[Panel(f, name, name) for name in f.data] for f in starts], (3.4, 3.0))
        for name in found:
            over = [[Panel(figures[f], key(name, j), f"{name}: {study.moving[j]}") for j in joints] for f in OVER_TIME]
            drawn[f"trajectory_{name}"] = draw(over, (5.5, 2.3))
            drawn[f"arm_{name}"] = draw([[Panel(figures["arm"], name, name)]], (7.0, 5.0))
    return [save_figure(figure, folder / f"{name}.png") for name, figure in drawn.items()]


def draw_torques(study: DesignFile, motions: Motions) -> Any:
    """Load and spring torque of each moving joint over time, side by side for the configurations of one task."""
    figures = {f.name: f for f in design_figures(study, motions)}
    quantity, every = study.quantity, study.configurations.items()
    head = {name: f"{name}: {quantity.name} = {c.cost:.4g} {quantity.unit}" for name, c in every}
    rows = [
        [Panel(figures["torque"], key(name, j), f"{head[name]}, {joint_words(joint)}") for name in head]
        for j, joint in enumerate(study.moving)
    ]
    return draw(rows, (4.6, 2.6), share=True)


def design_figures(study: DesignFile, motions: Motions, arm: Arrays | None = None) -> list[Figure]:
    """The figures of a study.

    Args:
        arm: Content of `ARM`; without it the arm is not shown.
    """
    by = ("configuration", *["task"] * (not study.single))
    shown = {
        key(name, *[t] * (not study.single), j): joint_columns(m, j, study.tasks[t].limits.get(joint), POINTS[not study.single])
        for name, of_tasks in motions.items()
        for t, m in enumerate(of_tasks)
        for j, joint in enumerate(m["joints"].tolist())
    }
    figures = _over_time((*by, "joint"), shown)
    if arm:
        figures.append(_arm(study, motions, arm, by))
    return [*figures, *_of_costs(study)]


def joint_columns(m: Arrays, j: int, limits: LimitsEntry | None, points: int) -> dict[str, np.ndarray]:
    """What the figures of one joint show, in degrees and Nm; the two phases meet at the instant of "release".

    Args:
        m: Arrays of a motion's npz.
        j: Row of the joint.
        limits: The joint's.
        points: Of a curve, at most.
    """
    rows = {"t": m["t"]} | {name: unit * m[name][j] for name, (unit, _) in QUANTITIES.items()}
    if m["tau_spring"][j].any():  # without springs there is nothing to tell apart
        rows |= {"tau_spring": m["tau_spring"][j], "needed": m["tau_load"][j] + m["tau_spring"][j]}
    if m["twist"][:, j].any():
        rows |= {f"{name}_drive": rows[name] - QUANTITIES[name][0] * m["twist"][i, j] for i, name in enumerate(TWISTED)}
    every = np.array(list(rows.values()))
    shown = dict(zip(rows, every[:, thinned(every, points, range(1, len(rows)))], strict=True))
    released = float(m["t"][m["phase"] == 0][-1])
    shown |= {"release": np.array([released, released]), "ends": m["t"][[0, -1]]}
    for name, (unit, of) in QUANTITIES.items():
        values = [shown[n] for n in (name, f"{name}_drive", *["needed"] * (name == "tau_load")) if n in shown]
        low, high = float(min(map(np.min, values))), float(max(map(np.max, values)))
        shown[f"{name}_span"] = np.array([low, high])
        bound = limits and getattr(limits, of)
        both = bound if isinstance(bound, tuple) else [None, None] if bound is None else [-bound, bound]
        for side, value in zip(SIDES, both, strict=True):
            if value is not None and low - NEAR * (high - low) <= value * unit <= high + NEAR * (high - low):
                shown[f"{name}_{side}"] = np.full(2, value * unit)
    return shown


OVER_TIME = ("angle", "speed", "acceleration", "torque")  # figures of a joint


def _over_time(by: tuple[str, ...], shown: Mapping[str, Arrays]) -> list[Figure]:
    """The figures of one joint, from `joint_columns` by key."""
    captions = {k: captions_of(c) for k, c in shown.items()}

    def figure(name: str, title: str, axes: tuple[str, str], curves: Sequence[Curve], row: str = "") -> Figure:
        around = [Curve("release", f"{row}_span", "limit", "payload released", dash="dot", width=1.5)]
        around += [Curve("ends", f"{row}_{side}", "limit", "limit", dash="dash", width=1.5) for side in SIDES]
        own = {k: said[name] for k, said in captions.items()}
        return Figure(name, title, axes, (*curves, *around * bool(row)), shown, "motion", own, by)

    def moved(row: str, words: str) -> list[Curve]:
        return [Curve("t", row, "load", words), Curve("t", f"{row}_drive", "ink", "drive", width=1)]

    torques = [
        Curve("t", "needed", "needed", "without the springs, same motion"),
        Curve("t", "tau_spring", "spring", "springs"),
        Curve("t", "tau_load", "load", "load torque", width=2.5),
    ]
    loop = [
        Curve("q", "needed", "needed", "needed for the motion"),
        Curve("q", "tau_spring", "spring", "springs", width=2.5),
        Curve("q", "tau_load", "load", "load torque", width=1.2),
    ]
    return [
        figure("angle", "Angle", ("time [s]", "angle [°]"), moved("q", "angle"), "q"),
        figure("speed", "Speed", ("time [s]", "speed [°/s]"), moved("dq", "speed"), "dq"),
        figure("acceleration", "Acceleration", ("time [s]", "acceleration [°/s²]"), moved("ddq", "acceleration"), "ddq"),
        figure("torque", "Load torque with and without the springs", ("time [s]", "torque [Nm]"), torques, "tau_load"),
        figure("spring", "Torque of the springs over the angle", ("angle [°]", "torque [Nm]"), loop),
    ]


def captions_of(c: Arrays) -> dict[str, str]:
    """What to see in each figure of one joint."""
    t, load, turn = c["t"], c["tau_load"], c["release"][0]
    said = {
        "angle": f"The joint moves from {c['q'][0]:.0f}° to {c['q'][np.searchsorted(t, turn)]:.0f}° in {turn:.2f} s with the payload and "
        f"returns in {t[-1] - turn:.2f} s without it, between {c['q'].min():.0f}° and {c['q'].max():.0f}°.",
        "speed": f"The joint turns with up to {_most(c, 'dq')} °/s{_its_limit(c, 'dq')}, and rests at both ends of each phase.",
        "acceleration": f"It reaches {_most(c, 'ddq')} °/s²{_its_limit(c, 'ddq')}.",
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


def _most(c: Arrays, row: str) -> str:
    return f"{np.max(np.abs(c[row])):.0f}"


def _its_limit(c: Arrays, row: str) -> str:
    touched = any(np.max(np.abs(c[row])) > 0.99 * abs(c[f"{row}_{side}"][0]) for side in SIDES if f"{row}_{side}" in c)
    return ", its limit" * touched


def _size(t: np.ndarray, tau: np.ndarray) -> str:
    rms = np.sqrt(np.trapezoid(tau**2, t) / np.ptp(t))
    return f"{rms:.1f} Nm rms and {np.abs(tau).max():.1f} Nm at most"


def _arm(study: DesignFile, motions: Motions, arm: Arrays, by: tuple[str, ...]) -> Figure:
    """The arm in its plane, moving: its links, the joints with springs, the payload, and the path of the tool."""
    data = {}
    for name, of_tasks in motions.items():
        springs = study.configurations[name].springs
        sprung = [j for j in range(1, len(study.joints) + 1) if any(f"{symbol}{j}" in springs for symbol in ONE_JOINT)]
        first = [study.joints.index(joint) for joint in study.moving][:2]
        cable = [0, *(j + 1 for j in first)] if "k_b" in springs else []
        for t, m in enumerate(of_tasks):
            points, at = arm[key(name, t)], np.linspace(m["t"][0], m["t"][-1], FRAMES)
            carried = np.where(at[:, None, None] <= m["t"][m["phase"] == 0][-1], points[:, -1:], np.nan)
            shown = {"arm": points, "spring": points[:, sprung], "cable": points[:, cable], "load": carried}
            columns = {f"{k}_{'xz'[i]}": p[:, :, i].ravel() for k, p in shown.items() if p.size for i in range(2)}
            path = {f"path_{'xz'[i]}": points[:, -1, i] for i in range(2)}
            data[key(name, *[t] * (not study.single))] = columns | path | {"seconds": np.array([np.ptp(m["t"])])}
    said = "The arm moves as fast as it would, with the payload and back without it."
    captions = {k: f"{said} {'Rings: joints with a spring.' if 'spring_x' in c else ''}".strip() for k, c in data.items()}
    curves = (
        Curve("path_x", "path_z", "needed", "path of the tool", width=1.2, dash="dot"),
        Curve("arm_x", "arm_z", "load", "arm", "lines+markers", 5, moves=True),
        Curve("cable_x", "cable_z", "spring", "cable across two joints", dash="dash", moves=True),
        Curve("spring_x", "spring_z", "spring", "spring", "markers", 20, hollow=True, moves=True),
        Curve("load_x", "load_z", "ink", "payload", "markers", 14, moves=True),
    )
    return Figure(
        "arm", "The arm and its springs", ("x [m]", "z [m]"), curves, data, "arm", captions, by, equal=True, height=400
    )


def _of_costs(study: DesignFile) -> Iterator[Figure]:
    """The figures of costs, by configuration; those that no configuration has anything for are left out."""
    quantity, stiff, count = study.quantity.title, study.configurations.get("SA"), len(study.tasks)

    def figure(own: Figure, columns: Callable[[Configuration], Columns], said: str, without: str) -> Iterator[Figure]:
        data = {name: shown for name, c in study.configurations.items() if (shown := columns(c))}
        near = {name: sum(m.cost <= GOOD * m.alone for m in c.tasks.values()) for name, c in study.configurations.items()}
        words = {name: said.format(name=name, near=near[name], count=count) if name in data else without for name in near}
        if data:
            yield replace(own, data=data, captions=words, by=("configuration",), table=own.name)

    if not study.single:
        said = "With {name} the set's springs need {near} of {count} tasks within 10 % of what springs of their own need."
        marks = (
            Curve("with_first", "task", "spring", "springs of the first task", "markers", 9, symbol="square"),
            Curve("cost", "task", "load", "springs of the set", "markers", 9),
            Curve("alone", "task", "needed", "springs of its own", "markers", 9, symbol="diamond", hollow=True),
        )
        own = Figure("tasks", "The cost of each task", (quantity, ""), marks, log="x", names=True, height=140 + 26 * count)
        yield from figure(own, _tasks, said, "Without springs nothing is shared.")
    lines = (
        *_marked("count", "cost", "load", "without the price"),
        *_marked("count", "priced", "spring", "with the price", "dash"),
        Curve("chosen_count", "chosen", "spring", "chosen", "markers", 18, hollow=True),
    )
    own = Figure("choice", "The cost for each number", ("number of springs", quantity), lines, log="y", counts=True)
    said = "The least cost that was found for each number of springs, without and with their price."
    yield from figure(own, _choice, said, "This configuration offers no springs.")
    lines = (
        *_marked("time", "stiff", "needed", "stiff actuation"),
        *_marked("time", "balancing", "spring", "springs that balance the arm at rest", hollow=True),
        *_marked("time", "cost", "load", "designed springs"),
        Curve("own_time", "own", "load", "where the cycle time is free", "markers", 15, symbol="star"),
    )
    own = Figure("cycle_times", "The cost over the cycle time", ("cycle time [s]", quantity), lines, log="y")
    said = "What is needed where both phases together take the same time."
    yield from figure(own, lambda c: _cycle_times(c, stiff), said, "This configuration was not compared.")
    axes, points = (f"{quantity} of the first task", f"{quantity} of the set"), _marked("first", "total", "load", text="share")
    said = f"{FRONT} Beside the points: the share of the objective that is the first task's alone."
    own = Figure("front", "The set against its first task", axes, points)
    yield from figure(own, _front, said, "Without springs there is nothing in between.")
    said = "Each point is a local optimum; beside it stands how many starts ended there."
    for phase in PHASES if study.single else ():
        own = Figure(f"starts_{phase}", f"Where starts ended: {phase}", (f"duration of {phase} [s]", quantity), STARTS)
        yield from figure(own, lambda c, phase=phase: _starts(c, phase), said, "Its optima are not kept.")


def _marked(x: str, y: str, role: str, words: str = "", dash: str = "solid", **more: Any) -> tuple[Curve, Curve]:
    """A line, and markers at its points."""
    return Curve(x, y, role, words, dash=dash), Curve(x, y, role, words, "markers", 8, **more)


def _rows(names: Sequence[str], rows: Iterable[Sequence[Any]]) -> Columns:
    """Columns of rows; none without rows."""
    return dict(zip(names, map(list, zip(*rows, strict=True)), strict=False))


def _tasks(c: Configuration) -> Columns:
    rows = [(name, m.cost, m.alone, m.with_first) for name, m in c.tasks.items()] if c.springs else ()
    return _rows(("task", "cost", "alone", "with_first"), rows)


def _choice(c: Configuration) -> Columns:
    if c.choice is None:
        return {}
    best = c.choice.points[c.choice.chosen]
    rows = _rows(("count", "cost", "priced"), [(p.count, p.cost, p.priced) for p in c.choice.points])
    return {**rows, "chosen_count": [best.count], "chosen": [best.priced]}


def _cycle_times(c: Configuration, stiff: Configuration | None) -> Columns:
    if not c.at_cycle_times:
        return {}
    shown = {"time": [at.cycle_s for at in c.at_cycle_times], "cost": [at.cost for at in c.at_cycle_times]}
    shown |= {"own_time": [sum(c.first.durations.values())], "own": [c.cost]}
    if c.balancing is not None:
        shown["balancing"] = [at.balancing for at in c.at_cycle_times]
    if stiff is not None and c is not stiff:
        shown["stiff"] = [at.cost for at in stiff.at_cycle_times]
    return {name: np.array(values, float) for name, values in shown.items()}


def _front(c: Configuration) -> Columns:
    return _rows(("first", "total", "share"), [(p.first, p.total, f"{p.share:.2g}") for p in c.front])


STARTS = tuple(
    Curve(f"{kind}_s", kind, "load", words, "markers", 10, hollow=kind == "open", text=f"{kind}_reached")
    for kind, words in (("refined", "refined to the mesh tolerance"), ("open", "on the first fine mesh"))
)


def _starts(c: Configuration, phase: str) -> Columns:
    """Where starts ended: the cost over the duration of a phase."""
    shown: dict[str, Any] = {}
    for kind in ("refined", "open"):
        own = [(o.durations[phase], o.cost, str(o.reached)) for o in c.optima if o.refined == (kind == "refined")]
        shown |= _rows((f"{kind}_s", kind, f"{kind}_reached"), own)
    return shown

"""The figures of a co-design study, made from its saved files alone."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import LogFormatter

from rrr_oc.codesign.design_file import DesignFile
from rrr_oc.codesign.task import PHASES, Task
from rrr_oc.report.figures import COLOURS, FOOTER, plt, save_figure
from rrr_oc.report.tables import spring_unit
from rrr_oc.robot.rigid_body import rigid_body
from rrr_oc.schema import read_json

ONE_JOINT = ("k_p", "k_v", "k_t")  # stiffnesses of springs across one joint
ORDERS = ("q", "dq", "ddq")  # of which drives and links differ where a spring stands between them
MARKS = {
    "with_first": ("s", "springs of the first task"),
    "cost": ("o", "springs of the set"),
    "alone": ("D", "springs of its own"),
}


def draw_all(folder: Path, tasks: Sequence[Task]) -> list[Path]:
    """Every figure of a run's folder; returns their paths."""
    study = read_json(folder / "summary.json", DesignFile)
    found, drawn = study.configurations, {}
    if study.single:
        motions = {name: dict(np.load(folder / f"{name}.npz")) for name in found}
        drawn |= {"torques": draw_torques(study, motions), "landscape": draw_landscape(study)}
        for name, motion in motions.items():
            drawn[f"trajectory_{name}"] = draw_trajectory(name, motion, tasks[0])
            drawn[f"arm_{name}"] = draw_arm(name, motion, tasks[0], found[name].springs)
    else:
        drawn["tasks"] = draw_tasks(study)
    if any(c.front for c in found.values()):
        drawn["front"] = draw_front(study)
    if any(c.at_cycle_times for c in found.values()):
        drawn["cycle_times"] = draw_cycle_times(study)
    if any(c.choice for c in found.values()):
        drawn["choice"] = draw_choice(study)
    return [save_figure(figure, folder / f"{name}.png") for name, figure in drawn.items()]


def draw_torques(study: DesignFile, motions: dict[str, dict]) -> Any:
    """Load and spring torque over time, summed over the moving joints, both phases (as Figure 5)."""
    rows, quantity = (len(motions) + 1) // 2, study.quantity
    figure, axes = plt.subplots(rows, min(2, len(motions)), figsize=(12, 3.2 * rows), squeeze=False, sharey=True)
    for axis, (name, m) in zip(axes.ravel(), motions.items(), strict=False):
        load, spring = m["tau_load"].sum(axis=0), m["tau_spring"].sum(axis=0)
        for i in range(len(PHASES)):
            k = m["phase"] == i
            axis.plot(m["t"][k], (load + spring)[k], color="0.6", lw=1, label="needed to move" if i == 0 else None)
            axis.plot(m["t"][k], spring[k], color=COLOURS[1], lw=1.5, label="springs" if i == 0 else None)
            axis.plot(m["t"][k], load[k], color=COLOURS[0], lw=1.8, label="load torque" if i == 0 else None)
        change = m["t"][m["phase"] == 0][-1]
        axis.axvline(change, color="0.7", lw=0.8, ls=":")
        axis.annotate(
            "payload released", (change, 0.97), xycoords=("data", "axes fraction"), rotation=90, va="top", ha="right", **FOOTER
        )
        axis.axhline(0, color="0.8", lw=0.8)
        axis.set_title(f"{name}: {quantity.name} = {study.configurations[name].cost:.4g} {quantity.unit}", fontsize=10)
        axis.set_xlabel("time [s]")
    for axis in axes[:, 0]:
        axis.set_ylabel("sum over joints [Nm]")
    for axis in axes.ravel()[len(motions) :]:
        axis.axis("off")
    axes.ravel()[len(motions) - 1].legend(fontsize=8, loc="upper right")
    figure.tight_layout()
    return figure


def draw_trajectory(name: str, m: dict, task: Task) -> Any:
    """Angles, speeds, accelerations and load torques of each moving joint over time, with their limits."""
    quantities = (
        ("q", "angle [°]", 180 / np.pi, task.lower, task.upper),
        ("dq", "speed [°/s]", 180 / np.pi, -task.speed, task.speed),
        ("ddq", "acceleration [°/s²]", 180 / np.pi, -task.acceleration, task.acceleration),
        ("tau_load", "load torque [Nm]", 1.0, -task.torque, task.torque),
    )
    figure, axes = plt.subplots(
        len(quantities), len(task.joints), figsize=(5.5 * len(task.joints), 9), sharex=True, squeeze=False
    )
    change = m["t"][m["phase"] == 0][-1]
    for row, (key, label, unit, lower, upper) in zip(axes, quantities, strict=True):
        for j, axis in enumerate(row):
            for i, phase in enumerate(PHASES):
                k = m["phase"] == i
                axis.plot(m["t"][k], m[key][j, k] * unit, color=COLOURS[i], lw=1.5, label=phase)
                if key in ORDERS and np.any(m["twist"][:, j]):
                    drive = m[key][j, k] - m["twist"][ORDERS.index(key), j, k]
                    axis.plot(m["t"][k], drive * unit, color="0.2", lw=0.8, label="drive" if i else None)
            top, bottom = axis.get_ylim()[1], axis.get_ylim()[0]
            for limit in (lower[j] * unit, upper[j] * unit):
                if np.isfinite(limit) and bottom - 0.4 * (top - bottom) <= limit <= top + 0.4 * (top - bottom):
                    axis.axhline(limit, color="0.4", lw=0.9, ls="--")
            axis.axvline(change, color="0.7", lw=0.8, ls=":")
            axis.set_ylabel(label)
    for j, joint in enumerate(task.joints):
        axes[0, j].set_title(f"{name}: {joint}", fontsize=10)
        axes[-1, j].set_xlabel("time [s]")
    axes[0, 0].legend(fontsize=8)
    of_drives = "; those of speed and acceleration are the drives'" * bool(np.any(m["twist"]))
    figure.text(0.5, -0.01, f"dashed: limits, where they are near{of_drives}", ha="center", **FOOTER)
    figure.tight_layout()
    return figure


def draw_arm(name: str, m: dict, task: Task, springs: dict[str, float]) -> Any:
    """The arm as a stick figure at equal times of each phase, the tool's path, and the springs at their joints."""
    body = rigid_body(task.robot)
    figure, axes = plt.subplots(1, len(PHASES), figsize=(12, 5), sharex=True, sharey=True)
    own = {joint: [k for k in ONE_JOINT if f"{k}{n}" in springs] for n, joint in enumerate(task.robot.joints, 1)}
    stiff = [
        f"{joint}: {k} = {springs[f'{k}{n}']:.3g} {spring_unit(k)[2]}"
        for n, (joint, symbols) in enumerate(own.items(), 1)
        for k in symbols
    ]
    for i, axis in enumerate(axes):
        k = np.flatnonzero(m["phase"] == i)
        q = task.full(m["q"][:, k])
        tool = np.array(
            [np.array(body.tool_position(column, task.tool.position)).ravel() for column in q.T[:: max(1, len(k) // 200)]]
        )
        axis.plot(tool[:, 0], tool[:, 2], color=COLOURS[1], lw=1.2, label="path of the tool")
        times = np.linspace(m["t"][k[0]], m["t"][k[-1]], 9)
        for n, column in enumerate(np.clip(np.searchsorted(m["t"][k], times), 0, len(k) - 1)):
            points = _joints(body, q[:, column], task)
            axis.plot(points[:, 0], points[:, 2], "o-", color=plt.cm.viridis(n / 8), lw=1.6, ms=3.5)
            if "k_b" in springs and n in (0, 8):
                a, b = (int(j) for j in task.moving[:2])
                base, elbow, shoulder = np.zeros(3), points[b + 1], points[a + 1]
                axis.plot(
                    [base[0], shoulder[0], elbow[0]],
                    [base[2], shoulder[2] + 0.02, elbow[2] + 0.02],
                    color="crimson",
                    lw=1,
                    ls="-.",
                )
        for joint in task.moving:
            if own[task.robot.joints[joint]]:
                for column in (0, -1):
                    x, _, z = _joints(body, q[:, column], task)[joint + 1]
                    axis.plot(x, z, "o", mfc="none", mec="crimson", ms=13, mew=1.2)
        payload = task.payloads[i]
        axis.set_title(
            f"{name}: {PHASES[i]}, {payload:g} kg, {m['t'][k[-1]] - m['t'][k[0]]:.2f} s (dark to light)", fontsize=10
        )
        axis.set_aspect("equal")
        axis.set_xlabel("x [m]")
    axes[0].set_ylabel("z [m]")
    axes[0].legend(fontsize=8)
    words = stiff + ([f"cable over both joints: k_b = {springs['k_b']:.3g} Nm/rad"] if "k_b" in springs else [])
    figure.text(0.5, 0.0, "springs (red): " + ("; ".join(words) if words else "none"), ha="center", **FOOTER)
    return figure


def _joints(body, q: np.ndarray, task: Task) -> np.ndarray:
    """Base, joints' origins and tool, (n + 2, 3) [m]."""
    frames = np.array(body.joint_frames(q))
    tool = np.array(body.tool_position(q, task.tool.position)).ravel()
    return np.vstack([np.zeros(3), frames[9:].T, tool])


def draw_landscape(study: DesignFile) -> Any:
    """Where starts ended: cost against the two phases' durations, distinct optima marked by how often each was reached."""
    names = [n for n, c in study.configurations.items() if c.optima]
    figure, axes = plt.subplots(2, max(len(names), 1), figsize=(3.4 * max(len(names), 1), 6.4), squeeze=False)
    for column, name in enumerate(names):
        optima = study.configurations[name].optima
        for row, phase in enumerate(PHASES):
            axis = axes[row, column]
            for o in optima:
                axis.plot(
                    o.durations[phase],
                    o.cost,
                    "o" if o.refined else "s",
                    ms=5 + 2.5 * np.sqrt(max(o.reached, 0)),
                    mfc=COLOURS[0] if o.refined else "none",
                    mec=COLOURS[0],
                    alpha=0.8,
                )
                axis.annotate(
                    str(o.reached),
                    (o.durations[phase], o.cost),
                    textcoords="offset points",
                    xytext=(7, 3),
                    **FOOTER,
                )
            axis.set_xlabel(f"duration of {phase} [s]")
            if row == 0:
                axis.set_title(name, fontsize=10)
            middle, half = np.mean(axis.get_xlim()), max(0.25, 0.65 * np.ptp(axis.get_xlim()))
            axis.set_xlim(middle - half, middle + half)
            axis.margins(y=0.25)
            axis.ticklabel_format(useOffset=False)
    for axis in axes[:, 0]:
        axis.set_ylabel(study.quantity.title)
    note = "filled: refined to the mesh tolerance; open: on the first fine mesh; number and size: starts that ended there"
    figure.text(0.5, -0.02, note, ha="center", **FOOTER)
    figure.tight_layout()
    return figure


def draw_tasks(study: DesignFile) -> Any:
    """The cost of each task with springs of its own, of the set, and of the first task; one panel a configuration with springs."""
    found = {name: c for name, c in study.configurations.items() if c.springs} or study.configurations
    tasks = [t.name for t in study.tasks]
    figure, axes = plt.subplots(
        1, len(found), figsize=(2.2 + 4.2 * len(found), 1.6 + 0.32 * len(tasks)), squeeze=False, sharey=True
    )
    y = np.arange(len(tasks))
    for axis, (name, c) in zip(axes[0], found.items(), strict=True):
        rows = {key: [getattr(c.tasks[task], key) for task in tasks] for key in MARKS}
        every = np.array(list(rows.values()))
        axis.hlines(y, every.min(axis=0), every.max(axis=0), color="0.8", lw=2, zorder=1)
        for colour, (key, (mark, label)) in zip((COLOURS[1], COLOURS[0], COLOURS[2]), MARKS.items(), strict=True):
            axis.plot(rows[key], y, mark, color=colour, ms=6, mfc="none" if key == "alone" else colour, label=label)
        axis.set_xscale("log")
        for part in (axis.xaxis.set_major_formatter, axis.xaxis.set_minor_formatter):
            part(LogFormatter(labelOnlyBase=False, minor_thresholds=(1.5, 0.5)))
        axis.set_title(name, fontsize=10)
        axis.set_xlabel(study.quantity.title)
        axis.grid(axis="x", which="both", color="0.92", lw=0.6)
    axes[0, 0].set_yticks(y, tasks)
    axes[0, 0].invert_yaxis()
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper center", ncols=3, fontsize=9, frameon=False, bbox_to_anchor=(0.5, 1.02))
    figure.tight_layout(rect=(0, 0, 1, 0.95))
    return figure


def draw_cycle_times(study: DesignFile) -> Any:
    """The cost over the cycle time: of each configuration, and dashed of springs of the same kinds that balance the arm at rest."""
    figure, axis = plt.subplots(figsize=(7, 4.6))
    for i, (name, c) in enumerate((n, c) for n, c in study.configurations.items() if c.at_cycle_times):
        colour = plt.cm.tab10(i % 10)
        own = [(sum(c.first.durations.values()), c.cost)]
        rows = [(at.cycle_s, at.cost) for at in c.at_cycle_times if at.cost is not None]
        axis.plot(*zip(*sorted({*rows, *own}), strict=True), "o-", color=colour, lw=1.5, ms=4, label=name)
        axis.plot(*own[0], "*", color=colour, ms=13)
        held = [(at.cycle_s, at.balancing) for at in c.at_cycle_times if at.balancing is not None]
        held += [(c.balancing.cycle_s, c.balancing.cost)] if c.balancing is not None else []
        if held:
            label = f"{name}, balanced at rest"
            axis.plot(*zip(*sorted(set(held)), strict=True), "o--", color=colour, lw=1.2, ms=4, mfc="none", label=label)
    axis.set_yscale("log")
    axis.set_xlabel("cycle time, both phases together [s]")
    axis.set_ylabel(study.quantity.title)
    axis.grid(which="both", color="0.92", lw=0.6)
    axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.text(0.5, -0.02, "star: the optimum where the cycle time is free", ha="center", **FOOTER)
    figure.tight_layout()
    return figure


def draw_choice(study: DesignFile) -> Any:
    """The objective against the number of springs, without and with their price; one panel a configuration."""
    found = {name: c.choice for name, c in study.configurations.items() if c.choice is not None}
    figure, axes = plt.subplots(1, len(found), figsize=(4.4 * len(found), 3.8), squeeze=False)
    for axis, (name, choice) in zip(axes[0], found.items(), strict=True):
        points, best = choice.points, choice.points[choice.chosen]
        counts = [p.count for p in points]
        axis.plot(counts, [p.cost for p in points], "o-", color=COLOURS[0], lw=1.2, ms=5, label="without the price")
        label = f"with {choice.price:g} a spring"
        axis.plot(counts, [p.priced for p in points], "s--", color=COLOURS[1], lw=1.2, ms=4, label=label)
        axis.plot(best.count, best.priced, "o", color=COLOURS[1], ms=12, mfc="none", label="chosen")
        axis.set_yscale("log")
        axis.set_xticks(range(choice.offered + 1))
        axis.set_title(name, fontsize=10)
        axis.set_xlabel("number of springs")
        axis.set_ylabel(study.quantity.title)
        axis.grid(axis="y", which="both", color="0.92", lw=0.6)
        axis.legend(fontsize=8, frameon=False)
    figure.tight_layout()
    return figure


def draw_front(study: DesignFile) -> Any:
    """The cost of the first task against the objective of the set; one panel a configuration."""
    found = {name: c.front for name, c in study.configurations.items() if c.front}
    figure, axes = plt.subplots(1, len(found), figsize=(4.4 * len(found), 3.8), squeeze=False)
    for axis, (name, points) in zip(axes[0], found.items(), strict=True):
        first, total, shares = ([getattr(p, key) for p in points] for key in ("first", "total", "share"))
        axis.plot(first, total, "o-", color=COLOURS[0], lw=1.2, ms=5)
        for x, y, share in zip(first, total, shares, strict=True):
            axis.annotate(f"{share:.2g}", (x, y), textcoords="offset points", xytext=(6, 4), **FOOTER)
        axis.set_title(name, fontsize=10)
        axis.set_xlabel(f"{study.quantity.title} of “{study.tasks[0].name}”")
        axis.set_ylabel(study.quantity.title)
        axis.margins(0.12)
    figure.text(0.5, -0.02, "number: share of the objective that is the first task's alone", ha="center", **FOOTER)
    figure.tight_layout()
    return figure

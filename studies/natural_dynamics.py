"""Springs, cycles and control: what is saved where the motion may use the natural dynamics of arm and springs.

    python studies/natural_dynamics.py --out results/natural_dynamics
    python studies/natural_dynamics.py --costs energy-0,energy-1 --friction 0.1 --out results/low_friction

The paper's arm stops at both ends of its task, minimises load torque, and follows its motion by P control. The authors say that such
control does not exploit the natural dynamics of arm and springs. What changes where the arm need not stop (ends "moving": the speed is
the same before and after, a cycle), where the motors' torque or energy counts, with or without the power that flows back, and where the
motor torque that the model predicts is fed forward?

For each kind of ends, cost and configuration of springs the best springs and motion are searched. Each optimum is then followed in MuJoCo,
cycle after cycle, by the arm as it was planned for and by one with 10 % more payload and 30 % more friction, under both controls.

The winding resistance of the prototype's drives is unknown. Here they have `--resistance`, an example, and the bundled coefficients of
Eq. 7 and 9, whose friction `--friction` scales. The same command resumes an interrupted run.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import matplotlib.pyplot as plt
import numpy as np
import typer

from rrr_oc import parallel
from rrr_oc.codesign.certificate import exact_cost
from rrr_oc.codesign.design_problem import COSTS as QUANTITIES
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import SAVED, SampledMotion, embedded, restart_arrays, restored, sample_motion
from rrr_oc.codesign.search.multistart import solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import offered, spring_bounds
from rrr_oc.codesign.task import PHASES, Task, load_task
from rrr_oc.commands.design import Intervals, Motions, Results, Starts, Tolerance
from rrr_oc.commands.output import Output
from rrr_oc.commands.shared import Jobs, Seed, Workers, named
from rrr_oc.errors import entry_point
from rrr_oc.kept import kept_motion, once
from rrr_oc.model.metrics import decrease
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.report.console import wide_console
from rrr_oc.report.figures import COLOURS, save_figure
from rrr_oc.report.tables import markdown
from rrr_oc.robot.drives import Actuators, load_actuators
from rrr_oc.schema import check_names
from rrr_oc.storage import check_folder, plain, read_npz, write_json, write_npz, write_text

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from studies.paper.driven import CONTROLS, DrivenArm, follow
from studies.paper.run_store import all_code

COSTS = {
    "load": ("load", 0.0),
    "motor": ("motor", 0.0),
    "energy-0": ("energy", 0.0),
    "energy-1": ("energy", 1.0),
}  # and regeneration
MEANING = {
    "load": "load torque² (Eq. 13)",
    "motor": "motor torque² (Eq. 7)",
    "energy-0": "electrical energy (Eq. 11), of which nothing that flows back is kept",
    "energy-1": "electrical energy (Eq. 11), of which all that flows back is kept",
}
FRICTION = ("c_0", "viscous", "c_v2", "c_12")  # of the drives' coefficients those of friction
ENDS = ("rest", "moving")
ARMS = {"as planned": (1.0, 1.0), "other arm": (1.1, 1.3)}  # factors on payload and friction
console = wide_console()


@dataclass(frozen=True)
class Run:
    """What all optima of a run share.

    Attributes:
        out: Folder of the results.
        task: The task, with its ends at rest.
        drives: Of its moving joints.
        options: Of every search.
        listener: Who is told how it goes on.
    """

    out: Path
    task: Task
    drives: Actuators
    options: SearchOptions
    listener: Output

    @property
    def asked(self) -> dict[str, Any]:
        """The settings on which a result depends."""
        task = {name: value for name, value in vars(self.task).items() if name not in ("robot", "tool", "files")}
        return {
            "task": task,
            "drives": [getattr(self.drives, name) for name in ("resistance", *FRICTION)],
            "options": asdict(self.options),
            "code": all_code(),
        }

    def design(self, ends: str, cost: str, configuration: str) -> CoDesign:
        """The problem."""
        task = replace(self.task, speeds=(ends, ends))
        return CoDesign(task, spring_bounds(task, configuration), COSTS[cost][0], self.drives_of(cost))

    def drives_of(self, cost: str) -> Actuators:
        """The drives, which keep of the power that flows back what the cost says."""
        return replace(self.drives, regeneration=np.full(len(self.drives.joints), COSTS[cost][1]))


def main(
    out: Results,
    task: Annotated[str, typer.Option(help="a bundled task, or the path of a task file")] = "paper",
    configurations: Annotated[
        str | None, typer.Option(help="comma-separated; default: all whose springs the task offers")
    ] = None,
    costs: Annotated[str, typer.Option(help=f"comma-separated, of {', '.join(COSTS)}")] = ",".join(COSTS),
    actuators: Annotated[str, typer.Option(help="drives: a JSON file or 'prototype'")] = "prototype",
    resistance: Annotated[
        float, typer.Option(min=0.01, help="of the windings where the drives have none [Ohm]: an example")
    ] = 1.0,
    friction: Annotated[
        float, typer.Option(min=0, help="factor on the friction of the drives, for other drives than these")
    ] = 1.0,
    starts: Starts = 4,
    motions: Motions = 8,
    seed: Seed = 0,
    tolerance: Tolerance = 1e-3,
    intervals: Intervals = 24,
    jobs: Jobs = -1,
    workers: Workers = parallel.LOCAL,
) -> None:
    """Writes report.md, summary.json, phase_plane.png, and a motion as npz for each optimum."""
    wanted, given = named(costs) or [], load_task(task)
    check_names(wanted, COSTS, "--costs", "cost")
    names = named(configurations) or list(offered(given))
    check_names(names, offered(given), "--configurations", "configuration")
    check_folder(out)
    drives = load_actuators(given.joints, actuators)
    drives = replace(drives, resistance=np.where(np.isfinite(drives.resistance), drives.resistance, resistance))
    drives = replace(drives, **{name: friction * getattr(drives, name) for name in FRICTION})
    search = SearchOptions(starts=starts, motions=motions, seed=seed, springs=3, rounds=1, refinement=Refinement(tolerance)).on(
        intervals
    )
    run = Run(out, replace(given, speeds=("rest", "rest")), drives, search, Output())
    found: dict[str, Any] = {}
    with parallel.workers(jobs, workers):
        for number, (cost, ends, name) in enumerate((c, e, n) for c in wanted for e in ENDS for n in names):
            label = _label(ends, cost, name)
            console.print(f"{number + 1} of {len(wanted) * len(ENDS) * len(names)}: {label}")
            found[label] = once(run, label, partial(_solved, run, found, ends, cost, name), [label])
            found[label] |= {
                "followed": once(run, f"{label} followed", partial(_followed, run, ends, cost, name, found[label]), [label])
            }
            write_npz(out / f"{label}.npz", read_npz(kept_motion(run, label)))
            _written(run, found, wanted, names)
    console.print(f"Everything is in {out}: report.md, summary.json, phase_plane.png, one npz an optimum.")


def _label(ends: str, cost: str, name: str) -> str:
    return f"{ends} {cost} {name}"


def _solved(run: Run, before: Mapping[str, Any], ends: str, cost: str, name: str) -> dict[str, Any]:
    """An optimum; its search also starts from the optima of the same cost with fewer springs or with ends at rest."""
    design, known = run.design(ends, cost, name), []
    for other in before:
        own_ends, own_cost, own = other.split(" ")
        if own_cost == cost and (own_ends == ends or own == name):
            inner = run.design(own_ends, cost, own)
            known.append(embedded(restored(inner, run.options, read_npz(kept_motion(run, other))), inner, design))
    with run.listener.stages(_label(ends, cost, name)) as report:
        guesses = [guess for guess in known if guess is not None]
        result = solve_multistart(design, run.options, known=guesses, report=report).whole()
    solution, motion = result.best.solution, sample_motion(design, result.best.solution)
    write_npz(kept_motion(run, _label(ends, cost, name)), motion.arrays | restart_arrays(solution))
    m = len(design.task.moving)
    speeds = [solution.at(i, np.ones(1))[0][m:, 0] for i in range(len(PHASES))]
    return plain(
        {
            "cost": solution.cost,
            "exact_cost": exact_cost(design, solution),
            "E1": motion.metrics().E1_total,
            "springs": design.hardware(solution.parameters),
            "parameters": solution.parameters,
            "durations": dict(zip(PHASES, solution.durations, strict=True)),
            "speed_at_release": speeds[0],
            "speed_at_start": speeds[1],
            "mesh": result.best.meshes[-1],
        }
    )


def _followed(run: Run, ends: str, cost: str, name: str, found: Mapping[str, Any]) -> dict[str, Any]:
    """What each arm needs under each control."""
    label, design = _label(ends, cost, name), run.design(ends, cost, name)
    saved, drives = read_npz(kept_motion(run, label)), run.drives_of(cost)
    motion = SampledMotion(**dict[str, Any]({key: saved[key] for key in SAVED}))
    parameters = np.array(found["parameters"])
    known = DrivenArm(design, parameters, drives)
    return {
        arm: {c: plain(asdict(follow(replace(known, payload=mass, friction=friction), motion, c, known))) for c in CONTROLS}
        for arm, (mass, friction) in ARMS.items()
    }


def _written(run: Run, found: Mapping[str, Any], costs: Sequence[str], names: Sequence[str]) -> None:
    """summary.json, report.md and the figure of what is found so far."""
    done = [(e, c, n) for c in costs for e in ENDS for n in names if _label(e, c, n) in found]
    write_json(run.out / "summary.json", {"resistance_Ohm": plain(run.drives.resistance), "optima": plain(found)})
    text = [
        "# Springs, cycles and control\n",
        f"Task {run.task.name}. Windings of {', '.join(f'{r:g}' for r in run.drives.resistance)} Ohm ({', '.join(run.drives.joints)}).\n",
        *[f"- `{cost}`: {MEANING[cost]} [{QUANTITIES[COSTS[cost][0]].unit}]." for cost in costs],
        "\n## Optima\n",
        "`less`: than stiff actuation (SA) with the same cost and ends. `by moving`: less than with ends at rest.\n",
        markdown(*_optima(found, done)),
        "\n## Followed in MuJoCo\n",
        "In one cycle: E1 [N²m²s] of the load torque, energy of the drives [J], root mean square of the tracking error [°], largest error "
        "where a phase ends [°]; P control | feed-forward. `other arm`: 10 % more payload and 30 % more friction than the control knows.\n",
        markdown(*_controls(found, done)),
    ]
    write_text(run.out / "report.md", "\n".join(text))
    _drawn(run, [key for key in done if key[1] == costs[0]], names)


def _optima(found: Mapping[str, Any], done: Sequence[tuple[str, str, str]]):
    rows = []
    for ends, cost, name in done:
        c = found[_label(ends, cost, name)]
        stiff, rest = (found.get(_label(*key)) for key in ((ends, cost, "SA"), ("rest", cost, name)))
        less = "" if stiff is None or name == "SA" else f"{100 * decrease(c['cost'], stiff['cost']):.1f} %"
        moving = f"{100 * decrease(c['cost'], rest['cost']):.1f} %" if ends == "moving" and rest else ""
        times = ", ".join(f"{t:.2f}" for t in c["durations"].values())
        rows.append([cost, ends, name, f"{c['cost']:.2f}", f"{c['exact_cost']:.2f}", less, moving, f"{c['E1']:.1f}", times])
    return ["cost", "ends", "springs", "cost found", "exact", "less", "by moving", "E1", "go, return [s]"], rows


def _controls(found: Mapping[str, Any], done: Sequence[tuple[str, str, str]]):
    rows = []
    for ends, cost, name in done:
        row = [cost, ends, name]
        for by_control in found[_label(ends, cost, name)]["followed"].values():
            two = [by_control[c] for c in CONTROLS]
            row += [" | ".join(f"{f['E1']:.1f}" for f in two), " | ".join(f"{f['energy']:.1f}" for f in two)]
            row += [" | ".join(f"{np.degrees(f[error]):.2f}" for f in two) for error in ("rms_error", "end_error")]
        rows.append(row)
    columns = [f"{what}, {arm}" for arm in ARMS for what in ("E1", "energy", "error", "at ends")]
    return ["cost", "ends", "springs", *columns], rows


def _drawn(run: Run, keys: Sequence[tuple[str, str, str]], names: Sequence[str]) -> None:
    """Speed over angle of each joint, a column for each configuration."""
    joints = run.task.joints
    figure, axes = plt.subplots(
        len(joints), len(names), figsize=(3.2 * len(names), 2.6 * len(joints)), squeeze=False, sharex="row", sharey="row"
    )
    for ends, cost, name in keys:
        motion = read_npz(kept_motion(run, _label(ends, cost, name)))
        for row, axis in enumerate(axes[:, list(names).index(name)]):
            q, dq = np.degrees(motion["q"][row]), np.degrees(motion["dq"][row])
            axis.plot(q, dq, color=COLOURS[ENDS.index(ends)], lw=1.2, label=ends)
            axis.plot(q[:1], dq[:1], "o", color=COLOURS[ENDS.index(ends)], ms=4)
    for column, name in enumerate(names):
        axes[0, column].set_title(name, fontsize=10)
        axes[-1, column].set_xlabel("angle [°]")
    for row, joint in enumerate(joints):
        axes[row, 0].set_ylabel(f"speed of {joint} [°/s]")
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="upper right", ncols=2, title="ends", fontsize=8, title_fontsize=8
    )
    save_figure(figure, run.out / "phase_plane.png")


run = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    run()

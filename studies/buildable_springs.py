"""Springs that can be built, on motions that a robot may make: what they save, by the time that a cycle may take.

    python studies/buildable_springs.py --out results/buildable_springs

The paper's task leaves out what a user pays for: its motions pass below the base, its accelerations jump, nothing limits its springs,
and E1 is of the load torque, without the friction of motors and gears. Here the same arm carries the same payload above the floor, its
jerk is limited, its springs have the limits of parts that can be ordered, and what is minimised is the squared torque of the
prototype's motors (Eq. 7), friction and rotors included.

At each cycle time stand side by side: the rigid arm; springs that balance the arm at rest, which is what one mounts without an optimal
motion, with the best motion that is found for them, and without limits of parts; springs in parallel with the joints (PEA), and with one
across both (PEA+BPEA). Beside what is minimised stand E1 and the work of the motors, of which nothing flows back.

The same command resumes an interrupted run.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from rrr_oc import parallel
from rrr_oc.codesign.clearance import Surroundings
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import describe_motors, embedded, restart_arrays, restored, sample_motion
from rrr_oc.codesign.parts.limits import SpringLimits
from rrr_oc.codesign.search.comparisons import at_cycle_times, balancing_springs, best_motion
from rrr_oc.codesign.search.multistart import solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.commands.design import Intervals, Motions, Results, Starts, Tolerance
from rrr_oc.commands.output import Output
from rrr_oc.commands.shared import Jobs, Seed, Workers, named
from rrr_oc.errors import UserError, entry_point
from rrr_oc.kept import kept_motion, once
from rrr_oc.model.metrics import decrease
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.optimal_control.solver import Solution
from rrr_oc.report.console import wide_console
from rrr_oc.report.tables import markdown
from rrr_oc.robot.drives import load_actuators
from rrr_oc.storage import check_folder, code, plain, read_npz, write_json, write_npz, write_text

FLOOR = 0.0  # [m] that tool and links stay above: the base's plane
LIMITS = SpringLimits(torque_Nm=20.0, turn_deg=180.0, force_N=800.0, energy_J=15.0)  # as in docs/codesign.md
RIGID, BALANCED, ALL = "SA", "balanced at rest", "PEA+BPEA"
ROWS = (RIGID, BALANCED, "PEA", ALL)  # in the order in which they are solved
QUANTITIES = {"motor": "motor torque² [N²m²s]", "E1": "E1 of the load torque [N²m²s]", "work_J": "work of the motors [J]"}


@dataclass(frozen=True)
class Run:
    """What all designs of a run share.

    Attributes:
        out: Folder of the results.
        jerk: Limit of the jerk of each joint [rad/s³].
        times: Of a cycle [s].
        options: Of every search.
        listener: Who is told how it goes on.
    """

    out: Path
    jerk: float
    times: tuple[float, ...]
    options: SearchOptions
    listener: Output

    @property
    def asked(self) -> dict[str, Any]:
        """The settings on which a result depends."""
        return {"jerk": self.jerk, "times": self.times, "options": asdict(self.options), "code": code()}

    def design(self, name: str) -> CoDesign:
        """The problem of a row of the table; of balancing springs that with all springs, free of limits."""
        paper = load_task("paper")
        limits = SpringLimits() if name == BALANCED else LIMITS
        jerk = np.full(len(paper.moving), self.jerk)
        task = replace(paper, around=Surroundings(FLOOR), jerk=jerk, spring_limits=limits)
        springs = spring_bounds(task, ALL if name == BALANCED else name)
        return CoDesign(task, springs, "motor", load_actuators(task.joints, "prototype"))


def main(
    out: Results,
    cycle_times: Annotated[str, typer.Option(help="comma-separated [s]")] = "3,4,6,8",
    jerk: Annotated[float, typer.Option(min=100, help="limit of each joint [°/s³]")] = 900.0,
    most: Annotated[Literal["PEA", "PEA+BPEA"], typer.Option(help="last row of the table")] = ALL,
    starts: Starts = 4,
    motions: Motions = 8,
    seed: Seed = 0,
    tolerance: Tolerance = 1e-3,
    intervals: Intervals = 24,
    jobs: Jobs = -1,
    workers: Workers = parallel.LOCAL,
) -> None:
    """Writes report.md and summary.json, and keeps each motion for a run that goes on."""
    try:
        times = tuple(sorted(float(given) for given in named(cycle_times) or ()))
    except ValueError:
        raise UserError(f"--cycle-times is {cycle_times!r}; numbers of seconds, comma-separated, are required") from None
    check_folder(out)
    few = SearchOptions(starts=starts, motions=motions, seed=seed, springs=3, rounds=1, refinement=Refinement(tolerance)).on(
        intervals
    )
    run, found, console = Run(out, float(np.radians(jerk)), times, few, Output()), dict[str, Any](), wide_console()
    with parallel.workers(jobs, workers):
        for name in ROWS[: ROWS.index(most) + 1]:
            fewer = [other for other in found if other != BALANCED]
            console.print(f"{name}: optimum")
            found[name] = once(run, name, partial(_optimum, run, name, fewer), [name])
            console.print(f"{name}: at {', '.join(f'{t:g}' for t in times)} s")
            files = [_file(name, time) for time in times]
            found[name] |= once(run, f"{name} at times", partial(_at_times, run, name, fewer), files)
    write_json(out / "summary.json", {"jerk_deg_per_s3": jerk, "cycle_s": times, "designs": found})
    table = _report(run, found)
    write_text(out / "report.md", table)
    console.print(table)


def _file(name: str, time: float) -> str:
    return f"{name} {time:g} s"


def _optimum(run: Run, name: str, before: Sequence[str]) -> dict[str, Any]:
    """The best springs and motion, of any cycle time; the search also starts from what was found with fewer springs. Of springs that
    balance the arm at rest the best motion."""
    design = run.design(name)
    if name == BALANCED:
        springs = balancing_springs(design)
        assert springs is not None
        design = design.with_fixed(design.hardware(springs))
        solution = best_motion(design, run.options)
    else:
        known = [embedded(_kept(run, other, other), run.design(other), design) for other in before]
        guesses = [guess for guess in known if guess is not None]
        with run.listener.stages(name) as report:
            solution = solve_multistart(design, run.options, known=guesses, report=report).whole().best.solution
    write_npz(kept_motion(run, name), restart_arrays(solution))
    return _told(design, solution)


def _at_times(run: Run, name: str, before: Sequence[str]) -> dict[str, Any]:
    """At each cycle time the best that is found, from the optimum and from what was found with fewer springs; None where nothing is."""
    design, solution = run.design(name), _kept(run, name, name)
    if name == BALANCED:
        design = design.with_fixed(design.hardware(solution.parameters))
    inner = []
    for other in before if name != BALANCED else ():
        files = {time: _file(other, time) for time in run.times if kept_motion(run, _file(other, time)).exists()}
        inner.append((run.design(other), {time: _kept(run, other, file) for time, file in files.items()}))
    solutions = at_cycle_times(design, solution, run.times, inner, run.options)
    for time, one in solutions.items():
        write_npz(kept_motion(run, _file(name, time)), restart_arrays(one))
    return {"at": [_told(design, solutions[time]) if time in solutions else None for time in run.times]}


def _kept(run: Run, name: str, file: str) -> Solution:
    return restored(run.design(name), run.options, read_npz(kept_motion(run, file)))


def _told(design: CoDesign, solution: Solution) -> dict[str, Any]:
    """A design's quantities, springs and cycle time."""
    motion = sample_motion(design, solution)
    motors = describe_motors(design, motion)
    assert motors is not None
    quantities = {"motor": motors["E1"], "E1": motion.metrics().E1_total, "work_J": motors["work_J"]}
    return plain(
        quantities
        | {"cost": solution.cost, "cycle_s": solution.durations.sum(), "springs": design.hardware(solution.parameters)}
        | {"lowest_tool_m": design.task.heights(motion.q)[-1].min()}
    )


def _report(run: Run, found: Mapping[str, Any]) -> str:
    """A table for each quantity: a row for each design, a column for each cycle time, and what is saved against the rigid arm."""
    times = ["any", *(f"{time:g} s" for time in run.times)]
    text = [f"# {__doc__.strip().splitlines()[0]}\n" if __doc__ else ""]
    for key, title in QUANTITIES.items():
        rows = []
        for name in found:
            pairs = zip([found[name], *found[name]["at"]], [found[RIGID], *found[RIGID]["at"]], strict=True)
            cells = [
                "–" if own is None else _cell(own[key], None if stiff is None else stiff[key], name) for own, stiff in pairs
            ]
            rows.append([name, *cells])
        text += [f"{title}, in a cycle of:\n", markdown(["", *times], rows), ""]
    return "\n".join(text)


def _cell(value: float, stiff: float | None, name: str) -> str:
    saved = "" if name == RIGID or stiff is None else f" ({100 * decrease(value, stiff):.0f} %)"
    return f"{value:.0f}{saved}" if value >= 100 else f"{value:.1f}{saved}"


run = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    run()

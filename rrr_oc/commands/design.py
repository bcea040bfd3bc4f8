"""`rrr-oc design`: springs and motion of a task, designed together."""

import time
from pathlib import Path
from typing import Annotated, cast, get_args

import typer
from rich.markdown import Markdown

from rrr_oc import parallel
from rrr_oc.codesign.design_file import Configuration
from rrr_oc.codesign.design_problem import COSTS
from rrr_oc.codesign.posterior.scenarios import Over
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import allowed_configurations
from rrr_oc.codesign.study import Request, Study, prepared
from rrr_oc.codesign.task import PRESETS
from rrr_oc.codesign.task_sets.task_set import SETS
from rrr_oc.commands.output import Json, Output, Quiet
from rrr_oc.commands.shared import MOST, Jobs, Seed, Workers, check_apart, command_line, note_without_compiler
from rrr_oc.data.published import published_springs
from rrr_oc.errors import UserError, printable
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.report.design_report import CERTIFICATES
from rrr_oc.report.study_files import FILES, write_study

PROTOTYPES = "a JSON file, 'prototype' or 'none'; default: the prototype's for the bundled tasks, none for others"
DRIVES = (
    "a JSON file, 'prototype', 'model' (friction and rotors of --model) or 'none'; default: the task's own, or the prototype's for the "
    "bundled tasks"
)
Front = Annotated[
    int, typer.Option(min=0, max=MOST, help="of a set of tasks: optima between that of the set and that of its first task")
]
CycleTimes = Annotated[
    str | None,
    typer.Option(
        help="comma-separated [s], at which all configurations of a task are compared, or 'none'; default: stiff's and the best one's"
    ),
]
app = typer.Typer(add_completion=False)


Tasks = Annotated[
    str, typer.Argument(help=f"a file with a task or a set of tasks, or a bundled one: {', '.join((*PRESETS, *SETS))}")
]
Results = Annotated[Path, typer.Option(help="folder of the results; the same command resumes an interrupted run")]
Starts = Annotated[int, typer.Option(min=1, max=MOST, help="a configuration, half from CMA-ES, half Sobol points")]
Motions = Annotated[int, typer.Option(min=0, max=MOST, help="proposed for each phase, for springs that starts led to")]
Springs = Annotated[
    int, typer.Option(min=1, max=MOST, help="different ones for which some of these motions are tried on the coarse mesh")
]
Rounds = Annotated[
    int, typer.Option(min=1, max=MOST, help="times that motions are searched for the springs found last, at most")
]
Tolerance = Annotated[float, typer.Option(min=1e-10, max=1e-2, help="mesh tolerance, relative")]
Intervals = Annotated[
    int,
    typer.Option(min=8, max=MOST, help="of a phase on the first fine mesh, which the tolerance refines; fewer are faster"),
]


@app.command()
def design(
    context: typer.Context,
    task: Tasks,
    out: Results,
    configurations: Annotated[
        str | None,
        typer.Option(help=f"comma-separated, each {allowed_configurations()}; default: all whose springs the task offers"),
    ] = None,
    starts: Starts = SearchOptions.starts,
    seed: Seed = 0,
    motions: Motions = SearchOptions.motions,
    springs: Springs = SearchOptions.springs,
    rounds: Rounds = SearchOptions.rounds,
    cost: Annotated[
        str, typer.Option(help=f"of {', '.join(COSTS)}: load torque squared, motor torque squared, or electrical energy")
    ] = "load",
    actuators: Annotated[str | None, typer.Option(help=f"what drives the joints: {DRIVES}")] = None,
    catalogue: Annotated[str | None, typer.Option(help=f"springs to buy, for the starred designs: {PROTOTYPES}")] = None,
    tolerance: Tolerance = 1e-6,
    model: Annotated[Path | None, typer.Option(help="model.json of calibrate or diagnose: optima are tracked in it")] = None,
    repaired: Annotated[
        bool, typer.Option("--repaired", help="design for the arm as --model has it: its masses, payload and link effects")
    ] = False,
    over: Annotated[
        str,
        typer.Option(
            help=f"with --repaired, whose cost is minimised: {', '.join(get_args(Over))} of what recordings leave open"
        ),
    ] = "calibrated",
    front: Front = 0,
    price: Annotated[
        float | None, typer.Option(help="of a spring, in the unit of the cost: only springs that are worth it are used")
    ] = None,
    cycle_times: CycleTimes = None,
    intervals: Intervals = 40,
    jobs: Jobs = -1,
    workers: Workers = parallel.LOCAL,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Springs across one joint (PEA and others), across two (BPEA, CBPEA) or of several kinds, and the motion of least cost for each.

    For a set of tasks the springs are the same in all of them, and each task has a motion of its own.

    Writes report.html, tables, figures, summary.json, one npz a configuration and task, and the profile of each pulley as CSV and DXF.
    """
    output = Output(quiet, as_json)
    search = SearchOptions(
        starts=starts, seed=seed, motions=motions, springs=springs, rounds=rounds, refinement=Refinement(tolerance)
    )
    request = Request(
        task, out, _names(configurations), search.on(intervals), cost, actuators, catalogue, model, repaired, front, price, cast(Over, over),
        _times(cycle_times),
    )  # fmt: skip
    read = [Path(file) for file in (task, actuators, catalogue, model) if file is not None]
    check_apart(read, [out / name for name in FILES])
    note_without_compiler(output)
    with parallel.workers(jobs, workers):
        _run(prepared(request, published_springs if request.bundled else None, output), output, command_line(context))


def _names(configurations: str | None) -> tuple[str, ...] | None:
    return None if configurations is None else tuple(name.strip() for name in configurations.split(",") if name.strip())


def _times(cycle_times: str | None) -> tuple[float, ...] | None:
    """The numbers of --cycle-times; raises `UserError` for what is none."""
    names = () if cycle_times == "none" else _names(cycle_times)
    try:
        return None if names is None else tuple(float(name) for name in names)
    except ValueError:
        raise UserError(f"--cycle-times is {cycle_times!r}; numbers above 0 [s] or 'none' are allowed") from None


def _run(study: Study, output: Output, command: str) -> None:
    """Solve, write and show a study."""
    began, found, ended = time.perf_counter(), dict[str, Configuration](), False
    for note in study.tasks.first.robot.notes:
        output.note(f"Note: {note}.")
    try:
        for name, result in study.results():
            found[name] = result
        ended = True
    finally:  # whatever ends the study, the designs that are finished are reported
        if found:
            unfinished = () if ended else study.unfinished(found)
            summary, text = write_study(study, found, time.perf_counter() - began, command, unfinished)
            output.result(summary)
            output.show(Markdown(printable(text.split(f"## {CERTIFICATES}")[0])))
            output.show(
                f"Everything is in {study.out}: report.html, report.md, summary.json, figures, one npz a configuration and task."
            )

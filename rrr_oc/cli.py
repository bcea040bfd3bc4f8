"""The command line `rrr-oc`: its commands and options. What they do is in `commands/`, imported when one of them runs."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from rrr_oc import __version__
from rrr_oc.errors import entry_point

app = typer.Typer(
    help="Springs for robot arms, and what their simulation lacks: co-design, calibration and diagnosis on recordings.",
    epilog="Exit status: 0 done; 2 an input that cannot be used, said in one sentence on stderr; 130 interrupted.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
importers = typer.Typer(help="Turn recordings in other layouts into a recording set.", no_args_is_help=True)
app.add_typer(importers, name="import")


class Way(StrEnum):
    """How parameters are found."""

    inverse = "inverse"
    response = "response"
    evolution = "evolution"


Dataset = Annotated[Path, typer.Argument(help="a recording set: a folder with recordings.json and CSV files")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="print nothing but warnings and errors")]
AsJson = Annotated[bool, typer.Option("--json", help="print the result as JSON in place of tables")]


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"rrr-oc {__version__}")
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="print the version and end")
    ] = False,
) -> None:
    """Springs for robot arms, and what their simulation lacks: co-design, calibration and diagnosis on recordings."""


@app.command()
def calibrate(
    dataset: Dataset,
    out: Annotated[Path, typer.Option(help="folder for model.json")],
    way: Annotated[
        Way,
        typer.Option(
            help="inverse: least squares on inverse dynamics; response: from there by Gauss-Newton on the simulated response; "
            "evolution: CMA-ES on MuJoCo rollouts, as the paper (slow)"
        ),
    ] = Way.inverse,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Find dry friction, viscous friction and armature of every joint; where the set says "identify", inertial parameters too."""
    from rrr_oc.commands import calibrate
    from rrr_oc.commands.common import Output

    calibrate.run(dataset, out, way, Output(quiet, as_json))


@app.command()
def diagnose(
    dataset: Dataset,
    out: Annotated[Path, typer.Option(help="folder for diagnosis.json, model.json, report.html and figures")],
    jobs: Annotated[int, typer.Option(help="processes; -1: one a core")] = -1,
    simulate: Annotated[bool, typer.Option(help="let the MuJoCo model track the recordings before and after, held out")] = True,
    priors: Annotated[
        Path | None,
        typer.Option(
            help="TOML file with what is known of the arm before: a table for each effect with its probability and typical sizes, "
            "and \\[context] with springs and inertias; without it, each effect's own prior holds"
        ),
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Say where the calibrated model fails, which physics it lacks, and how well it predicts once that is added."""
    from rrr_oc.commands import diagnose
    from rrr_oc.commands.common import Output

    diagnose.run(dataset, out, {"jobs": jobs, "simulate": simulate, "priors": priors}, Output(quiet, as_json))


@app.command()
def evaluate(
    model: Annotated[Path, typer.Argument(help="model.json that calibrate or diagnose wrote")],
    dataset: Dataset,
    out: Annotated[Path | None, typer.Option(help="file for the JSON; without it, it goes to stdout")] = None,
    simulate: Annotated[bool, typer.Option("--simulate", help="also let the MuJoCo model track the recorded motion")] = False,
    predictions: Annotated[Path | None, typer.Option(help="folder for one CSV of predictions per recording")] = None,
    window: Annotated[
        float | None,
        typer.Option(help="of the Savitzky-Golay smoothing before signals are compared \\[s]; 0: none; default: 0.15"),
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """NRMSE of a calibrated model on recordings: torque from the measured motion and, if asked for, simulated signals."""
    from rrr_oc.commands import evaluate
    from rrr_oc.commands.common import Output

    options = {"out": out, "simulate": simulate, "predictions": predictions, "window": window}
    evaluate.run(model, dataset, options, Output(quiet, as_json))


PROTOTYPES = "a JSON file, 'prototype' or 'none'; default: the prototype's for the bundled tasks, none for others"


@app.command()
def design(
    task: Annotated[str | None, typer.Argument(help="a task file, or a bundled task: paper (default) or prototype")] = None,
    preset: Annotated[str, typer.Option(help="the same as TASK")] = "paper",
    configurations: Annotated[
        str | None, typer.Option(help="comma-separated, of SA, PEA, BPEA, PEA+BPEA; default: all")
    ] = None,
    starts: Annotated[int, typer.Option(min=1, help="starts a configuration, half from CMA-ES, half from Sobol points")] = 40,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    hops: Annotated[int, typer.Option(min=0, help="rounds of basin hopping over the durations of the best optimum")] = 2,
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("results/pea_bpea"),
    cost: Annotated[str, typer.Option(help="load (Eq. 13), motor (motor torque squared, Eq. 7) or energy (Eq. 11)")] = "load",
    actuators: Annotated[
        str | None, typer.Option(help=f"drives, for the costs motor and energy and for --model: {PROTOTYPES}")
    ] = None,
    catalogue: Annotated[str | None, typer.Option(help=f"springs to buy, for the starred designs: {PROTOTYPES}")] = None,
    catalogue_search: Annotated[str, typer.Option(help="for BPEA*: exhaustive or screened")] = "exhaustive",
    tolerance: Annotated[float, typer.Option(min=1e-10, max=1e-2, help="mesh tolerance, relative")] = 1e-6,
    model: Annotated[
        Path | None, typer.Option(help="model.json of calibrate or diagnose: every optimum is tracked in it too")
    ] = None,
    jobs: Annotated[int, typer.Option(help="processes; -1 for all cores")] = -1,
) -> None:
    """Find the springs and the motion that need the least torque, for each configuration; with report, certificates and figures."""
    from rrr_oc.codesign.proposals import SearchOptions
    from rrr_oc.commands.design import Request, run
    from rrr_oc.optimal_control.refinement import Refinement

    search = SearchOptions(starts=starts, seed=seed, jobs=jobs, hops=hops, refinement=Refinement(tolerance))
    hardware = configurations, actuators, catalogue, catalogue_search
    run(Request(task or preset, out, cost, *hardware, model, search))


@app.command()
def export(
    model: Annotated[Path, typer.Argument(help="model.json that calibrate or diagnose wrote")],
    out: Annotated[Path, typer.Option(help="folder for arm.xml and arm.urdf")],
    payload: Annotated[float, typer.Option(min=0.0, help="mass held at the tool, for arm.xml \\[kg]")] = 0.0,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Write a model for other programs: MJCF that plain MuJoCo runs, and the URDF with identified inertias."""
    from rrr_oc.commands import export
    from rrr_oc.commands.common import Output

    export.run(model, out, payload, Output(quiet, as_json))


@app.command()
def init(
    urdf: Annotated[str, typer.Argument(help="path of the robot's URDF, or a bundled model")],
    out: Annotated[Path, typer.Option(help="folder to make")],
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Begin with a robot: write its recordings.json, the columns of a CSV file, a task, and what to do next."""
    from rrr_oc.commands import init
    from rrr_oc.commands.common import Output

    init.run(urdf, out, Output(quiet, as_json))


@app.command()
def effects(as_json: AsJson = False) -> None:
    """List the effects of the catalogue: their laws, parameters and units, and where they act."""
    from rrr_oc.commands import effects
    from rrr_oc.commands.common import Output

    effects.run(Output(as_json=as_json))


@importers.command()
def prototype(
    folder: Annotated[
        Path, typer.Argument(help="folder with data_file_M_ExpN.txt, of github.com/Co-Evolve/elastic-actuation-arm")
    ],
    out: Annotated[Path, typer.Argument(help="folder to make")],
    payload_at: Annotated[
        float | None,
        typer.Option(
            help="where the payload is held along link 3 \\[m]; default: 0.310, as in the authors' code; the recordings themselves say 0.355"
        ),
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """The public recordings of the paper's own arm."""
    from rrr_oc.commands import importing
    from rrr_oc.commands.common import Output

    importing.prototype(folder, out, payload_at, Output(quiet, as_json))


@importers.command()
def mcap(
    files: Annotated[list[Path], typer.Argument(help="MCAP files with sensor_msgs/JointState, each one recording")],
    robot: Annotated[str, typer.Option(help="path of the robot's URDF, or a bundled model")],
    out: Annotated[Path, typer.Option(help="folder to make")],
    joints: Annotated[str | None, typer.Option(help="comma-separated, in the order of the chain; default: all")] = None,
    topic: Annotated[str | None, typer.Option(help="of the joint states; default: the only one there is")] = None,
    torque: Annotated[str, typer.Option(help="what the efforts are: motor or load torque [Nm], or current [A]")] = "motor",
    torque_constant: Annotated[str | None, typer.Option(help="JOINT=Nm/A, comma-separated, for currents")] = None,
    inertial: Annotated[str, typer.Option(help="nominal: trust the URDF's masses; identify: only its kinematics")] = "nominal",
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """ROS 2 bags in MCAP files."""
    from rrr_oc.commands import importing
    from rrr_oc.commands.common import Output

    options = {"robot": robot, "joints": joints, "topic": topic, "torque": torque}
    options |= {"torque_constant": torque_constant, "inertial": inertial}
    importing.mcap(files, out, options, Output(quiet, as_json))


main = entry_point(app)

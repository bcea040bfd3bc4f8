"""`rrr-oc import`: recordings in other layouts, made into a recording set."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from rrr_oc.commands.shared import console
from rrr_oc.errors import UserError
from rrr_oc.recordings.importers import JointStates, import_mcap, import_prototype
from rrr_oc.recordings.importers.prototype import PAYLOAD_AT
from rrr_oc.recordings.recording import RecordingSet

app = typer.Typer(help="Turn recordings in other layouts into a recording set.", no_args_is_help=True, add_completion=False)


@app.command()
def prototype(
    folder: Annotated[
        Path, typer.Argument(help="folder with data_file_M_ExpN.txt, of github.com/Co-Evolve/elastic-actuation-arm")
    ],
    out: Annotated[Path, typer.Argument(help="folder to make")],
    payload_at: Annotated[
        float, typer.Option(help="where the payload is held along link 3 \\[m]; the recordings themselves say 0.355")
    ] = PAYLOAD_AT,
) -> None:
    """The public recordings of the paper's own arm."""
    _show_set(import_prototype(folder, out, payload_at))


@app.command()
def mcap(
    files: Annotated[list[Path], typer.Argument(help="MCAP files with sensor_msgs/JointState, each one recording")],
    robot: Annotated[str, typer.Option(help="path of the robot's URDF, or a bundled model")],
    out: Annotated[Path, typer.Option(help="folder to make")],
    joints: Annotated[str | None, typer.Option(help="comma-separated, in the order of the chain; default: all")] = None,
    topic: Annotated[str | None, typer.Option(help="of the joint states; default: the only one there is")] = None,
    torque: Annotated[str, typer.Option(help="what the efforts are: motor or load torque [Nm], or current [A]")] = "motor",
    torque_constant: Annotated[str | None, typer.Option(help="JOINT=Nm/A, comma-separated, for currents")] = None,
    inertial: Annotated[str, typer.Option(help="nominal: trust the URDF's masses; identify: only its kinematics")] = "nominal",
) -> None:
    """ROS 2 bags in MCAP files."""
    names = None if joints is None else [name.strip() for name in joints.split(",")]
    states = JointStates(names, topic, torque, inertial, _constants(torque_constant))
    _show_set(import_mcap(files, robot, out, states))


def _constants(text: str | None) -> dict[str, float]:
    if text is None:
        return {}
    try:
        return {name.strip(): float(value) for name, value in (pair.split("=") for pair in text.split(","))}
    except ValueError:
        raise UserError(f"--torque-constant is {text!r}; JOINT=NUMBER, comma-separated, is required") from None


def _show_set(recordings: RecordingSet) -> None:
    table = Table("recording", "rows", "seconds", "payload [kg]", "springs", "rows dropped")
    for r in recordings.recordings:
        springs = ", ".join(spring.name for spring, _ in r.springs)
        dropped = str(r.dropped + r.short)
        table.add_row(r.file, str(len(r.t)), f"{r.t[-1] - r.t[0]:.1f}", f"{r.payload.max():g}", springs, dropped)
    console.print(table)
    console.print(f"{recordings.path} holds the set.", highlight=False, soft_wrap=True)

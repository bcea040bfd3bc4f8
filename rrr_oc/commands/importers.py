"""`rrr-oc import`: recordings in other layouts, made into a recording set."""

from pathlib import Path
from typing import Annotated

import typer

from rrr_oc.commands.output import Json, Output, Quiet
from rrr_oc.commands.shared import Joints, named
from rrr_oc.errors import UserError
from rrr_oc.recordings.importers import JointStates, import_arrays, import_csv, import_lerobot, import_prototype, import_ros
from rrr_oc.recordings.importers.lerobot import Efforts
from rrr_oc.recordings.importers.prototype import PAYLOAD_AT
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.schema import decimal

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
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """The public recordings of the paper's own arm."""
    _show_set(import_prototype(folder, out, payload_at), Output(quiet, as_json))


@app.command()
def ros(
    files: Annotated[
        list[Path],
        typer.Argument(help="bags with sensor_msgs/JointState, each one recording: .bag, .db3, .mcap or folders of ROS 2"),
    ],
    robot: Annotated[str, typer.Option(help="path of the robot's URDF or MJCF, or a bundled model")],
    out: Annotated[Path, typer.Option(help="folder to make")],
    joints: Joints = None,
    topic: Annotated[str | None, typer.Option(help="of the joint states; default: the only one there is")] = None,
    torque: Annotated[str, typer.Option(help="what the efforts are: motor or load torque [Nm], or current [A]")] = "motor",
    torque_constant: Annotated[str | None, typer.Option(help="JOINT=Nm/A, comma-separated, for currents")] = None,
    inertial: Annotated[str, typer.Option(help="nominal: trust the URDF's masses; identify: only its kinematics")] = "nominal",
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Bags of ROS 1 and ROS 2."""
    states = JointStates(named(joints), topic, torque, inertial, _numbers("--torque-constant", torque_constant))
    _show_set(import_ros(files, robot, out, states), Output(quiet, as_json))


@app.command(name="csv")
def from_csv(
    files: Annotated[list[Path], typer.Argument(help="CSV files with columns of any names and units, each one recording")],
    mapping: Annotated[Path, typer.Option("--map", help="TOML file that says which column is what, and in which unit")],
    robot: Annotated[str, typer.Option(help="path of the robot's URDF or MJCF, or a bundled model")],
    out: Annotated[Path, typer.Option(help="folder to make")],
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """CSV files with columns and units of one's own."""
    _show_set(import_csv(files, robot, out, mapping), Output(quiet, as_json))


@app.command()
def lerobot(
    folder: Annotated[Path, typer.Argument(help="a data set of LeRobot on this machine: a folder with meta/info.json")],
    robot: Annotated[str, typer.Option(help="path of the robot's URDF or MJCF, or a bundled model")],
    out: Annotated[Path, typer.Option(help="folder to make")],
    mapping: Annotated[
        Path | None, typer.Option("--map", help="TOML file that says which column is what; default: as their names say")
    ] = None,
    unit: Annotated[str, typer.Option(help="of positions without --map: rad or deg; speeds are per second")] = "rad",
    torque_constant: Annotated[
        str | None, typer.Option(help="JOINT=Nm/A, comma-separated, for currents; of loads in counts: Nm a count")
    ] = None,
    kp: Annotated[
        str | None, typer.Option(help="Nm/rad of the loop that follows the commands (action): a number, or JOINT=NUMBER,…")
    ] = None,
    kd: Annotated[str | None, typer.Option(help="as --kp, Nm s/rad; with both, torques are made of commands")] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Data sets of LeRobot with torques, currents, loads, or commands of a loop of known gains, versions 2 and 3."""
    efforts = Efforts(_numbers("--torque-constant", torque_constant), _gain("--kp", kp), _gain("--kd", kd))
    _show_set(import_lerobot(folder, robot, out, mapping, unit, efforts), Output(quiet, as_json))


@app.command()
def arrays(
    files: Annotated[list[Path], typer.Argument(help=".npz of numpy or .mat of MATLAB, each one recording")],
    mapping: Annotated[Path, typer.Option("--map", help="TOML file that says which array is what, and in which unit")],
    robot: Annotated[str, typer.Option(help="path of the robot's URDF or MJCF, or a bundled model")],
    out: Annotated[Path, typer.Option(help="folder to make")],
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Arrays of numpy and MATLAB, with names and units of one's own."""
    _show_set(import_arrays(files, robot, out, mapping), Output(quiet, as_json))


def _gain(option: str, text: str | None) -> float | dict[str, float] | None:
    """A number of all joints, or one of each by name."""
    if text is None or "=" in text:
        return None if text is None else _numbers(option, text)
    number = decimal(text.strip())
    if number is None:
        raise UserError(f"{option} is {text!r}; a number, or JOINT=NUMBER, comma-separated, is required")
    return number


def _numbers(option: str, text: str | None) -> dict[str, float]:
    if text is None:
        return {}
    pairs = [pair.partition("=") for pair in text.split(",")]
    found = {name.strip(): decimal(value.strip()) for name, _, value in pairs}
    if None in found.values() or len(found) < len(pairs):
        raise UserError(f"{option} is {text!r}; JOINT=NUMBER, comma-separated, is required")
    return {name: value for name, value in found.items() if value is not None}


def _show_set(recordings: RecordingSet, output: Output) -> None:
    rows = [
        {
            "file": r.file,
            "rows": len(r.t),
            "seconds": float(r.t[-1] - r.t[0]),
            "payload_kg": float(r.payload.max()),
            "springs": [spring.name for spring, _ in r.springs],
            "rows_dropped": r.dropped + r.short,
        }
        for r in recordings.recordings
    ]
    output.result({"path": str(recordings.path), "recordings": rows})
    shown = [
        [
            r["file"],
            str(r["rows"]),
            f"{r['seconds']:.1f}",
            f"{r['payload_kg']:g}",
            ", ".join(r["springs"]),
            str(r["rows_dropped"]),
        ]
        for r in rows
    ]
    output.table(["recording", "rows", "seconds", "payload [kg]", "springs", "rows dropped"], shown)
    output.show(f"{recordings.path} holds the set.")

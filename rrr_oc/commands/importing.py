"""`rrr-oc import`."""

from pathlib import Path
from typing import Any

from rich.table import Table

from rrr_oc.commands.common import Output
from rrr_oc.errors import UserError
from rrr_oc.recordings.importers import JointStates, import_mcap, import_prototype
from rrr_oc.recordings.importers.prototype import PAYLOAD_AT
from rrr_oc.recordings.recording import RecordingSet


def prototype(folder: Path, out: Path, payload_at: float | None, output: Output) -> None:
    """Import the public recordings of the paper's own arm."""
    _show(import_prototype(folder, out, PAYLOAD_AT if payload_at is None else payload_at), output)


def mcap(files: list[Path], out: Path, options: dict[str, Any], output: Output) -> None:
    """Import ROS 2 bags.

    Args:
        options: "robot", "joints", "topic", "torque", "torque_constant" and "inertial" as the command declares them.
    """
    joints = options["joints"]
    names = None if joints is None else [name.strip() for name in joints.split(",")]
    states = JointStates(
        names, options["topic"], options["torque"], options["inertial"], _constants(options["torque_constant"])
    )
    _show(import_mcap(files, options["robot"], out, states), output)


def _constants(text: str | None) -> dict[str, float]:
    if text is None:
        return {}
    try:
        return {name.strip(): float(value) for name, value in (pair.split("=") for pair in text.split(","))}
    except ValueError:
        raise UserError(f"--torque-constant is {text!r}; JOINT=NUMBER, comma-separated, is required") from None


def _show(recordings: RecordingSet, output: Output) -> None:
    table = Table("recording", "rows", "seconds", "payload [kg]", "springs", "rows dropped")
    for r in recordings.recordings:
        springs = ", ".join(spring.name for spring, _ in r.springs)
        dropped = str(r.dropped + r.short)
        table.add_row(r.file, str(len(r.t)), f"{r.t[-1] - r.t[0]:.1f}", f"{r.payload.max():g}", springs, dropped)
    output.show(table)
    output.show(f"{recordings.path} holds the set.")
    files = [{"file": r.file, "rows": len(r.t), "seconds": float(r.t[-1] - r.t[0])} for r in recordings.recordings]
    output.result({"folder": str(recordings.path), "recordings": files})

"""What several commands need: the data set that they read, what they refuse to overwrite, and the line that runs them again."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from rrr_oc import compiler
from rrr_oc.commands.output import Output
from rrr_oc.errors import UserError, ends_at_once
from rrr_oc.model.metrics import WORTHLESS
from rrr_oc.schema import HEAVIEST
from rrr_oc.storage import resolved

if TYPE_CHECKING:
    from rrr_oc.calibration.calibrated_model import CalibratedModel
    from rrr_oc.recordings.consistency import Consistency
    from rrr_oc.recordings.recording import RecordingSet

Model = Annotated[Path, typer.Argument(help="model.json that calibrate or diagnose wrote")]
Dataset = Annotated[Path, typer.Argument(help="a recording set: a folder with recordings.json and CSV files")]

MOST = 100_000  # of what is counted, as starts and intervals; a hundred times that takes all memory
Window = Annotated[float, typer.Option(help="of the Savitzky-Golay smoothing before signals are compared \\[s]")]
Seed = Annotated[int, typer.Option(min=0, help="of the random starts")]
Jobs = Annotated[int, typer.Option(help="processes on this machine; -1: one a core")]
Workers = Annotated[str, typer.Option(help="local, or the address of a Dask scheduler, as tcp://host:8786")]

Joints = Annotated[str | None, typer.Option(help="comma-separated, in the order of the chain; default: all")]


def named(joints: str | None) -> list[str] | None:
    """Names from a comma-separated list."""
    return None if joints is None else [name.strip() for name in joints.split(",")]


def command_line(context: typer.Context) -> str:
    """The command that is running with the arguments and options that were given, but those that only change what is printed."""
    words = ["rrr-oc", str(context.command.name)]
    for parameter in context.command.params:
        value, source = context.params.get(parameter.name or ""), context.get_parameter_source(parameter.name or "")
        if source is None or source.name != "COMMANDLINE" or parameter.name in ("quiet", "as_json"):
            continue
        if parameter.param_type_name == "argument":
            words.append(str(value))
        elif isinstance(value, bool):
            words.append((parameter.opts if value else parameter.secondary_opts)[0])
        else:
            words += [parameter.opts[0], str(value)]
    return shlex.join(words)


_noted: list[bool] = []  # whether this process has said that there is no compiler


def note_without_compiler(output: Output) -> None:
    """Say once that there is no C compiler, where generated code would run."""
    if not (compiler.available() or _noted):
        _noted.append(True)
        output.note(
            f"Note: there is no C compiler on PATH ({', '.join(compiler.COMPILERS)}); CasADi's virtual machine takes its place. "
            "Results are the same; solves and simulations take longer, several times at worst."
        )


def check_window(window: float) -> None:
    """Raise `UserError` unless a window of smoothing is 0 s or more."""
    if not 0 <= window < float("inf"):
        raise UserError(f"--window is {window:g} s; 0 (no smoothing) or more is required")


def check_payload(payload: float) -> None:
    """Raise `UserError` unless a payload is one that an arm could hold."""
    if not 0 <= payload <= HEAVIEST:
        raise UserError(f"--payload is {payload:g} kg; 0 to {HEAVIEST:g} kg are allowed")


def loaded(dataset: Path, output: Output) -> RecordingSet:
    """A recording set; what a user should know of how it was read is noted."""
    with ends_at_once():
        from rrr_oc.recordings.reader import load_recordings
    recordings = load_recordings(dataset)
    for note in recordings.notes:
        output.note(f"Note: {note}.")
    return recordings


def doubted(recordings: RecordingSet, output: Output) -> Consistency:
    """What looks wrong in a set, each doubt noted."""
    with ends_at_once():
        from rrr_oc.recordings.consistency import check_consistency
    found = check_consistency(recordings)
    for doubt in found.doubts:
        output.note(f"Warning: {doubt.said}.")
    return found


def unexplained_torques(model: CalibratedModel) -> list[str]:
    """A warning for each joint whose torque a model explains no better than a constant does, without a full stop."""
    warnings = []
    for joint, nrmse in zip(model.joints, model.nrmse, strict=True):
        if not nrmse <= WORTHLESS:
            found = "never changes" if np.isnan(nrmse) else f"is explained no better than by a constant (NRMSE {nrmse:.3g})"
            mend = "Check units, signs and the order of columns, gains of a loop, masses, gravity, tool and payload"
            warnings.append(f"Warning: the torque of {joint} {found}. {mend}")
    return warnings


def check_apart(read: Sequence[Path], written: Sequence[Path]) -> None:
    """Raise `UserError` where what is to be written would take the place of what was read; a name may be a pattern such as *.png."""
    inputs = [place for path in read for place in (path.absolute(), resolved(path))]
    for path in written:
        folder, leads_to = path.absolute().parent, resolved(path)
        for one in inputs:
            same = one == leads_to or (fnmatch(one.name, path.name) and one.parent in (folder, folder.resolve()))
            if same:
                raise UserError(f"{one}: is read by this command and would be overwritten; another place is required")


def shown(value: float | None) -> str:
    """A number with four digits, or a dash where there is none."""
    return "–" if value is None else f"{value:.4g}"


def show_errors(result: dict[str, Any], output: Output) -> None:
    """The means of `summary` by way, joint and signal."""
    rows = [
        [way, joint, signal, *(shown(errors[key]) for key in ("nrmse", "rmse"))]
        for way, joints in result["mean"].items()
        for joint, found in joints.items()
        for signal, errors in (found.items() if way == "simulated" else [("recorded", found)])
    ]
    output.table(["way", "joint", "signal", "mean NRMSE", "mean RMSE"], rows)

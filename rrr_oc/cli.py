"""The command line `rrr-oc`: import recordings, calibrate a model on them, evaluate it on others."""

import json
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

from rrr_oc.calibration.calibrate import calibrate as calibrate_inverse
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.calibration.prediction_error import evaluate_inverse, evaluate_simulated, summary, write_predictions
from rrr_oc.calibration.response import calibrate_evolution, calibrate_response
from rrr_oc.diagnosis.held_out import in_closed_loop
from rrr_oc.diagnosis.procedure import diagnose as diagnose_recordings
from rrr_oc.effects import CATALOGUE
from rrr_oc.effects.base import PLACEMENTS, SIDES
from rrr_oc.effects.priors import load_priors
from rrr_oc.errors import UserError, entry_point
from rrr_oc.numerics.savitzky_golay import WINDOW
from rrr_oc.parallel import check_jobs, one_thread
from rrr_oc.recordings.importers import JointStates, import_mcap, import_prototype
from rrr_oc.recordings.importers.prototype import PAYLOAD_AT
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.report.console import wide_console
from rrr_oc.report.diagnosis_report import write_diagnosis
from rrr_oc.report.diagnosis_words import gain, not_claimed, on_prior, percent, rivals
from rrr_oc.storage import check_file, check_folder, write_json

app = typer.Typer(
    help="System identification of robot arms on recordings of their motion and torques.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
importers = typer.Typer(help="Turn recordings in other layouts into a recording set.", no_args_is_help=True)
app.add_typer(importers, name="import")
console, errors = wide_console(), wide_console(stderr=True)


class Way(StrEnum):
    """How parameters are found."""

    inverse = "inverse"
    response = "response"
    evolution = "evolution"


WAYS: dict[Way, Callable[[RecordingSet], CalibratedModel]] = {
    Way.inverse: calibrate_inverse,
    Way.response: calibrate_response,
    Way.evolution: calibrate_evolution,
}
WORTHLESS = 1.0  # NRMSE
Dataset = Annotated[Path, typer.Argument(help="a recording set: a folder with recordings.json and CSV files")]


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
) -> None:
    """Find dry friction, viscous friction and armature of every joint; where the set says "identify", inertial parameters too."""
    check_folder(out)
    recordings = _loaded(dataset)
    model = WAYS[way](recordings)
    save_model(model, out / "model.json")
    _show_model(model)
    console.print(f"{out / 'model.json'} holds the model.", highlight=False, soft_wrap=True)


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
) -> None:
    """Say where the calibrated model fails, which physics it lacks, and how well it predicts once that is added."""
    check_jobs(jobs)
    check_folder(out)
    believed = None if priors is None else load_priors(priors)
    recordings = _loaded(dataset)
    _check_apart(recordings.files, [out / r.file for r in recordings.recordings if Path(r.file).match("suggested_*.csv")])
    with console.status("reading") as status, one_thread():
        found = diagnose_recordings(recordings, lambda line: status.update(line), jobs, believed)
        status.update("tracking the recordings in closed loop")
        simulated = in_closed_loop(found, jobs) if simulate else None
        status.update("writing the report")
        content = write_diagnosis(found, out, simulated)
    _show_diagnosis(content)
    console.print(f"{out} holds diagnosis.json, model.json and report.html.", highlight=False, soft_wrap=True)


@app.command()
def evaluate(
    model: Annotated[Path, typer.Argument(help="model.json that calibrate or diagnose wrote")],
    dataset: Dataset,
    out: Annotated[Path | None, typer.Option(help="file for the JSON; without it, it goes to stdout")] = None,
    simulate: Annotated[bool, typer.Option("--simulate", help="also let the MuJoCo model track the recorded motion")] = False,
    predictions: Annotated[Path | None, typer.Option(help="folder for one CSV of predictions per recording")] = None,
    window: Annotated[float, typer.Option(help="of the Savitzky-Golay smoothing before signals are compared \\[s]")] = WINDOW,
) -> None:
    """NRMSE of a calibrated model on recordings: torque from the measured motion and, if asked for, simulated signals."""
    if not 0 <= window < float("inf"):
        raise UserError(f"--window is {window:g} s; 0 (no smoothing) or more is required")
    if out is not None:
        check_file(out)
    if predictions is not None:
        check_folder(predictions)
    recordings = _loaded(dataset)
    calibrated = load_model(model)
    written = [] if out is None else [out]
    written += [] if predictions is None else [predictions / r.file for r in recordings.recordings]
    _check_apart([model, *recordings.files], written)
    inverse = evaluate_inverse(calibrated, recordings, window)
    simulated = evaluate_simulated(calibrated, recordings, window) if simulate else None
    result = summary(inverse, simulated)
    if predictions is not None:
        write_predictions(calibrated, recordings, predictions)
    if out is None:
        typer.echo(json.dumps(result, indent=1, ensure_ascii=False, allow_nan=False))
    else:
        write_json(out, result)
        _show_errors(result)


@app.command()
def effects() -> None:
    """List the effects of the catalogue: their laws, parameters and units, and where they act."""
    table = Table("effect", "law", "parameters", "acts on", "where", show_lines=True)
    for kind in CATALOGUE.values():
        fixed = isinstance(kind.parameters, tuple)  # else their number depends on what the term was found to depend on
        parameters = ", ".join(f"{p.name} [{p.unit}]" for p in kind.parameters) if fixed else "coefficients [Nm]"
        table.add_row(kind.name, kind.equation, parameters, kind.side, PLACEMENTS[kind.placement])
    console.print(table)
    for side, meaning in SIDES.items():
        console.print(f"{side}: {meaning}.", highlight=False, soft_wrap=True)


@importers.command()
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
) -> None:
    """ROS 2 bags in MCAP files."""
    names = None if joints is None else [name.strip() for name in joints.split(",")]
    states = JointStates(names, topic, torque, inertial, _constants(torque_constant))
    _show_set(import_mcap(files, robot, out, states))


main = entry_point(app)


def _loaded(dataset: Path) -> RecordingSet:
    """A recording set; what a user should know of how it was read goes to stderr."""
    recordings = load_recordings(dataset)
    for note in recordings.notes:
        errors.print(f"Note: {note}.", highlight=False, soft_wrap=True)
    return recordings


def _check_apart(read: Sequence[Path], written: Sequence[Path]) -> None:
    """Raise `UserError` where what is to be written would take the place of what was read."""
    inputs = {path.resolve() for path in read}
    for path in written:
        if path.resolve() in inputs:
            raise UserError(f"{path}: is read by this command and would be overwritten; another place is required")


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


def _show_model(model: CalibratedModel) -> None:
    table = Table("effect", "joint", "parameter", "value", "95 % interval", "unit", "")
    for term in model.terms:
        for parameter, e in zip(term.effect.parameters, term.estimates, strict=True):
            interval = "not determined" if e.interval is None else f"{e.interval[0]:.4g} … {e.interval[1]:.4g}"
            interval = "–" if e.at_bound and e.interval is not None and e.interval[0] == e.interval[1] else interval
            joints = ", ".join(model.joints[j] for j in term.effect.joints)
            held = "at its bound" if e.at_bound else ""
            table.add_row(term.effect.name, joints, parameter.name, f"{e.value:.4g}", interval, parameter.unit, held)
    console.print(table)
    joints = Table("joint", "NRMSE of the torque", "noise [Nm]")
    for joint, nrmse, noise in zip(model.joints, model.nrmse, model.noise, strict=True):
        joints.add_row(joint, f"{nrmse:.4f}", f"{noise:.4g}")
    console.print(joints)
    for joint, nrmse in zip(model.joints, model.nrmse, strict=True):
        if not nrmse <= WORTHLESS:
            found = "never changes" if np.isnan(nrmse) else f"is explained no better than by a constant (NRMSE {nrmse:.3g})"
            errors.print(
                f"Warning: the torque of {joint} {found}. Check units, signs and the order of columns, and gravity, tool and payload.",
                highlight=False,
                soft_wrap=True,
            )
    base = model.report.get("base_parameters", [])
    if base:
        console.print(f"{len(base)} base inertial parameters were identified; model.json lists them with their intervals.")


def _show_diagnosis(found: dict[str, Any]) -> None:
    console.print(f"Verdict: {found['verdict']}")
    table = Table(
        "effect", "joint", "recordings", "parameters", "probability", "share of error", "gain held out [nats]", "as good"
    )
    for effect in found["effects"]:
        values = ", ".join(f"{k} = {_value(v['value'])} {v['unit']}".strip() for k, v in effect["parameters"].items())
        joint, files = effect["joint"], effect["recordings"]
        table.add_row(
            effect["effect"],
            "" if joint is None else joint if isinstance(joint, str) else ", ".join(joint),
            files if isinstance(files, str) else ", ".join(files),
            values,
            percent(effect["probability"]),
            f"{effect['share_of_error']:.2f}",
            gain(effect["held_out_gain_nats"]),
            ", ".join(rivals(effect)),
        )
    if found["effects"]:
        console.print(table)
    for other in found["unexplained"]:
        console.print(f"Unexplained: {other['description']}.", soft_wrap=True)
    for line in [*on_prior(found), *not_claimed(found)]:
        console.print(line, highlight=False, soft_wrap=True)
    errors = Table("joint", "NRMSE held out, before", "after", "after / before, 95 % interval")
    for joint, b in found["bootstrap"].items():
        interval = b["ratio"]["interval"]
        ratio = "–" if interval is None else f"{_shown(interval[0])} … {_shown(interval[1])}"
        errors.add_row(joint, _shown(b["before"]["value"]), _shown(b["after"]["value"]), ratio)
    console.print(errors)


def _value(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _show_errors(result: dict[str, Any]) -> None:
    table = Table("way", "joint", "signal", "mean NRMSE", "mean RMSE")
    for way, joints in result["mean"].items():
        for joint, found in joints.items():
            for signal, errors in found.items() if way == "simulated" else [("recorded", found)]:
                table.add_row(way, joint, signal, *(_shown(errors[key]) for key in ("nrmse", "rmse")))
    console.print(table)


def _shown(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"

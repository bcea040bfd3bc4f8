"""`rrr-oc evaluate`: how well a model predicts recordings."""

from pathlib import Path
from typing import Annotated

import typer

from rrr_oc.commands.output import Json, Output, Quiet
from rrr_oc.commands.shared import Dataset, Model, Window, check_apart, check_window, loaded, note_without_compiler, show_errors
from rrr_oc.errors import ends_at_once
from rrr_oc.numerics.savitzky_golay import WINDOW
from rrr_oc.storage import check_file, check_folder, write_json

app = typer.Typer(add_completion=False)


@app.command()
def evaluate(
    model: Model,
    dataset: Dataset,
    out: Annotated[Path | None, typer.Option(help="file for the result as JSON; without it, it goes to stdout")] = None,
    simulate: Annotated[bool, typer.Option("--simulate", help="also let the MuJoCo model track the recorded motion")] = False,
    predictions: Annotated[Path | None, typer.Option(help="folder for one CSV of predictions per recording")] = None,
    window: Window = WINDOW,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """NRMSE of a calibrated model on recordings: torque from the measured motion and, if asked for, simulated signals."""
    with ends_at_once():
        from rrr_oc.calibration.model_file import load_model
        from rrr_oc.calibration.prediction_error import evaluate_inverse, evaluate_simulated, summary, write_predictions
    output = Output(quiet, as_json)
    check_window(window)
    if out is not None:
        check_file(out)
    if predictions is not None:
        check_folder(predictions)
    recordings = loaded(dataset, output)
    calibrated = load_model(model)
    for what, unknown in calibrated.without_values(recordings).items():
        output.note(f"{', '.join(unknown)}: the model has no {what} for {'it' if len(unknown) == 1 else 'them'}; 0 is taken")
    written = [] if out is None else [out]
    written += [] if predictions is None else [predictions / r.file for r in recordings.recordings]
    check_apart([model, *recordings.files], written)
    if simulate:
        note_without_compiler(output)
    inverse = evaluate_inverse(calibrated, recordings, window)
    simulated = evaluate_simulated(calibrated, recordings, window) if simulate else None
    result = summary(inverse, simulated)
    if predictions is not None:
        write_predictions(calibrated, recordings, predictions)
    if out is None:  # a program reads it, whatever else is asked for
        Output(as_json=as_json or not quiet).result(result)
        return
    write_json(out, result)
    output.result(result)
    show_errors(result, output)

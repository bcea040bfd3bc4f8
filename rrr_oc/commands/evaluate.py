"""`rrr-oc evaluate`."""

from pathlib import Path
from typing import Any

from rich.table import Table

from rrr_oc.calibration.model_file import load_model
from rrr_oc.calibration.prediction_error import evaluate_inverse, evaluate_simulated, summary, write_predictions
from rrr_oc.commands.common import Output, check_apart, loaded, print_json, shown
from rrr_oc.errors import UserError
from rrr_oc.numerics.savitzky_golay import WINDOW
from rrr_oc.storage import check_file, check_folder, write_json


def run(model: Path, dataset: Path, options: dict[str, Any], output: Output) -> None:
    """Evaluate a model on a recording set.

    Args:
        options: "out", "simulate", "predictions" and "window" as the command declares them.
    """
    out, predictions = options["out"], options["predictions"]
    window = WINDOW if options["window"] is None else options["window"]
    if not 0 <= window < float("inf"):
        raise UserError(f"--window is {window:g} s; 0 (no smoothing) or more is required")
    if out is not None:
        check_file(out)
    if predictions is not None:
        check_folder(predictions)
    recordings = loaded(dataset, output)
    calibrated = load_model(model)
    written = [] if out is None else [out]
    written += [] if predictions is None else [predictions / r.file for r in recordings.recordings]
    check_apart([model, *recordings.files], written)
    inverse = evaluate_inverse(calibrated, recordings, window)
    simulated = evaluate_simulated(calibrated, recordings, window) if options["simulate"] else None
    result = summary(inverse, simulated)
    if predictions is not None:
        write_predictions(calibrated, recordings, predictions)
    if out is None:
        print_json(result)
        return
    write_json(out, result)
    _show(result, output)
    output.result(result)


def _show(result: dict[str, Any], output: Output) -> None:
    table = Table("way", "joint", "signal", "mean NRMSE", "mean RMSE")
    for way, joints in result["mean"].items():
        for joint, found in joints.items():
            for signal, errors in found.items() if way == "simulated" else [("recorded", found)]:
                table.add_row(way, joint, signal, *(shown(errors[key]) for key in ("nrmse", "rmse")))
    output.show(table)

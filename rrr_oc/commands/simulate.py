"""`rrr-oc simulate`: a model in MuJoCo tracks recordings."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from rrr_oc.commands.output import Json, Output, Quiet
from rrr_oc.commands.shared import Dataset, Model, Window, check_apart, check_window, loaded, note_without_compiler, show_errors
from rrr_oc.errors import ends_at_once
from rrr_oc.numerics.savitzky_golay import WINDOW
from rrr_oc.storage import check_folder

app = typer.Typer(add_completion=False)


@app.command()
def simulate(
    model: Model,
    dataset: Dataset,
    out: Annotated[Path, typer.Option(help="folder for one CSV a recording: positions, speeds, accelerations, torques")],
    window: Window = WINDOW,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Let a calibrated model in MuJoCo track recordings, and compare what it does with what was recorded.

    The motor torque that the model expects is fed forward, and controllers hold it on the recorded motion.
    """
    with ends_at_once():
        from rrr_oc.calibration.model_file import load_model
        from rrr_oc.calibration.prediction_error import errors_simulated, simulated, summary, write_simulated
    output = Output(quiet, as_json)
    check_window(window)
    check_folder(out)
    recordings = loaded(dataset, output)
    calibrated = load_model(model)
    check_apart([model, *recordings.files], [out / r.file for r in recordings.recordings])
    note_without_compiler(output)
    with output.steps("tracking the recordings"):
        found = simulated(calibrated, recordings)
    write_simulated(found, calibrated.joints, out)
    for file, motion in found.items():
        if np.isnan(motion.q).any():
            output.note(f"Warning: {file}: the simulation diverged; its file has no numbers.")
    result = summary({}, errors_simulated(calibrated, recordings, found, window))
    result = {
        key: {"simulated": part["simulated"]} if key == "mean" else part for key, part in result.items() if key != "inverse"
    }
    output.result(result)
    show_errors(result, output)
    output.show(f"{out} holds the predictions.")

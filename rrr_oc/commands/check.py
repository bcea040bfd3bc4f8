"""`rrr-oc check`: what looks wrong in a recording set before it is calibrated."""

from dataclasses import asdict

import numpy as np
import typer

from rrr_oc.commands.output import Json, Output, Quiet
from rrr_oc.commands.shared import Dataset, doubted, loaded
from rrr_oc.model.metrics import WORTHLESS
from rrr_oc.storage import plain

app = typer.Typer(add_completion=False)


@app.command()
def check(dataset: Dataset, quiet: Quiet = False, as_json: Json = False) -> None:
    """Say in seconds which columns have the wrong sign, order, unit or clock, and what the motions do not show."""
    output = Output(quiet, as_json)
    recordings = loaded(dataset, output)
    found = doubted(recordings, output)
    from rrr_oc.recordings.mends import BAD  # with what `doubted` has imported

    by_joint = {joint: x if np.isfinite(x) else None for joint, x in zip(recordings.joints, found.nrmse, strict=True)}
    said = [asdict(doubt) for doubt in found.doubts]
    output.result(plain({"doubts": said, "notes": recordings.notes, "nrmse": by_joint, "diagnosis_s": found.diagnosis_s}))
    rows = [[joint, "never changes" if nrmse is None else f"{nrmse:.2g}"] for joint, nrmse in by_joint.items()]
    output.table(["joint", "NRMSE of the torque, rigid arm with friction"], rows)
    poor = [joint for joint, nrmse in by_joint.items() if nrmse is not None and nrmse > WORTHLESS]
    if poor:
        checked = (
            "kp, kd, " * (recordings.torque == "command") + "units and signs, masses and inertias, gravity, tool and payload"
        )
        output.note(
            f"Warning: the rigid arm explains the torque of {', '.join(poor)} no better than a constant does. Check {checked}; if "
            "they are right, physics is missing there, and rrr-oc diagnose says which."
        )
    weak = [joint for joint, nrmse in by_joint.items() if nrmse is not None and nrmse > BAD]
    if not (poor or found.doubts):
        badly = (
            f", but the rigid arm explains the torque of {', '.join(weak)} badly, and no single mistake says why"
            if weak
            else ""
        )
        output.show(f"No column contradicts another or the robot{badly}.")
    low, high = found.diagnosis_s
    output.show(f"A diagnosis takes {low:.0f} to {high:.0f} s of processor time, the less the fewer effects are missing.")

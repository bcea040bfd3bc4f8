"""`rrr-oc calibrate`."""

import json
from pathlib import Path

import numpy as np
from rich.table import Table

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.model_file import save_model
from rrr_oc.calibration.response import calibrate_evolution, calibrate_response
from rrr_oc.commands.common import Output, loaded
from rrr_oc.storage import check_folder

WAYS = {"inverse": calibrate, "response": calibrate_response, "evolution": calibrate_evolution}
WORTHLESS = 1.0  # NRMSE from which a torque counts as not explained


def run(dataset: Path, out: Path, way: str, output: Output) -> None:
    """Calibrate a model on a recording set in one of `WAYS`, write model.json, and show it."""
    check_folder(out)
    recordings = loaded(dataset, output)
    model = WAYS[way](recordings)
    save_model(model, out / "model.json")
    _show(model, output)
    output.show(f"{out / 'model.json'} holds the model.")
    output.result(json.loads((out / "model.json").read_text(encoding="utf-8")))


def _show(model: CalibratedModel, output: Output) -> None:
    table = Table("effect", "joint", "parameter", "value", "95 % interval", "unit", "")
    for term in model.terms:
        for parameter, e in zip(term.effect.parameters, term.estimates, strict=True):
            interval = "not determined" if e.interval is None else f"{e.interval[0]:.4g} … {e.interval[1]:.4g}"
            interval = "–" if e.at_bound and e.interval is not None and e.interval[0] == e.interval[1] else interval
            joints = ", ".join(model.joints[j] for j in term.effect.joints)
            held = "at its bound" if e.at_bound else ""
            table.add_row(term.effect.name, joints, parameter.name, f"{e.value:.4g}", interval, parameter.unit, held)
    output.show(table)
    joints = Table("joint", "NRMSE of the torque", "noise [Nm]")
    for joint, nrmse, noise in zip(model.joints, model.nrmse, model.noise, strict=True):
        joints.add_row(joint, f"{nrmse:.4f}", f"{noise:.4g}")
    output.show(joints)
    for joint, nrmse in zip(model.joints, model.nrmse, strict=True):
        if not nrmse <= WORTHLESS:
            found = "never changes" if np.isnan(nrmse) else f"is explained no better than by a constant (NRMSE {nrmse:.3g})"
            output.warn(
                f"Warning: the torque of {joint} {found}. Check units, signs and the order of columns, and gravity, tool and payload."
            )
    base = model.report.get("base_parameters", [])
    if base:
        output.show(f"{len(base)} base inertial parameters were identified; model.json lists them with their intervals.")

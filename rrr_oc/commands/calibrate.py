"""`rrr-oc calibrate`: a calibrated model of recordings."""

from __future__ import annotations

import json
import shlex
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rrr_oc.commands.output import Json, Output, Quiet
from rrr_oc.commands.shared import Dataset, check_apart, doubted, loaded, note_without_compiler, unexplained_torques
from rrr_oc.errors import ends_at_once
from rrr_oc.storage import check_folder

if TYPE_CHECKING:
    from rrr_oc.calibration.calibrated_model import CalibratedModel

app = typer.Typer(add_completion=False)


class Way(StrEnum):
    """How parameters are found."""

    inverse = "inverse"
    response = "response"
    evolution = "evolution"


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
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Find dry friction, viscous friction and armature of every joint; where the set says "identify", inertial parameters too."""
    with ends_at_once():
        from rrr_oc.calibration.calibrate import calibrate as calibrate_inverse
        from rrr_oc.calibration.model_file import save_model
        from rrr_oc.calibration.response import calibrate_evolution, calibrate_response
        from rrr_oc.robot.robot import too_dense
    ways = {Way.inverse: calibrate_inverse, Way.response: calibrate_response, Way.evolution: calibrate_evolution}
    output = Output(quiet, as_json)
    check_folder(out)
    recordings = loaded(dataset, output)
    check_apart(recordings.files, [out / "model.json"])
    doubted(recordings, output)
    if way != Way.inverse:
        note_without_compiler(output)
    model = ways[way](recordings)
    save_model(model, out / "model.json")
    output.result(json.loads((out / "model.json").read_text(encoding="utf-8")))
    _show_model(model, output)
    for said in model.report["clocks"]:
        output.note(f"Note: {said}.")
    for warning in unexplained_torques(model):
        output.note(
            f"{warning}; if they are right, the arm has physics that this model lacks, and rrr-oc diagnose {shlex.quote(str(dataset))} "
            f"--out {shlex.quote(str(out))} says which."
        )
    if model.inertial == "identify":
        for said in too_dense(model.robot):
            output.note(f"Warning: the identified {said}. Check the units of torques and angles; rrr-oc check does.")
    output.show(f"{out / 'model.json'} holds the model.")


def _show_model(model: CalibratedModel, output: Output) -> None:
    from rrr_oc.calibration.link_findings import OffLink
    from rrr_oc.diagnosis.diagnosis_file import Measured
    from rrr_oc.report.diagnosis_words import if_identified, measured, off_links
    from rrr_oc.schema import built

    rows = []
    for term in model.terms:
        for parameter, e in zip(term.effect.parameters, term.estimates, strict=True):
            interval = "not determined" if e.interval is None else f"{e.interval[0]:.4g} … {e.interval[1]:.4g}"
            interval = "–" if e.at_bound and e.interval is not None and e.interval[0] == e.interval[1] else interval
            joints = ", ".join(model.joints[j] for j in term.effect.joints)
            held = "at its bound" if e.at_bound else ""
            rows.append([term.effect.name, joints, parameter.name, f"{e.value:.4g}", interval, parameter.unit, held])
    output.table(["effect", "joint", "parameter", "value", "95 % interval", "unit", ""], rows)
    own = zip(model.joints, model.nrmse, model.noise, strict=True)
    output.table(
        ["joint", "NRMSE of the torque", "noise [Nm]"], [[j, f"{nrmse:.4f}", f"{noise:.4g}"] for j, nrmse, noise in own]
    )
    links, unidentified = (built(model.report.get(key, []), list[OffLink]) for key in ("link_findings", "if_identified"))
    measurement = built(model.report.get("measurement", {}), dict[str, Measured])
    for line in [*off_links(links), *if_identified(unidentified), *measured(measurement)]:
        output.show(line)
    base = model.report.get("base_parameters", [])
    if base:
        output.show(f"{len(base)} base inertial parameters were identified; model.json lists them with their intervals.")

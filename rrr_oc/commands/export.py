"""`rrr-oc export`: a model as files for other programs."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from rrr_oc.calibration.model_file import load_model
from rrr_oc.commands.output import Json, Output, Quiet
from rrr_oc.commands.shared import Model as ModelFile
from rrr_oc.model.symbolic_model import Model
from rrr_oc.simulation.export import mjcf, urdf
from rrr_oc.storage import check_folder, write_text

app = typer.Typer(add_completion=False)


@app.command()
def export(
    model: ModelFile,
    out: Annotated[Path, typer.Option(help="folder for arm.xml and arm.urdf")],
    payload: Annotated[float, typer.Option(min=0.0, help="mass held at the tool, for arm.xml \\[kg]")] = 0.0,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Write a model for other programs: MJCF that plain MuJoCo runs, and the URDF with identified inertias."""
    output = Output(quiet, as_json)
    check_folder(out)
    found = load_model(model)
    everywhere = [term for term in found.terms if term.recordings == "all"]
    theta = np.concatenate([np.zeros(0), *(term.values for term in everywhere)])
    arm = Model(found.robot, found.tool, tuple(term.effect for term in everywhere))
    made = mjcf(arm, theta, payload)
    write_text(out / "arm.xml", made.text)
    write_text(out / "arm.urdf", urdf(found.urdf, found.robot))
    left_out = [
        *made.left_out,
        *(f"{t.effect.name}: only some recordings have it" for t in found.terms if t.recordings != "all"),
    ]
    for one in left_out:
        output.note(f"Not in arm.xml: {one}.")
    output.show(f"{out / 'arm.xml'} runs in plain MuJoCo: python -m mujoco.viewer --mjcf={out / 'arm.xml'}")
    output.show(f"{out / 'arm.urdf'} has the inertial parameters of the model.")
    output.result({"mjcf": str(out / "arm.xml"), "urdf": str(out / "arm.urdf"), "not_in_mjcf": left_out})

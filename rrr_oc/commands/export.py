"""`rrr-oc export`."""

from pathlib import Path

import numpy as np

from rrr_oc.calibration.model_file import load_model
from rrr_oc.commands.common import Output
from rrr_oc.model.symbolic_model import Model
from rrr_oc.simulation.export import mjcf, urdf
from rrr_oc.storage import check_folder, write_text


def run(model: Path, out: Path, payload: float, output: Output) -> None:
    """Write arm.xml and arm.urdf of a calibrated model, and say what is not in them."""
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
        output.warn(f"Not in arm.xml: {one}.")
    output.show(f"{out / 'arm.xml'} runs in plain MuJoCo: python -m mujoco.viewer --mjcf={out / 'arm.xml'}")
    output.show(f"{out / 'arm.urdf'} has the inertial parameters of the model.")
    output.result({"mjcf": str(out / "arm.xml"), "urdf": str(out / "arm.urdf"), "not_in_mjcf": left_out})

"""Exported files beside the model: what agrees, and that a file which does not is refused."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chains import arm
from commands import rrr_oc

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term, nominal_term
from rrr_oc.calibration.model_file import save_model
from rrr_oc.effects import CATALOGUE
from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.robot import load_robot
from rrr_oc.simulation.agreement import differences, largest_of
from rrr_oc.simulation.export import mjcf, urdf_of

VALUES = {
    "armature": {"inertia": 0.3},
    "viscous_friction": {"coefficient": 2.0},
    "dry_friction": {"level": 1.0},
    "parallel_spring": {"stiffness": 20.0, "equilibrium": 0.4},
    "link_inertial": {"mass": 0.3, "first_moment_x": 0.05, "inertia_yy": 0.01},
    "load_dependent_friction": {"mu": 0.1},
}


def model_of(folder: Path) -> tuple[Model, np.ndarray, str]:
    """Two links with friction, a rotor, a spring, a heavier link and a law that no file has; its parameters, and its URDF."""
    (folder / "listed.urdf").write_text(arm(2))
    robot = load_robot(folder / "listed.urdf")
    effects = tuple(CATALOGUE[name]((1,)) for name in VALUES)
    nominal = [{p.name: p.nominal for p in e.parameters} | VALUES[e.name] for e in effects]
    theta = np.array([named[p.name] for e, named in zip(effects, nominal, strict=True) for p in e.parameters])
    return Model(robot, robot.tool, effects), theta, arm(2)


def written(folder: Path, payload: float = 0.0) -> tuple[dict[str, Path], Model, np.ndarray]:
    model, theta, text = model_of(folder)
    files = {"mjcf": folder / "arm.xml", "urdf": folder / "arm.urdf"}
    files["mjcf"].write_text(mjcf(model, theta, payload).text)
    files["urdf"].write_text(urdf_of(text, model, theta).text)
    return files, model, theta


def test_files_are_those_of_the_model(tmp_path):
    files, model, theta = written(tmp_path, 0.7)
    found = differences(files, model, theta, 0.7)
    assert set(found) == {"mjcf", "urdf"}
    assert all(set(sizes) == {"mass matrix", "gravity", "torque"} for sizes in found.values())
    largest = largest_of(found)
    assert largest is not None
    assert largest[2] < 1e-5  # six digits in the files


def test_a_urdf_has_what_was_claimed_of_its_links_and_lists_what_it_lacks(tmp_path):
    files, model, _ = written(tmp_path)
    again = load_robot(files["urdf"])
    assert again.inertial[0, 1] == pytest.approx(model.robot.inertial[0, 1] + VALUES["link_inertial"]["mass"])
    text = files["urdf"].read_text()
    for name in ("armature", "parallel_spring", "load_dependent_friction", "dry_friction"):
        assert re.search(rf"^  {name}\[", text[: text.index("-->")], re.MULTILINE)
    assert "link_inertial" not in text[: text.index("-->")]


@pytest.mark.parametrize(
    ("file", "quantity"), [("mjcf", "mass matrix"), ("mjcf", "gravity"), ("mjcf", "torque"), ("urdf", "gravity")]
)
def test_another_arm_is_refused(tmp_path, file, quantity):
    """A rotor, a link or a spring that is not the model's."""
    files, model, theta = written(tmp_path)
    text = files[file].read_text()
    change = {"mass matrix": ("armature", 1.5), "gravity": ("mass", 1.05), "torque": ("damping", 1.5)}[quantity]
    number = re.compile(rf'({change[0]}(?: value)?=")([\d.e-]+)')
    files[file].write_text(number.sub(lambda m: f"{m[1]}{float(m[2]) * change[1]:.12g}", text))
    with pytest.raises(UserError, match=f"the {file.upper()} differs from the model: its "):
        largest_of({file: {quantity: differences(files, model, theta)[file][quantity]}})


def test_the_command_tells_the_largest_difference(tmp_path, monkeypatch, capsys):
    model, theta, text = model_of(tmp_path)
    numbers = iter(theta.tolist())
    terms = tuple(nominal_term(e).with_values(np.array([next(numbers) for _ in e.parameters])) for e in model.effects)
    assert all(isinstance(term, Term) for term in terms)
    none = np.full(2, np.nan)
    found = CalibratedModel(
        robot=model.robot, source="urdf", urdf=text, tool=model.tool, torque="motor", torque_constant=(None, None),
        inertial="nominal", terms=terms, noise=none, nrmse=none, versions={},
    )  # fmt: skip
    save_model(replace(found), tmp_path / "model.json")
    assert rrr_oc(monkeypatch, "export", str(tmp_path / "model.json"), "--out", str(tmp_path / "out"), "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert max(size for sizes in result["differences"].values() for size in sizes.values()) < 1e-5
    assert any(one.startswith("armature[") for one in result["not_in_urdf"])
    assert [one for one in result["not_in_mjcf"] if "load_dependent_friction" in one]

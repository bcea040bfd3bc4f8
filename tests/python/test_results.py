"""The functions of `import rrr_oc`: the same as the commands, and what is said of their results. Diagnoses and designs:
tests/whole/test_readme.py."""

import json
import subprocess
import sys
from types import SimpleNamespace

import matplotlib.image
import mujoco
import numpy as np
import pytest
from commands import rrr_oc as command
from recorded import Plant, as_set, record

import rrr_oc
from rrr_oc.errors import UserError
from rrr_oc.recordings.writer import save_recordings

TRUTH = np.array([[5.2, 7.1, 3.3], [14.0, 21.0, 9.0], [0.31, 0.22, 0.12]])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a recording set."""
    folder, plant, rng = tmp_path_factory.mktemp("python"), Plant("rrr", *TRUTH), np.random.default_rng(0)
    save_recordings(as_set(plant, [record(plant, f"{i}.csv", rng, 6.0) for i in range(2)]), folder / "set")
    return folder


@pytest.fixture(scope="module")
def model(folder):
    return rrr_oc.calibrate(folder / "set", folder / "model", quiet=True)


def test_importing_the_package_imports_nothing_heavy():
    start = "import sys, rrr_oc; rrr_oc.__version__; dir(rrr_oc); print({'numpy', 'casadi', 'mujoco'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", start], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
    with pytest.raises(AttributeError, match="has no attribute 'fly'"):
        _ = rrr_oc.fly  # type: ignore[attr-defined]


def test_calibrate_is_the_command_and_prints_nothing(folder, model, monkeypatch, capsys):
    assert capsys.readouterr().out == ""
    assert command(monkeypatch, "calibrate", folder / "set", "--out", folder / "by_command", "--quiet") == 0
    ours, theirs = (json.loads((folder / name / "model.json").read_text()) for name in ("model", "by_command"))
    assert model.content == ours
    assert [ours["effects"], ours["robot"]] == [theirs["effects"], theirs["robot"]]


def test_a_model_as_a_table_has_the_estimates_with_their_units(model):
    columns, rows = model.table()
    assert columns == ["effect", "joint", "parameter", "value", "low", "high", "unit"]
    found = {(r[0], r[1]): r for r in rows}
    row = found["dry_friction", "joint2"]
    assert row[3] == pytest.approx(7.1, rel=0.05)
    assert row[4] < row[3] < row[5]
    assert row[6] == "Nm"
    assert "joint3" in repr(model)
    assert repr(model).startswith(f"<Model in {model.folder}: ")
    assert model._repr_html_().count("<tr>") == len(rows) + 1


def test_recordings_as_a_table_have_the_samples_of_the_files(folder):
    found = rrr_oc.load(folder / "set")
    columns, rows = found.table()
    file = np.loadtxt(folder / "set" / "1.csv", delimiter=",", skiprows=1)
    own = np.array([row[1:] for row in rows if row[0] == "1.csv"])
    assert columns[:3] == ["recording", "t [s]", "q_joint1 [rad]"]
    np.testing.assert_allclose(own[:, 1:4], file[:, 1:4])
    assert "2 recordings of joint1, joint2 and joint3, 12.0 s, motor torque" in repr(found)
    assert "more rows" in found._repr_html_()
    with pytest.raises(UserError, match=r"no recording '7\.csv'; there are 0\.csv, 1\.csv"):
        found.plot("7.csv")


def test_simulate_and_export_take_results(folder, model):
    recordings = rrr_oc.load(folder / "set")
    simulated = rrr_oc.simulate(model, recordings, quiet=True)
    columns, rows = simulated.table()
    assert columns[:3] == ["recording", "joint", "signal"]
    assert {row[0] for row in rows} == {"0.csv", "1.csv"}
    assert max(row[3] for row in rows if row[2] == "q") < 0.05
    assert (simulated.folder / "0.csv").is_file()  # as long as the result is there
    files = rrr_oc.export(model, folder / "export", quiet=True)
    assert mujoco.MjModel.from_xml_path(files.mjcf).nv == 3
    assert files.urdf.endswith("arm.urdf")
    assert [row[0] for row in files.table()[1]][:2] == ["mjcf", "urdf"]


def test_plots_are_pictures(folder, model, tmp_path):
    recordings = rrr_oc.load(folder / "set")
    for name, picture in (
        ("a", recordings.plot("1.csv")),
        ("b", model.plot()),
        ("c", rrr_oc.simulate(model, recordings).plot()),
    ):
        assert picture._repr_png_().startswith(b"\x89PNG")
        drawn = matplotlib.image.imread(picture.save(tmp_path / f"{name}.png"))
        assert len(np.unique(drawn[..., :3].reshape(-1, 3), axis=0)) > 10  # more than axes


def test_a_data_frame_is_the_table(model, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=lambda rows, columns: (columns, rows)))
    assert model.to_dataframe() == model.table()
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(UserError, match="needs the package pandas"):
        model.to_dataframe()


def test_loading_takes_what_is_there(folder, model, tmp_path):
    assert rrr_oc.load(folder / "model").content == rrr_oc.load(folder / "model" / "model.json").content == model.content
    with pytest.raises(UserError, match=r"nothing to load; allowed is a folder with recordings\.json \(recordings\)"):
        rrr_oc.load(tmp_path)


def test_wrong_options_are_errors_as_at_the_command_line(folder, tmp_path):
    with pytest.raises(UserError, match="calibrate: unknown option 'wayy'; allowed are way, quiet"):
        rrr_oc.calibrate(folder / "set", tmp_path, wayy="inverse")
    with pytest.raises(UserError, match="'sideways' is not one of"):
        rrr_oc.calibrate(folder / "set", tmp_path, way="sideways")


def test_options_are_those_of_the_command(folder):
    from rrr_oc.python.functions import _words

    assert _words("design", {"configurations": ["SA", "PEA"], "repaired": True, "cycle_times": "none", "price": None}) == [
        "--configurations", "SA,PEA", "--repaired", "--cycle-times", "none",
    ]  # fmt: skip
    assert _words("diagnose", {"simulate": False, "jobs": 2}) == ["--no-simulate", "--jobs", "2"]

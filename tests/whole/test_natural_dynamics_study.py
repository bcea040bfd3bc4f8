"""The study of natural dynamics as its users run it, in a size of seconds; what it says to those who ask wrongly."""

import json
from importlib.resources import files

import natural_dynamics as study
import numpy as np
from commands import run

SMALL = ["--starts", "1", "--motions", "0", "--intervals", "10", "--tolerance", "1e-2", "--jobs", "1"]


def test_a_small_study_leaves_a_report_and_is_not_run_twice(monkeypatch, capsys, tmp_path):
    task = json.loads(files("rrr_oc.data").joinpath("paper.json").read_text()) | {"duration_s": [1.0, 1.3]}
    (tmp_path / "task.json").write_text(json.dumps(task))
    arguments = [
        "--task",
        str(tmp_path / "task.json"),
        "--configurations",
        "SA",
        "--costs",
        "load",
        *SMALL,
        "--out",
        str(tmp_path),
    ]
    assert run(study, monkeypatch, *arguments) == 0
    optima = json.loads((tmp_path / "summary.json").read_text())["optima"]
    rest, moving = optima["rest load SA"], optima["moving load SA"]
    assert moving["cost"] < rest["cost"]
    np.testing.assert_allclose(rest["speed_at_release"], 0, atol=1e-9)
    assert np.abs(moving["speed_at_release"]).max() > 0.1
    for found in (rest, moving):
        planned, other = (found["followed"][arm] for arm in study.ARMS)
        assert abs(planned["feed-forward"]["E1"] / found["cost"] - 1) < 0.05  # the mesh's 10 intervals
        assert other["feed-forward"]["energy"] > planned["feed-forward"]["energy"]
        assert planned["P"]["rms_error"] > 10 * planned["feed-forward"]["rms_error"]
    report = (tmp_path / "report.md").read_text()
    assert f"| load | moving | SA | {moving['cost']:.2f} |" in report
    assert (tmp_path / "phase_plane.png").stat().st_size > 10_000
    capsys.readouterr()
    assert run(study, monkeypatch, *arguments) == 0
    assert capsys.readouterr().err.count("taken from the interrupted or repeated run") == 4
    assert json.loads((tmp_path / "summary.json").read_text())["optima"] == optima


def test_what_there_is_not_is_refused(monkeypatch, capsys, tmp_path):
    assert run(study, monkeypatch, "--costs", "load,beauty", "--out", str(tmp_path)) == 2
    assert "--costs: unknown cost 'beauty'; allowed are load, motor, energy-0, energy-1" in capsys.readouterr().err
    assert run(study, monkeypatch, "--configurations", "VPEA", "--out", str(tmp_path)) == 2
    assert "unknown configuration 'VPEA'" in capsys.readouterr().err

"""The comparison as its users run it, in a size of seconds; its tables from a store; what it says to those who ask wrongly."""

import json
from pathlib import Path

import gradient_vs_evolution as study
import numpy as np
import pytest
from commands import run

from rrr_oc.simulation.tracking import Reference
from studies.paper.comparison import summarise
from studies.paper.comparison_report import tables
from studies.paper.run_store import Run, all_runs

STUDY = Path(__file__).resolve().parents[2] / "studies" / "gradient_vs_evolution.py"


def test_a_small_study_leaves_tables_and_figures_and_is_not_run_twice(monkeypatch, tmp_path):
    monkeypatch.setitem(study.SIZES, "reduced", study.Size(2, 3, 6, 60, 1, 2, 1, 1, (3.0,)))
    arguments = [
        "--experiments",
        "PEA",
        "--stages",
        "engine,restricted,again,race,tables",
        "--jobs",
        "1",
        "--out",
        str(tmp_path),
    ]
    assert run(study, monkeypatch, *arguments) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    entry = summary["rest"]["PEA"]
    assert len(entry["evolution-engine"]["E1"]) == 2
    assert entry["evolution-engine"]["evaluations"] == [18, 18]
    assert entry["again-analytic"]["best"] <= entry["restricted"]["best"] * (1 + 1e-9)
    race = summary["races"]["race"]["PEA"]
    assert race["won"] == 1
    assert race["reached"][0] <= race["target"] == entry["evolution-engine"]["best"]
    assert {p.name for p in tmp_path.glob("*.png")} == {"anytime.png", "trials.png", "figure_5.png"}
    text = (tmp_path / "report.md").read_text()
    assert f"{entry['restricted']['best']:.3f}" in text
    stamps = {p: p.stat().st_mtime_ns for p in (tmp_path / "runs").rglob("run.json")}
    assert run(study, monkeypatch, *arguments) == 0
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "runs").rglob("run.json")} == stamps


def store_of(folder: Path) -> Path:
    """Two ways of two experiments with made-up results of known statistics."""
    for name, low in (("SA", 100.0), ("PEA", 10.0)):
        x = [0.5] * (22 if name == "SA" else 26)
        for seed in range(3):
            labels = {
                "preset": "paper",
                "experiment": name,
                "ends": "rest",
                "way": "evolution",
                "model": "engine",
                "via": 5,
                "seed": seed,
            }
            found = {
                "x": x,
                "cost": low + seed,
                "analytic": low + seed,
                "engine": low + seed,
                "limits_exceeded": 0.0,
                "parameters": [] if name == "SA" else [10.0, 1.9, 0.5, 2.4],
                "hardware": {} if name == "SA" else {"k_p2": 10.0, "q_eq2": 1.9, "k_p3": 0.5, "q_eq3": 2.4},
                "durations": [3.0, 4.0],
                "evaluations": 40,
                "generations": 4,
                "stopped": "generations",
                "core_s": 8.0,
            }
            curve = low + seed + np.array([90.0, 9.0, 0.0, 0.0])
            arrays = {
                "best": curve,
                "core_s": np.array([1.0, 2.0, 4.0, 8.0]),
                "median": curve,
                "evaluations": 10.0 * np.arange(1, 5),
            }
            Run(folder / name / "rest" / "evolution-engine" / str(seed), labels).finish(found, arrays)
    return folder


def test_tables_say_what_the_runs_hold(tmp_path):
    summary = summarise(store_of(tmp_path), "paper")
    entry = summary["rest"]["PEA"]["evolution-engine"]
    assert entry["E1"] == [10.0, 11.0, 12.0]
    assert (entry["best"], entry["median"]) == (10.0, 11.0)
    assert entry["to_its_best_core_s"] == 4.0  # to within a per mille
    assert entry["near_best_known_core_s"] == pytest.approx(4.0, rel=0.1)  # on the curve's grid
    assert entry["curve"]["least"][-1] == 10.0
    assert entry["curve"]["largest"][-1] == 12.0
    (pair,) = summary["tests"]["evolution-engine"]["pairs"]
    assert (pair["better"], pair["worse"], pair["delta"]) == ("PEA", "SA", 1.0)
    assert pair["p"] == pytest.approx(2 / 20)  # of C(6, 3) orders
    text = tables(summary)
    assert "| PEA | 10.000 (11.00; 12.00; n = 3) |" in text
    assert "90 \\| – \\| 73 |" in text  # total decrease: evolution, gradient, paper


def test_runs_of_another_preset_are_left_out(tmp_path):
    store_of(tmp_path)
    assert len(all_runs(tmp_path)) == 6
    assert summarise(tmp_path, "prototype")["rest"] == {}


BAD = {
    "unknown protocol": (["--protocol", "huge"], "full, reduced"),
    "unknown experiment": (["--experiments", "SA,XPEA"], "'XPEA'"),
    "unknown stage": (["--stages", "dance"], "'dance'"),
    "no experiment": (["--experiments", ","], "names none"),
    "no processes": (["--jobs", "0"], "jobs"),
    "unknown preset": (["--preset", "nowhere"], "no task at 'nowhere'"),
    "no restricted optimum": (["--experiments", "SA", "--stages", "again"], "'restricted' before"),
}


@pytest.mark.parametrize(("arguments", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_one_sentence_and_status_2(monkeypatch, capsys, tmp_path, arguments, message):
    assert run(study, monkeypatch, "--out", str(tmp_path / "results"), *arguments) == 2
    told = capsys.readouterr().err.strip()
    assert told.startswith("Error: ")
    assert message in told
    assert len(told.splitlines()) == 1
    assert not (tmp_path / "results").exists()


def test_commands_to_the_plant_contain_the_feed_forward_torque():
    """A P-controller takes positions only: q_ref + torque / gain, held before and after the phase."""
    from transfer_to_plant import _command

    t, rows = np.array([0.0, 1.0, 2.0]), np.array([[0.0, 1.0, 2.0], [3.0, 3.0, 3.0]])
    phase = Reference(
        t, rows, 0 * rows, 0 * rows, np.zeros(3), name="go", feed_forward=np.array([[4.0, 4.0, 4.0], [0.0, 6.0, 0.0]])
    )
    found = _command(phase, np.array([0.0, 0.5, 1.0, 2.0, 3.0]), 2, np.array([2.0, 3.0]))
    np.testing.assert_allclose(found[0], [2, 2, 2, 2.5, 3, 4, 4])
    np.testing.assert_allclose(found[1], [3, 3, 3, 4, 5, 3, 3])

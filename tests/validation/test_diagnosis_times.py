"""The timing of diagnoses: rows that end by their limit, are taken again, are skipped, and stand beside those of another run."""

import json
from functools import partial
from pathlib import Path

import pytest

from rrr_oc.errors import UserError
from validation.diagnosis_times import ROWS, Row, Run, check_tree, chosen, comparison, real, run_all, stored, table

# In place of the package, a command that claims what its set says, or takes all the time there is
FAKE = """
import json, pathlib, sys
header = json.loads((pathlib.Path(sys.argv[2]) / "recordings.json").read_text())
print("set of", header["joints"], flush=True)
while header["forever"]:
    pass
out = pathlib.Path(sys.argv[4])
out.mkdir()
(out / "diagnosis.json").write_text(json.dumps(header["found"]))
"""


def found(level: float, *unexplained: str) -> dict:
    """The content of a diagnosis.json that claims a Stribeck effect of joint1, and an unexplained torque each of others."""
    parameters = {"level": {"value": level, "std": 0.01, "unit": "Nm"}, "width": {"value": [0.1, 2], "std": None, "unit": "1"}}
    effect = {"effect": "stribeck", "joint": "joint1", "recordings": "all", "probability": 0.97, "parameters": parameters}
    others = [{"joint": j, "depends_on": ["time"], "recordings": ["a.csv"], "probability": 0.9999} for j in unexplained]
    held = {"before": {"joint1": 0.2, "joint2": 0.4}, "after": {"joint1": 0.1, "joint2": None}}
    return {"verdict": "missing_physics", "effects": [effect], "unexplained": others, "nrmse": {"held_out": held}}


@pytest.fixture
def run(tmp_path) -> Run:
    """A run of the fake package, which ends rows after a second."""
    package = tmp_path / "tree" / "rrr_oc"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "__main__.py").write_text(FAKE)
    return Run(package.parent, tmp_path / "out", tmp_path / "cases", tmp_path / "none", 1)


def row(folder: Path, name: str, claims: dict, forever: bool = False) -> Row:
    """A row whose set says what is found in it."""
    data = folder / "sets" / name
    data.mkdir(parents=True, exist_ok=True)
    header = {"joints": ["joint1", "joint2"], "recordings": [{}], "forever": forever, "found": claims}
    (data / "recordings.json").write_text(json.dumps(header))
    return Row(name, lambda cases, shared: data)


def test_rows_are_ended_by_the_limit_skipped_or_whole_and_not_run_again(run, tmp_path):
    rows = [row(tmp_path, "quick", found(0.5)), row(tmp_path, "slow", found(0.5), forever=True)]
    rows.append(Row("real/arm", partial(real, "arm")))
    quick, slow, missing = run_all(rows, run)
    assert (quick["status"], quick["ended"], quick["verdict"]) == (0, False, "missing_physics")
    assert quick["nrmse"] == {"before": pytest.approx(0.3), "after": pytest.approx(0.1)}
    assert 0 < quick["processor_s"] < 1
    assert quick["peak_MB"] > 5  # an interpreter
    assert slow["ended"]
    assert quick["processor_s"] < slow["processor_s"] < 2  # the system looks at limits in whole seconds, and is not exact
    assert slow["said"] == "set of ['joint1', 'joint2']\n"
    assert "claims" not in slow
    assert "recordings.json is missing" in missing["skipped"]
    assert not run.result(rows[2]).exists()
    shown = (run.out / "times.md").read_text()
    assert "| ended at 1 s |" in shown
    assert "| stribeck joint1 (level 0.5 Nm, width [0.1, 2], 97.0 %) | 0.3 | 0.1 |" in shown
    (run.tree / "rrr_oc" / "__main__.py").write_text("raise SystemExit(70)")
    assert run_all(rows, run) == [quick, slow, missing] == json.loads((run.out / "times.json").read_text())


def test_two_runs_side_by_side(run, tmp_path):
    rows = [row(tmp_path, "same", found(0.5)), row(tmp_path, "other", found(0.5)), row(tmp_path, "slow", found(0.5), True)]
    run_all(rows, run)
    rows = [row(tmp_path, "same", found(0.51)), row(tmp_path, "other", found(0.7, "joint2")), row(tmp_path, "slow", found(0.5))]
    later = Run(run.tree, tmp_path / "later", run.cases, run.shared, run.limit)
    lines = comparison(run_all(rows, later), stored(run.out)).splitlines()
    assert [line.split(" | ")[-1] for line in lines[2:5]] == [
        "no |",
        "+ unexplained joint2 over time in a.csv; stribeck joint1: level 0.5 → 0.7 |",
        "– |",
    ]
    assert lines[4].split(" | ")[3].startswith("< ")  # than a row that was ended
    assert lines[-1].startswith("2 rows that neither run ended")


def test_a_failure_is_shown_by_what_it_said(run, tmp_path):
    (run.tree / "rrr_oc" / "__main__.py").write_text("import sys; sys.exit('Error: a sentence')")
    assert "| 1 | – | Error: a sentence |" in table(run_all([row(tmp_path, "bad", {})], run))


def test_rows_by_names_and_patterns():
    assert len({r.name for r in ROWS}) == len(ROWS)
    assert [r.name for r in chosen(["shared/pair", "paper/*"])][:2] == ["shared/pair", "paper/bare"]
    assert chosen([]) == list(ROWS)
    with pytest.raises(UserError, match="the rows are shared/gain"):
        chosen(["nothing"])


def test_the_tree_must_have_the_package(run, tmp_path):
    check_tree(run.tree)
    with pytest.raises(UserError, match="a checkout with the package"):
        check_tree(tmp_path)

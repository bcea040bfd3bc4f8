"""`rrr-oc demo` without its computations: what comes with the package, the truth beside claims, and the folder. The whole tour:
tests/whole/test_readme.py."""

import json
from importlib.resources import files
from pathlib import Path

import pytest
from commands import rrr_oc as run

from rrr_oc.commands.tour import demo
from rrr_oc.commands.tour.truth import beside
from validation.demo import write

BUNDLED = Path(str(files("rrr_oc.data") / "demo"))
TRUTH = json.loads((BUNDLED / demo.TRUTH).read_text())


def test_the_recordings_are_small_and_made_by_the_plant(tmp_path):
    """At most 2 MB; numbers as the script makes them again, but for the last digit, which differs between machines."""
    every = [path for path in BUNDLED.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in every) < 2_000_000
    write(tmp_path)
    made = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert made == {str(path.relative_to(BUNDLED)) for path in every} - {"task.json"}
    for name in made:
        before, now = ((folder / name).read_text() for folder in (BUNDLED, tmp_path))
        if name.endswith(".csv"):
            rows = [[float(x) for line in text.splitlines()[1:] for x in line.split(",")] for text in (before, now)]
            assert rows[0] == pytest.approx(rows[1], rel=2e-6, abs=1e-9)
            assert before.splitlines()[0] == now.splitlines()[0]
        else:
            assert len(before) == pytest.approx(len(now), abs=20)


def test_what_a_user_gets_before_the_diagnosis_is_not_the_truth(tmp_path):
    demo._give(tmp_path)
    given = "".join(path.read_text() for path in tmp_path.rglob("*") if path.is_file())
    assert (tmp_path / "arm.urdf").is_file()
    assert not (tmp_path / demo.TRUTH).exists()
    assert all(word not in given for effect in TRUTH["effects"] for word in (effect["says"], effect["effect"]))
    demo._give(tmp_path)  # a demo that was interrupted goes on


def test_a_folder_with_something_else_is_left_alone(tmp_path, monkeypatch, capsys):
    (tmp_path / "arm.urdf").write_text("mine")
    assert run(monkeypatch, "demo", "--out", tmp_path) == 2
    assert "has something other than a demo in it" in capsys.readouterr().err
    assert (tmp_path / "arm.urdf").read_text() == "mine"


def claims(stiffness: float) -> dict:
    """A diagnosis that claims the hose alone, with an interval of ± 0.01."""
    entry = {"value": stiffness, "interval": [stiffness - 0.01, stiffness + 0.01], "unit": "Nm/rad"}
    rest = {"value": 0.31, "interval": None, "unit": "rad"}
    found = {"effect": "cable_harness", "joint": "elbow", "parameters": {"stiffness": entry, "rest": rest}}
    along = {"joint": "elbow", "quantity": "first_moment", "value": 0.315, "interval": [0.31, 0.32], "along": [0.0, 0.0, 1.0]}
    return {"effects": [found], "link_findings": [{"link": "forearm", "directions": [along]}]}


def test_the_truth_beside_claims_tells_right_wrong_and_missing():
    right, wrong = (list(beside(TRUTH, claims(k))) for k in (0.805, 0.85))
    assert right[0][1:] == ["elbow: stiffness", "0.8 Nm/rad", "0.805", "0.795 … 0.815", "yes"]
    assert wrong[0][3:] == ["0.85", "0.84 … 0.86", "no"]
    assert right[1][3:] == ["0.31", "not determined", "–"]
    assert [row[3] for row in right[2:4]] == ["not claimed"] * 2  # the grease
    assert right[4][1:] == ["forearm: first moment", "0.3146 kg m", "0.315", "0.31 … 0.32", "yes"]
    assert right[5][3] == "not claimed"

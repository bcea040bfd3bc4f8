"""`rrr-oc compare` of a fleet: what is on which arm, and an arm that was changed by hand stands out."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import rrr_oc as command
from filled import filled
from msgspec import to_builtins
from recorded import Plant, as_set, record

import rrr_oc
from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.model_file import save_model
from rrr_oc.comparison.fleet import names
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile
from rrr_oc.storage import plain

ERROR = 0.1  # [Nm] of dry friction, 1 σ
HARNESS = {
    "effect": "cable_harness",
    "joint": "joint2",
    "recordings": "all",
    "parameters": {"stiffness": {"value": 6.0, "unit": "Nm/rad", "interval": (5.8, 6.2)}},
}
POSSIBLE = {"effect": "cable_harness", "joint": "joint2", "recordings": "all", "probability": 0.7}
TOLD = {
    "a": {"format": "rrr_oc-diagnosis/1", "verdict": "missing_physics", "effects": [HARNESS]},
    "c": {"format": "rrr_oc-diagnosis/1", "verdict": "missing_physics", "possible": [POSSIBLE]},
}
CLEAN = {"format": "rrr_oc-diagnosis/1", "verdict": "nothing_missing"}


@pytest.fixture(scope="module")
def base() -> CalibratedModel:
    plant = Plant("rrr", np.ones(3), np.ones(3), np.ones(3))
    return plain_model(as_set(plant, [record(plant, "0.csv", np.random.default_rng(0), 1.0)]))


def with_friction(base: CalibratedModel, value: float) -> CalibratedModel:
    """With this dry friction of joint 2, as if recordings had told it."""
    terms = [
        replace(t, estimates=(Estimate(value, ERROR, (value - 1.96 * ERROR, value + 1.96 * ERROR)), *t.estimates[1:]))
        if (t.effect.name, t.effect.joints) == ("dry_friction", (1,))
        else t
        for t in base.terms
    ]
    return replace(base, terms=tuple(terms))


@pytest.fixture
def folders(base, tmp_path) -> list[Path]:
    """Six arms; the friction of the last is far from that of the others."""
    result = []
    for name, value in zip("abcdef", (5.0, 5.2, 4.9, 5.1, 5.0, 9.0), strict=True):
        folder = tmp_path / name / "diagnosis"
        folder.mkdir(parents=True)
        save_model(with_friction(base, value), folder / "model.json")
        content = filled(TOLD.get(name, CLEAN), DiagnosisFile)
        (folder / "diagnosis.json").write_text(json.dumps(plain(to_builtins(content))))
        result.append(folder)
    return result


def test_a_fleet_is_a_table_and_a_page(folders, monkeypatch, capsys, tmp_path):
    assert command(monkeypatch, "compare", *folders, "--out", tmp_path / "page") == 0
    said = capsys.readouterr().out
    assert "Found on 6 arms: cable harness of joint2 on a; f by 1 number stands out." in said
    page = (tmp_path / "page" / "fleet.html").read_text()
    assert "stiffness 6.0 ± 0.2 Nm/rad" in page
    assert len(page) < 2_000_000


def test_what_an_arm_has_otherwise_and_which_number_stands_out(folders):
    found = rrr_oc.compare(*folders)
    columns, rows = found.table()
    assert columns[:3] == ["arm", "verdict", "cable harness of joint2"]
    assert [row[2] for row in rows] == ["stiffness 6.0 ± 0.2 Nm/rad", "–", "possible", "–", "–", "–"]
    (one,) = found.content["outliers"]
    assert (one["arm"], one["effect"], one["joints"], one["b"], one["median"]) == ("f", "dry_friction", ["joint2"], 9.0, 5.05)
    scatter = 1.4826 * np.median(np.abs(np.array([5.0, 5.2, 4.9, 5.1, 5.0, 9.0]) - 5.05))
    assert one["times"] == pytest.approx(3.95 / np.hypot(scatter, ERROR), rel=1e-6)


def test_few_arms_have_no_outlier_and_models_are_no_fleet(folders, monkeypatch, capsys):
    assert rrr_oc.compare(*folders[3:]).content["outliers"] == []
    assert command(monkeypatch, "compare", folders[0], folders[1] / "model.json", folders[2]) == 2
    assert "model.json: is no diagnosis" in capsys.readouterr().err
    assert command(monkeypatch, "compare", folders[0]) == 2
    assert "two or more can be compared" in capsys.readouterr().err


def test_arms_are_named_by_what_distinguishes_their_paths():
    assert names([Path("/x/a/diagnosis"), Path("/x/b/diagnosis")]) == ("a", "b")
    assert names([Path("/x/a/1"), Path("/x/b/2")]) == ("a/1", "b/2")
    assert names([Path("/x/a"), Path("/x/a")]) == ("/x/a", "/x/a")

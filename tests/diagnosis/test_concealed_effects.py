"""Diagnosis, by its command, of recordings that the independent plant made, with an effect concealed in them or with none."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner

from rrr_oc.calibration.calibrated_model import Estimate, Term
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.model_file import load_model
from rrr_oc.calibration.prediction_error import evaluate_inverse
from rrr_oc.calibration.regression import rows
from rrr_oc.calibration.samples import prepare
from rrr_oc.commands import app
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile
from rrr_oc.diagnosis.result import Finding
from rrr_oc.diagnosis.signatures import table, view
from rrr_oc.diagnosis.suggestion import suggest
from rrr_oc.effects import Trial
from rrr_oc.effects.black_box.empirical import Empirical
from rrr_oc.recordings.reader import load_recordings
from validation.concealed.cases import Concealed


def run(*arguments: object) -> None:
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output


@cache
def output(case: Path) -> Path:
    """Where a case's diagnosis is, made once."""
    run("diagnose", case / "data", "--out", case / "out", "--jobs", 1)
    return case / "out"


def diagnosed(case: Path) -> dict:
    out = output(case)
    text = (out / "diagnosis.json").read_text()
    assert msgspec.json.decode(text, type=DiagnosisFile).held_out in ("recordings", "blocks")  # as its reference describes it
    files = {"diagnosis.json", "model.json", "report.html", "figures.npz", "before_after.png", "prediction.png"}
    assert {p.name for p in out.iterdir()} >= files
    return json.loads(text)


@pytest.mark.parametrize(
    ("robot", "effect"),
    [("arm2", "load_dependent_friction"), ("arm1", "stribeck")],
)
def test_names_what_was_concealed(made, robot, effect):
    case, truth = made(f"{effect}/{robot}", robot, Concealed(effect, 2.0))
    found = diagnosed(case)
    (hidden,) = truth["effects"]
    assert found["format"] == "rrr_oc-diagnosis/1"
    assert found["verdict"] == "missing_physics"
    assert [(e["effect"], e["joint"], e["recordings"]) for e in found["effects"]] == [(effect, hidden["joint"], "all")]
    for name, parameter in found["effects"][0]["parameters"].items():
        true = hidden["parameters"][name]["value"]
        assert abs(parameter["value"] - true) < 5 * parameter["std"] + 0.02 * abs(true)  # the plant's law is sampled
    assert all(m["significant"] == (m["joint"] == hidden["joint"]) for m in found["mismatch"] if m["joint"] == hidden["joint"])


def test_repaired_model_predicts_unseen_recordings(made, tmp_path):
    case, truth = made("load_dependent_friction/arm2", "arm2", Concealed("load_dependent_friction", 2.0))
    found = diagnosed(case)
    run("calibrate", case / "data", "--out", tmp_path / "plain")
    unseen, joint = load_recordings(case / "unseen"), truth["effects"][0]["joint"]
    plain, repaired = (evaluate_inverse(load_model(at / "model.json"), unseen) for at in (tmp_path / "plain", output(case)))
    for file in plain:
        assert repaired[file][joint]["nrmse"] < 0.7 * plain[file][joint]["nrmse"]
    for when in ("before", "after"):
        entry = found["bootstrap"][joint][when]
        assert entry["value"] == pytest.approx(found["nrmse"]["held_out"][when][joint])
        assert entry["interval"][0] < entry["value"] < entry["interval"][1]
    assert found["bootstrap"][joint]["ratio"]["interval"][1] < 1
    assert found["simulated"]["after"][joint]["tau_load"] < found["simulated"]["before"][joint]["tau_load"]


@pytest.mark.parametrize("robot", ["arm1", "arm3"])
def test_stays_silent_where_nothing_is_missing(made, robot):
    case, _ = made(f"clean/{robot}", robot)
    found = diagnosed(case)
    assert found["verdict"] == "nothing_missing"
    assert found["effects"] == []
    assert found["unexplained"] == []
    assert not any(m["significant"] for m in found["mismatch"])


def test_a_motion_is_suggested_that_tells_a_series_from_its_rival(made):
    case, _ = made("clean/arm2", "arm2")
    recordings = load_recordings(case / "data")
    prepared, plain = prepare(recordings), plain_model(recordings)
    effect = Empirical((1,), (("q", 1),), (-1.0,), (1.0,), edges=((1, 0.9, 3), (-1, 0.1, 3)))

    def apart(size: float) -> str:
        found = Finding(Term(effect, (Estimate(size), Estimate(-size)), 0.05), 1.0, 50.0, 1e-9, (("torque_offset", (1,)),))
        (suggestion,) = suggest(recordings, replace(plain, noise=np.full(2, 0.01)), [found], False, view(prepared, plain))
        assert suggestion.separates == ("empirical", "torque_offset")
        return suggestion.why

    assert "differ by 0" not in apart(300.0)
    assert apart(300.0) != apart(3.0)


@pytest.mark.parametrize(
    ("variables", "orders", "edges"),
    [
        ((("motor", 0), ("time", -1)), (1, 1), ()),
        ((("motor", 1), ("dq", 0)), (1, 2), ()),
        ((("motor", 1),), (), ((1, 0.8, 3), (-1, 0.2, 1))),
        ((("ddq", 0),), (3,), ()),
    ],
)
def test_signature_of_an_unexplained_torque_is_its_exact_derivative(made, variables, orders, edges):
    case, _ = made("clean/arm2", "arm2")
    recordings = load_recordings(case / "data")
    prepared = prepare(recordings)[:1]
    low, high = (-0.5,) * len(variables), (0.5, 15.0)[: len(variables)]
    effect = Empirical((1,), variables, low, high, orders, edges=edges)
    start = plain_model(recordings)
    term = Term(effect, tuple(Estimate(0.1) for _ in effect.parameters), 0.05)
    model = replace(start, terms=(*start.terms, term))
    zero = dict.fromkeys(effect.amplitudes, 0.0)
    trial = Trial(effect, tuple(zero | {name: 1.0} for name in effect.amplitudes), width=0.05)
    exact = rows(prepared, model).jacobian[:, :, len(start.terms) :]
    assert np.abs(exact).max() > 5e-3
    found, signature = table(prepared, model, [trial]), np.zeros_like(exact)
    for j, (values, used) in enumerate(zip(found.values, found.used, strict=True)):
        signature[j][:, used] = values
    np.testing.assert_allclose(signature, exact, atol=1e-6)

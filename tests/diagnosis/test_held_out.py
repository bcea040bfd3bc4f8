"""Errors before and after a diagnosis: intervals on numbers whose answers are known, and the twin on a made-up plant."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from filled import filled
from recorded import Plant, as_set, record

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.calibrated_model import Estimate, Term
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.prediction_error import SIGNALS
from rrr_oc.diagnosis import held_out as before_after
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile
from rrr_oc.diagnosis.held_out import _means, acts_on, in_closed_loop, intervals, joints_made_worse, ranges
from rrr_oc.diagnosis.procedure import ready
from rrr_oc.diagnosis.result import Diagnosis, Fold
from rrr_oc.effects.body.gravity_tilt import GravityTilt
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.effects.priors import Priors
from rrr_oc.effects.sensor.encoder_offset import EncoderOffset
from rrr_oc.effects.transmission.backlash import Backlash
from rrr_oc.effects.transmission.joint_elasticity import JointElasticity
from rrr_oc.report.diagnosis_report import write_diagnosis
from rrr_oc.report.diagnosis_words import extrapolated, sentence

STIFFNESS, REST = 15.0, 1.5  # of the spring that nobody listed [Nm/rad, rad]


def fold(k: int, models, errors) -> Fold:
    """A fold that holds out recording k."""
    return Fold((k,), *models, *errors)


@pytest.fixture(scope="module")
def diagnosis() -> Diagnosis:
    """Three recordings with an unlisted spring at joint 2; the extended models have it, the plain ones do not."""
    plant, rng = Plant("rrr", np.full(3, 1.0), np.full(3, 4.0), np.full(3, 0.1)), np.random.default_rng(0)
    made = [record(plant, f"{k}.csv", rng, 3.0, pea={1: (STIFFNESS, REST)}) for k in range(3)]
    recordings = as_set(plant, [replace(r, springs=()) for r in made])
    start = plain_model(recordings)
    truth = [v for j in range(3) for v in (1.0, 4.0, 0.1)]
    plain = replace(
        start,
        terms=tuple(t.with_values(np.array([v])) for t, v in zip(start.prompt_terms, truth, strict=True)),
        noise=np.ones(3),
    )
    spring = Term(ParallelSpring((1,)), (Estimate(STIFFNESS), Estimate(REST)), 0.003)
    model = replace(plain, terms=(*plain.terms, spring))
    before, after = (
        np.array([[0.1, 0.4, np.nan]] * 3) * [[1.0], [2.0], [3.0]],
        np.array([[0.1, 0.1, np.nan]] * 3) * [[1], [2], [3]],
    )
    folds = tuple(fold(k, (plain, model), (before[k : k + 1], after[k : k + 1])) for k in range(3))
    none = np.zeros(3)
    return Diagnosis(
        recordings,
        plain,
        model,
        (),
        (),
        (),
        (),
        (),
        (),
        (none, none),
        (none, none),
        "recordings",
        (),
        (),
        folds,
        (0.0,) * 3,
    )


def test_intervals_of_numbers_that_are_known(diagnosis):
    found = intervals(diagnosis)
    assert found["joint2"]["ratio"] == {"value": pytest.approx(0.25), "interval": [pytest.approx(0.25), pytest.approx(0.25)]}
    assert found["joint2"]["before"]["value"] == pytest.approx(0.8)
    low, high = found["joint2"]["before"]["interval"]
    assert 0.4 <= low < 0.8 < high <= 1.2 + 1e-9  # within the smallest and the largest recording
    assert found["joint3"]["before"] == {"value": None, "interval": None}  # it never moves
    two = replace(diagnosis, folds=diagnosis.folds[:2])
    assert intervals(two)["joint2"]["before"] == {"value": pytest.approx(0.6), "interval": None}


def test_intervals_cover_as_often_as_they_say(diagnosis, monkeypatch):
    monkeypatch.setattr(before_after, "RESAMPLES", 400)
    rng, hits, rounds = np.random.default_rng(1), 0, 100
    for _ in range(rounds):
        before = rng.gamma(9.0, 1.0, (12, 3))
        fold = replace(diagnosis.folds[0], held=tuple(range(12)), before=before, after=0.5 * before)
        low, high = intervals(replace(diagnosis, folds=(fold,)))["joint1"]["before"]["interval"]
        hits += low < 9.0 < high
    # 95 % is meant; of twelve a bootstrap gives some 91 %. Three standard errors of 100 rounds are 9 %
    assert 0.82 < hits / rounds < 0.99


def test_the_twin_tracks_better_with_what_was_missing(diagnosis):
    found = in_closed_loop(diagnosis)
    assert found["held_out"] is True
    before, after = (found[key]["joint2"] for key in ("before", "after"))
    for signal in ("tau_motor", "tau_load"):
        assert after[signal] < 0.3 * before[signal]
    assert set(after) == {"q", "dq", "ddq", "tau_motor", "tau_load"}


def test_what_the_twin_cannot_simulate_is_said(diagnosis):
    gap, twist = (
        Term(Backlash((0,)), (Estimate(0.02), Estimate(0.1))),
        Term(JointElasticity((0,)), (Estimate(500.0), Estimate(0.002))),
    )
    with_gap = replace(diagnosis.plain, terms=(*diagnosis.plain.terms, twist, gap))
    found = in_closed_loop(replace(diagnosis, folds=tuple(replace(f, model=with_gap) for f in diagnosis.folds)))
    assert "joint1" in found["before"]
    assert "backlash[joint1]" in found["after"]["why_not"]


def test_the_page_holds_its_figures_and_says_what_was_not_simulated(diagnosis, tmp_path):
    found = write_diagnosis(diagnosis, tmp_path)
    assert "simulated" not in found
    assert json.loads((tmp_path / "diagnosis.json").read_text()) == found
    text = (tmp_path / "report.html").read_text()
    assert text.count('class="plot"') == 1 + 1 + 6  # before and after, prediction, what is left with both models
    assert "In closed loop" not in text
    numbers = {j: dict.fromkeys(SIGNALS, 0.25) for j in diagnosis.model.joints}
    simulated = {"held_out": True, "before": numbers, "after": {"why_not": "a <gap> moves the link by itself"}}
    write_diagnosis(diagnosis, tmp_path, simulated)
    text = (tmp_path / "report.html").read_text()
    assert "The extended model was not simulated: a &lt;gap&gt; moves the link by itself." in text
    assert ">25.0 % → –</td>" in text


def test_the_page_says_for_which_recordings_nothing_could_be_foretold(diagnosis, tmp_path):
    assert write_diagnosis(diagnosis, tmp_path)["alone"] == []
    assert "foretold" not in (tmp_path / "report.html").read_text()
    *plain, spring = diagnosis.model.terms
    one = replace(diagnosis.model, terms=(*plain, replace(spring, recordings=(), groups=("0.csv",))))
    found = write_diagnosis(replace(diagnosis, model=one), tmp_path)
    assert found["alone"] == ["0.csv", "1.csv", "2.csv"]  # each is a set-up of its own
    assert "cannot be foretold" in (tmp_path / "report.html").read_text()
    twins = [replace(r, group=r.group if r.file == "1.csv" else "same") for r in diagnosis.recordings.recordings]
    shared = replace(diagnosis, model=one, recordings=replace(diagnosis.recordings, recordings=tuple(twins)))
    assert write_diagnosis(shared, tmp_path)["alone"] == ["1.csv"]


def test_the_verdict_is_a_sentence(diagnosis):
    found = {
        "verdict": "missing_physics",
        "effects": [{"effect": "payload_mass", "joint": None, "recordings": ["a.csv"], "indistinguishable_from": []}],
        "unexplained": [],
        "bootstrap": intervals(diagnosis),
    }
    text = sentence(filled(found, DiagnosisFile))
    assert text.startswith("The calibrated model lacks payload mass in 1 of the recordings.")
    assert "joint2's torque goes from 80.0 % to 20.0 %" in text
    errors = {
        "calibration": {"before": {"joint1": 0.05, "joint2": 0.1}},
        "held_out": {"before": {"joint1": 0.06, "joint2": 0.8}},
    }
    silent = filled({"verdict": "nothing_missing", "nrmse": errors}, DiagnosisFile)
    assert sentence(silent).startswith("Nothing is missing: the calibrated model explains these recordings to their noise. But")
    assert "(an error of 80.0 % against 10.0 % on joint2)" in sentence(silent)
    silent.nrmse.held_out.before["joint2"] = 0.12
    assert sentence(silent).endswith("noise.")


def test_a_twin_that_diverges_on_a_recording_gives_no_mean():
    good = {"joint1": {s: {"nrmse": 0.1, "rmse": 1.0} for s in SIGNALS}}
    bad = {"joint1": {s: {"nrmse": None, "rmse": None} for s in SIGNALS}}
    assert _means([([{"a.csv": good, "b.csv": good}], {})], ["joint1"])["joint1"]["q"] == pytest.approx(0.1)
    assert _means([([{"a.csv": good}], {}), ([{"b.csv": bad}], {})], ["joint1"]) == {
        "why_not": "it diverges while it follows b.csv"
    }


@pytest.mark.parametrize(
    ("effect", "joints"), [(ParallelSpring((1,)), [1]), (EncoderOffset((1,)), [0, 1, 2]), (GravityTilt(()), [0, 1, 2])]
)
def test_what_changes_motion_or_body_acts_on_all_joints(effect, joints):
    assert acts_on(effect, 3) == joints


def reaching(reach: float) -> Any:
    """Three recordings of two joints, each held out once, on all of which the first joint's error rises: in the last it goes `reach` times
    as far as in the others."""
    t = np.arange(0, 10, 0.02)
    motions = [np.array([np.sin(t) * (reach if k == 2 else 1.0), np.sin(t)]) for k in range(3)]
    made = [SimpleNamespace(q=q, dq=np.gradient(q, t, axis=1)) for q in motions]
    errors = {"before": np.array([[0.1, 0.1]]), "after": np.array([[0.2, 0.1]])}
    return SimpleNamespace(recordings=made, joints=("a", "b")), [SimpleNamespace(held=(k,), **errors) for k in range(3)]


@pytest.mark.parametrize(("reach", "said"), [(1.0, "inside"), (2.0, "outside")])
def test_an_error_says_whether_the_motion_was_covered(reach, said):
    """The last of three recordings goes as far as the others, or twice as far, on the first of two joints."""
    recordings, folds = reaching(reach)
    found = ranges(recordings, folds)
    assert found == {"a": said, "b": "inside"}
    file = filled({"nrmse": {"held_out": {"range": found}}, "held_out": "recordings"}, DiagnosisFile)
    (line, *rest) = extrapolated(file) or [""]
    assert ("move a at" in line) == (said == "outside")
    assert not rest


@pytest.mark.parametrize(("reach", "worse"), [(1.0, {0}), (2.0, set())])
def test_an_error_that_rises_where_the_motion_was_covered_tells_against_what_was_found(reach, worse):
    assert joints_made_worse(*reaching(reach)) == worse


def test_what_is_held_out_is_predicted_by_what_a_calibration_reports(planar):
    """Where a law is missing, the likeliest model predicts worse than the reported one, and held-out errors are of what is reported."""
    plant, rng = planar(1), np.random.default_rng(3)
    made = [record(plant, f"{k}.csv", rng, 8.0) for k in range(3)]
    # no law of the catalogue: a torque with the product of position, speed and acceleration
    odd = [replace(r, tau=r.tau + 0.3 * r.tau.std() * np.tanh(r.q * r.dq * r.ddq)) for r in made]
    recordings = as_set(plant, odd)
    _, fitter, _, plain = ready(recordings, Priors())
    begin = fitter.with_signs(fitter.fit(plain, fitter.data.links.none))
    _, one = before_after._fold(0, fitter, begin, None, (0,))
    reported = calibrate(replace(recordings, recordings=tuple(odd[1:])))
    wanted = before_after.nrmse(fitter.data.part((0,)), reported)
    np.testing.assert_allclose(one.before, wanted, rtol=0.01)

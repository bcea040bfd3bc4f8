"""The stages of a diagnosis: one that goes on from any of them ends in the same numbers, and what fails at the end costs nothing else."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import chains
import numpy as np
import pytest
from recorded import Plant, as_set, record
from typer.testing import CliRunner

from rrr_oc.calibration.calibrated_model import Estimate
from rrr_oc.calibration.estimator.left_out import Fall
from rrr_oc.calibration.link_findings import Off, OffLink
from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.commands import app
from rrr_oc.commands import diagnose as command
from rrr_oc.commands.output import Output
from rrr_oc.diagnosis import alternatives, held_out, procedure
from rrr_oc.diagnosis.claims import classes
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile, to_json
from rrr_oc.diagnosis.held_out import intervals
from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.diagnosis.result import Diagnosis, Like, Possible, Suggestion
from rrr_oc.diagnosis.stages import SHARES, Stages
from rrr_oc.diagnosis.structures.search import StructureSearch
from rrr_oc.errors import UserError
from rrr_oc.kept import Keeping
from rrr_oc.progress import Step
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.recordings.writer import save_recordings
from rrr_oc.report import diagnosis_report
from rrr_oc.schema import built

ORDER = ["plain model", "search", *(f"search without part {k} of 3" for k in (1, 2, 3)), "held-out check"]


class Run:
    """A diagnosis whose stages are kept in a folder, and what was said of it."""

    def __init__(self, recordings: RecordingSet, folder, asked: str = "these") -> None:
        self.said: list[str] = []
        self.steps: list[Step] = []
        kept = Keeping(folder, {"recordings": asked, "code": "1"}, SimpleNamespace(note=self.said.append))
        self.found = diagnose(recordings, self.steps.append, None, kept)


def numbers(found: Diagnosis) -> str:
    """All that a diagnosis says, but the seconds that it took."""
    models = [(m.terms, m.robot.inertial.tolist(), m.noise.tolist()) for m in (found.plain, found.model)]
    return json.dumps(to_json(found) | {"bootstrap": intervals(found)}) + repr(models)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory) -> RecordingSet:
    """Of one joint with quadratic drag."""
    folder = tmp_path_factory.mktemp("arm")
    (folder / "arm.urdf").write_text(chains.arm(1))
    plant, rng = Plant(folder / "arm.urdf", np.ones(1), np.ones(1), 0.1 * np.ones(1)), np.random.default_rng(1)
    made = [record(plant, f"{i}.csv", rng, 5.0, 0.01) for i in range(3)]
    drag = [0.4 * r.dq * np.abs(r.dq) for r in made]
    return as_set(plant, [r.__class__(**(r.__dict__ | {"tau": r.tau + d})) for r, d in zip(made, drag, strict=True)])


@pytest.fixture(scope="module")
def whole(recordings, tmp_path_factory):
    """A diagnosis that nobody interrupted, and its folder."""
    folder = tmp_path_factory.mktemp("whole")
    return Run(recordings, folder), folder


def test_without_a_folder_the_numbers_are_the_same(recordings, whole):
    assert numbers(diagnose(recordings)) == numbers(whole[0].found)
    assert [f.term.effect.name for f in whole[0].found.findings] == ["quadratic_drag"]
    assert whole[0].said == []


@pytest.mark.parametrize("stages", [1, 2, 4, 6])
def test_a_diagnosis_goes_on_from_any_stage_to_the_same_numbers(recordings, whole, tmp_path, stages, monkeypatch):
    _, folder = whole
    for name in ORDER[:stages]:
        shutil.copy(folder / f".{name}.json", tmp_path)
    if stages > 1:  # then nothing is searched again on all recordings
        monkeypatch.setattr(StructureSearch, "run", lambda *_: pytest.fail("it searched again"))
    again = Run(recordings, tmp_path)
    assert numbers(again.found) == numbers(whole[0].found)
    taken = [line for line in again.said if "taken from" in line]
    assert len(taken) == (stages if stages < len(ORDER) else 2)  # the last has all but the clocks of the recordings


def test_other_recordings_are_begun_anew(recordings, whole, tmp_path):
    shutil.copytree(whole[1], tmp_path, dirs_exist_ok=True)
    again = Run(recordings, tmp_path, "others")
    assert numbers(again.found) == numbers(whole[0].found)
    assert again.said
    assert all(
        line.endswith(f": begun anew; what is saved in {tmp_path} was made with other settings: recordings")
        for line in again.said
    )


def test_what_a_search_remembers_is_read_back(recordings):
    _, fitter, every, plain = procedure.ready(recordings, procedure.Priors())
    search = StructureSearch.of(fitter, every)
    at = search.run(fitter.with_signs(fitter.fit(plain, fitter.data.links.none)))
    again = StructureSearch.of(fitter, every).restored(search.memory)
    assert (again.visited, again.predicted) == (search.visited, search.predicted)
    assert [len(one.fitted.extra) for one in again.path] == [len(one.fitted.extra) for one in search.path]
    there = again.path[-1]
    assert there.score == at.score
    moved = there.fitted.model.values - at.fitted.model.values
    spread = np.sqrt(np.diag(np.linalg.inv(at.fitted.posterior.matrix)))[: len(moved)]
    assert np.all(np.abs(moved) < spread)  # a search ends a step before the optimum where that seems linear enough
    assert there.fitted.posterior.cost(there.fitted.residual) <= there.fitted.posterior.cost(at.fitted.residual)
    np.testing.assert_array_equal(there.fitted.posterior.hyper.sigma, at.fitted.posterior.hyper.sigma)
    assert [t.effect for t in there.fitted.model.terms] == [t.effect for t in at.fitted.model.terms]


def test_steps_go_forward_through_all_stages(whole):
    done = [step.done for step in whole[0].steps]
    assert done == sorted(done)
    assert 0 <= done[0] <= done[-1] <= 1
    stages = list(dict.fromkeys(step.stage for step in whole[0].steps))
    assert stages == [name for name in SHARES if name in stages] == list(SHARES)[:4]
    assert max(step.tried for step in whole[0].steps if step.stage == "search") > 1


def failing(*_):
    raise RuntimeError("variables [ddq_1] are free")


@pytest.mark.parametrize(
    ("module", "function", "step"),
    [
        (held_out, "in_closed_loop", "tracking"),
        (procedure, "suggest", "suggested recordings"),
        (classes, "as_good", "comparison: links in the place of quadratic_drag"),
        (alternatives, "equal_terms", "alternatives to quadratic_drag of j1"),
        (diagnosis_report, "draw_errors", "before_after.png"),
        (diagnosis_report, "draw_prediction", "prediction.png"),
        (diagnosis_report, "curves", "report.html and prediction.png"),
    ],
)
def test_an_optional_step_that_fails_is_named_and_costs_nothing_else(recordings, tmp_path, monkeypatch, module, function, step):
    clean = recordings.__class__(**(recordings.__dict__ | {"path": tmp_path / "set"}))
    save_recordings(clean, tmp_path / "set")
    monkeypatch.setattr(module, function, failing)
    ended = CliRunner().invoke(
        app, ["diagnose", str(tmp_path / "set"), "--out", str(tmp_path / "out"), "--jobs", "1", "--json"]
    )
    assert ended.exit_code == 0, ended.output
    content = json.loads(ended.stdout)  # one document
    assert content == json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert content["failed"][step] == "RuntimeError: variables [ddq_1] are free"
    assert step.startswith("comparison") or len(content["failed"]) == 1
    assert [e["effect"] for e in content["effects"]] == ["quadratic_drag"]
    assert (tmp_path / "out" / "model.json").is_file()
    if step != "report.html and prediction.png":
        assert f"Not made: {step}" in (tmp_path / "out" / "report.html").read_text()
    steps = [json.loads(line) for line in ended.stderr.splitlines() if line.startswith("{")]
    assert [s["stage"] for s in steps][-1] == "report"
    assert all({"stage", "share_done", "tried", "seconds", "seconds_left"} <= s.keys() for s in steps)


def test_why_there_is_no_tracking_is_asked_again_and_steps_are_in_words(recordings, tmp_path, monkeypatch):
    """As where a C compiler was missing and no longer is."""
    save_recordings(recordings.__class__(**(recordings.__dict__ | {"path": tmp_path / "set"})), tmp_path / "set")
    arguments = ["diagnose", str(tmp_path / "set"), "--out", str(tmp_path / "out"), "--jobs", "1"]
    with monkeypatch.context() as patch:
        patch.setattr(held_out, "evaluate_simulated", failing)
        first = CliRunner().invoke(app, arguments)
    assert "quadratic drag of j1" in first.stderr
    assert "quadratic_drag" not in first.stderr
    file = tmp_path / "out" / "diagnosis.json"
    without = json.loads(file.read_text())["simulated"]["before"]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    tracked = json.loads(file.read_text())["simulated"]["before"]
    assert without == {"why_not": "RuntimeError: variables [ddq_1] are free"}
    assert tracked.keys() == {"j1"}


def test_a_part_that_fails_costs_no_other(recordings, whole, tmp_path, monkeypatch):
    """Of three parts that are left out in turn the second; it is tried again by the same command."""

    def second_fails(number, *arguments):
        return failing() if number == 1 else fold(number, *arguments)

    fold = held_out._fold
    monkeypatch.setattr(held_out, "_fold", second_fails)
    found = Run(recordings, tmp_path).found
    assert found.failed == {"search without part 2 of 3": "RuntimeError: variables [ddq_1] are free"}
    assert [f.held for f in found.folds] == [f.held for f in whole[0].found.folds if f.held != whole[0].found.folds[1].held]
    assert [f.term.effect.name for f in found.findings] == ["quadratic_drag"]
    assert [(tmp_path / f".{name}.json").is_file() for name in ORDER] == [True, True, True, False, True, True]
    monkeypatch.setattr(held_out, "_fold", failing)
    alone = Run(recordings, tmp_path / "none").found
    assert len(alone.failed) == 3
    content = diagnosis_report.write_diagnosis(alone, tmp_path / "none")
    assert content["nrmse"]["held_out"]["before"] == {"j1": None}
    assert (tmp_path / "none" / "report.html").is_file()


def test_what_is_no_number_is_null_and_is_read_as_none(recordings, whole, tmp_path):
    """Whatever a diagnosis computes can be kept, written and read."""
    found, gone = whole[0].found, np.nan
    (f,) = found.findings
    estimate = replace(f.term.estimates[0], std=np.inf, interval=(gone, gone))
    term = replace(f.term, estimates=(estimate,))
    model = replace(
        found.model, terms=(*found.model.terms[:-1], term), report={"correlation": [gone]}, unexplained=np.array([gone])
    )
    spread = np.array(found.model.spread)
    spread[0, 0] = 1e30
    fall, like = Fall(0, gone, -np.inf, np.inf), Like(term, gone)
    f = replace(f, term=term, worth=-np.inf, probability=gone, p_value=gone, fall=fall, innovations=fall, like=like, reach=gone)
    strange = replace(
        found,
        model=replace(model, spread=spread),
        findings=(f,),
        small=(f,),
        possible=(Possible(f.key, (), gone),),
        anatomy=({"noise": gone},),
        links=(OffLink(found.model.robot.links[0], (), gone, mass=Off(gone, 1.0, gone)),),
        idle=((0, gone, gone),),
        suggestions=(Suggestion("it would tell more", (), recordings.recordings[0]),),
        above_noise=(np.inf,),
        calibration=(np.array([gone]), np.array([gone])),
    )
    stages = Stages(recordings, found.plain, Keeping(tmp_path, {"code": "1"}, SimpleNamespace(note=print)))
    stages.keep("one", strange)
    assert repr(stages.saved("one")) == repr(strange)
    assert stages.saved("one").recordings is recordings
    content = diagnosis_report.write_diagnosis(strange, tmp_path)
    assert content["failed"] == {}
    assert (content["left_over"], content["effects"][0]["log_odds"]) == ({"j1": None}, None)
    assert content == json.loads((tmp_path / "diagnosis.json").read_text())
    read = load_model(tmp_path / "model.json")
    assert read.spread is not None
    assert read.terms[-1].estimates[0] == replace(estimate, std=None, interval=None)
    command._show_diagnosis(built(content, DiagnosisFile), Output())


def test_a_stage_from_others_runs_nothing(recordings, whole, tmp_path):
    """A pickle may name any function; but for what a diagnosis is made of, none is known."""

    class Runs:
        def __reduce__(self):
            return print, ("it ran",)

    stages = Stages(recordings, whole[0].found.plain, Keeping(tmp_path, {"code": "1"}, SimpleNamespace(note=print)))
    stages.keep("one", Runs())
    with pytest.raises(UserError, match=r"builtins\.print, which no diagnosis has"):
        stages.saved("one")


def test_an_estimate_that_is_no_number_is_one_sentence(whole, tmp_path):
    found = whole[0].found
    term = replace(found.findings[0].term, estimates=(Estimate(np.nan),))
    with pytest.raises(UserError, match=r"quadratic_drag of j1: the fit ends with coefficient = nan .*; are torques"):
        save_model(replace(found.model, terms=(term,)), tmp_path / "model.json")

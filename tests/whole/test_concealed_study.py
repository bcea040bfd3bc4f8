"""The study of sealed cases: two small ones from the plant, run blind, and the rules by which answers are scored."""

import json
import shutil

import concealed_physics as study
import numpy as np
import pytest
from scipy.stats import binom

from rrr_oc.errors import UserError
from validation.concealed.build import build
from validation.concealed.cases import Case, Concealed
from validation.concealed.write import write_case


@pytest.fixture(scope="module")
def cases(tmp_path_factory):
    """A pendulum of one joint, with nothing missing and with drag, four recordings of 8 s each."""
    out = tmp_path_factory.mktemp("cases")
    (out / "sealed").mkdir()
    for kind, concealed in (("clean", ()), ("short", (Concealed("quadratic_drag", 3.0),))):
        write_case(build(Case(f"{kind}/test", kind, 5, "arm1", concealed, short=True), 8.0), out)
    return out


def test_blind_then_opened(cases, tmp_path, monkeypatch):
    folders = study.chosen(cases, None, None)
    assert [f.name for f in study.chosen(cases, "clean", None)] == [
        f.name for f in folders if study.read(cases / "sealed" / f"{f.name}.json")["kind"] == "clean"
    ]
    with pytest.raises(UserError, match="no cases of the kind 'pair'"):
        study.chosen(cases, "pair", None)
    shutil.move(cases / "sealed", tmp_path / "away")  # nothing of the truth is there while the diagnosis runs
    study.run_all("diagnosing", study.diagnose_case, {f.name: (f,) for f in folders}, tmp_path / "out" / "cases")
    shutil.move(tmp_path / "away", cases / "sealed")
    monkeypatch.setattr(study, "diagnose", lambda *_, **__: pytest.fail("diagnosed again"))
    study.main(cases, tmp_path / "out", 1)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["failed"] == []
    assert summary["false_alarms"]["count"] == 0
    assert summary["named"]["short, 3 times the noise"]["count"] == 1
    assert summary["unseen_nrmse"]["repaired / plain"][1] < 1
    assert summary["unseen_nrmse"]["repaired / oracle"][1] < 1.1
    assert summary["near_oracle"]["count"] == 1
    assert set(summary["by_kind"]) == {"clean", "short"}
    memory = summary["by_effect"]["quadratic_drag"]["peak_MB"]
    if study.CLEAR_REFS.exists():  # Linux
        assert 50 < memory[0] <= memory[1] < 5000
    text = (tmp_path / "out" / "report.md").read_text()
    assert "2 sealed cases, 0 of them failed" in text
    for figure in ("confusion.png", "reliability.png"):
        assert (tmp_path / "out" / figure).stat().st_size > 1000


def test_the_oracle_measures_as_the_plant_does(cases, tmp_path):
    """The growth of the likelihood is the plant's own: the squared torque of the effect that no plain parameter explains, over noise."""
    (folder,) = study.chosen(cases, "short", None)
    truth = study.read(cases / "sealed" / f"{folder.name}.json")
    study.oracle_case(folder, cases / "sealed" / f"{folder.name}.json", tmp_path)
    (found,) = study.read(tmp_path / f"{folder.name}.json")["effects"]
    assert found["parameters"] == 1
    own = truth["effects"][0]["equal_effects"]["chi2_of_residual"]
    assert found["likelihood"] == pytest.approx(own, rel=0.2)  # the noise is estimated, and the filter leaves out the ends


def test_a_crash_is_a_result(cases, tmp_path):
    broken = tmp_path / "broken"
    (broken / "data").mkdir(parents=True)
    study.diagnose_case(broken, tmp_path)
    found = study.read(tmp_path / "broken.json")
    assert "recordings.json" in found["failed"]
    truth = study.read(next((cases / "sealed").glob("*.json")))
    scored = study.score_case(truth, found)
    assert scored["first"] == "failed"
    assert scored["alarm"]  # no word is no all-clear


def effect(name: str, joint=None, recordings="all", rivals=(), **parameters) -> dict:
    return {
        "effect": name,
        "joint": joint,
        "recordings": recordings,
        "rivals": [{"effect": n, "joint": j} for n, j in rivals],
        "parameters": {
            k: {"value": v, "std": s, "unit": "1", "interval": None if s is None else [v - 2 * s, v + 2 * s]}
            for k, (v, s) in parameters.items()
        },
    }


def true(name: str, joint=None, recordings="all", ratio=1.0, equal=(), depends_on=None, **parameters) -> dict:
    found = {
        "effect": name,
        "in_catalogue": depends_on is None,
        "joint": joint,
        "recordings": recordings,
        "parameters": {k: {"value": v, "unit": "1"} for k, v in parameters.items()},
        "ratio": {"requested": ratio},
        "equal_effects": {"equal": [{"effect": n, "joint": j} for n, j in equal], "within_noise": []},
    }
    return found if depends_on is None else {**found, "depends_on": depends_on}


def scored(
    kind: str,
    effects: list,
    found: list,
    unexplained: list | None = None,
    small: list | None = None,
    possible: list | None = None,
) -> dict:
    truth = {"case": "x", "key": f"{kind}/x", "kind": kind, "robot": "rrr", "joints": ["a", "b"], "effects": effects,
             "recordings": [{"file": f"{k}.csv", "unseen": k == 3} for k in range(4)]}  # fmt: skip
    if small is not None:
        truth["small"] = small
    verdict = "missing_physics" if found or unexplained else "nothing_missing"
    diagnosis = {"verdict": verdict, "effects": found, "unexplained": unexplained or []}
    if possible is not None:
        diagnosis["possible"] = possible
    unseen = {"before": {"a": 0.2, "b": None}, "after": {"a": 0.1, "b": None}}
    return study.score_case(truth, {"diagnosis": diagnosis, "wall_s": 1.0, "unseen": unseen})


def test_what_counts_as_named():
    drag = true("quadratic_drag", "a", equal=[("stribeck", "a")])

    def how(*found):
        return scored("single", [drag], list(found))["true"][0]["how"]

    assert how(effect("quadratic_drag", "a")) == "itself"
    assert how(effect("quadratic_drag", "b")) is None
    assert how(effect("torque_gain", "a"), effect("quadratic_drag", "a")) is None  # the most important one counts
    assert how(effect("torque_gain", "a", rivals=[("quadratic_drag", "a")])) == "rival"
    assert how(effect("stribeck", "a")) == "equal"
    assert how(effect("stribeck", "b")) is None
    assert how() is None
    both = true("coupled_friction", ["a", "b"])
    assert scored("single", [both], [effect("coupled_friction", ["b", "a"])])["true"][0]["named"]


def test_each_found_effect_names_one_true_one():
    """Of a pair; assigned so that most are named."""
    pair = [true("stribeck", "a"), true("quadratic_drag", "a", equal=[("stribeck", "a")])]
    one = scored("pair", pair, [effect("stribeck", "a")])
    assert [(e["named"], e["how"]) for e in one["true"]] == [(True, "itself"), (False, "contained")]
    assert study.summarise([one])["every_effect_named"]["pair"]["count"] == 0
    assert study.summarise([one])["every_effect_that_can_be_told"]["count"] == 1
    other = scored("pair", pair, [effect("torque_gain", "b"), effect("quadratic_drag", "a"), effect("stribeck", "a")])
    assert [e["how"] for e in other["true"]] == ["itself", "itself"]
    assert other["extra"] == 1


def test_recordings_are_compared_among_those_that_were_seen():
    some = true("payload_mass", None, ["1.csv", "3.csv"])
    assert scored("some", [some], [effect("payload_mass", None, ["1.csv"])])["true"][0]["recordings"]
    assert not scored("some", [some], [effect("payload_mass", None, ["1.csv", "2.csv"])])["true"][0]["recordings"]
    assert not scored("some", [some], [effect("payload_mass", None)])["true"][0]["recordings"]
    everywhere = true("payload_mass", None)
    assert scored("some", [everywhere], [effect("payload_mass", None, ["0.csv", "1.csv", "2.csv"])])["true"][0]["recordings"]


def test_what_counts_as_unexplained():
    fan = true("cross_fan", ["a", "b"], depends_on=["dq_a", "q_b"])

    def named(joint, *depends_on):
        return scored("outside", [fan], [], [{"joint": joint, "depends_on": depends_on}])["true"][0]["named"]

    assert named("a", "dq_a", "q_b")
    assert named("a", "q_a*q_b")
    assert not named("a", "q_a")
    assert not named("c", "dq_a")
    anywhere = true("sloshing_payload", None, depends_on=["time"])
    assert scored("outside", [anywhere], [], [{"joint": "b", "depends_on": ["time"]}])["true"][0]["named"]


def test_intervals_that_hold_the_truth():
    """Only where the effect itself was found; phases count modulo a turn, undecided parameters not at all."""
    ripple = true("torque_ripple", "a", amplitude=1.0, order=7, phase=6.2)
    found = effect(
        "torque_ripple", "a", amplitude=(1.5, 0.1), order=(7.01, 0.02), phase=(6.25 - 2 * np.pi, 0.1), other=(1, None)
    )
    assert scored("single", [ripple], [found])["true"][0]["covered"] == [False, True, True]
    assert scored("single", [ripple], [{**found, "joint": "b"}])["true"][0]["covered"] == []
    body = true("link_inertial", "a", mass=0.5, first_moment=[0.1, 0.2, 0.3])
    vector = {"value": [0.1, 0.5, 0.3], "std": [0.1, 0.1, None], "unit": "kg m"}
    whole = effect("link_inertial", "a")
    whole["parameters"] = {"mass": {"value": 0.4, "std": 0.1, "unit": "kg"}, "first_moment": vector}
    assert scored("single", [body], [whole])["true"][0]["covered"] == [True, True, False]


def test_shares_have_exact_intervals():
    """Clopper and Pearson: at each end the count's tail has 2.5 %."""
    s = study.share([True] * 4 + [False] * 16)
    low, high = s["interval"]
    assert binom.sf(3, 20, low) == pytest.approx(0.025)
    assert binom.cdf(4, 20, high) == pytest.approx(0.025)
    assert study.share([False] * 150)["interval"] == [0.0, pytest.approx(1 - 0.025 ** (1 / 150))]
    assert study.share([])["share"] is None


def test_half_of_the_effects_are_named_at():
    rng = np.random.default_rng(0)
    drawn = np.exp(rng.uniform(np.log(0.2), np.log(20.0), 3000))
    named = rng.random(drawn.size) < 0.95 / (1 + (1.3 / drawn) ** 4)  # 5 % are missed however strong
    middle = 1.3 * (0.5 / 0.45) ** 0.25  # where that is a half

    def score(strength: float, found: bool, name: str) -> dict:
        return {"visible": strength, "true": [{"effect": name, "named": found}]}

    late = [score(v, v > 6.0, "late") for v in (1.0, 2.0, 4.0, 8.0, 16.0)]
    always = [score(v, True, "always") for v in (2.0, 5.0, 9.0)]
    curve = study.sensitivity([*(score(*x, "drawn") for x in zip(drawn, named, strict=True)), *late, *always])
    assert curve["half_named"] == pytest.approx(middle, rel=0.05)
    assert curve["lapse"] == pytest.approx(0.05, abs=0.015)
    assert curve["by_effect"]["drawn"]["half_named"] == pytest.approx(middle, rel=0.05)
    assert 4.0 < curve["by_effect"]["late"]["half_named"] < 8.0
    assert curve["by_effect"]["late"]["bound"] is None
    assert curve["by_effect"]["always"] == {"half_named": pytest.approx(2.0), "bound": "at most", "of": 3}
    assert study.sensitivity(always) is None  # nothing was missed


def test_summary_and_confusion():
    scores = [
        scored("clean", [], []),
        scored("clean", [], [effect("torque_gain", "a")]),
        scored("single", [true("stribeck", "a", ratio=3.0)], [effect("stribeck", "a")]),
        scored("single", [true("stribeck", "a", ratio=0.5)], []),
        scored("outside", [true("cross_fan", "a", depends_on=["q_a"])], [], [{"joint": "a", "depends_on": ["q_a"]}]),
    ]
    summary = study.summarise(scores)
    assert {k: v["share"] for k, v in summary["named"].items()} == {
        "single, 3 times the noise": 1.0,
        "single, 0.5 times the noise": 0.0,
    }
    assert (summary["false_alarms"]["count"], summary["false_alarms"]["of"]) == (1, 2)
    assert summary["outside_unexplained"]["share"] == 1.0
    assert summary["unseen_nrmse"]["repaired / plain"] == [0.5] * len(study.QUANTILES)
    rows, columns, counts = study.confusion(scores)
    table = {(r, c): counts[i, k] for i, r in enumerate(rows) for k, c in enumerate(columns) if counts[i, k]}
    assert table == {
        ("cross_fan", "unexplained"): 1,
        ("nothing", "nothing"): 1,
        ("nothing", "torque_gain"): 1,
        ("stribeck", "stribeck"): 1,
        ("stribeck", "nothing"): 1,
    }
    assert "single, 3 times the noise" in study.report(summary)


def test_strong_effects_of_imperfect_arms_are_to_be_named_first():
    strong, ripple = true("cable_harness", "a", equal=[("parallel_spring", "a")]), true("torque_ripple", "b")

    def first(*found, effects=(strong,)):
        return scored("imperfect", list(effects), list(found), small=[ripple])["strong_first"]

    assert first(effect("cable_harness", "a"), effect("torque_ripple", "b"))
    assert first(effect("parallel_spring", "a"))
    assert not first(effect("torque_ripple", "b"), effect("cable_harness", "a"))  # named, but not first
    assert not first()
    both = strong, true("payload_mass")
    assert first(effect("payload_mass"), effect("cable_harness", "a"), effects=both)
    assert not first(effect("payload_mass"), effect("torque_ripple", "b"), effect("cable_harness", "a"), effects=both)
    assert first(effect("torque_ripple", "b"), effects=()) is None  # no strong effect


def test_small_parts_are_true_and_others_are_not():
    strong = true("cable_harness", "a", equal=[("parallel_spring", "a")])
    clock = {**true("clock", "a"), "in_catalogue": False}
    small = [true("torque_ripple", "b", amplitude=1.0), true("link_inertial", "b"), clock]
    found = [
        effect("cable_harness", "a"),
        effect("torque_ripple", "b", amplitude=(1.1, 0.1)),
        effect("torque_ripple", "a"),
        effect("payload_mass", None, rivals=[("link_inertial", "b")]),
        effect("parallel_spring", "a"),  # only the equal of what is named already
        effect("clock", "a"),  # not an effect of the catalogue
    ]
    s = scored("imperfect", [strong], found, [{"joint": "a", "depends_on": ["q_a"]}], small)
    assert [c["right"] for c in s["claims"]] == [True, True, False, True, False, False, None]
    assert s["covered_small"] == [True]
    numbers = study.summarise([s, scored("imperfect", [], [], small=small), scored("imperfect", [], [found[1]], small=small)])
    of = numbers["imperfect"]
    assert (of["something_not_there"]["count"], of["something_not_there"]["of"]) == (1, 3)
    assert (of["something_unexplained"]["count"], of["something_unexplained"]["of"]) == (1, 3)
    assert (of["strong_first"]["count"], of["strong_first"]["of"]) == (1, 1)
    assert (of["claims_that_are_there"]["count"], of["claims_that_are_there"]["of"]) == (4, 7)
    assert of["not_there"] == {"torque_ripple": 1, "parallel_spring": 1, "clock": 1}
    assert numbers["false_alarms"]["of"] == 0  # an arm with small parts is no clean one
    text = study.report(numbers)
    assert "imperfect: something that is not there was claimed" in text
    assert "not there: 1 torque_ripple" in text


def test_stated_probabilities_are_compared_with_what_is_there():
    drag = true("quadratic_drag", "a")

    def claim(name: str, probability: float | None, joint="a") -> dict:
        return {**effect(name, joint), "probability": probability}

    scores = [
        scored("single", [drag], [claim("quadratic_drag", 0.99)], possible=[claim("stribeck", 0.6)]),
        scored("single", [drag], [claim("stribeck", 1.0)], possible=[claim("quadratic_drag", 0.8)]),
        scored("single", [drag], [claim("quadratic_drag", None)]),  # states none
        scored("single", [drag], [effect("quadratic_drag", "a")]),  # an old result
        scored(
            "clean", [], [], [{"joint": "a", "depends_on": ["q_a"], "probability": 0.97}], possible=[claim("stribeck", 0.2)]
        ),
    ]
    low, middle, high = study.summarise(scores)["reliability"]["all"]
    assert (low["right"]["count"], low["right"]["of"], low["stated"]) == (0, 1, 0.6)
    assert (middle["right"]["count"], middle["right"]["of"], middle["stated"]) == (1, 1, 0.8)
    assert (high["right"]["count"], high["right"]["of"]) == (1, 3)
    assert high["stated"] == pytest.approx((0.99 + 1.0 + 0.97) / 3)
    outside = true("cross_fan", "a", depends_on=["dq_a"])
    u = {"joint": "a", "depends_on": ["dq_a"], "probability": 0.96}
    assert [c["right"] for c in scored("outside", [outside], [], [u])["claims"]] == [True]
    assert len(study.draw_reliability(study.summarise(scores)).axes) == 2
    none = study.summarise(scores[2:4])["reliability"]["all"]
    assert [b["stated"] for b in none] == [None] * 3


def test_imperfect_cases_alone(tmp_path):
    """Made, scored from results without a word of probabilities, and reported, with --only."""
    (tmp_path / "sealed").mkdir()
    write_case(build(Case("imperfect/test", "imperfect", 5, "arm1", ()), 3.0), tmp_path)
    write_case(build(Case("clean/test", "clean", 5, "arm1", (), short=True), 3.0), tmp_path)
    for folder in study.chosen(tmp_path, None, None):
        found = {"verdict": "missing_physics", "effects": [effect("torque_gain", "joint1")], "unexplained": []}
        errors = {"before": {"joint1": 0.2}, "after": {"joint1": 0.1}}
        result = {"case": folder.name, "wall_s": 2.0, "diagnosis": found, "unseen": errors}
        study.write_json(tmp_path / "out" / "cases" / f"{folder.name}.json", result)
    study.main(tmp_path, tmp_path / "out", only="imperfect", score_only=True)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["cases"] == 1
    assert summary["imperfect"]["something_not_there"]["count"] == 0
    assert summary["by_kind"]["imperfect"] == {"cases": 1, "seconds": [2.0, 2.0], "peak_MB": None}
    assert (tmp_path / "out" / "reliability.png").stat().st_size > 1000

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
    study.run_all("diagnosing", study.diagnose_case, {f.name: (f,) for f in folders}, tmp_path / "out" / "cases", 1)
    shutil.move(tmp_path / "away", cases / "sealed")
    monkeypatch.setattr(study, "diagnose", lambda *_, **__: pytest.fail("diagnosed again"))
    study.main(cases, tmp_path / "out", 1, None, None)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["failed"] == []
    assert summary["false_alarms"]["count"] == 0
    assert summary["named"]["short, 3 times the noise"]["count"] == 1
    assert summary["unseen_nrmse"]["repaired / plain"][1] < 1
    assert summary["unseen_nrmse"]["repaired / oracle"][1] < 1.1
    text = (tmp_path / "out" / "report.md").read_text()
    assert "2 sealed cases, 0 of them failed" in text
    assert (tmp_path / "out" / "confusion.png").stat().st_size > 1000


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


def scored(kind: str, effects: list, found: list, unexplained: list | None = None) -> dict:
    truth = {"case": "x", "key": f"{kind}/x", "kind": kind, "robot": "rrr", "joints": ["a", "b"], "effects": effects,
             "recordings": [{"file": f"{k}.csv", "unseen": k == 3} for k in range(4)]}  # fmt: skip
    verdict = "missing_physics" if found or unexplained else "nothing_missing"
    diagnosis = {"verdict": verdict, "effects": found, "unexplained": unexplained or []}
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

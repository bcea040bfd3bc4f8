"""The study of real arms: made-up sets on disk, diagnosed blind in processes of their own, and the table made of them."""

import io
import json
import os
import signal

import numpy as np
import pytest
import real_arms as study
from chains import arm
from recorded import Plant, as_set, multisine, record
from rich.console import Console

from rrr_oc.errors import UserError
from rrr_oc.recordings.writer import save_recordings
from rrr_oc.schema import validated

SPRING = 12.0, 2.0  # [Nm/rad], [rad]: far from noise, and pulling over the whole motion


def published(**about):
    """What is published, as it is read from a file."""
    return validated("made up", about, dict[str, study.Published])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three sets of a pendulum: `sprung` has a spring that no file mentions, in `train` and `test`; `alone` lacks nothing and is a
    lone recording; `broken` cannot be read."""
    out = tmp_path_factory.mktemp("sets")
    (out / "arm.urdf").write_text(arm(1))
    rng, plant = np.random.default_rng(3), Plant(out / "arm.urdf", np.array([0.5]), np.array([0.3]), np.array([0.1]))
    mounted = {0: SPRING}

    def recorded(name, seconds, pea=None):
        found = record(plant, name, rng, seconds, pea=pea)
        return found if pea is None else type(found)(**{**vars(found), "springs": ()})  # nobody noted the spring

    save_recordings(as_set(plant, [recorded(f"r{k}.csv", 8.0, mounted) for k in range(3)]), out / "sprung" / "train")
    save_recordings(as_set(plant, [recorded("r9.csv", 8.0, mounted)]), out / "sprung" / "test")
    save_recordings(as_set(plant, [recorded("r0.csv", 20.0)]), out / "more" / "alone")
    (out / "broken").mkdir()
    (out / "broken" / "recordings.json").write_text("{")
    return out


def test_sets_are_diagnosed_blind_and_again_only_where_they_failed(folder, tmp_path, monkeypatch, capsys):
    (tmp_path / "known.json").write_text(
        json.dumps({"sprung": {"text": "a spring | unlisted", "effects": [{"effect": "parallel_spring", "joint": "j1"}]}})
    )
    study.main(folder, tmp_path / "out", None, tmp_path / "known.json", 2)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    by_name = {s["set"]: s for s in summary["sets"]}
    assert set(by_name) == {"broken", "more/alone", "sprung"}
    assert "not valid JSON" in by_name["broken"]["failed"]
    sprung, alone = by_name["sprung"], by_name["more/alone"]
    assert sprung["held_out"] == {"way": "test", "files": ["r9.csv"]}
    assert summary["totals"]["sets"] == 1
    assert summary["totals"]["known, not claimed"] == 0
    assert sprung["nrmse"]["diagnosed"]["j1"] < 0.1 < sprung["nrmse"]["plain"]["j1"]  # 2 % of noise against a spring
    assert (alone["verdict"], alone["claims"], alone["published"]) == ("nothing_missing", [], None)
    assert alone["held_out"]["way"] == "blocks"
    assert alone["nrmse"]["diagnosed"] == alone["nrmse"]["plain"]
    for found in (sprung, alone):
        assert all(0 < found["nrmse"][kind]["j1"] < 1 for kind in study.REGRESSIONS)  # better than a constant
        assert found["peak_memory_MB"] > 50  # numpy alone takes as much
        assert found["wall_s"] > 0
    text = (tmp_path / "out" / "report.md").read_text()
    assert "a spring \\| unlisted" in text
    assert "failed: " in text
    assert (tmp_path / "out" / "diagnoses" / "more" / "alone" / "report.html").is_file()
    again, start = [], study._started
    monkeypatch.setattr(study, "_started", lambda one, *rest: again.append(one.name) or start(one, *rest))
    study.run_all(study.sets_below(folder, tmp_path / "out"), tmp_path / "out", 1)
    assert again == ["broken"]
    assert "sprung: physics is missing" in capsys.readouterr().out


def dies(*_):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_process_that_is_killed_is_a_result(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(study, "_worker", dies)
    study.run_all([study.RealSet("sprung", folder / "sprung" / "train")], tmp_path, 1)
    assert "killed by signal 9" in study.read(tmp_path / "sets" / "sprung.json")["failed"]


def test_sets_are_found_in_every_layout(folder, tmp_path):
    found = {s.name: s for s in study.sets_below(folder, tmp_path)}
    assert found["sprung"] == study.RealSet("sprung", folder / "sprung" / "train", folder / "sprung" / "test")
    assert found["more/alone"].test is None
    assert [s.name for s in study.sets_below(folder / "sprung", tmp_path)] == ["sprung"]
    assert [s.name for s in study.sets_below(folder / "more" / "alone", tmp_path)] == ["alone"]
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "data_file_1_Exp3.txt").write_text("")
    variants = study.sets_below(tmp_path, tmp_path / "out")
    assert [s.name for s in variants] == [f"own/{name}" for name in study.VARIANTS]
    assert study.chosen(variants, ["own"]) == variants
    assert [s.name for s in study.chosen(variants, ["own/bare"])] == ["own/bare"]
    with pytest.raises(UserError, match="--only is 'bare'; the sets are own/labelled"):
        study.chosen(variants, ["bare"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="holds no recording set"):
        study.sets_below(tmp_path / "empty", tmp_path / "out")
    with pytest.raises(UserError, match="no such folder"):
        study.sets_below(tmp_path / "nowhere", tmp_path)


def claim(effect, joint, **more):
    """A claim as a set's result has it."""
    plain = {"recordings": "all", "parameters": {}, "depends_on": [], "probability": None, "p_value": None, "rivals": []}
    return {"effect": effect, "joint": joint, **plain, **more}


def result(*claims):
    """The result of a set of two joints."""
    nrmse = {m: {"a": 0.1 * k, "b": None} for k, m in enumerate(study.MODELS, 1)}
    return {
        "set": "made/up", "joints": ["a", "b"], "verdict": "missing_physics", "claims": list(claims), "nrmse": nrmse,
        "held_out": {"way": "folds", "files": ["r.csv"]}, "wall_s": 1.0, "peak_memory_MB": 200.0, "notes": [],
    }  # fmt: skip


def test_claims_are_compared_with_what_is_published():
    known = published(
        made={
            "effects": [
                {"effect": ["cable_harness", "parallel_spring"], "joint": "a"},
                {"effect": "coupled_friction", "joint": ["a", "b"]},
                {"effect": "stribeck", "joint": "b"},
                {"effect": "backlash", "joint": "a"},
            ],
            "absent": [{"effect": ["gravity_tilt", "parallel_spring"]}],
        }
    )
    claims = [
        (claim("parallel_spring", "a"), "known"),
        (claim("parallel_spring", "b"), "known to be absent"),
        (claim("gravity_tilt", None), "known to be absent"),
        (claim("coupled_friction", ["b", "a"]), "known"),
        (claim("torque_offset", "b", rivals=[{"effect": "stribeck", "joint": "b"}]), "known, as rival"),
        (claim("stribeck", "a"), "not published"),
        (claim("unexplained", "a", depends_on=["q_a"]), "not published"),
    ]
    about = study.published_about("made/up", known)
    found = study.judged(result(*(c for c, _ in claims)), about)
    assert [c["published"] for c in found["claims"]] == [word for _, word in claims]
    assert found["published"]["missed"] == [{"effect": "backlash", "joint": "a"}]
    both = claim("torque_offset", "b", rivals=[{"effect": e, "joint": j} for e, j in (("stribeck", "b"), ("backlash", "a"))])
    once = study.judged(result(both), about)
    assert [m["effect"] for m in once["published"]["missed"]].count("backlash") == 1  # one claim stands for one effect
    count = study.totals([found, study.judged(result(), None)])
    assert count == {
        "known": 2, "known, as rival": 1, "known to be absent": 2, "not published": 2, "known, not claimed": 1, "sets": 1,
    }  # fmt: skip
    specific = published(made={"text": "all"}, **{"made/up": {"text": "one"}})
    assert study.published_about("made/up", specific).text == "one"
    assert study.published_about("made/other", specific).text == "all"
    assert study.published_about("other", specific) is None
    with pytest.raises(UserError, match="unknown key 'efects'"):
        published(made={"efects": []})


def test_each_claim_stands_in_the_row_of_its_joint():
    claims = (
        claim("gravity_tilt", None, parameters={"about_x": {"value": 0.012345, "unit": "rad"}}, probability=0.9876),
        claim("coupled_friction", ["b", "a"], recordings="1 of 3", p_value=1e-30),
        claim("unexplained", "b", depends_on=["q_b", "sign(dq_b)"], p_value=2e-5),
    )
    known = published(up={"text": "little", "effects": [{"effect": "backlash", "joint": "a"}]})["up"]
    every = study.rows(study.judged(result(*claims), known))
    assert {len(row) for row in every} == {len(study.HEADINGS)}
    first, tilt, a, coupled, left = every
    assert first[:6] == ["made/up", "mean of 2", "physics is missing", "held out: folds, 1 file", "", "little"]
    assert first[6:8] == ["0.100", "0.200"]  # the mean is that of the joint that is known
    assert first[-2:] == ["1", "200"]
    assert tilt[1:6] == ["–", "gravity tilt", "about_x 0.0123 rad", "0.988", "not published"]
    assert a[1:7] == ["a", "(backlash)", "", "", "known, not claimed", "0.100"]
    assert coupled[1:7] == ["b", "coupled friction with a in 1 of 3 recordings", "", "p < 1e-16", "not published", "–"]
    assert left[1:5] == ["", "unexplained", "depends on q_b, sign(dq_b)", "p = 2e-05"]
    assert study.chance(claim("stribeck", "a", probability=0.99999)) == "> 0.999"
    console = Console(width=160, record=True, file=io.StringIO())
    console.print(study.table([study.judged(result(*claims), known)]))
    assert "coupled friction" in console.export_text()


def test_regressions_are_held_to_what_they_were_not_trained_on():
    """A torque that is linear in q and dq of two joints: a ridge over splines finds it, a joint that never moves has no error."""
    rng, t = np.random.default_rng(5), np.arange(3000) / 100

    def part(size=1.0):
        q, dq, ddq = (size * x for x in multisine(2, t, rng))
        return study.Part(t, np.vstack([q, dq, ddq, 0 * t]).T, np.vstack([3 * q[0] - dq[1], 0 * t]), (slice(0, 3000),))

    every = [([part(), part()], [part(0.5)])]  # within what was trained on: beyond that, splines stay constant
    for make in study.REGRESSIONS.values():
        moved, still = study.regression_errors(make, every)
        assert still is None
        assert moved < 0.6  # a constant has 1; trees know a minute of random motion, and splines reach far less
    assert study.regression_errors(study.REGRESSIONS["splines"], every)[0] < 0.02  # splines of degree 3 contain straight lines
    pieces = study.blocks(every[0][0][0])
    assert len(pieces) == study.BLOCKS
    np.testing.assert_array_equal(np.concatenate([p.t for p in pieces]), t)
    assert all(p.segments == (slice(0, len(p.t)),) for p in pieces)
    gap = study.Part(t, every[0][0][0].x, every[0][0][0].y, (slice(0, 1000), slice(1000, 3000)))
    assert [p.segments for p in study.blocks(gap)][1] == (slice(0, 250), slice(250, 750))

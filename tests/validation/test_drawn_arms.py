"""How the share of rows inside a band of drawn arms is counted, and that a case goes through: a diagnosis is replaced by a calibration."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rrr_oc.calibration.calibrate import calibrate
from validation.chains import drawn_arms
from validation.chains.make import new_case, write

EVERY_ROW = np.ones((1, 5000), bool)


def test_the_share_inside_is_that_of_the_band_for_draws_of_the_true_distribution_and_less_for_narrow_ones():
    rng = np.random.default_rng(0)
    wanted = rng.standard_normal((1, 5000))
    for width, noise, least, most in (
        (1.0, 0.0, 0.86, 0.93),
        (0.6, 0.8, 0.86, 0.94),
        (0.5, 0.0, 0.55, 0.63),
        (0.0, 1.0, 0.86, 0.94),
    ):
        torques = width * rng.standard_normal((200, 1, 1)) + np.zeros((1, 1, 5000))
        (share,) = drawn_arms.inside(torques, noise, wanted, EVERY_ROW)
        assert least < share < most
    assert np.isnan(drawn_arms.inside(wanted[None], 1.0, wanted, ~EVERY_ROW)[0])


def test_rows_at_rest_and_rows_of_a_push_do_not_count():
    t = np.arange(6.0)
    v = np.array([[0.0, 1.0, 1.0, 1.0, 1.0, 0.01]])
    found = drawn_arms.counted(t, v, [{"from": 2.0, "to": 3.0}], ["j1"])
    assert found.tolist() == [[False, True, False, False, True, False]]


def test_a_case_is_diagnosed_once_and_its_arms_enclose_the_truth(tmp_path, monkeypatch, capsys):
    case = new_case("direct_drive", 0, "clean", seed=5)
    case = replace(case, family=replace(case.family, pace=replace(case.family.pace, seconds=4.0), recordings=2))
    write(case, tmp_path / "cases", seed=5)
    monkeypatch.setattr(drawn_arms, "diagnose", lambda recordings: SimpleNamespace(model=calibrate(recordings)))
    folder = tmp_path / "cases" / case.name
    found = drawn_arms.once(folder, tmp_path / "out", 20, 0)
    assert case.name in capsys.readouterr().out
    monkeypatch.setattr(drawn_arms, "diagnose", None)
    assert drawn_arms.once(folder, tmp_path / "out", 20, 0) == json.loads(json.dumps(found))
    assert set(found["inside"]) == {"true", "recorded"}
    assert all(0.3 < x <= 1.0 for x in found["inside"]["recorded"])
    assert "mean, clean" in drawn_arms.table([found])


@pytest.mark.parametrize("kind", ["clean", "hidden"])
def test_the_table_has_a_row_for_each_case_and_the_means(kind):
    row = {"case": "a", "kind": kind, "refused": 2, "inside": {"true": [0.9, 0.8], "recorded": [0.5, 0.7]}}
    lines = drawn_arms.table([row, row]).splitlines()
    assert lines[2] == f"a | {kind} | 2 | 90, 80 | 50, 70"
    assert lines[4] == "mean, all |  |  | 85.0 % | 60.0 %"

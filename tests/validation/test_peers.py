"""The comparison with peers: how terms are chosen, what they mean, and how claims are judged. The peers themselves are not needed."""

import numpy as np

from validation.peers.discovery import claimed
from validation.peers.library import INPUTS, MEANS, OTHERS, Meaning, Problem
from validation.peers.regressions import PENALTIES, compressed, folds, lasso, lasso_default, tuned
from validation.peers.scores import names, of_case, table_of


def problem(size: float) -> Problem:
    """Four recordings of white noise with so much of the third of six terms."""
    rng = np.random.default_rng(0)
    x = [rng.standard_normal((200, 6)) for _ in range(4)]
    y = [part[:, 2] * size + rng.standard_normal(200) for part in x]
    meanings = [Meaning((), "joint1"), Meaning(("stribeck",), "joint1"), Meaning(("quadratic_drag",), "joint2")]
    return Problem(x, y, meanings, np.array([0, 1, 2, 2, 1, 0]), lambda _: np.arange(6), lambda r, c: np.zeros((1, 1)))


def test_the_tuned_lasso_keeps_the_term_that_is_there_and_none_in_noise():
    found, _ = tuned(lasso, problem(1.0), PENALTIES)
    assert np.argmax(np.abs(found)) == 2
    assert 0.5 < found[2] < 1.1
    assert not np.any(tuned(lasso, problem(0.0), PENALTIES)[0])


def test_the_lasso_by_its_defaults_keeps_it_too():
    found = lasso_default(problem(1.0))
    assert np.argmax(np.abs(found)) == 2


def test_recordings_in_which_a_joint_stands_still_are_not_left_out():
    rows, none = np.ones(3), np.zeros(0)
    assert [part.tolist() for part in folds([rows, none, rows, rows])] == [[0], [2], [3]]
    assert folds([none, rows, none]) == []


def test_fewer_rows_have_the_same_normal_equations():
    rng = np.random.default_rng(1)
    x, y = rng.standard_normal((50, 4)), rng.standard_normal(50)
    a, b = compressed(x, y)
    assert len(b) == 5
    np.testing.assert_allclose(a.T @ a, x.T @ x, atol=1e-12)
    np.testing.assert_allclose(a.T @ b, x.T @ y, atol=1e-12)


def test_claims_come_by_weight_and_terms_of_the_plain_model_are_none():
    claims = claimed([problem(1.0)], [np.array([9.0, 0.1, 2.0, 0.0, 0.0, 0.0])])
    assert [(c["effects"], c["joint"]) for c in claims] == [(["quadratic_drag"], "joint2"), (["stribeck"], "joint1")]


def test_a_claim_is_right_by_effect_and_joint_by_its_equals_and_of_the_arm_on_any_joint():
    drag = {"effect": "quadratic_drag", "joint": "joint1"}
    equal = drag | {"equal_effects": {"equal": [{"effect": "stribeck", "joint": "joint2"}], "within_noise": []}}
    assert names(drag, {"effects": ["stribeck", "quadratic_drag"], "joint": "joint1"})
    assert not names(drag, {"effects": ["quadratic_drag"], "joint": "joint2"})
    assert names(equal, {"effects": ["stribeck"], "joint": "joint2"})
    assert names({"effect": "payload_mass", "joint": None}, {"effects": ["payload_mass"], "joint": "joint2"})
    assert not names(drag, {"effects": [], "joint": "joint1"})  # something unexplained
    rival = {"effects": ["stribeck"], "joint": "joint1", "rivals": [drag]}
    assert names(drag, rival, rivals=True)
    assert not names(drag, rival)


def test_cases_are_scored_and_counted():
    truth = {"effects": [{"effect": "quadratic_drag", "joint": "joint1", "ratio": {"reached": 1.0}}]}
    claims = [{"effects": ["stribeck"], "joint": "joint1"}, {"effects": ["quadratic_drag"], "joint": "joint1"}]
    there = of_case(truth, {"claims": claims, "nrmse": 0.5, "seconds": 2.0}, 1.0)
    assert (there["first"], there["among"], there["joint"], there["beyond"], there["error"]) == (False, True, True, 1, 0.5)
    clean = of_case({"effects": []}, {"claims": claims, "nrmse": 1.0, "seconds": 4.0}, 1.0)
    assert clean["alarm"]
    faults = [{"effect": c["effects"][0], "joint": c["joint"], "in_catalogue": True} for c in claims]
    imperfect = {"effects": [], "small": faults}
    assert not of_case(imperfect, {"claims": claims, "nrmse": 1.0, "seconds": 4.0}, 1.0)["alarm"]
    assert of_case(imperfect | {"small": faults[:1]}, {"claims": claims, "nrmse": 1.0, "seconds": 4.0}, 1.0)["alarm"]
    header, rows = table_of({"one": [there, clean]})
    assert len(header) == len(rows[0])
    assert rows[0][1:6] == ["0 of 1", "0 of 1", "1 of 1", "1 of 1", "1 of 1"]


def test_terms_mean_effects_of_the_catalogue():
    from rrr_oc.effects import CATALOGUE

    assert {name for meaning in (*MEANS.values(), *INPUTS.values(), OTHERS) for name in meaning} <= set(CATALOGUE)

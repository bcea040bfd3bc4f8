"""What the report says about how sure a claim is, on made-up contents of diagnosis.json."""

import pytest

from rrr_oc.effects import CATALOGUE
from rrr_oc.report.diagnosis_words import gain, not_claimed, on_prior, percent, placed, rivals


def entry(effect: str, joint="a", probability: float = 0.5, **more) -> dict:
    return {"effect": effect, "joint": joint, "probability": probability, **more}


@pytest.mark.parametrize("beforehand", [0.005, 0.03, 0.3])
def test_a_claim_rests_on_the_prior_where_a_tenth_of_it_makes_no_claim(beforehand):
    """By Bayes' rule with two hypotheses: odds are prior odds times the ratio of likelihoods."""
    odds = beforehand / (1 - beforehand)
    for ratio, rests in ((0.99 * 190 / odds, True), (1.01 * 190 / odds, False)):
        now, less = (x / (1 + x) for x in (odds * ratio, odds / 10 * ratio))
        assert (less < 0.95) == rests
        said = on_prior({"effects": [entry("stribeck", probability=now)], "unexplained": []})
        assert len(said) == rests
        said = on_prior({"effects": [], "unexplained": [{"joint": "b", "probability": now}]})
        assert [("torque on b" in line, "rests on the prior" in line) for line in said] == [(True, True)] * rests
    assert on_prior({"effects": [entry("stribeck", probability=1.0)], "unexplained": []}) == []


def test_what_is_not_claimed_is_listed():
    assert not_claimed({}) == not_claimed({"possible": [], "not_confirmed": []}) == []
    box = next(name for name, kind in CATALOGUE.items() if kind.role == "black_box")
    possible = [
        entry("torque_ripple", "a", 0.61, recordings="all"),
        entry("payload_mass", None, 0.08, recordings=["1.csv", "2.csv"]),
        entry("coupled_friction", ["a", "b"], 0.07, recordings="all"),
    ]
    first, second = not_claimed({"possible": possible, "not_confirmed": [entry(box, "b", 0.9996), entry(box, "b", 0.9996)]})
    assert first.endswith(": torque ripple of a (61%), payload mass in 1.csv, 2.csv (8%), coupled friction of a and b (7%).")
    assert second.startswith(
        "Not confirmed on held-out recordings, not claimed: a torque on b that no effect explains (> 99.9%). "
    )


def test_numbers_and_names():
    assert [percent(p) for p in (0.054, 0.949, 0.953, 0.9989, 0.9995, 1.0)] == [
        "5%",
        "95%",
        "95.3%",
        "99.9%",
        "> 99.9%",
        "> 99.9%",
    ]
    assert [gain(x) for x in (None, -0.31, 4.06, 1234.5)] == ["–", "-0.3", "+4.1", "+1234"]
    one = entry("stribeck", "a", rivals=[{"effect": "quadratic_drag", "joint": "a"}, {"effect": "torque_ripple", "joint": "b"}])
    assert rivals(one) == ["quadratic drag", "torque ripple of b"]
    assert placed(entry("payload_mass", None)) == "payload mass"

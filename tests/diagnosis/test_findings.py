"""Probabilities of effects from structures that were visited."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from rrr_oc.calibration.calibrated_model import Estimate, Term
from rrr_oc.diagnosis import findings
from rrr_oc.diagnosis.diagnosis_file import _prior
from rrr_oc.diagnosis.findings import _rivals, contribution, found, identities, identity, probabilities
from rrr_oc.diagnosis.knobs import CLAIM, NEGLIGIBLE
from rrr_oc.diagnosis.result import Finding
from rrr_oc.diagnosis.structures.search import StructureSearch
from rrr_oc.effects.base import Prior
from rrr_oc.effects.black_box.empirical import Empirical
from rrr_oc.effects.elastic.cable_harness import CableHarness
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.effects.priors import Priors
from rrr_oc.effects.sensor.torque_offset import TorqueOffset

SPRING, HARNESS, OFFSET = (ParallelSpring((0,)), ()), (CableHarness((0,)), ()), (TorqueOffset((0,)), ())

PRIORS = Priors({"torque_offset": Prior(0.02, {"offset": (0.1, "torque")}, "made up")})


def placed(effect) -> Term:
    return Term(effect, tuple(Estimate(0.0) for _ in effect.parameters))


@dataclass(frozen=True)
class Model:
    """The terms of a model."""

    terms: tuple[Term, ...]


def searched(visited: dict, predicted: dict | None = None) -> StructureSearch:
    return StructureSearch(None, None, None, visited=visited, predicted=predicted or {})  # pyright: ignore[reportArgumentType]


def test_probabilities_are_shares_of_all_structures():
    visited = {frozenset(): -1000.0, frozenset({SPRING}): -999.0, frozenset({SPRING, OFFSET}): -997.0}
    found = dict(probabilities(searched(visited, {frozenset({HARNESS}): -998.0, frozenset({SPRING}): -990.0})))
    assert sum(found.values()) == pytest.approx(1.0)
    weights = np.exp([-3.0, -2.0, 0.0, -1.0])  # a structure that was fitted counts as fitted, not as predicted
    expected = dict(zip([*visited, frozenset({HARNESS})], weights / weights.sum(), strict=True))
    assert found == pytest.approx(expected)


def test_effects_that_are_equal_share_the_probability_and_are_rivals():
    both = {frozenset({SPRING, OFFSET}): -10.0, frozenset({HARNESS, OFFSET}): -10.0, frozenset({OFFSET}): -60.0}
    every = probabilities(searched(both))
    spring, harness, offset = (identity(effect) for effect, _ in (SPRING, HARNESS, OFFSET))
    shares = {key: sum(p for structure, p in every if key in identities(structure)) for key in (spring, harness)}
    assert shares == pytest.approx({spring: 0.5, harness: 0.5})
    own = {spring, offset}
    assert _rivals(spring, every, own) == [harness]
    assert _rivals(offset, every, own) == []  # it is in every structure that is probable


def test_what_is_much_less_probable_is_no_rival():
    every = probabilities(searched({frozenset({SPRING}): 0.0, frozenset({HARNESS}): -5.0}))
    assert _rivals(identity(SPRING[0]), every, {identity(SPRING[0])}) == []


def test_two_black_box_terms_of_a_joint_have_probabilities_of_their_own(monkeypatch):
    """One is certain, the other is not; the range that recordings gave a term does not tell it from another."""
    first, second = (Empirical((0,), ((kind, 0),), (-1.0,), (1.0,), (2,)) for kind in ("q", "dq"))
    wider = replace(first, low=(-2.0,), high=(3.0,))
    names = [[(e.without_range(), ()) for e in some] for some in ([first], [first, second])]
    search = searched({frozenset(some): score for some, score in zip(names, (0.0, 1.0), strict=True)})
    search.fitter = SimpleNamespace(data=None, view=SimpleNamespace(springs=()), priors=PRIORS)  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setattr(findings, "wald", lambda *_: 0.5)
    monkeypatch.setattr(StructureSearch, "worths", lambda *_: [9.0, 1.0])
    monkeypatch.setattr(findings, "contribution", lambda *_: 1.0)
    extra = tuple(placed(e) for e in (wider, second))
    claimed, possible = found(search, SimpleNamespace(fitted=SimpleNamespace(extra=extra)))
    assert [f.term for f in claimed] == [extra[0]]
    assert claimed[0].probability == pytest.approx(1.0)
    assert [p.key for p in possible] == [("empirical", (0,))]
    assert possible[0].probability == pytest.approx(1 / (1 + np.exp(-1.0)))


@pytest.mark.parametrize(("size", "claims"), [(1.01 * NEGLIGIBLE, 1), (0.99 * NEGLIGIBLE, 0)])
def test_an_effect_too_small_to_matter_is_possible_but_not_claimed(monkeypatch, size, claims):
    search = searched({frozenset({OFFSET}): 0.0})
    search.fitter = SimpleNamespace(data=None, view=SimpleNamespace(springs=()), priors=PRIORS)  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setattr(findings, "wald", lambda *_: 1e-9)
    monkeypatch.setattr(StructureSearch, "worths", lambda *_: [50.0])
    monkeypatch.setattr(findings, "contribution", lambda *_: size)
    claimed, possible = found(search, SimpleNamespace(fitted=SimpleNamespace(extra=(placed(OFFSET[0]),))))
    assert (len(claimed), len(possible)) == (claims, 1 - claims)
    assert (claimed or possible)[0].probability == pytest.approx(1.0)


def test_no_probability_exceeds_1_by_rounding(monkeypatch):
    """Of an effect, and of one that is possible beside it, that are in every structure: sums of the shares of all."""
    monkeypatch.setattr(findings, "wald", lambda *_: 1e-9)
    monkeypatch.setattr(StructureSearch, "worths", lambda *_: [50.0])
    monkeypatch.setattr(findings, "contribution", lambda *_: 1.0)
    fitted, rng, sums = SimpleNamespace(extra=(placed(OFFSET[0]),)), np.random.default_rng(0), []
    for _ in range(20):
        scores = rng.normal(size=20)
        search = searched({frozenset({OFFSET, HARNESS, (ParallelSpring((i,)), ())}): score for i, score in enumerate(scores)})
        search.fitter = SimpleNamespace(data=None, view=SimpleNamespace(springs=()), priors=PRIORS)  # pyright: ignore[reportAttributeAccessIssue]
        (claimed,), possible = found(search, SimpleNamespace(fitted=fitted))
        sums.append(sum(p for _, p in probabilities(search)))
        assert possible[0].key == ("cable_harness", (0,))
        assert max(claimed.probability, possible[0].probability) <= 1.0
    assert max(sums) > 1.0  # so that there is something to round


@pytest.mark.parametrize("beforehand", [0.005, 0.03, 0.3])
def test_a_claim_rests_on_its_prior_by_the_rule_of_bayes(beforehand):
    """Odds are prior odds times the Bayes factor; with a tenth of the prior odds a claim needs 190 times prior odds of one."""
    odds = beforehand / (1 - beforehand)
    prior = replace(PRIORS.of(TorqueOffset), probability=beforehand)
    for factor, rests in ((0.99 * 190 / odds, True), (1.01 * 190 / odds, False)):
        now, less = (x / (1 + x) for x in (odds * factor, odds / 10 * factor))
        finding = Finding(placed(OFFSET[0]), now, 9.0, 1e-9, (), prior)
        assert finding.rests_on_prior == rests == (less < CLAIM)
        assert _prior(finding, ["a"]) == {
            "effect": "torque_offset",
            "joint": "a",
            "probability": beforehand,
            "typical": {"offset": {"value": 0.1, "unit": "torque"}},
            "source": "made up",
            "claim_rests_on_prior": rests,
        }


def test_a_contribution_is_what_the_effect_changes_where_it_holds():
    """An offset of 0.5 Nm on joint 1 in one of two groups; of no consequence are the other group and rows that do not count."""
    labels = np.array([0] * 6 + [1] * 4)
    counted = np.ones((2, 10), bool)
    counted[:, 0] = False
    change = np.array([[9.0, *[0.5] * 5, *[3.0] * 4], np.zeros(10)])
    term, residual = Term(OFFSET[0], (), groups=("a",)), np.ones((2, 10))
    data = SimpleNamespace(
        counted=counted,
        labels=("a", "b"),
        label=labels,
        torque=np.array([10.0, 1.0]),
        residual=lambda model: residual + change * (not model.terms),
    )
    fitted = SimpleNamespace(extra=(term,), model=Model((term,)), residual=residual)
    assert contribution(data, fitted, 0) == pytest.approx(0.05)

"""Probabilities of effects from structures that were visited."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rrr_oc.calibration.calibrated_model import Term
from rrr_oc.diagnosis import findings
from rrr_oc.diagnosis.findings import _rivals, found, identities, identity, probabilities
from rrr_oc.diagnosis.search import Search
from rrr_oc.effects.black_box.empirical import Empirical
from rrr_oc.effects.elastic.cable_harness import CableHarness
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.effects.sensor.torque_offset import TorqueOffset

SPRING, HARNESS, OFFSET = (ParallelSpring((0,)), ()), (CableHarness((0,)), ()), (TorqueOffset((0,)), ())


def searched(visited: dict, foreseen: dict | None = None) -> Search:
    return Search(None, (), visited=visited, foreseen=foreseen or {})  # pyright: ignore[reportArgumentType]


def test_probabilities_are_shares_of_all_structures():
    visited = {frozenset(): -1000.0, frozenset({SPRING}): -999.0, frozenset({SPRING, OFFSET}): -997.0}
    found = dict(probabilities(searched(visited, {frozenset({HARNESS}): -998.0, frozenset({SPRING}): -990.0})))
    assert sum(found.values()) == pytest.approx(1.0)
    weights = np.exp([-3.0, -2.0, 0.0, -1.0])  # a structure that was fitted counts as fitted, not as foreseen
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
    monkeypatch.setattr(findings, "wald", lambda *_: 0.5)
    monkeypatch.setattr(Search, "worths", lambda *_: [9.0, 1.0])
    extra = tuple(Term(e, ()) for e in (wider, second))
    claimed, possible = found(search, SimpleNamespace(fitted=SimpleNamespace(extra=extra)))
    assert [f.term for f in claimed] == [extra[0]]
    assert claimed[0].probability == pytest.approx(1.0)
    assert [p.key for p in possible] == [("empirical", (0,))]
    assert possible[0].probability == pytest.approx(1 / (1 + np.exp(-1.0)))

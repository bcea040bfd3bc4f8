"""Probabilities of effects from structures that were visited."""

import numpy as np
import pytest

from rrr_oc.diagnosis.findings import _rivals, keys_of, probabilities
from rrr_oc.diagnosis.search import Search
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
    spring, harness = ("parallel_spring", (0,)), ("cable_harness", (0,))
    shares = {key: sum(p for structure, p in every if key in keys_of(structure)) for key in (spring, harness)}
    assert shares == pytest.approx({spring: 0.5, harness: 0.5})
    own = {spring, ("torque_offset", (0,))}
    assert _rivals(spring, every, own) == [harness]
    assert _rivals(("torque_offset", (0,)), every, own) == []  # it is in every structure that is probable


def test_what_is_much_less_probable_is_no_rival():
    every = probabilities(searched({frozenset({SPRING}): 0.0, frozenset({HARNESS}): -5.0}))
    assert _rivals(("parallel_spring", (0,)), every, {("parallel_spring", (0,))}) == []

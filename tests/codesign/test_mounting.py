"""Choosing among ways to mount springs: on made-up costs, whose best way is known."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rrr_oc.codesign.search import mounting
from rrr_oc.codesign.search.mounting import RIVALS, TRIED, best_mounted
from rrr_oc.codesign.search.proposals import SearchOptions

OPTIONS = SearchOptions(starts=20)


@pytest.fixture
def contest(monkeypatch):
    """Ways 0, 1, …, each with a task, whose starts and whose improved springs cost what is given; says which starts were solved."""

    def make(starts, improved, stopped=()):
        solved = [[] for _ in starts]
        searched = []

        def least(way, _, numbers):
            solved[way] += list(numbers)
            return starts[way]

        def search(way, _):
            searched.append(way)
            return (
                None
                if improved[way] is None
                else SimpleNamespace(optima=[SimpleNamespace(cost=improved[way])], interrupted=way in stopped)
            )

        monkeypatch.setattr(mounting, "_least", least)
        monkeypatch.setattr(mounting, "_searched", search)
        monkeypatch.setattr(
            mounting, "Polisher", lambda *_: SimpleNamespace(polished=lambda _, guess: SimpleNamespace(polished=guess))
        )
        ways: list[Any] = [(way,) for way in range(len(starts))]
        return ways, solved, searched

    return make


def test_the_dearer_half_is_left_out_and_no_start_is_solved_twice(contest):
    starts = [8.0, 1.0, 7.0, 1.2, 6.0, 1.1, 5.0, 1.3]
    ways, solved, searched = contest(starts, starts)
    assert best_mounted(ways, OPTIONS)[0] == 1
    assert [len(one) for one in solved] == [2 * TRIED if cost < 2 else TRIED for cost in starts]
    assert all(one == list(range(len(one))) for one in solved)
    assert searched == [1, 5]
    assert len(searched) == RIVALS


def test_rivals_are_compared_after_their_springs_were_improved(contest):
    ways, *_ = contest([1.0, 2.0, 9.0], [1.0, 0.4, 0.1])
    best, found = best_mounted(ways, OPTIONS)
    assert best == 1
    assert [one.optima[0].cost for one in found] == [0.4]


def test_a_way_far_above_the_best_is_not_searched(contest):
    ways, _, searched = contest([1.0, 100.0, 200.0], [1.0, 0.1, 0.1])
    assert best_mounted(ways, OPTIONS) == (0, [])
    assert not searched


def test_a_way_is_no_dearer_than_the_fewer_springs_that_it_contains(contest):
    ways, *_ = contest([3.0, 1.0, 1.1, 9.0], [3.0, 1.0, 1.1, 9.0])
    guesses: list[list[Any]] = [[], [], [], [0.5], []]
    assert best_mounted(ways, OPTIONS)[0] == 1
    assert best_mounted(ways, OPTIONS, known=guesses[:4])[0] == 3
    assert best_mounted(ways[:2], OPTIONS, known=guesses[3:])[0] == 0


def test_the_only_way_needs_no_search(contest):
    ways, solved, searched = contest([1.0], [1.0])
    assert best_mounted(ways, OPTIONS) == (0, [])
    assert (solved, searched) == ([[]], [])


def test_a_way_whose_search_finds_nothing_loses(contest):
    ways, *_ = contest([np.inf, np.inf], [None, 5.0])
    assert best_mounted(ways, OPTIONS)[0] == 1


def test_a_search_that_is_interrupted_is_the_last_one(contest):
    ways, _, searched = contest([1.0, 1.0], [2.0, 1.0], stopped=[0])
    best, (found,) = best_mounted(ways, OPTIONS)
    assert (best, found.interrupted, searched) == (0, True, [0])


def test_how_far_the_choice_is_never_falls_and_ends_at_the_whole(contest):
    ways, *_ = contest([1.0] * 16, [1.0] * 16)
    told = []
    best_mounted(ways, OPTIONS, report=told.append)
    assert [step.tried for step in told] == list(range(1, told[0].total + 1))


def test_the_costs_of_several_tasks_are_weighed(monkeypatch):
    costs = {"a": 1.0, "b": 9.0, "c": 4.0, "d": 4.0}
    monkeypatch.setattr(
        mounting, "_searched", lambda one, _: SimpleNamespace(optima=[SimpleNamespace(cost=costs[one])], interrupted=False)
    )
    ways: list[Any] = [("a", "b"), ("c", "d")]
    assert best_mounted(ways, OPTIONS, lambda _, own: max(own))[0] == 1
    assert best_mounted(ways, OPTIONS, lambda _, own: own[0])[0] == 0

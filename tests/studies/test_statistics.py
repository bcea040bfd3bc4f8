"""Rank-sum tests against the paper's printed p-values, against counting, and against a hand-worked correction."""

from itertools import combinations

import numpy as np
import pytest

from rrr_oc.errors import UserError
from studies.paper.statistics import compare, holm, rank

LOW, HIGH = list(range(10)), list(range(10, 20))


def test_ten_trials_that_do_not_overlap_give_the_papers_p():
    """The paper prints p = 0.000091 for three comparisons; exact, two-sided it is 2 / C(20, 10)."""
    (found,) = compare({"a": LOW, "b": HIGH}, [("a", "b")])
    assert round(found.p_paper, 6) == 0.000091
    assert found.p == pytest.approx(2 / 184756, rel=1e-9)
    assert (found.superiority, found.delta) == (1.0, 1.0)
    assert found.ratio == pytest.approx(4.5 / 14.5)


def test_p_is_that_of_all_permutations():
    """Five against five by enumeration of the 252 ways to divide ten numbers."""
    a, b = np.array([1.0, 4.0, 2.5, 7.0, 3.0]), np.array([5.0, 6.0, 2.0, 8.0, 9.0])
    (found,) = compare({"a": a, "b": b}, [("a", "b")])
    every, wins = np.r_[a, b], []
    for chosen in combinations(range(10), 5):
        rest = [i for i in range(10) if i not in chosen]
        wins.append(np.sum(every[list(chosen)][:, None] < every[rest]))
    here = np.sum(a[:, None] < b)
    share = np.mean(np.abs(np.array(wins) - 12.5) >= abs(here - 12.5))
    assert found.p == pytest.approx(share, rel=1e-12)
    assert found.delta == pytest.approx(2 * here / 25 - 1)


def test_holms_correction():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.6, 0.9]) == [1.0, 1.0]


def test_a_ranking_is_as_sure_as_its_trials_are_apart():
    sure = rank({"a": LOW, "b": HIGH})
    assert sure.order == ("a", "b")
    assert sure.by_median > 0.97
    same = rank({"a": LOW, "b": LOW, "c": LOW})
    assert 0.05 < same.by_median < 0.3  # one order of six, less ties
    assert rank({"b": LOW, "a": HIGH}, seed=1) == rank({"b": LOW, "a": HIGH}, seed=1)


def test_too_few_trials_are_refused():
    with pytest.raises(UserError, match="b has 1"):
        compare({"a": LOW, "b": [1.0]}, [("a", "b")])

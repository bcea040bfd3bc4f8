"""How often claims are right: the regression on claims about sealed arms."""

import numpy as np
import pytest

from rrr_oc.diagnosis.claims.reliability import NAMES, probability_of
from validation.chains.reliability import elsewhere, regression, table


def claims(count, chance, seed=0):
    """Claims that are right with a chance which depends on the second quantity, of three families."""
    rng = np.random.default_rng(seed)
    every = []
    for k in range(count):
        x = np.append(1.0, rng.normal(size=len(NAMES) - 1))
        every.append((f"family {k % 3}", x, bool(rng.uniform() < chance(x[1]))))
    return every


def test_a_probability_is_a_frequency_on_a_family_that_was_left_out():
    some = claims(3000, lambda x: 1 / (1 + np.exp(-1.5 - x)))
    said = elsewhere(some)
    assert len(said) == 3000
    for low, high in ((0.3, 0.7), (0.8, 0.9), (0.9, 0.97)):
        inside = np.array([(p, right) for _, p, right in said if low < p < high], float)
        assert len(inside) > 200
        assert inside[:, 0].mean() == pytest.approx(inside[:, 1].mean(), abs=0.05)
    assert "0.9 to 0.95 | " in table(said)


@pytest.mark.parametrize("count", [10, 100])
def test_of_claims_that_were_all_right_the_next_may_be_wrong(count):
    """With a chance of about one in their number (Laplace's rule of succession)."""
    p = probability_of(np.append(1.0, np.zeros(len(NAMES) - 1)), regression(claims(count, lambda _: 1.0)))
    assert 1 - p == pytest.approx(1 / (count + 2), rel=0.3)

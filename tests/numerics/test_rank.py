"""Inverses of matrices without full rank."""

import numpy as np
import pytest

from rrr_oc.numerics.rank import pseudo_inverse


def test_leaving_out_what_alone_knows_of_a_parameter_says_nothing_of_it():
    """A column of zeros has neither an estimate nor a say."""
    matrix = np.array([[4.0, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 2.0]])
    inverse = pseudo_inverse(matrix)
    assert np.all(inverse[1] == pytest.approx(0.0, abs=1e-12))
    np.testing.assert_allclose(inverse[np.ix_([0, 2], [0, 2])], np.linalg.inv(matrix[np.ix_([0, 2], [0, 2])]), atol=1e-12)

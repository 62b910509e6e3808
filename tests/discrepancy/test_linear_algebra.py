"""Decompositions of finite columns have an answer, also where the fast algorithm has none."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from casadi_engine.discrepancy.linear_algebra import basis, coefficients, inverse, svd

COLUMNS = np.random.default_rng(0).standard_normal((9, 4))


def failing(columns, full_matrices=True):
    raise np.linalg.LinAlgError("SVD did not converge")


def test_where_the_fast_algorithm_fails_the_plain_one_answers(monkeypatch):
    """One of the matrices of a pendulum's record ended a repair by a bare error."""
    frame, there = basis(COLUMNS), coefficients(COLUMNS, COLUMNS @ [1.0, 2.0, 3.0, 4.0])
    monkeypatch.setattr(np.linalg, "svd", failing)
    again = basis(COLUMNS)
    np.testing.assert_allclose(again @ again.T, frame @ frame.T, atol=1e-12)
    np.testing.assert_allclose(coefficients(COLUMNS, COLUMNS @ [1.0, 2.0, 3.0, 4.0]), there, atol=1e-12)
    np.testing.assert_allclose(there, [1, 2, 3, 4], atol=1e-12)
    with pytest.raises(np.linalg.LinAlgError):
        svd(np.full((3, 2), np.nan))


@given(st.integers(0, 10**6), st.integers(-12, 12))
def test_directions_in_parameters_of_any_size_have_an_inverse(seed, decades):
    """Of a modulus of 1e10 beside a leak of 1e-7 the leak counted as zero, and a law was held against one record in
    place of two: "far more probable"."""
    rng = np.random.default_rng(seed)
    size = 10.0 ** np.array([0, decades, -decades, decades / 2])
    turn = size[:, None] * np.linalg.qr(rng.standard_normal((4, 4)))[0][:, :3]
    np.testing.assert_allclose(inverse(turn) @ turn, np.eye(3), atol=1e-8)

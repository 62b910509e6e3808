"""Decompositions of finite columns have an answer, also where the fast algorithm has none."""

import numpy as np
import pytest

from casadi_engine.discrepancy.linear_algebra import basis, coefficients, svd

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

"""A stretch of a coloured process becomes white, whatever its length, with samples missing or not."""

import numpy as np
import pytest
from scipy.linalg import toeplitz

from casadi_engine.validation.whitening import Whitener


def process():
    """An autoregression x_k = 0.9 x_{k-1} − 0.2 x_{k-2}: its predictors, variances and covariance of 30 samples."""
    wide = np.zeros(400)
    wide[0] = 1.0
    impulse = np.zeros(400)
    for k in range(400):
        impulse[k] = wide[k] + 0.9 * impulse[k - 1] * (k > 0) - 0.2 * impulse[k - 2] * (k > 1)
    covariance = toeplitz([impulse[: 400 - lag] @ impulse[lag:] for lag in range(30)])
    one = covariance[0, 1] / covariance[0, 0]
    predictors = (np.ones(1), np.array([1.0, -one]), np.array([1.0, -0.9, 0.2]))
    variances = np.array([covariance[0, 0], covariance[0, 0] * (1 - one**2), 1.0])
    return predictors, variances, covariance


@pytest.mark.parametrize(
    ("size", "missing"),
    [(1, ()), (2, ()), (2, (0,)), (3, (0,)), (3, (1,)), (30, ()), (30, (0,)), (30, (3, 4))],
)
def test_the_squares_are_those_of_the_covariance(size, missing):
    predictors, variances, covariance = process()
    valid = ~np.isin(np.arange(size), missing)
    columns = np.where(valid[:, None], np.random.default_rng(0).standard_normal((size, 2)), 0.0)
    white = Whitener(predictors, variances, valid)
    own = covariance[:size, :size][np.ix_(valid, valid)]
    wanted = columns[valid].T @ np.linalg.solve(own, columns[valid])
    made = white.apply(columns)
    np.testing.assert_allclose(made.T @ made, wanted, rtol=1e-9)
    assert white.log_determinant == pytest.approx(np.linalg.slogdet(own)[1], abs=1e-9)

"""Autoregressions: the sums of lagged products against their definition."""

import numpy as np
import pytest

from casadi_engine.estimation.autoregression import _products


@pytest.mark.parametrize("order", [0, 1, 7])
@pytest.mark.parametrize("gaps", [(), (50,), (0, 3, 80, 81)])
@pytest.mark.parametrize("columns", [1, 4])
def test_lagged_products_are_their_sums(order, gaps, columns):
    rng = np.random.default_rng(order + columns)
    noise = np.cumsum(rng.standard_normal((120, columns)), axis=0)
    valid = ~np.isin(np.arange(120), gaps)
    noise[~valid] = 0
    index = np.arange(120)
    run = index - np.maximum.accumulate(np.where(valid, -1, index))
    found = _products(noise, run, order)
    wanted = np.zeros_like(found)
    for t in range(order, 120):
        if run[t] <= order:  # a row needs its whole past
            continue
        for k in range(columns):
            row = np.append(noise[t - order : t, k][::-1], noise[t, k])  # e(t - 1) ... e(t - order), e(t)
            wanted[min(k, 1)] += np.outer(row, row)
    np.testing.assert_allclose(found, wanted, rtol=1e-10, atol=1e-9 * max(np.abs(wanted).max(), 1))

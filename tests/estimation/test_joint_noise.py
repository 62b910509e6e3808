"""Colour that outputs have in common: against the exact covariance of a vector autoregression."""

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from casadi_engine.estimation.joint_noise import common_scatter, vector_autoregression

TURN = np.array([[0.8, 0.15], [-0.2, 0.7]])
PUSH = np.array([[1.0, 0.6], [0.6, 1.0]])


def drawn(random, count):
    """A vector autoregression of order 1 (2, n), from its stationary law on."""
    root = np.linalg.cholesky(PUSH)
    e = np.empty((2, count))
    e[:, 0] = np.linalg.cholesky(solve_discrete_lyapunov(TURN, PUSH)) @ random.standard_normal(2)
    for k in range(1, count):
        e[:, k] = TURN @ e[:, k - 1] + root @ random.standard_normal(2)
    return e


def covariance(count):
    """(2, 2, n, n) of the same, in closed form."""
    lag = [solve_discrete_lyapunov(TURN, PUSH)]
    for _ in range(count - 1):
        lag.append(TURN @ lag[-1])
    found = np.empty((2, 2, count, count))
    for s in range(count):
        for t in range(count):
            found[:, :, s, t] = lag[s - t] if s >= t else lag[t - s].T
    return found


def test_the_scatter_is_that_of_the_exact_covariance():
    random, count = np.random.default_rng(1), 400
    slopes = [
        np.stack([np.sin(np.arange(count) / 9 + k), np.cos(np.arange(count) / 31)], axis=1) for k in range(2)
    ]
    exact = covariance(count)
    wanted = sum(slopes[i].T @ exact[i, j] @ slopes[j] for i in range(2) for j in range(2))
    long = drawn(random, 20000)
    found = [
        common_scatter([one[:, None] for one in part], np.ones(count, dtype=bool), slopes)
        for part in np.split(long, 50, axis=1)
    ]
    np.testing.assert_allclose(np.median(found, axis=0)[[0, 1], [0, 1]], np.diag(wanted), rtol=0.12)
    alone = sum(slopes[i].T @ exact[i, i] @ slopes[i] for i in range(2))
    assert np.linalg.norm(wanted - alone) > 0.2 * np.linalg.norm(
        wanted
    )  # what the outputs by themselves leave out


def test_coefficients_are_found_beside_gaps():
    noise = drawn(np.random.default_rng(2), 6000)
    valid = np.ones(6000, dtype=bool)
    valid[1000:1100], valid[::701] = False, False
    coefficients, innovations = vector_autoregression((noise * valid)[:, :, None], valid)
    np.testing.assert_allclose(coefficients[0], TURN, atol=0.05)
    np.testing.assert_allclose(innovations, PUSH, atol=0.06)
    assert len(coefficients) < 6


def test_few_samples_have_none():
    assert vector_autoregression(np.ones((2, 30, 1)), np.ones(30, dtype=bool)) is None
    assert common_scatter([np.ones((30, 1))] * 2, np.ones(30, dtype=bool), [np.ones((30, 1))] * 2) is None


def test_a_memory_longer_than_the_record_is_cut():
    """A ramp in both outputs predicts itself without end."""
    noise = np.stack([np.arange(300.0), np.arange(300.0)[::-1]]) + np.random.default_rng(0).standard_normal(
        (2, 300)
    )
    found = common_scatter([one[:, None] for one in noise], np.ones(300, dtype=bool), [np.ones((300, 1))] * 2)
    assert np.isfinite(found).all()
    assert found[0, 0] >= 0

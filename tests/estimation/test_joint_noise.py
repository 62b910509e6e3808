"""Colour that outputs have in common: against the exact covariance of a vector autoregression."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from scipy.signal import lfilter

import casadi_engine as ce
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


def test_two_sensors_that_one_thing_moves_are_worth_no_more_than_one():
    """A drift that both see: where their colour is one, its error is that by one of them, root 2 times as large."""
    b = ce.Blueprint("drift")
    g, x = b.parameter("g", 0.1, unit="m/s", min=-5, max=5), b.state("x", unit="m")
    b.ode("x", g)
    b.output("y1", x, unit="m")
    b.output("y2", x, unit="m")
    model, time, units = b.model(), 0.1 * np.arange(600), {"y1": "m", "y2": "m"}
    ratios = []
    for seed in range(6):
        random = np.random.default_rng(seed)
        e = lfilter([0.6], [1, -0.8], random.standard_normal((2, 600)), axis=1)
        own = 0.1 * random.standard_normal((2, 600))
        errors = []
        for second in (e[0], e[1]):
            y1, y2 = 0.3 * time + e[0] + own[0], 0.3 * time + second + own[1]
            data = ce.Experiment.from_arrays("r", time=time, units=units, y1=y1, y2=y2)
            errors.append(ce.estimate(model, data, progress=False).stderr["g"])
        ratios.append(errors[0] / errors[1])
    assert np.mean(ratios) == pytest.approx(np.sqrt(2), rel=0.1)

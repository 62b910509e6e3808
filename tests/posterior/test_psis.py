"""Pareto smoothing, on weights of a known tail."""

import numpy as np
import pytest

from casadi_engine.posterior.psis import kish, log_mean, normalised, pareto_smoothed


@pytest.mark.parametrize("shape", [0.2, 0.5, 0.9])
def test_the_shape_of_the_tail_is_found(shape):
    weights = np.random.default_rng(0).random(40000) ** -shape
    assert pareto_smoothed(np.log(weights))[1] == pytest.approx(shape, abs=0.08)


def test_smoothing_lowers_the_largest_weights_and_keeps_their_order():
    weights = np.random.default_rng(1).random(4000) ** -0.8
    smooth, _ = pareto_smoothed(np.log(weights))
    assert np.array_equal(np.argsort(smooth, kind="stable")[-50:], np.argsort(weights, kind="stable")[-50:])
    assert smooth.max() <= np.log(weights.max())
    assert np.exp(log_mean(smooth)) == pytest.approx(1 / (1 - 0.8), rel=0.25)


def test_weights_that_are_alike_have_no_tail():
    smooth, shape = pareto_smoothed(np.zeros(1000))
    assert shape == -np.inf
    assert not smooth.any()


def test_too_few_weights_are_not_trusted():
    assert pareto_smoothed(np.array([0.0, 1.0, 2.0]))[1] == np.inf
    assert pareto_smoothed(np.full(100, -np.inf))[1] == np.inf
    assert log_mean(np.full(100, -np.inf)) == -np.inf


def test_a_draw_that_outweighs_all_is_worth_one():
    assert kish(normalised(np.array([0.0, -800.0, -900.0]))) == pytest.approx(1.0)
    assert kish(normalised(np.full(50, -3.0))) == pytest.approx(50.0)


def test_a_tail_beyond_all_numbers_is_heavy():
    smooth, shape = pareto_smoothed(-np.random.default_rng(0).exponential(3e4, 1000))
    assert shape > 100
    assert np.isfinite(smooth).all()


def test_tiny_weights_are_worth_as_many_as_their_multiples():
    assert kish(np.full(7, 1e-200)) == pytest.approx(7)
    assert kish(np.zeros(7)) == 0

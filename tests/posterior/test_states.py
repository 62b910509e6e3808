"""The prior of initial states, and their integral."""

import numpy as np
import pytest

from casadi_engine.posterior.states import StatePrior, state_prior


def test_the_integral_is_that_of_a_normal_density(covariance, normal):
    random = np.random.default_rng(0)
    rows, rest = random.standard_normal((4, 9)), 3 * random.standard_normal(9)
    prior = StatePrior(random.standard_normal(4), np.linalg.cholesky(covariance))
    squares, volume = prior.marginal(rows, rest)
    whole = normal(rest[None], -prior.mean @ rows, np.eye(9) + rows.T @ covariance @ rows)[0]
    assert -0.5 * (squares + volume) - 4.5 * np.log(2 * np.pi) == pytest.approx(whole)
    best = prior.best(rows, rest)
    apart = np.linalg.solve(prior.factor, best - prior.mean)
    assert np.square(rest + best @ rows).sum() + apart @ apart == pytest.approx(squares)
    for side in np.eye(4):
        moved = np.linalg.solve(prior.factor, best + 0.1 * side - prior.mean)
        assert np.square(rest + (best + 0.1 * side) @ rows).sum() + moved @ moved > squares


def test_two_states_have_twice_the_mean_and_the_variance(covariance):
    prior = StatePrior(np.arange(4.0), np.linalg.cholesky(covariance)).of_sum()
    np.testing.assert_allclose(prior.mean, 2 * np.arange(4.0))
    np.testing.assert_allclose(prior.factor @ prior.factor.T, 2 * covariance)


def test_a_record_is_the_prior_of_its_own_states(two_masses):
    fit, target = two_masses
    record = target.search.records[0]
    first = np.array([one.value for one in fit.initial[record.experiment.name].values()]) / record.scale
    prior = state_prior(record, target.start, first)
    apart = np.linalg.solve(prior.factor, first - prior.mean)
    assert apart @ apart < 9  # three states
    speed = fit.traces[record.experiment.name]["omega"].simulated / record.scale[0]
    assert prior.mean[0] == pytest.approx(speed.mean(), rel=0.01)
    assert np.sqrt((prior.factor @ prior.factor.T)[0, 0]) == pytest.approx(1.5 * speed.std(), rel=0.1)


def test_without_states_along_the_record_their_size_stands_for_them(two_masses):
    _, target = two_masses
    single = target.search.records[0].single()
    prior = state_prior(single, target.start, np.array([1.2, 1.2, 0.1]))
    np.testing.assert_allclose(prior.factor, 1.5 * np.diag([1.2, 1.2, 1.0]))
    assert not prior.mean.any()


def test_what_is_no_number_has_no_integral():
    prior = StatePrior(np.zeros(1), np.eye(1))
    with pytest.raises(FloatingPointError):
        prior.marginal(np.array([[np.nan, 0.0]]), np.zeros(2))

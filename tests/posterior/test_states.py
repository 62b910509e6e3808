"""The prior of initial states, and their integral."""

import numpy as np
import pytest

from casadi_engine.posterior.states import WIDTHS, StatePrior, state_prior


def test_the_integral_is_that_of_normal_densities_of_all_widths(covariance, normal):
    random = np.random.default_rng(0)
    rows, rest = random.standard_normal((4, 9)), 3 * random.standard_normal(9)
    prior = StatePrior(random.standard_normal(4), np.linalg.cholesky(covariance))
    (log,), (width,), _ = prior.integral(rows[None], rest[None])
    whole = [
        normal(rest[None], -prior.mean @ rows, np.eye(9) + rows.T @ (w**2 * covariance) @ rows)[0]
        for w in WIDTHS
    ]
    expected = np.logaddexp.reduce(whole) - np.log(len(WIDTHS))
    assert log - 4.5 * np.log(2 * np.pi) == pytest.approx(expected)
    assert width == WIDTHS[np.argmax(whole)]


@pytest.mark.parametrize(("size", "width"), [(1.0, 1.0), (30.0, 10.0)])
def test_the_width_is_that_of_the_data(size, width):
    """Forty states seen without noise, as wide as the prior and thirty times as wide."""
    states = size * np.random.default_rng(1).standard_normal(40)
    prior = StatePrior(np.zeros(40), np.eye(40))
    _, found, best = prior.integral(100 * np.eye(40)[None], -100 * states[None])
    assert found == [width]
    np.testing.assert_allclose(best[0], states, rtol=1e-3)


def test_the_best_states_have_the_least_chi_squared(covariance):
    random = np.random.default_rng(0)
    rows, rest = random.standard_normal((4, 9)), 3 * random.standard_normal(9)
    prior = StatePrior(random.standard_normal(4), np.linalg.cholesky(covariance), width=3.0)

    def squares(states):
        apart = np.linalg.solve(3 * prior.factor, states - prior.mean)
        return np.square(rest + states @ rows).sum() + apart @ apart

    left = rest + prior.mean @ rows
    best = prior.best(rows, left)
    least = left @ left - prior.without(rows, left[None])[0, 0]
    assert squares(best) == pytest.approx(least)
    assert all(squares(best + 0.1 * side) > least for side in (*np.eye(4), *-np.eye(4)))


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
    assert apart @ apart < 12  # three states, the first of which is farther out than most
    speed = fit.traces[record.experiment.name]["omega"].simulated / record.scale[0]
    assert prior.mean[0] == pytest.approx(speed.mean(), rel=0.01)
    assert np.sqrt((prior.factor @ prior.factor.T)[0, 0]) == pytest.approx(speed.std(), rel=0.1)


def test_without_states_along_the_record_their_size_stands_for_them(two_masses):
    _, target = two_masses
    single = target.search.records[0].single()
    prior = state_prior(single, target.start, np.array([1.2, 1.2, 0.1]))
    np.testing.assert_allclose(prior.factor, np.diag([1.2, 1.2, 1.0]))
    assert not prior.mean.any()


def test_coordinates_may_be_others(covariance):
    random = np.random.default_rng(2)
    prior = StatePrior(random.standard_normal(4), np.linalg.cholesky(covariance))
    rows, rest = random.standard_normal((2, 4, 9)), random.standard_normal((2, 9))
    turn = random.standard_normal((2, 4, 4))
    one = prior.integral(turn.swapaxes(1, 2) @ rows, rest)
    two = prior.integral(rows, rest, turn)
    np.testing.assert_allclose(one[0], two[0])
    np.testing.assert_allclose((turn @ one[2][..., None])[..., 0], two[2])


def test_what_is_no_number_has_no_integral():
    prior = StatePrior(np.zeros(1), np.eye(1))
    rows = np.array([[[np.nan, 0.0]], [[1.0, 0.0]]])
    assert np.isnan(prior.integral(rows, np.zeros((2, 2)))[0]).tolist() == [True, False]

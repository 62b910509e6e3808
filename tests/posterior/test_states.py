"""The prior of initial states, and their integral."""

from dataclasses import replace

import numpy as np
import pytest

from casadi_engine.estimation.options import interval_length
from casadi_engine.posterior.states import WIDTHS, StatePrior, _factor, state_prior


def prior_of(random, covariance):
    """Two densities of four states."""
    factor = np.linalg.cholesky(covariance)
    return StatePrior(random.standard_normal((2, 4)), np.array([factor, 0.3 * np.eye(4)]))


def test_the_integral_is_that_of_normal_densities_of_all_shapes_and_widths(covariance, normal):
    random = np.random.default_rng(0)
    rows, rest = random.standard_normal((4, 9)), 3 * random.standard_normal(9)
    prior = prior_of(random, covariance)
    (log,), _ = prior.integral(rows[None], rest[None])
    shapes = list(zip(prior.means, (covariance, 0.09 * np.eye(4)), strict=True))
    whole = [
        normal(rest[None], -mean @ rows, np.eye(9) + rows.T @ (w**2 * shape) @ rows)[0]
        for mean, shape in shapes
        for w in WIDTHS
    ]
    expected = np.logaddexp.reduce(whole) - np.log(len(whole))
    assert log - 4.5 * np.log(2 * np.pi) == pytest.approx(expected)
    settled = prior.settled(rows, rest)
    assert len(WIDTHS) * settled.chosen + WIDTHS.tolist().index(settled.width) == np.argmax(whole)


@pytest.mark.parametrize(("size", "chosen", "width"), [(1.0, 0, 1.0), (30.0, 0, 10.0), (0.03, 1, 1.0)])
def test_shape_and_width_are_those_of_the_data(size, chosen, width):
    """Forty states seen without noise: as wide as the prior, thirty times as wide, and like the second prior."""
    states = size * np.random.default_rng(1).standard_normal(40)
    prior = StatePrior(np.zeros((2, 40)), np.array([np.eye(40), 0.03 * np.eye(40)]))
    rows, rest = 3000 * np.eye(40), -3000 * states
    found = prior.settled(rows, rest)
    assert (found.chosen, found.width) == (chosen, width)
    np.testing.assert_allclose(prior.integral(rows[None], rest[None])[1][0], states, rtol=1e-3)


def test_the_best_states_have_the_least_chi_squared(covariance):
    random = np.random.default_rng(0)
    rows, rest = random.standard_normal((4, 9)), 3 * random.standard_normal(9)
    prior = replace(prior_of(random, covariance), width=3.0)

    def squares(states):
        apart = np.linalg.solve(prior.factor, states - prior.mean)
        return np.square(rest + states @ rows).sum() + apart @ apart

    left = rest + prior.mean @ rows
    best = prior.best(rows, left)
    least = left @ left - prior.without(rows, left[None])[0, 0]
    assert squares(best) == pytest.approx(least)
    assert all(squares(best + 0.1 * side) > least for side in (*np.eye(4), *-np.eye(4)))


def test_some_of_the_states_have_their_own_share(covariance):
    prior = StatePrior(np.arange(4.0)[None], np.linalg.cholesky(covariance)[None]).part(np.array([1, 3]))
    np.testing.assert_allclose(prior.mean, [1, 3])
    np.testing.assert_allclose(prior.factor @ prior.factor.T, covariance[np.ix_([1, 3], [1, 3])])


def test_the_last_state_follows_from_the_first(covariance):
    """Draws of the first state, the last one made of each of them."""
    random = np.random.default_rng(4)
    ahead, forced = 0.7 * random.standard_normal((4, 4)), random.standard_normal(4)
    prior = StatePrior(np.arange(4.0)[None], np.linalg.cholesky(covariance)[None])
    first = prior.mean + random.standard_normal((200_000, 4)) @ prior.factor.T
    sums = first + first @ ahead.T + forced
    found = prior.of_sum(ahead, forced)
    np.testing.assert_allclose(found.mean, sums.mean(axis=0), atol=0.03)
    np.testing.assert_allclose(found.factor @ found.factor.T, np.cov(sums.T), rtol=0.02, atol=0.1)


def test_a_trend_is_led_back_to_the_beginning():
    """Motion about a line that falls: the first state lies as far from the mean of the later half as the line does."""
    at = np.arange(400.0)
    nodes = np.stack([np.sin(at), 5.0 - 0.01 * at + 0.1 * np.cos(at)], axis=1)
    factor = _factor(nodes[200:])
    spread = np.sqrt(np.diag(factor @ factor.T))
    assert spread[0] == pytest.approx(np.sqrt(0.5), rel=0.05)
    assert spread[1] == pytest.approx(np.hypot(3.0, nodes[200:, 1].std()), rel=0.02)


def test_a_record_is_the_prior_of_its_own_states(two_masses):
    fit, target = two_masses
    record = target.search.records[0]
    first = np.array([one.value for one in fit.initial[record.experiment.name].values()]) / record.scale
    prior = state_prior(record, target.start, first)
    speed = fit.traces[record.experiment.name]["omega"].simulated / record.scale[0]
    later = speed[len(speed) // 2 :]
    apart = np.linalg.solve(prior.factor, first - prior.mean)
    assert apart @ apart < 16  # three states, the first of which is farther out than most
    assert prior.mean[0] == pytest.approx(later.mean(), rel=0.01)
    plan = record.again(gain=record.gain, length=interval_length("auto", record.grid)).plan
    nodes = speed[: plan.m * plan.length : plan.length][plan.m // 2 :]
    trend = np.polyfit(np.arange(len(nodes)), nodes, 1)[0] * 1.5 * len(nodes)
    spread = np.sqrt((prior.factor @ prior.factor.T)[0, 0])
    assert spread == pytest.approx(np.hypot(nodes.std(), trend), rel=1e-3)
    assert nodes.std() == pytest.approx(later.std(), rel=0.1)
    assert not prior.means[1].any()
    np.testing.assert_allclose(prior.factors[1], np.diag(np.maximum(np.abs(first), 1)))


def test_noise_in_the_first_states_does_not_widen_it(two_masses):
    """A shaft that the fit starts with a twist far from any that follow."""
    _, target = two_masses
    record = target.search.records[0]
    still, twisted = (state_prior(record, target.start, np.array([1.2, 1.2, twist])) for twist in (0.1, 3.0))
    assert twisted.factor[2, 2] == pytest.approx(still.factor[2, 2], rel=0.1)


def test_without_states_along_the_record_their_size_stands_for_them(two_masses):
    _, target = two_masses
    single = target.search.records[0].single()
    prior = state_prior(single, target.start, np.array([1.2, 1.2, 0.1]))
    np.testing.assert_allclose(prior.factor, np.diag([1.2, 1.2, 1.0]))
    assert len(prior.means) == 1
    assert not prior.mean.any()


def test_coordinates_may_be_others(covariance):
    random = np.random.default_rng(2)
    prior = prior_of(random, covariance)
    rows, rest = random.standard_normal((2, 4, 9)), random.standard_normal((2, 9))
    turn = random.standard_normal((2, 4, 4))
    one = prior.integral(turn.swapaxes(1, 2) @ rows, rest)
    two = prior.integral(rows, rest, turn)
    np.testing.assert_allclose(one[0], two[0])
    np.testing.assert_allclose((turn @ one[1][..., None])[..., 0], two[1])


def test_what_is_no_number_has_no_integral():
    prior = StatePrior(np.zeros((1, 1)), np.eye(1)[None])
    rows = np.array([[[np.nan, 0.0]], [[1.0, 0.0]]])
    assert np.isnan(prior.integral(rows, np.zeros((2, 2)))[0]).tolist() == [True, False]


def test_states_that_are_seen_far_better_than_their_prior_leave_no_singular_matrix():
    """At a point far off two states did all but the same, a thousand million times as much as the noise."""
    random = np.random.default_rng(5)
    prior = StatePrior(np.zeros((1, 2)), np.array([np.eye(2)]))
    one = random.standard_normal(30)
    rows = 1e12 * np.array([one, one * (1 + 1e-14)])
    flat = random.standard_normal((3, 30))
    taken = prior.without(rows, flat)
    along = flat @ one / np.linalg.norm(one)
    np.testing.assert_allclose(taken, np.outer(along, along), atol=1e-6 * np.abs(taken).max())
    assert np.isfinite(prior.best(rows, flat[0])).all()
    rows[0, 3] = np.nan
    assert not np.isfinite(prior.without(rows, flat)).any()
    assert not np.isfinite(prior.best(rows, flat[0])).any()

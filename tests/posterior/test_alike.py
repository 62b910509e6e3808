"""The moment of a record that is like its beginning."""

import numpy as np
import pytest

from casadi_engine.posterior.alike import _moment, alike
from casadi_engine.posterior.states import state_prior


def drives_of(count, period, noise=0.0):
    """A pulse and a wave of one period, a drive that stands still, and noise."""
    at = np.arange(count) % period
    random = np.random.default_rng(0)
    moving = np.array([np.exp(-at / 7), 3 * np.sin(2 * np.pi * at / period)])
    return np.concatenate([moving + noise * random.standard_normal(moving.shape), np.full((1, count), 5.0)])


@pytest.mark.parametrize(("count", "period"), [(900, 60), (4000, 60), (14_402, 1731)])
def test_it_is_a_whole_number_of_periods_later(count, period):
    moment, length = _moment(drives_of(count, period, noise=0.05))
    assert count // 2 <= moment <= count - count // 4
    off = moment % period
    assert min(off, period - off) <= 2  # beside it where no number of samples divides it
    assert moment % length == 0
    assert max(count // 500, 1) <= length <= 2 * max(count // 500, 1)


def test_drives_that_stand_still_or_are_short_have_none():
    assert _moment(drives_of(900, 60)[2:]) is None
    assert _moment(drives_of(30, 6)) is None


def test_a_running_shaft_starts_where_it_is_cycles_later(two_masses):
    """Two masses from the state of a later cycle: where it says, closer than the motion is wide."""
    fit, target = two_masses
    record = target.search.records[0]
    first = np.array([one.value for one in fit.initial[record.experiment.name].values()]) / record.scale
    state, apart = alike(record, target.start, first)
    assert apart.shape[1] == len(state) == record.n
    prior = state_prior(record, target.start, first)
    assert len(prior.means) == 3
    np.testing.assert_array_equal(prior.means[2], state)
    np.testing.assert_allclose(
        prior.factors[2] @ prior.factors[2].T, apart.T @ apart / len(apart), rtol=1e-2, atol=1e-6
    )
    away = np.linalg.solve(prior.factors[2], first - state)
    assert away @ away < 10 * record.n * 10  # within the widths that are integrated over
    sizes = [np.linalg.slogdet(factor)[1] for factor in prior.factors]
    assert sizes[2] < sizes[0] < sizes[1]


def test_noise_in_the_first_states_does_not_widen_the_difference(two_masses):
    _, target = two_masses
    record = target.search.records[0]
    still, twisted = (state_prior(record, target.start, np.array([1.2, 1.2, twist])) for twist in (0.1, 3.0))
    assert twisted.factors[2][2, 2] == pytest.approx(still.factors[2][2, 2], rel=0.1)
    np.testing.assert_allclose(twisted.means[2], still.means[2], atol=0.01)

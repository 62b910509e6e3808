"""The moment of a record that is like its beginning."""

from dataclasses import replace

import numpy as np
import pytest

from casadi_engine.posterior.alike import Alike, _moment
from casadi_engine.posterior.spectral_likelihood import SpectralLikelihood
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
    again = Alike.of(record, target.start, first)
    state = again.state(target.start)
    apart = again.apart(target.start, state)
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


def test_the_prior_follows_the_state_that_the_drives_lead_to(two_masses):
    """It had stayed where the fit has it, whatever the parameters are: intervals of a crankshaft were too narrow."""
    fit, target = two_masses
    record, v = target.search.records[0], target.start
    first = np.array([one.value for one in fit.initial[record.experiment.name].values()]) / record.scale
    prior, away = state_prior(record, v, first), v + 0.02 * np.arange(1, len(v) + 1)
    assert not prior.follows(v).any()
    there = state_prior(record, away, first)
    moved = prior.at(away)
    np.testing.assert_allclose(moved.means[2], there.means[2], rtol=1e-9)
    np.testing.assert_allclose(moved.means - prior.means, np.tile(prior.follows(away), (3, 1)), rtol=1e-9)
    assert np.abs(moved.means[2] - prior.means[2]).max() > 1e-3


def test_the_likelihood_is_the_same_wherever_its_prior_was_made(two_masses):
    fit, target = two_masses
    records, v, sigma = target.search.records, target.start[: target.nv], np.full((2, 1), 0.1)
    away = v + 0.003 * np.array([1.0, -1.0, 1.0, -1.0, 1.0])
    (one,) = fit.initial.values()
    first = np.array([own.value for own in one.values()]) / records[0].scale

    def told(made, **changed):
        prior = replace(state_prior(records[0], made, first), **changed)
        likelihood = SpectralLikelihood(records, made, [prior]).full(np.array([v, away]), sigma)
        return likelihood[0] - likelihood[1]

    assert told(v) == pytest.approx(told(away), abs=0.03)
    assert abs(told(v, follows=None) - told(away, follows=None)) > 0.15

"""Mixtures of t-densities: their draws have their density."""

import numpy as np
import pytest

from casadi_engine.posterior.mixture import FREEDOM, Mixture, around
from casadi_engine.posterior.psis import log_mean


@pytest.fixture
def mixture(covariance):
    return Mixture.of(
        [3.0, 1.0], np.array([np.zeros(4), np.full(4, 5.0)]), np.array([covariance, 0.2 * covariance])
    )


def test_the_density_is_that_of_scipy(mixture, covariance):
    from scipy.stats import multivariate_t

    x = np.random.default_rng(0).standard_normal((20, 4)) * 3
    one = multivariate_t(np.zeros(4), covariance, FREEDOM).pdf(x)
    two = multivariate_t(np.full(4, 5.0), 0.2 * covariance, FREEDOM).pdf(x)
    np.testing.assert_allclose(np.exp(mixture.log_density(x)), 0.75 * one + 0.25 * two, rtol=1e-10)


def test_draws_have_the_density(mixture, covariance):
    x = mixture.draw(40000, np.random.default_rng(1))
    np.testing.assert_allclose(x.mean(axis=0), 1.25, atol=0.1)
    whole = FREEDOM / (FREEDOM - 2) * (0.75 + 0.25 * 0.2) * covariance + 0.75 * 0.25 * 25
    np.testing.assert_allclose(np.cov(x.T), whole, atol=0.05 * np.diag(whole).max())


def test_guarded_and_joined_mixtures_are_densities_too(mixture):
    random = np.random.default_rng(2)
    both = mixture.guarded().beside(mixture)
    x = both.draw(20000, random)
    assert np.exp(log_mean(mixture.log_density(x) - both.log_density(x))) == pytest.approx(1.0, abs=0.02)


def test_fitting_finds_two_modes(normal, covariance):
    random = np.random.default_rng(3)
    x = random.multivariate_normal(np.zeros(4), covariance, 3000)
    x[2000:] += 12
    found = around(x, 2, random)
    order = np.argsort(found.centre[:, 0])
    np.testing.assert_allclose(found.share[order], [2 / 3, 1 / 3], atol=0.01)
    np.testing.assert_allclose(found.centre[order], [[0] * 4, [12] * 4], atol=0.2)


def test_a_component_that_few_draws_know_goes_to_them_and_keeps_its_shape(mixture):
    x = mixture.draw(500, np.random.default_rng(4))
    near = x[np.argmax(mixture.parts(x), axis=0) == 0]
    seen = np.concatenate([near, np.full((1, 4), 5.0)])
    moved = mixture.fitted(seen, np.ones(len(seen)))
    np.testing.assert_allclose(moved.centre[1], 5.0, atol=0.2)
    np.testing.assert_allclose(moved.factor[1], np.sqrt(1.5) * mixture.factor[1])
    assert moved.share[1] < 0.02

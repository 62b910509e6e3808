"""Adaptive importance sampling: masses, moments and evidence of known densities, and what it does not trust."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from casadi_engine.posterior.importance import sample
from casadi_engine.posterior.mixture import Mixture


def test_two_modes_have_their_mass_and_evidence(normal, covariance):
    far = np.full(4, 12.0)

    def density(x):
        return (
            np.logaddexp(
                np.log(0.7) + normal(x, np.zeros(4), covariance),
                np.log(0.3) + normal(x, far, 0.5 * covariance),
            )
            + 3.0
        )

    start = Mixture.of(
        [0.5, 0.5], np.array([np.full(4, 0.5), far - 1]), np.array([2 * covariance, 0.3 * covariance])
    )
    found = sample(density, start, np.random.default_rng(0))
    assert found.trusted
    assert found.log_evidence == pytest.approx(3.0, abs=4 * found.error)
    assert found.error < 0.03
    right = found.x.sum(axis=1) > 24
    assert found.weight[right].sum() == pytest.approx(0.3, abs=0.02)
    left = found.weight[~right] / found.weight[~right].sum()
    np.testing.assert_allclose(
        np.cov(found.x[~right].T, aweights=left), covariance, atol=0.15 * np.diag(covariance).max()
    )
    chosen = found.x[found.resampled(2000, np.random.default_rng(1))]
    assert (chosen.sum(axis=1) > 24).mean() == pytest.approx(0.3, abs=0.03)


def test_a_curved_valley_of_many_dimensions_is_not_trusted():
    def density(x):  # a thin ring that a mixture of a few components does not cover
        radius = np.linalg.norm(x, axis=1)
        return -0.5 * ((radius - 10) / 0.01) ** 2

    start = Mixture.of([1.0], np.array([[10.0, 0, 0, 0]]), 1e-4 * np.eye(4)[None])
    assert not sample(density, start, np.random.default_rng(0)).trusted


def test_nothing_within_reach_is_no_evidence():
    found = sample(
        lambda x: np.full(len(x), -np.inf),
        Mixture.of([1.0], np.zeros((1, 2)), np.eye(2)[None]),
        np.random.default_rng(0),
    )
    assert not found.trusted
    assert found.log_evidence == -np.inf


def test_a_part_of_the_start_that_no_draw_has_met_is_kept():
    """A tail with 3 % of the mass, which one of nine parts of the start leads to: what is learnt may lose it, the start
    stays beside it."""

    def density(x):
        return np.logaddexp(
            np.log(0.97) + multivariate_normal(np.zeros(2)).logpdf(x),
            np.log(0.03) + multivariate_normal(np.full(2, 30.0), 9.0).logpdf(x),
        )

    centres = np.concatenate([np.zeros((8, 2)), np.full((1, 2), 30.0)])
    share = np.array([0.12] * 8 + [0.04])
    start = Mixture.of(
        share, centres, np.tile(np.eye(2), (9, 1, 1)) * np.array([1.0] * 8 + [16.0])[:, None, None]
    )
    for seed in range(10):
        found = sample(density, start, np.random.default_rng(seed))
        assert found.trusted
        assert found.weight[found.x[:, 0] > 15].sum() == pytest.approx(0.03, rel=0.35)

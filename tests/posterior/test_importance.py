"""Adaptive importance sampling: masses, moments and evidence of known densities, and what it does not trust."""

import numpy as np
import pytest

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

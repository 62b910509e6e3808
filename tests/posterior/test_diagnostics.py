"""R-hat and effective sample sizes, on chains of known correlation."""

import numpy as np
import pytest

from casadi_engine.posterior.diagnostics import bulk_size, effective_size, ranked, rhat, tail_size


def autoregressive(phi, shape, seed=0):
    noise = np.random.default_rng(seed).standard_normal(shape)
    chains = np.empty(shape)
    chains[:, 0] = noise[:, 0] / np.sqrt(1 - phi**2)
    for k in range(1, shape[1]):
        chains[:, k] = phi * chains[:, k - 1] + noise[:, k]
    return chains


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.9])
def test_the_effective_size_is_that_of_theory(phi):
    chains = autoregressive(phi, (4, 5000))
    assert effective_size(chains) == pytest.approx(20000 * (1 - phi) / (1 + phi), rel=0.15)
    assert bulk_size(chains) == pytest.approx(20000 * (1 - phi) / (1 + phi), rel=0.15)


def test_a_chain_that_alternates_is_worth_more_than_its_length():
    assert effective_size(autoregressive(-0.5, (4, 2000))) > 12000


def test_tails_are_counted_by_themselves():
    chains = autoregressive(0.0, (4, 2000))
    assert tail_size(chains) == pytest.approx(8000, rel=0.2)
    chains *= np.exp(1.5 * autoregressive(0.98, (4, 2000), seed=1) * np.sqrt(1 - 0.98**2))
    assert tail_size(chains) < 0.2 * bulk_size(chains)


def test_rhat_sees_location_spread_and_drift():
    chains = autoregressive(0.0, (6, 1000))
    assert rhat(chains) < 1.005
    assert rhat(chains + np.array([0, 0, 0, 0, 0, 1.0])[:, None]) > 1.05
    assert rhat(chains * np.array([1, 1, 1, 1, 1, 4.0])[:, None]) > 1.05
    assert rhat(chains + np.linspace(0, 2, 1000)) > 1.05
    assert rhat(np.ones((3, 50))) == 1.0


def test_heavy_tails_have_an_rhat_by_their_ranks():
    assert rhat(np.random.default_rng(0).standard_cauchy((8, 2000))) < 1.005


def test_ties_share_a_rank():
    scores = ranked(np.array([[1.0, 1.0, 2.0, 3.0]]))
    assert scores[0, 0] == scores[0, 1] < scores[0, 2] < scores[0, 3]

"""The evidence and the masses of modes against nested sampling."""

import numpy as np
import pytest

from casadi_engine.posterior.importance import sample
from casadi_engine.posterior.mixture import Mixture

dynesty = pytest.importorskip("dynesty", reason="the referee is not installed")
pytestmark = pytest.mark.slow


def nested(density, low, high):
    """Log evidence under a flat prior, its error, and draws that weigh alike."""
    width = high - low
    sampler = dynesty.NestedSampler(
        lambda x: float(density(x[None])[0]),
        lambda unit: low + unit * width,
        len(low),
        nlive=400,
        rstate=np.random.default_rng(0),
    )
    sampler.run_nested(dlogz=0.05, print_progress=False)
    found = sampler.results
    return (
        found.logz[-1] + np.log(width).sum(),
        found.logzerr[-1],
        found.samples_equal(rstate=np.random.default_rng(1)),
    )


def test_two_modes(normal, covariance):
    def density(x):
        return np.logaddexp(
            np.log(0.8) + normal(x, np.zeros(4), covariance),
            np.log(0.2) + normal(x, np.full(4, 15.0), covariance),
        )

    start = Mixture.of(
        [0.5, 0.5], np.array([np.zeros(4), np.full(4, 15.0)]), np.array([covariance, covariance])
    )
    found = sample(density, start, np.random.default_rng(0))
    log_evidence, error, draws = nested(density, np.full(4, -25.0), np.full(4, 40.0))
    assert found.log_evidence == pytest.approx(log_evidence, abs=0.2 + 3 * error)
    mass = found.weight[found.x.sum(axis=1) > 30].sum()
    assert mass == pytest.approx(0.2, abs=0.02)
    assert mass == pytest.approx((draws.sum(axis=1) > 30).mean(), abs=0.08)


def test_one_inertia(fit, post):
    from casadi_engine.posterior.target import Target

    target = Target(fit)
    spread = np.array([np.std(np.log(post["J_eng"])), np.std(post["C_eng"] / target.coordinates.scale[1])])
    low, high = target.start - 12 * spread, target.start + 12 * spread
    log_evidence, error, draws = nested(target.log_density, low, high)
    assert post.log_evidence == pytest.approx(log_evidence, abs=0.2 + 3 * error)
    values = target.values(draws)
    for k, name in enumerate(post.names):
        assert np.median(values[:, k]) == pytest.approx(np.median(post[name]), abs=0.15 * post[name].std())

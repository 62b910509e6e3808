"""Noise that is a share of what a sensor shows, in bands of what it will show."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation.share_noise import ShareNoise, share_noises
from casadi_engine.estimation.varied_noise import as_a_share

TIME = np.arange(200) * 0.1


@pytest.fixture(scope="module")
def tank():
    b = ce.Blueprint("tank")
    rate = b.parameter("k", 0.5, unit="1/s", min=0.01, max=20)
    gain = b.parameter("g", 1.5, unit="1", min=0.1, max=20)
    x, u = b.state("x", unit="1"), b.input("u", unit="1")
    b.ode("x", rate * (gain * u - x))
    b.output("y", x)
    return b.model()


def record(seed, *, scale=1.0, share=True):
    """By the closed form of every held step; with the outputs without noise."""
    rng = np.random.default_rng(seed)
    u, y = scale * np.repeat(rng.uniform(0.5, 6, 10), 20), [2.0]
    for one in u[:-1]:
        y.append(2 * one + (y[-1] - 2 * one) * np.exp(-0.08))
    y, e = np.array(y), rng.standard_normal(200)
    seen = y * (1 + 0.05 * e) if share else y + 0.2 * e
    return ce.Experiment.from_arrays(
        f"r{seed}", time=TIME, units={"u": "1", "y": "1"}, hold={"u": "zero"}, u=u, y=seen
    )


@pytest.mark.parametrize("share", [True, False])
def test_bands_hold_a_fresh_measurement_that_goes_farther(tank, share):
    """With one level for all they held 86 % of noise that is 5 % of what is shown."""
    inside, own = [], []
    for seed in range(8):
        fit = ce.estimate(tank, record(2 * seed, share=share), progress=False)
        fresh = record(2 * seed + 1, scale=1.5, share=share)
        ahead = ce.simulate(fit, fresh, band=True)
        band, seen = ahead["y"], fresh["y"].values
        inside.append(np.mean((band.low_noise <= seen) & (seen <= band.high_noise)))
        own.append(share_noises(fit))
        assert any("% of what it shows" in words for words in ahead.messages) is share
    assert 0.92 < np.mean(inside) < 0.98
    if share:
        assert np.mean([one["y"].share for one in own]) == pytest.approx(0.05, rel=0.1)
    else:
        assert own == [{}] * 8


def test_a_posteriors_band_is_as_wide(tank):
    fit = ce.estimate(tank, record(0), progress=False)
    ahead = ce.posterior(fit, progress=False).predictive(record(1, scale=1.5))
    low, high = ahead.band("y", noise=True)
    wide, shown = high - low, np.median(ahead.runs["y"], axis=0)
    assert np.corrcoef(wide, shown)[0, 1] > 0.98
    assert np.mean((low <= ahead.measured["y"]) & (ahead.measured["y"] <= high)) > 0.9


def test_a_stated_level_is_kept(tank):
    fit = ce.estimate(tank, record(0), noise=ce.Noise(y=0.3), progress=False)
    assert share_noises(fit) == {}


def test_an_instrument_has_a_least_error():
    np.testing.assert_allclose(ShareNoise(0.05, 2.0).at(np.array([-10.0, 0.0, 4.0])), [0.5, 0.1, 0.2])


@pytest.mark.parametrize(("heavy", "most"), [(False, 0.01), (True, 0.02)])
def test_noise_of_one_size_is_hardly_ever_told_to_be_a_share(heavy, most):
    """Worst where the output varies by a tenth; with heavy tails it was so in 6 % of records."""
    shown = 10 * (1 + 0.12 * np.sqrt(2) * np.sin(0.1 * np.arange(200)))
    told = 0
    for seed in range(1000):
        rng = np.random.default_rng(seed)
        noise = rng.standard_t(5, 200) if heavy else rng.standard_normal(200)
        told += as_a_share(noise, shown) > np.log(20.0)
    assert told <= most * 1000

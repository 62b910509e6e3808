"""A constraint between parameters that the fit rests on: the posterior is a normal density cut off there."""

import numpy as np
import pytest
from scipy.stats import norm

import casadi_engine as ce

SIGMA = 0.5


def line():
    b = ce.Blueprint("line")
    p, q = b.parameter("p", 1.0, min=-50, max=50), b.parameter("q", 1.0, min=-50, max=50)
    clock = b.state("clock")
    b.ode("clock", 1.0)
    b.output("y", p + q * clock)
    return b.model()


@pytest.mark.parametrize("beyond", [1.0, -1.0])
def test_the_sum_of_two_is_cut_off(beyond):
    """The data have it ``beyond`` standard errors above the most that it may be."""
    time = np.arange(20) / 10
    y = 1 + 0.5 * time + SIGMA * np.random.default_rng(0).standard_normal(20)
    record = ce.Experiment.from_arrays("r", time=time, units={"y": "1"}, y=y)
    slopes = np.stack([np.ones(20), time], axis=1)
    covariance = SIGMA**2 * np.linalg.inv(slopes.T @ slopes)
    middle = float((covariance @ slopes.T @ y / SIGMA**2).sum())
    error = float(np.sqrt(covariance.sum()))
    model = line()
    pars = model.parameters()
    pars.constrain("p + q", max=middle - beyond * error)
    fit = ce.estimate(
        model, record, parameters=pars, noise=ce.Noise(y=SIGMA), initial={"clock": 0.0}, progress=False
    )
    assert fit.values["p"] + fit.values["q"] == pytest.approx(middle - max(beyond, 0.0) * error, abs=1e-6)
    draws = ce.posterior(fit, seed=1).draws
    total = (np.asarray(draws["p"]) + np.asarray(draws["q"]) - middle) / error
    assert total.max() <= -beyond + 1e-4
    wanted = -norm.pdf(-beyond) / norm.cdf(-beyond)
    assert total.mean() == pytest.approx(wanted, abs=0.12)


def test_intervals_beside_it_count_with_all_that_it_leaves():
    """What the fit rests on may be inside by as much as the data tell: each interval is as wide as half a free one."""
    time = np.arange(20) / 10
    y = 1 + 0.5 * time + SIGMA * np.random.default_rng(0).standard_normal(20)
    record = ce.Experiment.from_arrays("r", time=time, units={"y": "1"}, y=y)
    known = {"noise": ce.Noise(y=SIGMA), "initial": {"clock": 0.0}, "progress": False}
    free = ce.estimate(line(), record, **known)
    pars = line().parameters()
    pars.constrain("p + q", max=free.values["p"] + free.values["q"] - 0.05)
    fit = ce.estimate(line(), record, parameters=pars, **known)
    for name in ("p", "q"):
        one = fit.estimates[name]
        half = 1.96 * (one.stderr or 0.0)
        low, high = one.interval or (one.value - half, one.value + half)
        assert high - low > 1.96 * free.stderr[name]
        assert low < free.values[name] < high

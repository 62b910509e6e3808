"""Intervals by a few refits of the problem that a fit has set up, against the profiles that are drawn in full."""

from dataclasses import replace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.identifiability import profile


def run_up(n=25, sigma=0.6, seed=4):
    """Few noisy samples of a run-up from rest."""
    time = 0.08 * np.arange(n)
    y = 4 * (1 - np.exp(-time / 0.8)) + sigma * np.random.default_rng(seed).standard_normal(n)
    units = {"T": "N m", "omega": "rad/s"}
    return ce.Experiment.from_arrays(
        "run_up", time=time, units=units, hold="zero", T=np.full(n, 2.0), omega=y
    )


def parameters():
    pars = ce.one_inertia().parameters()
    pars["J_eng"].set(0.5, min=1e-3, max=1e3)
    pars["C_eng"].set(0.5, min=1e-3, max=1e3)
    return pars


@pytest.mark.parametrize("noise", [ce.Noise(omega=0.6), ce.Noise()])
def test_ends_are_those_of_the_whole_profile(noise):
    """With an estimated noise level by the F quantile, as there."""
    fit = ce.estimate(
        ce.one_inertia(), run_up(), parameters=parameters(), noise=noise, initial={"omega_eng": 0.0},
        progress=False,
    )  # fmt: skip
    shown = [name for name in fit.free if fit.estimates[name].interval]
    assert shown
    for name in shown:
        low, high = profile(fit, name, points=4).intervals[name]
        assert fit.estimates[name].interval == pytest.approx((low, high), rel=0.01)


def test_a_tied_parameter_has_the_interval_of_the_one_it_follows():
    pars = parameters()
    pars.add("half", 0.25, unit="kg m2")
    pars.tie("J_eng", "2*half")
    pars["half"].set(0.25, min=1e-3, max=1e3)
    fit = ce.estimate(
        ce.one_inertia(), run_up(), parameters=pars, noise=ce.Noise(omega=0.6), initial={"omega_eng": 0.0},
        progress=False,
    )  # fmt: skip
    low, high = fit.estimates["half"].interval
    assert fit.estimates["J_eng"].interval == pytest.approx((2 * low, 2 * high), rel=1e-9)
    assert fit.estimates["J_eng"].quadratic == pytest.approx(2 * fit.estimates["half"].quadratic)


def test_where_intervals_take_long_none_is_made_and_the_posterior_is_named():
    fit = ce.estimate(
        ce.one_inertia(), run_up(), parameters=parameters(), noise=ce.Noise(omega=0.6),
        initial={"omega_eng": 0.0}, progress=False, errors=0.0,
    )  # fmt: skip
    assert fit.doubted
    assert all(fit.estimates[name].why == "not symmetric (see note)" for name in fit.doubted)
    assert fit.messages[0].endswith(
        f"; for {', '.join(fit.doubted)} call ce.profile(fit), or ce.posterior(fit)"
    )


def test_progress_shows_the_search_and_not_the_refits():
    seen = []
    fit = ce.estimate(
        ce.one_inertia(), run_up(), parameters=parameters(), noise=ce.Noise(omega=0.6),
        initial={"omega_eng": 0.0}, progress=lambda *told: seen.append(told[0]), starts=2,
    )  # fmt: skip
    assert any(one.interval for one in fit.estimates.values())
    assert seen.count(0) == 2


@pytest.mark.parametrize(
    ("ends", "words"),
    [
        ((1e-3, 2.0), " (open to its lower bound)"),
        ((0.1, 1e3), " (open to its upper bound)"),
        ((1e-3, 1e3), " (open to its lower and its upper bound)"),
        ((0.1, 2.0), ""),
    ],
)
def test_an_end_that_is_a_bound_says_so(ends, words):
    fit = ce.estimate(
        ce.one_inertia(), run_up(), parameters=parameters(), noise=ce.Noise(omega=0.6),
        initial={"omega_eng": 0.0}, progress=False,
    )  # fmt: skip
    own = replace(fit.estimates["J_eng"], interval=ends, stderr=None)
    text = str(replace(fit, estimates={**fit.estimates, "J_eng": own}))
    (line,) = (line for line in text.splitlines() if line.startswith("  J_eng"))
    assert ("open to" in line) == bool(words)
    assert words in line

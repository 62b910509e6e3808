"""What a fit says of itself: acting constraints, ends that are no optimum, coloured residuals, Ctrl-C."""

import os
import re
import signal
import threading

import numpy as np
import pytest

import casadi_engine as ce


def run_up(samples=300, sigma=0.02, colour=0.0, seed=3):
    t = np.arange(samples) * 0.01
    noise = np.random.default_rng(seed).standard_normal(samples) * sigma
    for k in range(1, samples):
        noise[k] += colour * noise[k - 1]
    omega = 4 * (1 - np.exp(-t / 0.8)) + noise
    units = {"T": "N m", "omega": "rad/s"}
    return ce.Experiment.from_arrays(
        "run_up", time=t, units=units, hold="zero", T=np.full(samples, 2.0), omega=omega
    )


def said(fit, words):
    return any(words in message for message in fit.messages)


@pytest.fixture
def model():
    return ce.one_inertia()


def test_a_constraint_that_holds_the_fit_is_named_with_its_limit(model):
    pars = model.parameters()
    pars.constrain("J_eng + C_eng", 1.2, 1.5)  # the truth is 0.9
    fit = ce.estimate(model, run_up(), parameters=pars)
    assert fit.converged
    assert fit.values["J_eng"] + fit.values["C_eng"] == pytest.approx(1.2, abs=1e-6)
    assert said(fit, "held by constraints: J_eng + C_eng at its lower limit 1.2")
    assert "held by constraints" in str(fit)


def test_a_constraint_that_is_met_with_room_is_not_mentioned(model):
    pars = model.parameters()
    pars.constrain("J_eng + C_eng", 0.1, 1.5)
    assert not said(ce.estimate(model, run_up(), parameters=pars), "held by constraints")


def test_where_the_search_ran_out_there_are_no_standard_errors(model):
    pars = model.parameters()
    pars["J_eng"].set(5.0)
    fit = ce.estimate(model, run_up(), parameters=pars, max_iterations=1)
    assert fit.status.startswith("not converged")
    assert fit.stderr["J_eng"] is None
    assert fit.estimates["J_eng"].why == "the search did not end at an optimum"
    assert np.isnan(fit.covariance).all()
    assert said(fit, "this is not an optimum")


def test_a_coloured_residual_is_said_to_make_the_errors_larger(model):
    words = "the standard errors count with that"
    assert said(ce.estimate(model, run_up(colour=0.9)), words)
    assert not said(ce.estimate(model, run_up()), words)
    curvature = ce.estimate(model, run_up(colour=0.9), errors="quadratic")
    assert said(curvature, "the standard errors are too small")


@pytest.mark.skipif(
    threading.current_thread() is not threading.main_thread(), reason="signals need the main thread"
)
def test_ctrl_c_ends_the_fit_and_is_told(model):
    """A real signal: nothing is raised inside CasADi, the fit comes back as interrupted, the handler is put back."""
    before = signal.getsignal(signal.SIGINT)

    def press(iteration, *_):
        if iteration == 0:  # a second one would raise
            os.kill(os.getpid(), signal.SIGINT)

    fit = ce.estimate(model, run_up(), progress=press)
    assert fit.status == "interrupted"
    assert said(fit, "stopped by the user")
    assert signal.getsignal(signal.SIGINT) is before


def test_a_stated_level_that_the_residual_cannot_have_is_named(model):
    record = run_up(sigma=0.2)
    right = ce.estimate(model, record, noise=ce.Noise(omega=0.2), progress=False)
    assert not said(right, "times the stated noise level")
    small = ce.estimate(model, record, noise=ce.Noise(omega=0.2 * np.pi / 30), progress=False)
    assert said(small, "times the stated noise level of 0.0209: the level (its unit?) or the model is wrong")
    estimated = ce.estimate(model, record, progress=False)
    assert not said(estimated, "times the stated noise level")


def test_a_slope_that_is_an_underflow_is_no_size():
    """exp(-100 h) says nothing of a rate: the fit ends, at the truth or with a word, and does not crash."""
    b = ce.Blueprint("decay", time_unit="h")
    k, x = b.parameter("k", 100.0, unit="1/h", min=0, max=1e9), b.state("x")
    b.ode("x", -k * x)
    b.output("c", x)
    t = np.array([0, 1, 2, 3, 4.0, 6])
    data = ce.Experiment.from_arrays("a", units={"time": "h", "c": "1"}, time=t, c=5 * np.exp(-0.7 * t))
    fit = ce.estimate(b.model(), data, noise=ce.Noise(c=0.01), progress=False)
    assert not fit.converged or abs(fit.values["k"] - 0.7) < 3 * fit.stderr["k"]


@pytest.mark.parametrize("level", [1e-300, 1e300])
def test_a_level_that_is_no_noise_of_the_samples_is_refused(model, level):
    """1e-300 blamed the start values, 1e300 ended in an OverflowError."""
    with pytest.raises(
        ce.errors.EstimationError,
        match=rf"the noise level of omega cannot be that of its samples; seen: {re.escape(f'{level:g}')}, where",
    ):
        ce.estimate(model, run_up(), noise=ce.Noise(omega=level), progress=False)


def test_more_lags_than_a_record_has_are_refused(model):
    """1000 lags of 100 samples were PASSED, with no test of whiteness made."""
    fit = ce.estimate(model, run_up(), progress=False)
    fresh = run_up()
    count = int(fresh["omega"].mask.sum())
    allowed = (
        rf"run_up/omega has too few samples .* seen: lags={count}, {count} valid .*: 1 to {(count - 5) // 2},"
    )
    with pytest.raises(ce.errors.ExperimentError, match=allowed):
        ce.validate(fit, fresh, lags=count)
    assert ce.validate(fit, fresh, lags=(count - 5) // 2)
    with pytest.raises(ce.errors.ExperimentError, match="the number of lags does not fit; seen: many"):
        ce.validate(fit, fresh, lags="many")


def test_no_fresh_data_are_refused(model):
    fit = ce.estimate(model, run_up(), progress=False)
    with pytest.raises(
        ce.errors.EstimationError, match="there are no fresh data to judge; seen: an empty sequence"
    ):
        ce.validate(fit, [])


@pytest.mark.parametrize("data", ["r.csv", ["r.csv"], np.zeros(3), 3])
def test_data_that_are_no_experiment_are_named(model, data):
    """They were bare errors of Python: 'str' object has no attribute 'name'."""
    fit = ce.estimate(model, run_up(), progress=False)
    with pytest.raises(
        ce.errors.ExperimentError, match=r"the data are no experiment; seen: (str|int|float64)"
    ):
        ce.validate(fit, data)

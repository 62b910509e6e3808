"""Degrees of freedom of noise levels that are estimated from samples of unlike number."""

import numpy as np
import pytest
from scipy.stats import t as student

import casadi_engine as ce
from casadi_engine.errors import PosteriorError
from casadi_engine.estimation import few_samples


def two_means(many, few, *, known=False, seed=0):
    """Two levels without anything in common, each measured by an output of its own."""
    b = ce.Blueprint("levels")
    one, two = (b.parameter(name, 1.0, unit="V", min=-10, max=10) for name in ("one", "two"))
    x = b.state("x", unit="1")
    b.ode("x", -1e-9 * x)
    b.output("first", one * x, unit="V")
    b.output("second", two * x, unit="V")
    random = np.random.default_rng(seed)
    t = np.arange(float(many))
    data = ce.Experiment.from_arrays(
        "run", units={"first": "V", "second": "V"}, first=(t, 2 + 0.1 * random.standard_normal(many)),
        second=(t[:few], 3 + 0.1 * random.standard_normal(few)),
    )  # fmt: skip
    noise = ce.Noise(second=0.1) if known else None
    return ce.estimate(b.model(), data, initial={"x": 1.0}, noise=noise, progress=False)


def said(fit):
    return [words for words in fit.messages if words.startswith("few samples")]


def test_a_parameter_that_hangs_on_few_samples_has_the_freedom_of_these():
    (words,) = said(two_means(200, 6))
    assert "from 5 degrees of freedom" in words
    assert f"goes {student.ppf(0.975, 5):.2g} standard errors" in words


def test_a_known_level_and_many_samples_are_known_well():
    assert said(two_means(200, 6, known=True)) == []
    assert said(two_means(200, 150)) == []


def test_a_level_has_no_fewer_degrees_than_its_own_samples_leave(monkeypatch):
    """Where parameters are all but exchangeable the parts of an error do not add up: a culture had 8e-11 degrees of
    freedom, and an interval of 6e148 standard errors."""
    grams = few_samples.grams_of
    monkeypatch.setattr(few_samples, "grams_of", lambda *args: [1e6 * gram for gram in grams(*args)])
    (words,) = said(two_means(200, 6))
    assert "from 1 degrees of freedom" in words


def test_one_level_has_all_samples():
    (words,) = said(two_means(6, 6))
    assert "from 5 degrees of freedom" in words


@pytest.mark.slow
def test_intervals_of_students_t_cover():
    inside = 0
    for seed in range(200):
        one = two_means(200, 6, seed=seed).estimates["two"]
        inside += abs(one.value - 3) < student.ppf(0.975, 5) * one.stderr
    assert 180 <= inside <= 198


def test_a_level_that_parameters_leave_no_sample_for_is_not_known():
    """Two samples of an output with a gain and an offset of its own: the fit goes through them."""
    b = ce.Blueprint("decay")
    k, s = b.parameter("k", 0.5, unit="1/s", min=0.01, max=10), b.parameter("s", 1.5, min=-100, max=100)
    o, x = b.parameter("o", 0.5, min=-100, max=100), b.state("x")
    b.ode("x", -k * x)
    b.output("y1", x)
    b.output("y2", s * x + o)
    time = np.linspace(0, 5, 60)
    rng, true = np.random.default_rng(0), 3 * np.exp(-0.6 * time)
    few = np.where(np.isin(np.arange(60), (5, 20, 45)), 2 * true + 1 + 0.1 * rng.standard_normal(60), np.nan)
    data = ce.Experiment.from_arrays(
        "r", time=time, units={"y1": "1", "y2": "1"}, y1=true + 0.05 * rng.standard_normal(60), y2=few
    )
    fit = ce.estimate(b.model(), data, progress=False)
    assert fit.converged
    assert set(fit.stderr.values()) == {None}
    assert any(
        words.startswith("the noise level of y2 is not known, and so no error") for words in fit.messages
    )
    assert "Next: state the noise level that is not known" in str(fit)
    with pytest.raises(PosteriorError, match="not told by the samples that are left"):
        ce.posterior(fit)
    known = ce.estimate(b.model(), data, noise=ce.Noise(y1="estimate", y2=0.1), progress=False)
    assert abs(known.values["o"] - 1) < 4 * known.stderr["o"]

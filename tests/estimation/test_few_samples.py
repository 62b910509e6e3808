"""Degrees of freedom of noise levels that are estimated from samples of unlike number."""

import numpy as np
import pytest
from scipy.stats import t as student

import casadi_engine as ce


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

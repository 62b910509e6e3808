"""A mode above half the sampling rate is told by its alias: the fit says so."""

from dataclasses import replace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation.aliased import aliased


def swinging(hertz, step=0.1, samples=200):
    """An undamped oscillator of this frequency, in closed form."""
    t = np.arange(samples) * step
    y = np.cos(2 * np.pi * hertz * t) + 0.01 * np.random.default_rng(1).standard_normal(samples)
    return ce.Experiment.from_arrays("swing", time=t, units={"y": "m"}, y=y)


def fitted(data, start):
    b = ce.Blueprint("oscillator")
    w = b.parameter("w", start, unit="rad/s", min=0.1, max=200)
    x, v = b.state("x", unit="m"), b.state("v", unit="m/s")
    b.ode("x", v)
    b.ode("v", -(w**2) * x)
    b.output("y", x, unit="m")
    return ce.estimate(b.model(), data, noise=ce.Noise(y=0.01), initial={"x": 1.0, "v": 0.0}, progress=False)


def test_a_value_at_an_alias_comes_with_a_word():
    """A bulk modulus was 4.2e9 +- 3e7, where 1.2e9 had the same samples."""
    fit = fitted(swinging(3.0), 2 * np.pi * 7.0)  # 10 Hz less 3 Hz
    assert fit.values["w"] == pytest.approx(2 * np.pi * 7.0, rel=1e-2)
    assert aliased(fit) == ()  # the other one was found, and its error is not told
    one = fit.estimates["w"]
    (words,) = aliased(replace(fit, estimates={"w": replace(one, stderr=one.quadratic)}))
    assert words.startswith(
        "a mode at 7 Hz, which w sets, is faster than half the sampling rate of every output, 5 Hz"
    )
    assert "samples show it at 3 Hz" in words


def test_a_mode_that_the_samples_show_has_none():
    fit = fitted(swinging(3.0), 2 * np.pi * 3.0)
    assert fit.converged
    assert aliased(fit) == ()


def test_a_fast_mode_that_no_parameter_sets_has_none():
    """A stiff link that is known, or an error so large that no mode tells the parameter."""
    t = np.arange(200) * 0.1
    b = ce.Blueprint("link")
    c = b.parameter("c", 1.0, unit="1/s", min=0.01, max=50)
    x, v, z = b.state("x", unit="m"), b.state("v", unit="m/s"), b.state("z", unit="m")
    b.ode("x", v)
    b.ode("v", -(40.0**2) * x)
    b.ode("z", -c * z)
    b.output("y", z, unit="m")
    y = np.exp(-0.7 * t) + 0.01 * np.random.default_rng(1).standard_normal(200)
    data = ce.Experiment.from_arrays("run", time=t, units={"y": "m"}, y=y)
    fit = ce.estimate(
        b.model(), data, noise=ce.Noise(y=0.01), initial={"x": 0.0, "v": 0.0, "z": 1.0}, progress=False
    )
    assert aliased(fit) == ()

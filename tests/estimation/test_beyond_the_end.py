"""Steps that fill up the last interval of a record are no part of it: a model may have no value there."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce


def rocket():
    b = ce.Blueprint("rocket")
    flow = b.parameter("mf", 0.6, unit="kg/s", min=0.01, max=5)
    speed = b.parameter("ve", 800.0, unit="m/s", min=100, max=5000)
    drag = b.parameter("k", 0.01, unit="kg/m", min=0, max=1)
    height, v = b.state("h", unit="m", scale=1000), b.state("v", unit="m/s", scale=100)
    lost = b.state("lost", unit="kg")
    mass = 15.0 - lost
    b.ode("h", v)
    b.ode("lost", flow + ca.SX(0))
    b.ode("v", speed * flow / mass - 9.81 - drag * v**2 / mass)
    b.output("h", height, unit="m")
    return b.model()


@pytest.mark.parametrize("samples", [49, 45, pytest.param(50, marks=pytest.mark.slow)])
def test_a_rocket_is_known_though_its_mass_is_gone_soon_after(samples):
    """Of 48 cells the fourth interval of sixteen begins with the last sample; 0.9 of 15 kg are lost each second, for 12
    s of the record and for 16 of the intervals."""
    t = np.linspace(0, 12, samples)

    def rate(s, x):
        mass = 15 - 0.9 * s
        return [x[1], 1000 * 0.9 / mass - 9.81 - 0.012 * x[1] ** 2 / mass]

    run = solve_ivp(rate, (0, 12), [0.0, 0.0], t_eval=t, rtol=1e-10, atol=1e-10)
    noisy = run.y[0] + 2 * np.random.default_rng(2).standard_normal(samples)
    data = ce.Experiment.from_arrays("flight", time=t, units={"h": "m"}, h=noisy)
    fit = ce.estimate(rocket(), data, initial={"h": 0.0, "v": 0.0, "lost": 0.0}, progress=False)
    assert fit.converged
    assert not any("no value" in words for words in fit.messages)
    for name, truth in {"mf": 0.9, "ve": 1000.0, "k": 0.012}.items():
        one = fit.estimates[name]
        low, high = one.interval or (one.value - 3 * one.stderr, one.value + 3 * one.stderr)
        assert low - 0.3 * (high - low) < truth < high + 0.3 * (high - low)

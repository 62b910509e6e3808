"""A magnet holds a ball in the air by a controller, and its current is recorded: the model alone falls over at once."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.estimation.short_intervals import short_enough

K, DAMPER, GAP, MASS, GRAVITY, STEP, SIGMA = 3e-5, 0.2, 1.5e-3, 0.05, 9.81, 0.005, 1e-4


def bearing():
    b = ce.Blueprint("magnet")
    k = b.parameter("k", 4.3e-5, unit="N m2/A2", min=1e-7, max=1e-2)
    d = b.parameter("d", 0.28, unit="N s/m", min=0, max=10)
    gap = b.parameter("gap", 1.3e-3, unit="m", min=0, max=0.01)
    current = b.input("i", unit="A")
    x, v = b.state("x", unit="m", scale=0.01), b.state("v", unit="m/s", scale=0.1)
    b.ode("x", v)
    b.ode("v", GRAVITY - (k * (current / (x + gap)) ** 2 + d * v) / MASS)
    b.output("place", x, unit="m", scale=0.01)
    return b.model()


@pytest.fixture(scope="module")
def record():
    """200 samples of SciPy's, the controller reads the place with its noise."""
    rng, x = np.random.default_rng(3), np.array([0.01, 0.0])
    time, place, currents = np.arange(200) * STEP, [], []
    for t in time:
        wanted = 0.01 + 0.002 * np.sign(np.sin(2 * np.pi * 1.3 * t))
        held = np.sqrt(MASS * GRAVITY / K) * (wanted + GAP)
        current = held + 300 * (x[0] - wanted) + 6 * x[1]
        place.append(x[0] + SIGMA * rng.standard_normal())
        currents.append(current)

        def rates(_, s, current=current):
            return [s[1], GRAVITY - (K * (current / (s[0] + GAP)) ** 2 + DAMPER * s[1]) / MASS]

        x = solve_ivp(rates, (0, STEP), x, rtol=1e-9, atol=1e-12).y[:, -1]
    units = {"i": "A", "place": "m"}
    return ce.Experiment.from_arrays(
        "held", time=time, hold="zero", units=units, i=np.array(currents), place=np.array(place)
    )


def test_it_is_fitted_from_values_with_which_it_hits_the_magnet(record):
    fit = ce.estimate(bearing(), record, progress=False)
    assert fit.converged
    for name, true in (("k", K), ("d", DAMPER), ("gap", GAP)):
        assert abs(fit.values[name] - true) < 3.5 * fit.stderr[name] < true


def test_an_interval_that_was_asked_for_is_kept():
    search, arguments = object(), {"interval": 40}
    assert short_enough(search, arguments, None) == (search, arguments)

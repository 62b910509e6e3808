"""First states that rest where the equations cease to have a value: a level under a root."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce

TIME = np.linspace(0, 20, 101)
FLOW = 0.1 + 0.08 * np.sin(TIME)


def tank():
    b = ce.Blueprint("tank")
    outlet = b.parameter("a", 0.2, unit="1/s", min=0.01, max=2)
    level = b.state("x", unit="m")
    b.ode("x", b.input("q", unit="m/s") - outlet * ca.sqrt(level))
    b.output("y", level, unit="m")
    return b.model()


def fitted(offset):
    """The level as a sensor shows it that is off by so much [m]: from what it shows first, the level is below empty."""
    level = solve_ivp(
        lambda t, x: [np.interp(t, TIME, FLOW) - 0.3 * np.sqrt(max(x[0], 0.0))], (0, 20), [0.05], t_eval=TIME,
        rtol=1e-9, max_step=0.05,
    ).y[0]  # fmt: skip
    noise = 0.01 * np.random.default_rng(0).standard_normal(len(TIME))
    data = ce.Experiment.from_arrays(
        "r", time=TIME, units={"q": "m/s", "y": "m"}, q=FLOW, y=level + offset + noise
    )
    return ce.estimate(tank(), data, noise=ce.Noise(y=0.01), progress=False)


@pytest.mark.parametrize("offset", [-0.1, -0.06])
def test_the_search_goes_on_along_the_edge_and_says_so(offset):
    fit = fitted(offset)
    first = fit.initial["r"]["x"]
    assert fit.converged
    assert 0 < first.value < 1e-3
    assert first.at_bound == "min"
    assert any(
        text.startswith("x of r: the first value rests where the equations cease") for text in fit.messages
    )


def test_nothing_is_said_of_an_edge_that_is_not_met():
    fit = fitted(0.0)
    assert fit.converged
    assert fit.values["a"] == pytest.approx(0.3, rel=0.05)
    assert not any("cease to have one" in text for text in fit.messages)

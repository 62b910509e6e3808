"""Which integrator a simulation takes, and how far off it says it is."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_engine.errors import SimulationError
from casadi_engine.experiment import Experiment
from casadi_engine.model import Blueprint
from casadi_engine.simulation.grid import lay_grid
from casadi_engine.simulation.values import simulated

EQUAL = np.linspace(0, 2, 41)
UNEQUAL = 2 * (np.arange(41) / 40) ** 1.7


def run(rate, time, start=1.0, *, shown=lambda x, u: x, hold="first", u=None, **options):
    b = Blueprint("small")
    k, x, channel = b.parameter("k", 0.7), b.state("x", scale=2.0), b.input("u")
    b.ode("x", rate(x, channel, b.time, k))
    b.output("y", shown(x, channel))
    model = b.model()
    data = Experiment.from_arrays(
        "r", time=time, units={"u": "1", "y": "1"}, hold={"u": hold}, u=np.zeros(len(time)) if u is None else u,
        y=np.zeros(len(time)),
    )  # fmt: skip
    return simulated(model, lay_grid(model, data), np.array([0.7]), np.array([start]), **options)


def test_a_linear_model_on_equal_steps_is_exact():
    found = run(lambda x, u, t, k: u - k * x, EQUAL)
    np.testing.assert_allclose(found.outputs[0], np.exp(-0.7 * EQUAL), rtol=1e-13)
    assert found.integration.integrator == "exact"
    assert found.integration.largest == 0


@pytest.mark.parametrize("hold", ["first", "zero"])
def test_any_times_within_the_tolerance(hold):
    """A ramp, or stairs, in front of a lag, at unequal times."""
    u = np.arange(41) / 40.0
    found = run(lambda x, u, t, k: u - k * x, UNEQUAL, u=u, hold=hold, tolerance=1e-9)
    x, true = 1.0, [1.0]
    for h, low, high in zip(np.diff(UNEQUAL), u[:-1], u[1:], strict=True):
        rise = (high - low) / h if hold == "first" else 0.0
        # the settled answer to low + rise s is low / k + rise (s - 1 / k) / k
        begin, end = low / 0.7 - rise / 0.49, low / 0.7 + rise * (h - 1 / 0.7) / 0.7
        x = end + (x - begin) * np.exp(-0.7 * h)
        true.append(x)
    np.testing.assert_allclose(found.outputs[0], true, rtol=0, atol=1e-9)
    assert found.integration.integrator.startswith("explicit steps of order 8")


def test_a_nonlinear_model_on_equal_steps_says_its_steps():
    found = run(lambda x, u, t, k: -k * x**2, EQUAL)
    np.testing.assert_allclose(found.outputs[0], 1 / (1 + 0.7 * EQUAL), rtol=1e-6)
    assert found.integration.largest < 1e-6
    assert found.integration.steps >= 40


def test_outputs_that_jump_are_shown_as_they_are():
    found = run(lambda x, u, t, k: -k * x, UNEQUAL, shown=lambda x, u: ca.if_else(x > 0.5, 1.0, 0.0))
    np.testing.assert_array_equal(found.outputs[0], (np.exp(-0.7 * UNEQUAL) > 0.5).astype(float))


@pytest.mark.parametrize("time", [EQUAL, UNEQUAL], ids=["equal", "unequal"])
def test_an_output_that_is_no_number_names_its_time(time):
    with pytest.raises(SimulationError) as refused:
        run(lambda x, u, t, k: -ca.sign(x) * k, time, shown=lambda x, u: ca.log(x - 0.31))
    first = time[time >= 0.986][0]  # x = 1 - 0.7 t passes 0.31 at 0.986 s
    assert f"the simulation is not finite; seen: at {first:.6g} s, with k=0.7" in str(refused.value)
    assert "a root or logarithm of a negative number" in str(refused.value)


def test_a_root_that_ends_names_its_time():
    """A tank that leaks through a root and a hole: empty at 2/k - 2 c/k² ln(1 + k/c)."""
    empty = 2 / 0.7 - 2e-3 / 0.49 * np.log(1 + 700)
    with pytest.raises(SimulationError, match=rf"not finite; seen: at {empty:.5g} s, with k=0\.7"):
        run(lambda x, u, t, k: -k * ca.sqrt(x) - 1e-3, np.linspace(0, 4, 21))


def test_euler_stays_what_it_is():
    found = run(lambda x, u, t, k: -k * x, EQUAL, method="euler")
    np.testing.assert_allclose(found.outputs[0], (1 - 0.7 * 0.05) ** np.arange(41), rtol=1e-12)

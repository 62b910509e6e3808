"""Many steps in one call: the states of SciPy's integrator, and step by step wherever the tolerance asks for it."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.simulation.adaptive import Adaptive
from casadi_engine.simulation.swept_steps import FEWEST

RNG = np.random.default_rng(0)


def model(width):
    """A pendulum with friction that is rounded over a speed."""
    b = ce.Blueprint("pendulum")
    friction, torque = b.parameter("f", 0.5), b.input("u")
    x, w = b.state("x"), b.state("w")
    b.ode("x", w)
    b.ode("w", torque - 30 * ca.sin(x) - friction * ca.tanh(w / width))
    b.output("y", x)
    return b.model()


def scipy_run(time, u, hold, width):
    found = [np.array([1.5, 0.0])]
    for k in range(len(time) - 1):
        rise = (u[k + 1] - u[k]) / (time[k + 1] - time[k]) if hold == "first" else 0.0

        def rate(t, x, k=k, rise=rise):
            torque = u[k] + rise * (t - time[k])
            return [x[1], torque - 30 * np.sin(x[0]) - 0.5 * np.tanh(x[1] / width)]

        found.append(
            solve_ivp(rate, time[k : k + 2], found[-1], rtol=1e-10, atol=1e-12, method="DOP853").y[:, -1]
        )
    return np.array(found)[:, 0]


def record(time, u, hold):
    units = {"u": "1", "y": "1"}
    return ce.Experiment.from_arrays(
        "r", time=time, units=units, u=u, y=np.full(len(time), np.nan), hold=hold
    )


@pytest.fixture
def pieces(monkeypatch):
    """How many pieces between samples were integrated step by step."""
    plain, taken = Adaptive._piece, []

    def counted(self, *arguments):
        taken.append(arguments[1])
        return plain(self, *arguments)

    monkeypatch.setattr(Adaptive, "_piece", counted)
    return taken


@pytest.mark.parametrize("hold", ["zero", "first"])
@pytest.mark.parametrize("width", [1.0, 0.01])
@pytest.mark.parametrize("even", [True, False])
def test_states_are_those_of_scipy(pieces, hold, width, even):
    steps = np.full(299, 0.02) if even else RNG.uniform(0.002, 0.05, 299)
    time = np.concatenate([[0.0], np.cumsum(steps)])
    u = np.repeat(RNG.standard_normal(60), 5)
    run = ce.simulate(model(width), record(time, u, hold), initial={"x": 1.5, "w": 0.0})
    assert np.abs(run["y"].values - scipy_run(time, u, hold, width)).max() < 2e-7
    few = len(pieces) / (2 * 299)  # it is simulated twice, for its error
    assert few < 0.1 if width == 1.0 else 0.02 < few < 0.9  # a sharp corner is passed step by step


def test_a_short_record_is_integrated_step_by_step(pieces):
    time = 0.02 * np.arange(FEWEST)
    run = ce.simulate(model(1.0), record(time, np.zeros(FEWEST), "zero"), initial={"x": 1.5, "w": 0.0})
    assert len(pieces) >= FEWEST - 1
    assert np.isfinite(run["y"].values).all()


def test_a_state_that_grows_beyond_all_numbers_is_refused():
    b = ce.Blueprint("blow_up")
    x, torque = b.state("x"), b.input("u")
    b.ode("x", x**2 + torque)
    b.output("y", x)
    time = 0.01 * np.arange(300)
    with pytest.raises(ce.errors.SimulationError):
        ce.simulate(b.model(), record(time, np.zeros(300), "zero"), initial={"x": 1.0})

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


def dry_friction():
    b = ce.Blueprint("slide")
    torque = b.input("u")
    x, w = b.state("x"), b.state("w")
    b.ode("x", w)
    b.ode("w", torque - 0.5 * w - 0.3 * ca.sign(w))
    b.output("y", x)
    return b.model()


def event_by_event(time, u, hold):
    """Positions of the same, by SciPy, with an event at each stop."""

    def stops(t, x, *_):
        return x[1]

    stops.terminal = True
    x, found = np.array([0.0, 0.4]), [0.0]
    for k in range(len(time) - 1):
        rise = (u[k + 1] - u[k]) / (time[k + 1] - time[k]) if hold == "first" else 0.0
        t, end = time[k], time[k + 1]
        while t < end:
            push = u[k] + rise * (t - time[k])
            at_rest = abs(x[1]) < 1e-12
            if at_rest and abs(push) <= 0.3:  # held until it breaks away
                late = (0.3 * np.sign(rise) - push) / rise if rise else np.inf
                t, x = min(end, t + max(late, 0.0) + 1e-13), np.array([x[0], 0.0])
                continue
            side = np.sign(push) if at_rest else np.sign(x[1])

            def rate(s, z, side=side, k=k, rise=rise):
                return [z[1], u[k] + rise * (s - time[k]) - 0.5 * z[1] - 0.3 * side]

            stops.direction = -side
            run = solve_ivp(rate, (t, end), x, rtol=1e-11, atol=1e-13, method="DOP853", events=stops)
            t, x = run.t[-1], run.y[:, -1]
            if run.status == 1:
                x = np.array([x[0], 0.0])
        found.append(x[0])
    return np.array(found)


@pytest.mark.parametrize("hold", ["zero", "first"])
def test_records_with_switches_are_swept_between_their_events(pieces, hold):
    time = 0.02 * np.arange(600)
    u = np.round(0.8 * np.sin(1.1 * time) + 0.3 * np.sin(2.9 * time), 2)
    run = ce.simulate(dry_friction(), record(time, u, hold), initial={"x": 0.0, "w": 0.4})
    assert np.abs(run["y"].values - event_by_event(time, u, hold)).max() < 1e-6
    assert len(pieces) < 0.25 * 2 * 599  # it is simulated twice, for its error

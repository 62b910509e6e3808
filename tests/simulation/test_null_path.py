"""The null path: the states along a record by the integrator that fits of the same model have."""

import importlib

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import casadi_engine as ce
from casadi_engine.simulation.grid import lay_grid
from casadi_engine.simulation.null_path import null_path

START = {"omega_eng": 125.0, "omega_load": 125.0, "twist": -0.01}


@pytest.fixture(scope="module")
def record():
    """Coarse samples, so that what lies between them counts: 40 to a revolution."""
    t = np.arange(160) / 800.0
    theta = 125.0 * t
    columns = {"theta": theta, "T_load": np.full(len(t), 30.0), "omega": np.full(len(t), 125.0)}
    for number, shift in enumerate((0.0, 3.0, 1.0, 2.0), start=1):
        columns[f"p{number}"] = 1e5 + 3e6 * np.exp(
            -((np.angle(np.exp(1j * (theta / 2 - shift * np.pi / 2))) / 0.2) ** 2)
        )
    units = {"theta": "rad", "T_load": "N m", "omega": "rad/s", **{f"p{n}": "Pa" for n in (1, 2, 3, 4)}}
    return ce.Experiment.from_arrays("coarse", time=t, units=units, **columns)


def states_of(model, record):
    grid = lay_grid(model, record, outputs=("omega",))
    p = np.asarray(model.parameter_vector(None), dtype=float).ravel()
    return null_path(model, grid, p, np.array(list(START.values())))


@pytest.mark.parametrize("delay", [None, 0.0, 2e-4])
def test_the_states_are_those_of_a_simulation_whatever_the_outputs_show(record, delay):
    """A delayed sensor shows torques at once; at this rate another integrator would be 0.05 rad/s off."""
    model = ce.two_mass(reciprocating_speed="model")
    if delay is not None:
        model = model.with_effect(ce.effects.SensorDelay(), at="sensor_omega", values={"delay": delay})
    path = states_of(model, record)
    run = ce.simulate(model, record, initial=START)
    shown = path.function([model.output_expressions])(*path.at_samples().arguments)[0][0]
    np.testing.assert_allclose(shown, run["omega"].values, rtol=0, atol=1e-8)


@pytest.mark.parametrize("event", [ce.effects.LoadStep(width=2e-3), ce.effects.Impulse(width=2e-3)])
def test_a_law_of_time_leaves_the_channels_read_as_a_simulation_reads_them(record, event):
    """A rounded load step keeps the linear core, which takes channels as lines between samples; steps that follow the
    error do not, and would be off by 0.05 rad/s."""
    values = {event.amplitude.name: 3.0, "time": 0.1}
    model = ce.two_mass(reciprocating_speed="model").with_effect(event, at="load", values=values)
    path = states_of(model, record)
    run = ce.simulate(model, record, initial=START)
    shown = path.function([model.output_expressions])(*path.at_samples().arguments)[0][0]
    np.testing.assert_allclose(shown, run["omega"].values, rtol=0, atol=1e-6)


def test_a_sensor_does_not_move_the_shaft(record):
    model = ce.two_mass(reciprocating_speed="model")
    delayed = model.with_effect(ce.effects.SensorDelay(), at="sensor_omega", values={"delay": 2e-4})
    np.testing.assert_allclose(states_of(delayed, record).x, states_of(model, record).x, rtol=0, atol=1e-12)


def test_two_bursts_ten_minutes_apart():
    """A damped swing whose input holds in between, against the matrix exponential of each piece."""
    b = ce.Blueprint("swing")
    u, x, v = b.input("u"), b.state("x"), b.state("v")
    b.ode("x", v)
    b.ode("v", -2 * x - 0.4 * v + u)
    b.output("x", x)
    model = b.model()
    t = np.concatenate([np.arange(0, 5, 0.05), np.arange(600, 605, 0.05)])
    data = ce.Experiment.from_arrays("r", time=t, units={"u": "1"}, hold="zero", u=np.sin(3 * t))
    grid = lay_grid(model, data.bridged(u="hold"), outputs=())
    path = null_path(model, grid, np.zeros(0), np.array([1.0, 0.0]))
    states, wide = [np.array([1.0, 0.0])], np.array([[0.0, 1, 0], [-2, -0.4, 1], [0, 0, 0]])
    for h, level in zip(np.diff(t), np.sin(3 * t), strict=False):
        states.append((expm(wide * h) @ [*states[-1], level])[:2])
    at = np.searchsorted(path.grid.time, t - 1e-9)
    np.testing.assert_allclose(path.grid.time[at], t, rtol=0, atol=1e-9)
    np.testing.assert_allclose(path.x[:, at], np.array(states).T, rtol=0, atol=3e-6)


def test_what_lies_before_a_step_of_a_held_input_knows_nothing_of_it():
    """A controller's output holds the noise of the reading it is made of: what would see it before its time, explained
    half of that noise, and all else was tested against the other half."""
    b = ce.Blueprint("boiler")
    heater, water, power = b.state("h", unit="K"), b.state("T", unit="K"), b.input("P", unit="W")
    b.ode("h", (power - 20 * (heater - water)) / 180)
    b.ode("T", 20 * (heater - water) / 1700)
    b.output("T", water, unit="K")
    model, t = b.model(), np.arange(60.0)
    paths = []
    for jump in (0.0, 100.0):
        given = 300 + 50 * np.sin(0.3 * t)
        given[30] += jump
        data = ce.Experiment.from_arrays(
            "run", time=t, units={"P": "W", "T": "K"}, hold={"P": "zero"}, P=given, T=0 * t
        )
        grid = lay_grid(model, data, outputs=("T",))
        paths.append(null_path(model, grid, np.zeros(0), np.array([300.0, 290.0])))
    one, other = (path.between(0.5).x for path in paths)
    np.testing.assert_array_equal(one[:, :30], other[:, :30])
    assert np.abs(one[:, 30] - other[:, 30]).max() > 0.1
    turn = np.array([[-20 / 180, 20 / 180], [20 / 1700, -20 / 1700]])
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[0, 2] = turn, 1 / 180
    half = expm(0.5 * whole)
    x = paths[1].x[:, :-1]
    held = data["P"].values[:-1]
    exact = half[:2, :2] @ x + half[:2, 2:] * held
    np.testing.assert_allclose(other, exact, rtol=0, atol=1e-5)


def test_friction_that_sticks_moves_as_it_does_by_shorter_steps():
    """By one step to a sample a path was 0.7 % of its scatter off, and noise 1 %: right effects did not fit."""
    b = ce.Blueprint("rotor")
    w, torque = b.state("w", unit="rad/s", scale=5.0), b.input("T", unit="N m")
    j, c, dry = (b.parameter(n, v, min=0) for n, v in (("J", 0.025), ("c", 0.06), ("dry", 0.25)))
    b.ode("w", (torque - c * w - dry * ca.tanh(w / 0.002)) / j)
    b.output("w", w, unit="rad/s")
    model, time = b.model(), np.arange(400) * 0.05
    given = 0.5 * np.array([0.0, 2.5, 0.0, 0.0, 3.5, 0.8, 2.5, 0.0])[(time / 2.5).astype(int)]
    units = {"T": "N m", "w": "rad/s"}
    data = ce.Experiment.from_arrays("run", time=time, units=units, T=given, w=np.zeros(400))
    true = solve_ivp(
        lambda t, x: (np.interp(t, time, given) - 0.06 * x - 0.25 * np.tanh(x / 0.002)) / 0.025, (0, time[-1]), [0.0],
        t_eval=time, method="Radau", rtol=1e-8, atol=1e-10, max_step=0.01,
    ).y[0]  # fmt: skip
    path = null_path(model, lay_grid(model, data), model.parameter_vector(), np.zeros(1), steps=1)
    shown = np.interp(time, path.grid.time, path.x[0])
    assert np.abs(shown - true).max() < 2e-3 * np.std(true)


def test_a_path_that_was_made_a_moment_ago_is_not_made_again(monkeypatch):
    module = importlib.import_module("casadi_engine.simulation.null_path")
    made = []
    own = module.simulated_path
    monkeypatch.setattr(module, "simulated_path", lambda *a, **k: made.append(1) or own(*a, **k))
    monkeypatch.setattr(module, "_KEPT", module._KEPT.copy())
    b = ce.Blueprint("cup")
    rate, warm = b.parameter("k", 0.2, unit="1/s"), b.state("T", unit="K")
    b.ode("T", b.input("P", unit="K/s") - rate * warm)
    b.output("T_seen", warm, unit="K")
    model = b.model()
    t = np.arange(40) * 0.5

    def grid(power):
        units = {"P": "K/s", "T_seen": "K"}
        record = ce.Experiment.from_arrays("run", time=t, units=units, P=power, T_seen=0 * t)
        return lay_grid(model, record)

    at, start = np.array([0.2]), np.array([1.0])
    first = module.null_path(model, grid(np.sin(t)), at, start)
    assert module.null_path(model, grid(np.sin(t)), at.copy(), start.copy()) is first
    others = [
        (model, np.cos(t), at, start),
        (model, np.sin(t), 2 * at, start),
        (model, np.sin(t), at, 2 * start),
    ]
    for one, power, values, begun in others:
        assert module.null_path(one, grid(power), values, begun) is not first
    monkeypatch.setattr(module, "_LARGE", 0)
    large = module.null_path(model, grid(np.tan(t)), at, start)
    assert module.null_path(model, grid(np.tan(t)), at, start) is not large
    assert len(made) == 6

"""Fits of models without a useful linear core, and of effects with states of their own, through the same interface."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects import Amplitude, Effect, Law

STEP = 0.005


def forcing(count, seed=0):
    """A broken line with a corner every 20 samples, as recorded."""
    corners = np.random.default_rng(seed).normal(size=count // 20 + 2)
    return np.interp(np.arange(count), 20 * np.arange(len(corners)), corners)


def solved(slope, start, count, u):
    """States (n, count) by SciPy at tight tolerance, piece by piece between the corners of the input."""
    time, states, x = STEP * np.arange(count), [np.array(start, dtype=float)], np.array(start, dtype=float)
    for first in range(0, count - 1, 20):
        part = time[first : min(first + 20, count - 1) + 1]
        found = solve_ivp(
            lambda t, x: slope(t, x, np.interp(t, time, u)), part[[0, -1]], x,
            method="DOP853", rtol=1e-11, atol=1e-12, t_eval=part,
        )  # fmt: skip
        states += list(found.y.T[1:])
        x = found.y[:, -1]
    return np.array(states).T


def duffing():
    b = ce.Blueprint("duffing")
    c, k, k3 = b.parameter("c", 0.3, min=0), b.parameter("k", 1.3, min=0), b.parameter("k3", 2.0, min=0)
    q, v, force = b.state("q", scale=0.5), b.state("v"), b.input("u")
    b.ode("q", v)
    b.ode("v", force - c * v - k * q - k3 * q**3)
    b.output("y", q)
    return b.model()


def tank():
    b = ce.Blueprint("tank")
    gain, outflow = b.parameter("gain", 0.3, min=0.01), b.parameter("outflow", 0.6, min=0.01)
    level, inflow = b.state("level"), b.input("u")
    b.ode("level", gain * (2 + inflow) - outflow * ca.sqrt(level))
    b.output("y", level)
    return b.model()


SYSTEMS = {
    "duffing": (
        duffing,
        {"c": 0.2, "k": 1.0, "k3": 3.0},
        lambda t, x, u: [x[1], u - 0.2 * x[1] - x[0] - 3 * x[0] ** 3],
        [0.5, -1.0],
    ),
    "tank": (
        tank,
        {"gain": 0.2, "outflow": 0.5},
        lambda t, x, u: [0.2 * (2 + u) - 0.5 * np.sqrt(x[0])],
        [0.8],
    ),
}
SIGMA = 0.01


def record(y, u, *, sigma=SIGMA, seed=1):
    noise = sigma * np.random.default_rng(seed).standard_normal(len(u))
    units = {"u": "1", "y": "1"}
    return ce.Experiment.from_arrays("run", time=STEP * np.arange(len(u)), units=units, u=u, y=y + noise)


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_general_model_is_simulated_as_scipy_does(name):
    make, truth, slope, start = SYSTEMS[name]
    model, u = make(), forcing(1201)
    assert model.linear is None
    wanted = solved(slope, start, 1201, u)[0]
    initial = dict(zip((state.name for state in model.states), start, strict=True))
    run = ce.simulate(model, record(wanted, u, sigma=0.0), parameters=truth, initial=initial)
    assert np.abs(run["y"].values - wanted).max() < 1e-8 * np.abs(wanted).max()


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("interval", ["auto", "single"])
def test_a_general_model_is_fitted_within_its_errors(name, interval):
    make, truth, slope, start = SYSTEMS[name]
    u = forcing(1201)
    data = record(solved(slope, start, 1201, u)[0], u)
    fit = ce.estimate(make(), data, noise=ce.Noise(y=SIGMA), interval=interval, progress=False)
    assert fit.converged
    error = np.array([fit.values[key] - truth[key] for key in fit.free])
    assert error @ np.linalg.solve(fit.covariance, error) < 22  # chi-squared with 2 or 3: once in 1e4
    assert all(fit.stderr[key] < 0.1 * truth[key] for key in truth)
    assert abs(fit.cost / fit.n - 1) < 0.2
    (found,) = fit.integration.values()
    assert found.largest < 1e-8
    assert found.within
    assert "step" in str(fit)
    assert not any("integration" in message for message in fit.messages)


def test_an_output_without_a_slope_at_zero_has_its_start_found():
    """A late sensor of the tank's level shows the root of the level, which has no slope at zero."""
    _, truth, slope, start = SYSTEMS["tank"]
    late = tank().with_effect(ce.effects.SensorDelay(), at="sensor_y")
    u = forcing(1201)
    y = solved(slope, start, 1201, u)[0]
    y = np.interp(STEP * np.arange(1201) - 0.05, STEP * np.arange(1201), y, left=y[0])
    data = record(y, u).between(0.5, 6.0)
    fit = ce.estimate(late, data, noise=ce.Noise(y=SIGMA), progress=False)
    assert fit.converged
    assert fit.values["sensor_y.sensor_delay.delay"] == pytest.approx(0.05, abs=0.03)
    assert all(fit.values[key] == pytest.approx(truth[key], rel=0.1) for key in truth)


def test_a_coarse_record_is_integrated_finely_enough():
    make, truth, slope, start = SYSTEMS["duffing"]
    fine = solved(slope, start, 2401, np.zeros(2401))[0]
    time = STEP * np.arange(0, 2401, 80)
    data = ce.Experiment.from_arrays("run", time=time, units={"u": "1", "y": "1"}, u=0 * time, y=fine[::80])
    model = make()
    parameters = model.parameters()
    for name, value in truth.items():
        parameters.fix(name, value)
    initial = {"q": 0.5, "v": -1.0}
    fit = ce.estimate(
        model, data, parameters=parameters, initial=initial, noise=ce.Noise(y=1e-4), progress=False
    )
    (found,) = fit.integration.values()
    off = np.abs(fit.traces["run"]["y"].simulated - fine[::80]).max()
    assert off < 0.02 * 1e-4  # of the noise: it may move no estimate by more of its standard error
    assert found.shift <= 0.02
    assert found.substeps > 1
    assert not any("integration" in message for message in fit.messages)
    assert "relative error" in str(fit)


def test_a_linear_model_has_no_integration_error(run_up):
    fit = ce.estimate(ce.one_inertia(), run_up(), noise=ce.Noise(omega=0.05), progress=False)
    assert fit.integration == {}
    assert "integrated exactly (a linear model on equal steps)" in " ".join(str(fit).split())


class Creep(Effect):
    """A drag that follows the speed through a first-order lag: a law with a state of its own."""

    name, attaches = "creep", ("inertia",)
    sentence = "a lagging drag on {port}"
    amplitude = Amplitude("drag", unit="N m s2/rad2", min=0)

    def law(self, port, p, math):
        z = port.state("lag")
        return Law(-p.drag * z * z, states={"lag": (0.0, 3.0 * (port.speed - z))})


def disc(*, general):
    """A driven disc; with ``general`` its damping is quadratic in the ode itself, so that there is no core."""
    b = ce.Blueprint("disc")
    inertia, damping = b.parameter("J", 0.3, min=0.01), b.parameter("d", 0.02, min=0)
    speed, torque = b.state("w", scale=5.0), b.input("u")
    drag = b.port("disc", "inertia", {"speed": speed})
    b.ode("w", (10 + 5 * torque - damping * (speed**2 if general else speed) + drag) / inertia)
    b.output("y", speed)
    return b.model()


@pytest.mark.parametrize("general", [True, False], ids=["general", "with a linear core"])
def test_an_effect_with_a_state_of_its_own_is_fitted(general):
    model = disc(general=general).with_effect(Creep(), at="disc", values={"drag": 0.05})
    assert (disc(general=general).linear is None) == general
    truth = {"J": 0.25, "d": 0.03, "disc.creep.drag": 0.04}
    u = forcing(1201, seed=3)

    def slope(t, x, u):
        lost = 0.03 * (x[0] ** 2 if general else x[0]) + 0.04 * x[1] ** 2
        return [(10 + 5 * u - lost) / 0.25, 3 * (x[0] - x[1])]

    states = solved(slope, [4.0, 0.0], 1201, u)
    data = record(states[0], u)
    start = {"w": 4.0, model.states[1].name: 0.0}
    run = ce.simulate(model, data, parameters=truth, initial=start)
    assert np.abs(run["y"].values - states[0]).max() < 1e-8 * states[0].max()
    lag = {model.states[1].name: 0.0}
    fit = ce.estimate(model, data, noise=ce.Noise(y=SIGMA), initial=lag, progress=False)
    assert fit.converged
    error = np.array([fit.values[key] - truth[key] for key in fit.free])
    assert error @ np.linalg.solve(fit.covariance, error) < 22
    assert all(fit.stderr[key] < 0.2 * value for key, value in truth.items())
    (found,) = fit.integration.values()
    assert found.within

"""Where fits of models without a linear core begin, and how they end where no point can be evaluated."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.estimation import first_points
from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.search import Search
from casadi_engine.simulation.adaptive import Adaptive
from casadi_engine.simulation.event_propagator import EventPropagator
from casadi_engine.simulation.grid import lay_grid
from casadi_engine.simulation.intervals import cut
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator


def duffing(seed=0):
    """A hard spring at an amplitude of 20, whose period is 10 samples, and its record by SciPy."""
    b = ce.Blueprint("duffing")
    c = b.parameter("c", 0.21, unit="1/s", min=0, max=100)
    k3 = b.parameter("k3", 3.02, unit="1/s^2", min=0, max=100)
    q, v = b.state("q"), b.state("v", unit="1/s")
    b.ode("q", v)
    b.ode("v", -c * v - k3 * q**3)
    b.output("q", q)
    t = 0.02 * np.arange(60)
    found = solve_ivp(
        lambda t, x: [x[1], -0.2 * x[1] - 3 * x[0] ** 3], t[[0, -1]], [20, 0],
        method="DOP853", rtol=1e-11, atol=1e-11, t_eval=t,
    )  # fmt: skip
    noisy = found.y[0] + 0.02 * np.random.default_rng(seed).standard_normal(60)
    return b.model(), ce.Experiment.from_arrays("swing", units={"q": "1", "time": "s"}, time=t, q=noisy)


def arrived(fit, truth):
    assert fit.status == "converged"
    assert fit.cost / fit.n < 1.5
    for name, value in truth.items():
        assert abs(fit.values[name] - value) < 4 * fit.stderr[name]


@pytest.mark.parametrize("initial", [{"q": 20.0, "v": 0.0}, None])
def test_a_fast_swing_is_found_from_beside_the_truth(initial):
    model, data = duffing()
    fit = ce.estimate(model, data, noise=ce.Noise(q=0.02), initial=initial, progress=False)
    arrived(fit, {"c": 0.2, "k3": 3.0})


def test_the_simulation_from_the_given_states_is_a_start_too(monkeypatch):
    # Without the states that explain their intervals, those of a steady state are left, with speeds of 0.
    monkeypatch.setattr(first_points, "fitted_nodes", lambda record, v, nodes: nodes)
    model, data = duffing(1)
    fit = ce.estimate(model, data, noise=ce.Noise(q=0.02), initial={"q": 20.0, "v": 0.0}, progress=False)
    arrived(fit, {"c": 0.2, "k3": 3.0})


def test_a_fit_that_ends_worse_than_the_simulation_at_its_start_begins_again_there(monkeypatch):
    monkeypatch.setattr(first_points, "fitted_nodes", lambda record, v, nodes: nodes)
    model, data = duffing(2)
    search = Search(
        model, (data,), model.parameters(), ce.Noise(q=0.02), interval="auto",
        initial={"q": 20.0, "v": 0.0}, loss=Loss(), ties="substitute", method="exact", max_iterations=200,
        tolerance=1e-9, warm=None, progress=None,
    )  # fmt: skip
    start = search._start(search.pmap.start, first=True)
    start[search.problem.nv + 2 :] = 0.0  # rest in all intervals but the first
    own, starts = search.solver.solve, []

    def solve(x, lower, upper, *, exact=False):
        starts.append(x)
        found = own(x, lower, upper, exact=exact)
        return found if len(starts) > 1 else replace(found, x=start)  # a poor optimum

    monkeypatch.setattr(search.solver, "solve", solve)
    found = search._solved(start, exact=False)
    assert 2 * search._objective(start) > 100
    assert len(starts) == 2
    assert 2 * search._objective(found.x) < 1.5


@pytest.mark.slow  # test_pieces.py has a nonlinear model far off
def test_predators_and_prey_are_found_from_far_off():
    b = ce.Blueprint("predators", time_unit="d")
    p = [b.parameter(name, 0.8, unit="1/d", min=0, max=20) for name in "abcd"]
    x, y = b.state("x"), b.state("y")
    b.ode("x", p[0] * x - p[1] * x * y)
    b.ode("y", p[3] * x * y - p[2] * y)
    b.output("x", x)
    b.output("y", y)
    rng = np.random.default_rng(5)
    t = np.sort(rng.uniform(0, 30, 40))
    t[0] = 0
    found = solve_ivp(
        lambda t, z: [1.1 * z[0] - 0.4 * z[0] * z[1], 0.1 * z[0] * z[1] - 0.4 * z[1]], (0, 30), [10, 5],
        rtol=1e-11, atol=1e-12, t_eval=t,
    ).y + 0.3 * rng.standard_normal((2, 40))  # fmt: skip
    units = {"x": "1", "y": "1", "time": "d"}
    data = ce.Experiment.from_arrays("years", units=units, time=t, x=found[0], y=found[1])
    fit = ce.estimate(b.model(), data, noise=ce.Noise(x=0.3, y=0.3), approach="prediction", progress=False)
    arrived(fit, {"a": 1.1, "b": 0.4, "c": 0.4, "d": 0.1})


def test_a_bad_point_makes_no_other_slow():
    b = ce.Blueprint("decay")
    k, x = b.parameter("k", 1.0), b.state("x")
    b.ode("x", -k * x * ca.fabs(x))
    b.output("x", x)
    model = b.model()
    t = 0.1 * np.arange(21)
    grid = lay_grid(model, ce.Experiment.from_arrays("r", units={"time": "s", "x": "1"}, time=t, x=0 * t))
    z, one = ca.SX.sym("z"), np.ones((1, 1))
    propagator = RungeKuttaPropagator(model, grid, cut(grid, None), z, z, scale=np.ones(1))
    propagator.propagate(np.array([1.0]), one)
    before = propagator.fineness
    with propagator.unchanged(30):
        fast = propagator.propagate(np.array([20.0]), one)
        assert propagator.substeps > before.most
    with propagator.unchanged(1), pytest.raises(FloatingPointError, match="more integration steps"):
        propagator.propagate(np.array([20.0]), one)
    np.testing.assert_allclose(fast.x[:, 0, 0][-1], 1 / (1 + 20 * 2.0), rtol=1e-2)
    assert propagator.fineness is before


def thermostat():
    """A heater that lags behind its thermostat; with a weak heater the thermostat chatters at its upper limit."""
    b = ce.Blueprint("thermostat")
    tau, gain = b.parameter("tau", 3.0, unit="s", min=0.1), b.parameter("G", 25.0, unit="K", min=1)
    T, z = b.state("T", unit="degC"), b.state("z")
    on = ca.if_else(T < 19, 1, ca.if_else(T > 21, 0, ca.if_else(z > 0.5, 1, 0)))
    b.ode("T", (5 - T + gain * z) / tau)
    b.ode("z", (on - z) * 200)
    b.output("T", T, unit="degC")
    return b.model()


def test_a_point_that_chatters_is_given_up_soon(monkeypatch):
    model = thermostat()
    t = np.linspace(0, 6, 49)
    data = ce.Experiment.from_arrays("r", units={"time": "s", "T": "degC"}, time=t, T=20 + 0 * t)
    grid = lay_grid(model, data)
    z, steps = ca.SX.sym("z", 2), []
    monkeypatch.setattr(Adaptive, "_count", lambda self, own=Adaptive._count: (steps.append(1), own(self))[1])
    propagator = EventPropagator(model, grid, cut(grid, None), z, z, scale=np.ones(2))
    start = np.array([[15.0, 1.0]])
    good = model.parameter_vector()
    propagator.propagate(np.asarray(good, dtype=float).ravel(), start)
    usual = len(steps)
    bad = model.parameters()
    bad["tau"], bad["G"] = 2.0, 21.5
    with pytest.raises(FloatingPointError, match="too many"):
        propagator.propagate(np.asarray(model.parameter_vector(bad), dtype=float).ravel(), start)
    assert len(steps) < 10 * usual


def test_a_search_before_a_wall_ends(monkeypatch):
    model, data = duffing()
    search = Search(
        model, (data,), model.parameters(), ce.Noise(q=0.02), interval="single", initial=None, loss=Loss(),
        ties="substitute", method="exact", max_iterations=200, tolerance=1e-9, warm=None, progress=None,
    )  # fmt: skip
    start, own, tried = search._start(search.pmap.start, first=True), search.problem.at, []

    def at(x):
        tried.append(x)
        if abs(x[0] - start[0]) > 1e-7:
            raise FloatingPointError("beyond the wall")
        return own(x)

    monkeypatch.setattr(search.problem, "at", at)
    found = search.solver.solve(start, search.lower, search.upper)
    assert found.status.startswith("not converged")
    assert len(tried) < 500


def toggle():
    """Two repressors, whose share of the other's rate has a free power."""
    b = ce.Blueprint("toggle", time_unit="min")
    rates = [b.parameter(name, 5.0, unit="1/min", min=0.1, max=100) for name in ("a1", "a2")]
    power = b.parameter("hill", 2.0, unit="1", min=1, max=6)
    decay = b.parameter("d", 0.2, unit="1/min", min=0.01, max=5)
    x, y = b.state("x", unit="1"), b.state("y", unit="1")
    helps = b.input("iptg", unit="1")
    b.ode("x", rates[0] / (1 + (y / 10) ** power) - decay * x)
    b.ode("y", rates[1] / (1 + (x / (10 * (1 + helps))) ** power) - decay * y)
    b.output("gfp", x, unit="1")
    b.output("rfp", y, unit="1")
    return b.model()


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_a_start_near_samples_below_zero_has_slopes_by_a_power(seed):
    # y**2 has a value at y < 0, and its slope by the power has none
    t = np.arange(0, 200, 2.0)
    pushed = np.where((t > 60) & (t < 120), 4.0, 0.0)

    def rate(now, z):
        u, z = (4.0 if 61 < now < 121 else 0.0), np.maximum(z, 0)
        return [
            3 / (1 + (z[1] / 10) ** 2.5) - 0.1 * z[0],
            2.4 / (1 + (z[0] / (10 + 10 * u)) ** 2.5) - 0.1 * z[1],
        ]

    z = solve_ivp(rate, t[[0, -1]], [20, 2], t_eval=t, rtol=1e-9, atol=1e-9, max_step=1.0).y
    seen = z + 1.0 * np.random.default_rng(seed).standard_normal(z.shape)
    assert seen.min() < 0
    units = {"iptg": "1", "gfp": "1", "rfp": "1"}
    data = ce.Experiment.from_arrays(
        "plate", time=60 * t, units=units, hold={"iptg": "zero"}, iptg=pushed, gfp=seen[0], rfp=seen[1]
    )
    fit = ce.estimate(toggle(), data, progress=False)
    arrived(fit, {"a1": 3.0, "a2": 2.4, "hill": 2.5, "d": 0.1})


def test_an_output_that_is_a_product_of_states_says_nothing_of_them_at_zero():
    # at susceptible = infectious = 0 neither moves the incidence: searches began there, and ended
    b = ce.Blueprint("epidemic", time_unit="d")
    beta = b.parameter("beta", 0.36, unit="1/d", min=0.01, max=2)
    gamma = b.parameter("gamma", 0.2, unit="1/d", min=0.01, max=2)
    s, i = b.state("S", unit="1", scale=1), b.state("I", unit="1", scale=0.05)
    new = beta * s * i
    b.ode("S", -new)
    b.ode("I", new - gamma * i)
    b.output("incidence", 1e5 * new, unit="1")
    t = np.arange(100.0)
    z = solve_ivp(
        lambda _, z: [-0.42 * z[0] * z[1], 0.42 * z[0] * z[1] - 0.16 * z[1]],
        t[[0, -1]], [0.97, 0.002], t_eval=t, rtol=1e-10, atol=1e-12,
    ).y  # fmt: skip
    seen = 1e5 * 0.42 * z[0] * z[1] + 10 * np.random.default_rng(6).standard_normal(len(t))
    data = ce.Experiment.from_arrays("wave", time=86400 * t, units={"incidence": "1"}, incidence=seen)
    arrived(ce.estimate(b.model(), data, progress=False), {"beta": 0.42, "gamma": 0.16})


@pytest.mark.parametrize(
    ("made", "initial"),
    [(False, {"B": 0.4}), (False, {"A": 1.0}), (True, {"A": 1.0}), (False, None)],
    ids=str,
)
def test_a_share_of_what_decays_is_searched_away_from_its_pole(made, initial):
    # the quasi-steady state of what decays is nothing at all, of which a share has no value
    b = ce.Blueprint("share")
    k = b.parameter("k", 1.0, unit="1/s", min=0, max=10)
    one, other = b.state("A"), b.state("B")
    b.ode("A", -k * one)
    b.ode("B", k * one if made else -0.1 * other)
    b.output("share", one / (one + other))
    t = np.linspace(0, 8, 81)
    left = np.exp(-0.7 * t)
    beside = 1.4 - left if made else 0.4 * np.exp(-0.1 * t)
    seen = left / (left + beside) + 0.01 * np.random.default_rng(0).standard_normal(len(t))
    data = ce.Experiment.from_arrays("run", time=t, units={"share": "1"}, share=seen)
    fit = ce.estimate(b.model(), data, initial=initial, progress=False)
    assert fit.converged
    assert fit.noise["share"][0] < 0.012
    first = {name: one.value for name, one in fit.initial["run"].items()}
    assert first["B"] / first["A"] == pytest.approx(0.4, abs=0.02)
    assert fit.values["k"] == pytest.approx(0.7, abs=0.03)

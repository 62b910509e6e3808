"""The general propagator: order of its steps, agreement with the exact one, and a Duffing oscillator."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from casadi_engine.deadline import Deadline, TimeUp
from casadi_engine.model import Blueprint
from casadi_engine.simulation import sweeps
from casadi_engine.simulation.intervals import cut
from casadi_engine.simulation.linear import LinearPropagator
from casadi_engine.simulation.runge_kutta import Fineness, RungeKuttaPropagator
from casadi_engine.simulation.tableau import RADAU, RUNGE_KUTTA

NONE = np.zeros(0)


def run(made, model, grid, start, *, kind=RungeKuttaPropagator, length=None, p=None):
    """Outputs (samples, ny) from one start."""
    p = ca.DM(model.parameter_vector() if p is None else p)
    plan = cut(grid, length)
    scale = made.scale(model)
    propagator = kind(model, grid, plan, ca.SX(0, 1), p, scale=scale)
    path = propagator.propagate(NONE, np.asarray(start)[None] / scale, 0)
    return made.by_interval(plan, len(model.outputs), path.y)[0, : grid.samples, :, 0]


def duffing():
    b = Blueprint("duffing")
    q, v, force = b.state("q", scale=0.3), b.state("v", scale=2.0), b.input("F")
    k3 = b.parameter("k3", 3.0)
    b.ode("q", v)
    b.ode("v", force + ca.cos(2 * b.time) - 0.2 * v - q - k3 * q**3)
    b.output("q", q)
    b.output("energy", v**2 / 2 + q**2 / 2 + k3 * q**4 / 4)
    return b.model()


def test_duffing_equals_scipys_integrator(made):
    model = duffing()
    step, samples, start = 0.01, 1501, 0.4
    time = start + step * np.arange(samples)
    # A broken line, as recorded: corners every 25 samples.
    force = np.interp(time, time[::25], np.random.default_rng(0).normal(size=61))
    grid = made.grid(force, step=step, start=start)
    found = run(made, model, grid, [0.5, -1.0])

    def slope(t, x):
        return [x[1], np.interp(t, time, force) + np.cos(2 * t) - 0.2 * x[1] - x[0] - 3 * x[0] ** 3]

    wanted = solve_ivp(
        slope, time[[0, -1]], [0.5, -1.0], method="DOP853", rtol=1e-11, atol=1e-11, t_eval=time, max_step=0.05
    )
    np.testing.assert_allclose(found[:, 0], wanted.y[0], atol=2e-7)
    q, v = wanted.y
    np.testing.assert_allclose(found[:, 1], v**2 / 2 + q**2 / 2 + 0.75 * q**4, atol=1e-6)


def test_steps_are_of_fourth_order(made):
    model = duffing()
    ends = []
    for count in (20, 40, 80, 640):
        step = 2.0 / count
        # A straight line is held exactly whatever the step.
        grid = made.grid(0.3 * step * np.arange(count + 1), step=step, start=0.0)
        ends.append(run(made, model, grid, [0.5, -1.0])[-1, 0])
    errors = np.abs(np.array(ends[:-1]) - ends[-1])
    orders = np.log2(errors[:-1] / errors[1:])
    assert ((orders > 3.8) & (orders < 4.3)).all()


@pytest.mark.parametrize("holds", [("first", "first"), ("zero", "zero"), ("zero", "first")])
def test_a_linear_model_equals_the_exact_propagator(made, holds):
    b = Blueprint("linear")
    x, y, u, v = b.state("x", scale=3.0), b.state("y"), b.input("u"), b.input("v")
    b.ode("x", y - 0.5 * x + u + 2.0)
    b.ode("y", -x + v)
    b.output("first", x + u)
    b.output("second", y - 1)
    model = made.without_rates(b.model())
    grid = made.grid(np.random.default_rng(1).normal(size=(2, 200)), step=0.02, holds=holds)
    exact = run(made, model, grid, [1.0, 2.0], kind=LinearPropagator)
    steps = run(made, model, grid, [1.0, 2.0])
    np.testing.assert_allclose(steps, exact, atol=1e-8)


def test_a_fast_mode_is_stepped_more_finely(made):
    b = Blueprint("stiff")
    x, rate, u = b.state("x"), b.parameter("rate", 900.0), b.input("u")
    b.ode("x", rate * (u - x))
    b.output("x", x)
    model = b.model()
    grid = made.grid(np.sin(0.3 * np.arange(60)), step=0.01)
    exact = run(made, model, grid, [0.4], kind=LinearPropagator)
    z = ca.SX.sym("z", 1)
    plan = cut(grid, None)
    propagator = RungeKuttaPropagator(model, grid, plan, z, 900 * z, scale=np.ones(1))
    # One step of h rate = 9 would be unstable.
    found = made.by_interval(plan, 1, propagator.propagate(np.ones(1), np.full((1, 1), 0.4), 0).y)
    np.testing.assert_allclose(found[0, :60, :, 0], exact, atol=1e-4)


def test_the_first_steps_suit_the_fastest_mode_of_the_values_given(made):
    b = Blueprint("decay")
    x, tau = b.state("x"), b.parameter("tau", 1.0)
    b.ode("x", -x / tau)
    b.output("x", x)
    model, z = b.model(), ca.SX.sym("z")
    grid = made.grid(np.zeros((0, 5)), samples=5, step=0.1)
    for physical, at in ((0.05 * z, 1.0), (0.05 * ca.exp(z), 0.0), (ca.SX(0.05), 3.0)):
        propagator = RungeKuttaPropagator(model, grid, cut(grid, None), z, physical, scale=np.ones(1))
        propagator.propagate(np.array([at]), np.ones((1, 1)), 0)
        assert propagator.substeps == 2  # |lambda| h = 2 in steps of 1
    propagator = RungeKuttaPropagator(model, grid, cut(grid, None), z, 1e-5 * z, scale=np.ones(1))
    path = propagator.propagate(np.ones(1), np.ones((1, 1)), 1)
    assert propagator.fineness.scheme is RADAU
    assert np.abs(path.x[1:]).max() < 1e-3


def test_orders_zero_and_one_give_the_same_outputs(made):
    model = made.general(np.random.default_rng(3), states=3)
    grid = made.grid(np.random.default_rng(4).normal(size=(1, 40)), step=0.05)
    z, scale = ca.SX.sym("z", 2), made.scale(model)
    propagator = RungeKuttaPropagator(model, grid, cut(grid, 8), z, z, scale=scale)
    nodes = np.random.default_rng(5).normal(size=(5, 3))
    value = propagator.propagate(np.ones(2), nodes, 0)
    both = propagator.propagate(np.ones(2), nodes, 1)
    np.testing.assert_allclose(both.y[0], value.y[0], rtol=1e-13)
    np.testing.assert_array_equal(both.end, value.end)


def test_a_model_without_channels_and_parameters(made):
    b = Blueprint("pendulum")
    q, v = b.state("q"), b.state("v")
    b.ode("q", v)
    b.ode("v", -ca.sin(q))
    b.output("energy", v**2 / 2 - ca.cos(q))
    grid = made.grid(np.zeros((0, 400)), samples=400, step=0.05)
    energy = run(made, b.model(), grid, [1.0, 0.0])
    np.testing.assert_allclose(energy, -np.cos(1.0), atol=2e-6)
    plan = cut(grid, 30)
    propagator = RungeKuttaPropagator(b.model(), grid, plan, ca.SX(0, 1), ca.SX(0, 1), scale=np.ones(2))
    path = propagator.propagate(NONE, np.ones((plan.m, 2)), 1)
    zz, zs, ss = propagator.contraction(NONE, path, np.ones(path.y[0].shape), np.ones((2, plan.m)))
    assert (zz.shape, zs.shape, ss.shape) == ((0, 0), (0, 2, plan.m), (plan.m, 2, 2))


def test_a_state_that_runs_away_is_reported_without_noise(made):
    b = Blueprint("burst")
    x = b.state("x")
    b.ode("x", x**3)
    b.output("x", x)
    grid = made.grid(np.zeros((0, 100)), samples=100, step=0.05)
    with pytest.raises(FloatingPointError, match="the model's state is not finite here"):
        run(made, b.model(), grid, [5.0])


def test_drives_are_told(made):
    model = made.general(np.random.default_rng(0))
    grid = made.grid(np.arange(6.0), step=0.1, start=1.0)
    propagator = RungeKuttaPropagator(model, grid, cut(grid, None), model.p, model.p, scale=made.scale(model))
    found = propagator.drives_at(np.array([2.0, 1.0]))
    np.testing.assert_allclose(found, [2 * np.arange(6.0) ** 2 + np.cos(grid.time)], rtol=1e-13)


def test_the_same_point_is_not_propagated_twice(made):
    model = duffing()
    grid = made.grid(np.sin(np.arange(60.0)), step=0.01)
    plan, z = cut(grid, 10), ca.SX.sym("z", 1)
    propagator = RungeKuttaPropagator(model, grid, plan, z, 3 * z, scale=made.scale(model))
    nodes = np.full((plan.m, 2), 0.3)
    path = propagator.propagate(np.ones(1), nodes, 1)
    assert propagator.propagate(np.ones(1), nodes.copy(), 1) is path
    for at, other in ((np.full(1, 1.1), nodes), (np.ones(1), nodes + 0.1)):
        moved = propagator.propagate(at, other, 1)
        assert moved is not path
        assert np.abs(moved.y - path.y).max() > 1e-6
    finer = propagator.finer(2).propagate(np.ones(1), nodes, 1)
    assert finer.begun.shape[1] > path.begun.shape[1]
    again = propagator.propagate(np.ones(1), nodes, 1)
    np.testing.assert_array_equal(again.y, path.y)


@pytest.mark.parametrize("scheme", [RUNGE_KUTTA, RADAU], ids=["explicit", "implicit"])
def test_the_error_of_many_steps_is_made_in_parts(made, scheme, monkeypatch):
    model = duffing()
    grid = made.grid(np.sin(0.1 * np.arange(200)), step=0.02)
    scale, z = made.scale(model), NONE
    p = ca.DM(model.parameter_vector())
    fineness = Fineness(scheme, np.ones(199, np.intp))
    propagator = RungeKuttaPropagator(
        model, grid, cut(grid, 20), ca.SX(0, 1), p, scale=scale, fineness=fineness
    )
    path = propagator.propagate(z, np.zeros((propagator.intervals.m, 2)))
    off, cells = propagator.arising(z, path)
    monkeypatch.setattr(sweeps, "_MANY", 16)
    again, others = propagator.arising(z, path)
    np.testing.assert_allclose(again, off, rtol=1e-6, atol=1e-16)
    np.testing.assert_allclose(others, cells, rtol=1e-6, atol=1e-16)
    with Deadline(0.0), pytest.raises(TimeUp):
        propagator.arising(z, path)


@pytest.mark.parametrize("scheme", [RUNGE_KUTTA, RADAU], ids=["explicit", "implicit"])
def test_an_integration_whose_time_is_over_leaves_the_steps_as_they_were(made, scheme):
    model = duffing()
    grid = made.grid(np.sin(0.1 * np.arange(200)), step=0.02)
    fineness = Fineness(scheme, np.ones(199, np.intp))
    propagator = RungeKuttaPropagator(
        model, grid, cut(grid, 20), ca.SX(0, 1), ca.DM(model.parameter_vector()), scale=made.scale(model),
        fineness=fineness,
    )  # fmt: skip
    nodes = np.zeros((propagator.intervals.m, 2))
    with Deadline(0.0), pytest.raises(TimeUp):
        propagator.propagate(NONE, nodes)
    assert propagator.fineness is fineness
    with Deadline() as deadline:
        path = propagator.propagate(NONE, nodes)
    assert np.isfinite(path.x).all()
    assert deadline.done >= 199  # a step of every cell at least


def test_steps_that_are_hard_to_make_are_made_shorter(made, monkeypatch):
    """A substrate that runs out: Newton's method started anew at a step there, at every point of a search, for a
    hundred times the time of the others."""
    b = Blueprint("batch")
    cells, food, feed = b.state("X"), b.state("S", scale=60.0), b.input("F")
    rate = 0.4 * food / (20.0 + food)
    b.ode("X", rate * cells + feed)
    b.ode("S", -rate * cells / 0.12)
    b.output("X", cells)
    model, step = b.model(), 2.3
    grid = made.grid(np.zeros(14), step=step, start=0.0)
    plain = Fineness(RADAU, np.ones(13, dtype=np.intp))
    scale = made.scale(model)
    propagator = RungeKuttaPropagator(
        model, grid, cut(grid, None), ca.SX(0, 1), ca.DM(0, 1), scale=scale, fineness=plain
    )
    plain_run = sweeps.Sweeps.run

    def run_of_a_hard_step(self, z, nodes):
        found = plain_run(self, z, nodes)
        self.hard[:] = (self.layout.time[: self.layout.steps] > 15) & (
            self.layout.length[: self.layout.steps] > 1
        )
        return found

    monkeypatch.setattr(sweeps.Sweeps, "run", run_of_a_hard_step)
    nodes = np.array([[0.2, 60.0]]) / scale
    assert propagator.propagate(NONE, nodes, 0).begun.shape[1] == 13 + 1  # a trial point changes no steps
    first = propagator.propagate(NONE, nodes, 1)
    assert propagator.fineness.counts.tolist() == [1] * 7 + [4] * 6
    again = propagator.propagate(NONE, nodes + 1e-9, 1)
    assert again.begun.shape == first.begun.shape
    shown = made.by_interval(cut(grid, None), 1, first.y)[0, :14, 0, 0]

    def rates(_t, x):
        own = 0.4 * x[1] / (20.0 + x[1])
        return [own * x[0], -own * x[0] / 0.12]

    exact = solve_ivp(
        rates,
        (0, 13 * step),
        [0.2, 60.0],
        t_eval=step * np.arange(14),
        method="Radau",
        rtol=1e-10,
        atol=1e-12,
    )
    np.testing.assert_allclose(shown, exact.y[0], rtol=5e-3)

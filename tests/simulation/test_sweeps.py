"""Implicit stages: where Newton's method counts as arrived."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from casadi_engine.model import Blueprint
from casadi_engine.simulation import stage_newton, sweeps
from casadi_engine.simulation.intervals import cut
from casadi_engine.simulation.runge_kutta import Fineness, RungeKuttaPropagator
from casadi_engine.simulation.stage_newton import solve_stages, stages_of
from casadi_engine.simulation.tableau import RADAU


def linear(a):
    """Slopes h A x and their derivatives, as `solve_stages` reads them."""
    n = len(a)

    def function(columns, given):
        return a @ columns, np.repeat(a.T.reshape(-1, 1), columns.shape[1], axis=1).reshape(n, -1)

    return function


def test_a_step_over_many_time_constants_arrives():
    """What the stages of a decayed state hold is rounding of the other one; they are right to that."""
    a = 595.0 * np.array([[0.0, 1.0], [-2.0, -0.4]])
    x = np.array([[0.3, 1e-3], [-0.2, 1e-9]])
    stages, *_ = solve_stages(RADAU, linear(a), x, np.repeat(x[None], 3, axis=0), np.zeros((0, 6)))
    big = np.eye(6) - np.kron(RADAU.a, a)
    for k in range(2):
        true = np.linalg.solve(big, np.tile(x[:, k], 3)).reshape(3, 2)
        np.testing.assert_allclose(stages[:, :, k], true, rtol=0, atol=1e-11 * np.abs(x[:, k]).max())


def test_stages_of_a_state_far_smaller_than_another_keep_their_digits():
    """A trace of 1e-20 in balance with its source, beside a state of 1."""
    a = np.array([[-0.1, 0.0], [1e-15, -1e5]])
    x = np.array([[1.0], [1e-20]])
    stages, *_ = solve_stages(RADAU, linear(a), x, np.repeat(x[None], 3, axis=0), np.zeros((0, 3)))
    true = np.linalg.solve(np.eye(6) - np.kron(RADAU.a, a), np.tile(x[:, 0], 3)).reshape(3, 2)
    np.testing.assert_allclose(stages[:, :, 0], true, rtol=1e-9)


def test_stages_that_are_not_finite_do_not_arrive():
    a = np.array([[np.nan]])
    stages, *_ = solve_stages(RADAU, linear(a), np.ones((1, 2)), np.ones((3, 1, 2)), np.zeros((0, 6)))
    assert np.isnan(stages).all()


def friction(force, width):
    """Slopes of a mass of 1 with dry friction, h = 1: x' = pull - force tanh(x/width), pull is known."""

    def function(columns, given):
        value = given - force * np.tanh(columns / width)
        return value, -force / width / np.cosh(np.minimum(np.abs(columns) / width, 300)) ** 2

    return function


def test_a_step_that_goes_across_a_corner_arrives():
    """Newton's method leaps from one side of the corner to the other for ever, unless its steps are damped."""
    pull, force, width = np.array([0.2, 0.2, -0.7, 3.0]), 1.0, 1e-5
    x = np.array([[0.5, 1e-3, -0.4, 0.9]])
    stages, *_ = solve_stages(
        RADAU, friction(force, width), x, np.repeat(x[None], 3, axis=0), np.tile(pull, (1, 3))
    )
    assert np.isfinite(stages).all()
    slope = np.tile(pull, (3, 1)) - force * np.tanh(stages[:, 0] / width)
    np.testing.assert_allclose(stages[:, 0], x[0] + RADAU.a @ slope, rtol=0, atol=1e-6)
    assert np.abs(stages[-1, 0, :2]).max() < width  # it sticks
    np.testing.assert_allclose(stages[-1, 0, 2:], [-0.4 - 0.7 + 1.0, 0.9 + 3.0 - 1.0], rtol=1e-9)


def test_a_step_that_does_not_arrive_is_the_only_one():
    """No root: x = 1 + x^2 of the first, beside a decay."""

    def function(columns, given):
        value = np.where(given > 0, 5 + columns**2, -columns)
        return value, np.where(given > 0, 2 * columns, -np.ones_like(columns))

    x, kind = np.ones((1, 3)), np.array([1.0, 0.0, 0.0])
    stages, *_ = solve_stages(RADAU, function, x, np.repeat(x[None], 3, axis=0), np.tile(kind, (1, 3)))
    assert np.isnan(stages[..., 0]).all()
    np.testing.assert_allclose(stages[-1, 0, 1:], np.exp(-1.0), rtol=1e-3)


def uptake(size, half):
    """Slopes -size x/(half + x) of a stock, h = 1: beyond the pole at -half the stage equations have another root."""

    def function(columns, given):
        return -size * columns / (half + columns), -size * half / (half + columns) ** 2

    return function


@pytest.mark.parametrize(("size", "half"), [(3.0, 0.5), (1.0, 0.5), (0.5, 0.05)])
@pytest.mark.parametrize("begun", [None, 1e-3, -0.4, -2.0, -50.0])
def test_a_step_is_the_same_whatever_newtons_method_begins_at(size, half, begun):
    """A stock does not become negative by being used up, wherever the last run had left the stages."""
    x, given = np.array([[1.0, 0.3, 0.02]]), np.zeros((0, 9))
    near = None if begun is None else np.full((3, 1, 3), begun)
    stages = stages_of(RADAU, uptake(size, half), x, given, near)
    assert (stages[-1] > 0).all()
    slopes = uptake(size, half)(stages.reshape(1, -1), given)[0].reshape(3, 3)
    np.testing.assert_allclose(stages[:, 0], x + RADAU.a @ slopes, rtol=0, atol=1e-12)
    exact = [
        solve_ivp(lambda t, y: -size * y / (half + y), (0, 1), [own], rtol=1e-10).y[0, -1] for own in x[0]
    ]
    np.testing.assert_allclose(stages[-1, 0], exact, rtol=0, atol=5e-3)


def test_stages_that_are_not_known_do_not_hide_the_others():
    x, given = np.array([[1.0, 0.3]]), np.zeros((0, 6))
    wanted = stages_of(RADAU, uptake(0.1, 0.5), x, given)
    near = wanted.copy()
    near[..., 0] = np.nan
    found = stages_of(RADAU, uptake(0.1, 0.5), x, given, near)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-13)


def eaten(made):
    """Implicit steps, in many intervals, of a stock that is eaten with a rate S/(K + S)."""
    b = Blueprint("eaten")
    size, half = b.parameter("size", 2.0), b.parameter("half", 0.3)
    s, u = b.state("s"), b.input("u")
    b.ode("s", u - size * s / (half + s))
    b.output("s", s)
    model, time = b.model(), np.arange(151) * 0.1
    grid = made.grid(1.0 + np.sin(time), step=0.1, start=0.0)
    z = ca.SX.sym("z", 2)
    fine = Fineness(RADAU, np.ones(150, np.intp))
    return RungeKuttaPropagator(model, grid, cut(grid, 10), z, z, scale=made.scale(model), fineness=fine)


@pytest.mark.parametrize(
    ("size", "start", "share"), [(2.02, 1.03, 0.8), (2.0, 1.0, 0.5), (0.5, 8.0, 1.1)]
)  # near by, the point itself, far off
def test_a_point_near_by_begins_where_the_slopes_of_the_last_one_lead(made, monkeypatch, size, start, share):
    """It is the same one to rounding, with fewer of Newton's iterations; far off it costs no more."""
    asked, real = [], stage_newton._asked
    monkeypatch.setattr(stage_newton, "_asked", lambda *given: asked.append(1) or real(*given))

    def run(propagator, size, start):
        asked.clear()
        found = propagator.propagate(np.array([size, 0.3]), np.full((16, 1), start), 1)
        return found, len(asked)

    known = eaten(made)
    run(known, 2.0, 1.0)
    found, count = run(known, size, start)
    wanted, without = run(eaten(made), size, start)
    np.testing.assert_allclose(found.x, wanted.x, rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.y, wanted.y, rtol=0, atol=1e-9)
    assert count <= share * without


def test_a_run_too_large_to_keep_is_none_to_begin_at(made, monkeypatch):
    monkeypatch.setattr(sweeps, "_KEPT", 100)
    known = eaten(made)
    known.propagate(np.array([2.0, 0.3]), np.ones((16, 1)), 1)
    assert known.sweeps._near(np.array([2.0, 0.3])) is None

"""Implicit stages: where Newton's method counts as arrived."""

from __future__ import annotations

import numpy as np

from casadi_engine.simulation.sweeps import solve_stages
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
    stages = solve_stages(RADAU, linear(a), x, np.repeat(x[None], 3, axis=0), np.zeros((0, 6)))
    big = np.eye(6) - np.kron(RADAU.a, a)
    for k in range(2):
        true = np.linalg.solve(big, np.tile(x[:, k], 3)).reshape(3, 2)
        np.testing.assert_allclose(stages[:, :, k], true, rtol=0, atol=1e-11 * np.abs(x[:, k]).max())


def test_stages_of_a_state_far_smaller_than_another_keep_their_digits():
    """A trace of 1e-20 in balance with its source, beside a state of 1."""
    a = np.array([[-0.1, 0.0], [1e-15, -1e5]])
    x = np.array([[1.0], [1e-20]])
    stages = solve_stages(RADAU, linear(a), x, np.repeat(x[None], 3, axis=0), np.zeros((0, 3)))
    true = np.linalg.solve(np.eye(6) - np.kron(RADAU.a, a), np.tile(x[:, 0], 3)).reshape(3, 2)
    np.testing.assert_allclose(stages[:, :, 0], true, rtol=1e-9)


def test_stages_that_are_not_finite_do_not_arrive():
    a = np.array([[np.nan]])
    stages = solve_stages(RADAU, linear(a), np.ones((1, 2)), np.ones((3, 1, 2)), np.zeros((0, 6)))
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
    stages = solve_stages(
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
    stages = solve_stages(RADAU, function, x, np.repeat(x[None], 3, axis=0), np.tile(kind, (1, 3)))
    assert np.isnan(stages[..., 0]).all()
    np.testing.assert_allclose(stages[-1, 0, 1:], np.exp(-1.0), rtol=1e-3)

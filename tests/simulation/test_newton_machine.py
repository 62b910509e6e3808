"""Implicit steps by CasADi's machine: those of Newton's method by arrays, also where a fixed number does not arrive."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_engine.model import Blueprint
from casadi_engine.simulation import newton_machine, sweeps
from casadi_engine.simulation.intervals import cut
from casadi_engine.simulation.runge_kutta import Fineness, RungeKuttaPropagator
from casadi_engine.simulation.tableau import RADAU

VALUES = np.array([0.4])
STARTS = np.array([0.3, 2.0])


def rubbing(width):
    """A swing under dry friction, whose corner is rounded over a width of speed, that is switched off at a time."""
    b = Blueprint("rubbing")
    dry = b.parameter("dry", VALUES[0])
    x, v, u = b.state("x"), b.state("v", scale=2.0), b.input("u")
    friction = ca.if_else(b.time > 1.777, 0.0, dry) if width > 0.01 else dry
    b.ode("x", v)
    b.ode("v", u - 3 * x - friction * ca.tanh(v / width))
    b.output("x", x)
    return b.model()


def laid(made, width, length=None):
    """The steps of a record of 3 s, in intervals of so many samples."""
    model = rubbing(width)
    time = np.arange(151) * 0.02
    grid = made.grid(np.sin(2 * time), step=0.02, start=0.0)
    z = ca.SX.sym("z", 1)
    plan = cut(grid, length)
    propagator = RungeKuttaPropagator(
        model, grid, plan, z, z, scale=made.scale(model), fineness=Fineness(RADAU, np.ones(150, np.intp))
    )
    steps = propagator._sweeps
    begun = np.full((2, steps.layout.steps + steps.layout.intervals), np.nan)
    begun[:, steps.layout.at[0]] = np.tile((STARTS / made.scale(model))[:, None], (1, plan.m))
    return steps, begun


@pytest.mark.parametrize("iterations", [6, 3, 1])
@pytest.mark.parametrize("length", [None, 40])
@pytest.mark.parametrize("width", [0.1, 1e-4])
def test_every_step_is_that_of_newtons_method_by_arrays(made, monkeypatch, width, length, iterations):
    """Where few iterations do not arrive, too: steps over a bend are then made one by one, or all of them by arrays."""
    monkeypatch.setattr(newton_machine, "_FIXED", iterations)
    steps, begun = laid(made, width, length)
    wanted, stages = steps._newton(VALUES, begun.copy())
    real, asked = sweeps.stages_of, []
    monkeypatch.setattr(sweeps, "stages_of", lambda *given: asked.append(1) or real(*given))
    found, at_stage = steps._in_turn(VALUES, begun.copy())
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-13)
    np.testing.assert_allclose(at_stage, stages, rtol=0, atol=1e-13)
    if iterations == 6:  # a step over a sharp bend is looked at by itself
        assert len(asked) <= (0 if width == 0.1 else 2)
    elif width == 0.1:
        assert asked
    assert steps._bent == (iterations == 1)


def test_steps_that_are_too_often_left_are_no_longer_begun_by_the_machine(made, monkeypatch):
    monkeypatch.setattr(newton_machine, "_FIXED", 1)
    steps, begun = laid(made, 0.1)
    nodes = begun[:, steps.layout.at[0]].T
    steps.run(VALUES, nodes)
    monkeypatch.setattr(sweeps.Sweeps, "_in_turn", lambda *_: pytest.fail("begun"))
    assert np.isfinite(steps.run(VALUES, nodes)[0]).all()


def test_few_intervals_are_run_so_and_many_by_arrays(made, monkeypatch):
    chosen = []
    for way in ("_newton", "_in_turn"):
        monkeypatch.setattr(sweeps.Sweeps, way, lambda self, *given, way=way: chosen.append(way))
    for length in (None, 5):
        steps, begun = laid(made, 0.1, length)
        steps.run(VALUES, begun[:, steps.layout.at[0]].T)
    assert chosen == ["_in_turn", "_newton"]


@np.errstate(all="ignore")
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e308])
def test_where_newtons_method_fails_there_are_no_states(made, value):
    steps, begun = laid(made, 0.1)
    first = steps.layout.at[0]
    for way in (steps._newton, steps._in_turn):
        found, _ = way(np.array([value]), begun.copy())
        assert np.isfinite(found[:, first]).all()
        assert not np.isfinite(found[:, steps.layout.after]).any()


def test_a_step_with_a_singular_matrix_is_left_to_the_arrays(made, monkeypatch):
    steps, begun = laid(made, 0.1)
    wanted, _ = steps._newton(VALUES, begun.copy())
    real, left = sweeps.newton_steps(steps.slope, RADAU, 32), [3]

    def singular(*given):
        left[0] -= 1
        if left[0] >= 0:
            raise RuntimeError("singular")
        return real(*given)

    monkeypatch.setattr(sweeps, "newton_steps", lambda *_: singular)
    found, _ = steps._in_turn(VALUES, begun)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-13)


def test_a_singular_matrix_is_an_error_of_the_machine():
    """Which solver of CasADi's one takes decides it."""
    matrix, right = ca.MX.sym("matrix", 2, 2), ca.MX.sym("right", 2)
    solve = ca.Function("solve", [matrix, right], [ca.solve(matrix, right, "qr")])
    with pytest.raises(RuntimeError):
        solve(np.ones((2, 2)), np.ones(2))

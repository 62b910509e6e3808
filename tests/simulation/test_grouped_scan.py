"""Scans by groups of columns against the plain recursion."""

import numpy as np
import pytest

from casadi_engine.simulation.grouped_scan import Pushed, constant_scan, varying_scan

N, NY, K = 4, 2, 7


def problem(count, *, steps, seed=0):
    """Matrices of a recursion that neither grows nor dies, forces in groups of columns, and the plain recursion."""
    rng = np.random.default_rng(seed)
    f = np.eye(N) + 0.05 * rng.standard_normal((steps, N, N)) - 0.05 * np.eye(N)
    c = rng.standard_normal((1 if steps == 1 else count + 1, NY, N))
    start = rng.standard_normal((N, K))
    groups = [
        Pushed(np.array([0, 3, 4]), rng.standard_normal((steps, N, 2)), rng.standard_normal((2, 3, count))),
        Pushed(np.array([1, 6]), rng.standard_normal((steps, N, 5)), rng.standard_normal((5, 2, count))),
        Pushed(np.array([2, 5]), np.zeros((steps, N, 0)), np.zeros((0, 2, count))),
    ]
    state, shown = start.copy(), []
    for k in range(count + 1):
        at = 0 if steps == 1 else k
        shown.append(c[at] @ state)
        if k < count:
            after = f[at] @ state
            for one in groups:
                after[:, one.columns] += one.turn[at] @ one.force[:, :, k]
            state = after
    return f, c, groups, start, np.array(shown), state


@pytest.mark.parametrize("count", [1, 2, 9, 10, 99, 100, 103])
@pytest.mark.parametrize("cached", [1, 40_000])
def test_constant_steps(count, cached, monkeypatch):
    monkeypatch.setattr("casadi_engine.simulation.grouped_scan._CACHED", cached)
    f, c, groups, start, shown, state = problem(count, steps=1)
    out, end = constant_scan(f[0], c[0], groups, start, count)
    assert out == pytest.approx(shown, abs=1e-11 * np.abs(shown).max())
    assert end == pytest.approx(state, abs=1e-11 * np.abs(state).max())


@pytest.mark.parametrize("count", [2, 10, 103])
@pytest.mark.parametrize("together", [1, 96])
def test_varying_steps(count, together, monkeypatch):
    monkeypatch.setattr("casadi_engine.simulation.grouped_scan._TOGETHER", together)
    f, c, groups, start, shown, state = problem(count, steps=count)
    out, end = varying_scan(f, c, groups, start)
    assert out == pytest.approx(shown, abs=1e-11 * np.abs(shown).max())
    assert end == pytest.approx(state, abs=1e-11 * np.abs(state).max())

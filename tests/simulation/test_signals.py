"""The combinations of states that laws depend on."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.simulation.signals import lift, signals

X, P = ca.SX.sym("x", 4), ca.SX.sym("p", 2)

CASES = {
    "a difference": (ca.tanh((X[1] - X[0]) / 0.1), [[1, -1, 0, 0]]),
    "a sum behind a known term": (ca.sin(P[0] + X[0] + X[1] + X[2]), [[1, 1, 1, 0]]),
    "the same twice": (ca.sin(2 * (X[1] - X[0])) + (X[0] - X[1]) ** 3, [[1, -1, 0, 0]]),
    "a product of two": ((X[3] + X[2]) * (X[0] - X[1]), [[0, 0, 1, 1], [1, -1, 0, 0]]),
    "factors that are parameters": (ca.tanh(P[0] * X[0] + P[1] * X[1]), [[1, 0, 0, 0], [0, 1, 0, 0]]),
    "divided by a number and negated": (ca.exp(-(X[2] - X[3]) / 4), [[0, 0, 1, -1]]),
    "a branch": (ca.if_else(X[0] > 1, X[1], 2 * X[1]), [[1, 0, 0, 0], [0, 1, 0, 0]]),
    "affine": (3 * X[0] + 1, [[1, 0, 0, 0]]),
    "none": (P[0] ** 2, np.zeros((0, 4))),
}


@pytest.mark.parametrize("name", CASES)
def test_signals_are_the_combinations_that_enter_nonlinear_operations(name):
    expression, wanted = CASES[name]
    found = signals(expression, X, P)
    wanted = np.array(wanted, dtype=float)
    assert found.shape == wanted.shape
    if len(wanted):
        # the same space, whatever the order
        assert np.linalg.matrix_rank(np.vstack([found, wanted])) == len(wanted)


@pytest.mark.parametrize("name", [name for name in CASES if name != "none"])
def test_a_law_written_in_its_signals_is_the_same(name):
    expression, _ = CASES[name]
    rows = signals(expression, X, P)
    thinned = ca.substitute(expression, X, ca.DM(lift(rows) @ rows) @ X)
    values = ca.Function("values", [X, P], [expression, thinned])
    for seed in range(5):
        point = np.random.default_rng(seed).normal(size=4)
        one, other = (float(part) for part in values(point, [0.7, 1.3]))
        assert one == pytest.approx(other, rel=1e-13)


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 4), st.integers(0, 10**6))
def test_the_lift_is_a_right_inverse_with_as_few_states_as_signals(count, seed):
    rows = np.random.default_rng(seed).integers(-2, 3, size=(count, 5)).astype(float)
    if np.linalg.matrix_rank(rows) < count:
        return
    inverse = lift(rows)
    np.testing.assert_allclose(rows @ inverse, np.eye(count), atol=1e-9)
    assert np.count_nonzero(inverse.any(axis=1)) <= count

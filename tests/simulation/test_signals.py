"""The combinations of states that laws depend on."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_engine.simulation.signals import in_signals

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
    found, symbols, _ = in_signals(expression, X, P)
    wanted = np.array(wanted, dtype=float)
    assert found.shape == wanted.shape
    assert symbols.shape == (len(wanted), 1)
    if len(wanted):
        # the same space, whatever the order
        assert np.linalg.matrix_rank(np.vstack([found, wanted])) == len(wanted)


@pytest.mark.parametrize("name", CASES)
def test_a_law_written_in_its_signals_is_the_same(name):
    expression, _ = CASES[name]
    rows, symbols, written = in_signals(expression, X, P)
    assert not ca.depends_on(written, X)
    back = ca.substitute(written, symbols, ca.DM(rows) @ X) if len(rows) else written
    values = ca.Function("values", [X, P], [expression, back])
    for seed in range(5):
        point = np.random.default_rng(seed).normal(size=4)
        one, other = (float(part) for part in values(point, [0.7, 1.3]))
        assert one == pytest.approx(other, rel=1e-13)


def test_each_of_several_laws_depends_on_its_own_signals_only():
    # Angles along a shaft: sums of more and more twists, which share states but not signals.
    laws = ca.vertcat(ca.sin(X[0]), ca.sin(X[0] + X[1]), ca.sin(P[0] + X[0] + X[1] + X[2]) * X[3])
    rows, symbols, written = in_signals(laws, X, P)
    pattern = np.array(ca.DM(ca.jacobian_sparsity(written, symbols), 1)) if len(rows) else None
    np.testing.assert_array_equal(pattern, [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1]])


def test_a_combination_of_known_signals_is_no_new_one():
    laws = ca.vertcat(ca.sin(X[0] + X[1]), ca.sin(X[0] - X[1]), ca.sin(3 * X[0]))
    rows, symbols, written = in_signals(laws, X, P)
    assert len(rows) == 2
    back = ca.Function("back", [X], [ca.substitute(written, symbols, ca.DM(rows) @ X)])
    np.testing.assert_allclose(
        np.array(back([0.3, -0.8, 0, 0])).ravel(), np.sin([-0.5, 1.1, 0.9]), rtol=1e-13
    )

"""Laws on arrays: torques, slopes and curvature against CasADi's own, with channels, time and parameters in them."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.laws import Laws

X, U, T, P, Z = (
    ca.SX.sym("x", 3), ca.SX.sym("u", 2), ca.SX.sym("t"), ca.SX.sym("p", 3), ca.SX.sym("z", 4),
)  # fmt: skip
PHYSICAL = ca.vertcat(Z[1] ** 2, ca.exp(Z[3]), Z[0] + Z[1])
LAWS = ca.vertcat(
    P[0] * ca.tanh((X[1] - X[0]) / 0.2),
    -P[1] * X[2] ** 3 * U[0],
    ca.sin(X[0] + U[1]) * ca.cos(T) + (X[1] - X[0]) ** 2,
)
SCALE = np.array([2.0, 0.5, 3.0])


def made_laws(groups):
    return Laws((X, U, T, P), LAWS, groups, Z, PHYSICAL, SCALE)


@pytest.fixture
def sampled(made):
    """Laws, two of them in one group, on the steps of two intervals."""
    laws = made_laws([(0, 1), (2,)])
    rng = np.random.default_rng(0)
    grid = made.grid(rng.normal(size=(2, 9)), step=0.1, holds=("first", "zero"))
    plan = Intervals(2, 1, 4, np.arange(4))
    return laws, grid, plan


def test_laws_that_act_alike_are_one_and_know_their_signals_and_parameters():
    laws = made_laws([(0, 1), (2,)])
    assert (laws.count, laws.size) == (2, 3)
    assert laws.active.tolist() == [1, 3]
    # Scaled by the states' sizes, the largest factor of a signal is 1.
    np.testing.assert_allclose(np.abs(laws.q).max(axis=1), 1.0)
    assert [(law, first) for law, _, first in laws.pattern] == [(0, True), (0, False), (1, True), (1, False)]


@pytest.mark.parametrize("substeps", [1, 3])
def test_torques_slopes_and_curvature_equal_casadis(sampled, substeps):
    laws, grid, plan = sampled
    given = laws.given(grid, plan, substeps)
    z, rng = np.array([0.4, 1.2, 9.0, -0.3]), np.random.default_rng(1)
    held = ca.substitute(LAWS, P, PHYSICAL)
    value = ca.Function("value", [X, U, T, Z], [ca.vertcat(held[0] + held[1], held[2])])
    for step, node, interval in ((0, 0, 0), (1, 1, 1), (4 * substeps - 1, 2, 1), (2, 1, 0)):
        # Where in the record this is, and what the channels are there: a straight line and a stair.
        place = interval * 4 + (step + (0.0, 0.5, 1.0)[node]) / substeps
        sample = interval * 4 + step // substeps
        u = [np.interp(place, np.arange(9), grid.channels[0]), grid.channels[1, sample]]
        t = grid.start + 0.1 * place
        x = rng.normal(size=3)
        s, known = laws.q @ x, given[step, node][:, [interval]]
        wanted = np.array(value(x * SCALE, u, t, z)).ravel()
        np.testing.assert_allclose(laws.torques(z)(s[:, None], known)[0][:, 0], wanted, rtol=1e-12)
        by_signal, by_z = laws.slopes(s[:, None], known, z)
        slope = np.zeros((2, laws.size))
        for row, (law, signal, _) in enumerate(laws.pattern):
            slope[law, signal] = by_signal[row, 0]
        shifted = ca.substitute(ca.vertcat(held[0] + held[1], held[2]), X, ca.DM(SCALE) * X)
        first = ca.Function("first", [X, U, T, Z], [ca.jacobian(shifted, X), ca.jacobian(shifted, Z)])
        in_x, in_z = (np.array(part) for part in first(x, u, t, z))
        np.testing.assert_allclose(slope @ laws.q, in_x, rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(by_z[:, :, 0].T, in_z[:, laws.active], rtol=1e-12, atol=1e-13)
        omega = rng.normal(size=2)
        bends = laws.curvature(s[:, None], known, z, omega[:, None])[:, 0]
        lift = np.zeros((laws.size + 2, 7))
        lift[: laws.size, :3] = laws.q
        lift[laws.size, 3 + laws.active[0]] = lift[laws.size + 1, 3 + laws.active[1]] = 1.0
        full = np.zeros((laws.size + 2,) * 2)
        for a, b, bend in zip(*laws.bends, bends, strict=True):
            full[a, b] = full[b, a] = bend
        both = ca.vertcat(X, Z)
        hessian = ca.Function("hessian", [X, U, T, Z], [ca.hessian(ca.dot(ca.DM(omega), shifted), both)[0]])
        np.testing.assert_allclose(
            lift.T @ full @ lift, np.array(hessian(x, u, t, z)), rtol=1e-10, atol=1e-10
        )

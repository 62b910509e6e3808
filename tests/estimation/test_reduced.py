"""The condensed step's dense problem: elimination of initial states, and the trust region, against dense algebra."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq, minimize

from casadi_engine.estimation.condensing import Condensed
from casadi_engine.estimation.reduced import Reduced, trust_step


def positive(rng, size):
    root = rng.standard_normal((size, size))
    return root @ root.T + 0.2 * np.eye(size)


def several(seed, nv=4, sizes=((2, 3), (4, 2))):
    """Random shares of records with (active parameters, states), the whole Hessian and gradient in [dv; ds; ds]."""
    rng = np.random.default_rng(seed)
    zz = positive(rng, nv)
    nw = nv + sum(n for _, n in sizes)
    dense, slope = np.zeros((nw, nw)), rng.standard_normal(nw)
    dense[:nv, :nv] = zz
    shares, actives, at = [], [], nv
    for na, n in sizes:
        active = np.sort(rng.choice(nv, na, replace=False))
        own = positive(rng, na + n)
        dense[np.ix_(active, active)] += own[:na, :na]
        dense[active, at : at + n] = own[:na, na:]
        dense[at : at + n, active] = own[na:, :na]
        dense[at : at + n, at : at + n] = own[na:, na:]
        gradient = np.concatenate([np.zeros(na), slope[at : at + n]])
        shares.append(Condensed(np.zeros((1, n, na + n)), np.zeros((1, n)), own, gradient))
        actives.append(active)
        zz = zz.copy()
        zz[np.ix_(active, active)] += own[:na, :na]  # as the caller adds the records' own part
        at += n
    return zz, slope, shares, actives, dense


def quadratic(matrix, gradient):
    """A reduced problem without initial states."""
    return Reduced(matrix, gradient, np.ones(len(gradient), bool), (), 0.0, False)


@pytest.mark.parametrize("held", [(), (1,), (0, 4, 5), (4, 5, 6, 7, 8), (0, 1, 2, 3)])
def test_newton_by_elimination_is_the_dense_solution(held):
    zz, slope, shares, actives, dense = several(0)
    fixed = np.zeros(len(slope), bool)
    fixed[list(held)] = True
    step = Reduced.of(zz, slope, shares, actives, fixed).newton()
    expected = np.zeros(len(slope))
    expected[~fixed] = -np.linalg.solve(dense[np.ix_(~fixed, ~fixed)], slope[~fixed])
    np.testing.assert_allclose(step, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(step[fixed], 0)


def test_a_long_radius_gives_newtons_step_and_its_fall():
    zz, slope, shares, actives, dense = several(1)
    reduced = Reduced.of(zz, slope, shares, actives, np.zeros(len(slope), bool))
    step, fall, inside = trust_step(reduced, 1e6)
    assert inside
    np.testing.assert_allclose(step, -np.linalg.solve(dense, slope), rtol=1e-8)
    assert fall == pytest.approx(-(slope @ step + 0.5 * step @ dense @ step), rel=1e-9)


def test_a_short_radius_gives_the_best_step_within_it():
    zz, slope, shares, actives, dense = several(2)
    reduced = Reduced.of(zz, slope, shares, actives, np.zeros(len(slope), bool))
    radius = 0.3 * np.linalg.norm(np.linalg.solve(dense, slope)[:4])
    step, fall, inside = trust_step(reduced, radius)
    assert not inside
    assert np.linalg.norm(step[:4]) == pytest.approx(radius, rel=0.051)

    def value(w):
        return slope @ w + 0.5 * w @ dense @ w

    assert fall == pytest.approx(-value(step), rel=1e-9)
    best = minimize(
        value,
        np.zeros(len(slope)),
        jac=lambda w: slope + dense @ w,
        constraints={"type": "ineq", "fun": lambda w: step[:4] @ step[:4] - w[:4] @ w[:4]},
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )
    assert value(step) == pytest.approx(best.fun, rel=1e-6)


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 6), st.floats(1e-3, 10), st.booleans())
def test_the_trust_step_solves_the_secular_equation(seed, size, radius, definite):
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.standard_normal((size, size)))[0]
    values = rng.uniform(0.1, 5, size) if definite else rng.uniform(-3, 5, size)
    matrix, gradient = (basis * values) @ basis.T, rng.standard_normal(size)
    matrix = (matrix + matrix.T) / 2
    step, fall, inside = trust_step(quadratic(matrix, gradient), radius)

    def length(shift):
        return np.linalg.norm(np.linalg.solve(matrix + shift * np.eye(size), gradient))

    newton = values.min() > 0 and length(0.0) <= radius
    assert inside == newton
    assert fall == pytest.approx(-(gradient @ step + 0.5 * step @ matrix @ step), rel=1e-6, abs=1e-12)
    if newton:
        np.testing.assert_allclose(matrix @ step, -gradient, rtol=1e-7, atol=1e-9)
        return
    least = max(0.0, -float(np.linalg.eigvalsh(matrix)[0]))
    assume(length(least + 1e-9) > radius)  # else it is the hard case, below
    shift = brentq(lambda s: length(s) - radius, least + 1e-9, least + np.linalg.norm(gradient) / radius + 1)
    best = -np.linalg.solve(matrix + shift * np.eye(size), gradient)
    assert np.linalg.norm(step) == pytest.approx(radius, rel=0.051)
    at_best = gradient @ best + 0.5 * best @ matrix @ best
    assert -fall <= at_best + 0.11 * abs(at_best)
    # optimality: (matrix + shift) step = -gradient for one shift that makes the matrix positive
    own = -(gradient + matrix @ step) @ step / (step @ step)
    assert own >= least - 1e-6
    np.testing.assert_allclose(matrix @ step + own * step, -gradient, atol=1e-5 * np.linalg.norm(gradient))


def test_a_saddle_without_slope_is_left_along_its_falling_direction():
    # the hard case: the gradient says nothing of the direction in which the matrix bends down
    matrix, gradient = np.diag([-1.0, 2.0]), np.array([0.0, 0.5])
    step, fall, inside = trust_step(quadratic(matrix, gradient), 1.0)
    assert not inside
    assert np.linalg.norm(step) == pytest.approx(1.0, rel=1e-6)
    assert step[1] == pytest.approx(-0.5 / 3, rel=1e-6)
    assert fall == pytest.approx(-(gradient @ step + 0.5 * step @ matrix @ step), rel=1e-9)
    assert fall > 0.5


def test_what_the_data_do_not_tell_stays():
    step, _, _ = trust_step(quadratic(np.diag([2.0, 0.0]), np.array([1.0, 0.0])), 10.0)
    np.testing.assert_allclose(step, [-0.5, 0.0], atol=1e-12)


def test_an_initial_state_that_bends_down_is_said_so():
    zz, slope, shares, actives, _ = several(3)
    n = 3
    own = shares[0].hessian.copy()
    own[-n:, -n:] = np.diag([-1.0, 2.0, 3.0])
    shares[0] = Condensed(shares[0].turn, shares[0].shift, own, shares[0].gradient)
    reduced = Reduced.of(zz + 20 * np.eye(4), slope, shares, actives, np.zeros(len(slope), bool))
    assert reduced.bent
    _, fall, inside = trust_step(reduced, 1e6)
    assert not inside
    assert fall > 0


def test_newton_is_refused_where_the_matrix_is_not_positive():
    assert quadratic(np.diag([1.0, -1.0]), np.ones(2)).newton() is None
    assert trust_step(quadratic(np.diag([1.0, np.nan]), np.ones(2)), 1.0) is None


def test_without_open_parameters_the_initial_states_alone_move():
    zz, slope, shares, actives, dense = several(4)
    held = np.zeros(len(slope), bool)
    held[:4] = True
    reduced = Reduced.of(zz, slope, shares, actives, held)
    step, fall, inside = trust_step(reduced, 1e-3)
    expected = -np.linalg.solve(dense[4:, 4:], slope[4:])
    np.testing.assert_allclose(step[4:], expected, rtol=1e-9)
    np.testing.assert_allclose(reduced.newton(), step)
    assert inside
    assert fall == pytest.approx(-0.5 * slope[4:] @ expected, rel=1e-9)

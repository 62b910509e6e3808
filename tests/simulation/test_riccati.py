"""The stationary predictor against SciPy, a long Riccati recursion, and differences; noise of a step by quadrature."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad_vec
from scipy.linalg import expm, solve_discrete_are, solve_discrete_lyapunov

from casadi_engine.simulation import jets
from casadi_engine.simulation.riccati import kalman, lyapunov, over_steps, riccati, step_noise


def system(rng, n, ny, *, radius=0.95):
    """A random A of this spectral radius, C, Q of rank n or less, R."""
    a = rng.normal(size=(n, n))
    a *= radius / np.abs(np.linalg.eigvals(a)).max()
    g = rng.normal(size=(n, max(1, n - 1)))
    v = rng.normal(size=(ny, ny))
    return a, rng.normal(size=(ny, n)), g @ g.T, v @ v.T + 0.1 * np.eye(ny)


def curve(rng, value, d, size=0.3):
    """A jet with random derivatives and the quadratic function of z with it."""
    jet = size * rng.normal(size=(jets.count(d, 2), *value.shape)) * np.abs(value).max()
    jet[0] = value
    if value.shape[0] == value.shape[1] and np.array_equal(value, value.T):
        jet = (jet + jet.transpose(0, 2, 1)) / 2
    i, j = jets.pairs(d)

    def at(z):
        total = jet[0] + np.tensordot(z, jet[1 : 1 + d], 1)
        factor = np.where(i == j, 0.5, 1.0) * z[i] * z[j]
        return total + np.tensordot(factor, jet[1 + d :], 1)

    return jet, at


def moved(f, d, *, step):
    """First and second central differences, in the order of a jet."""
    e = step * np.eye(d)
    i, j = jets.pairs(d)
    first = [(f(e[k]) - f(-e[k])) / (2 * step) for k in range(d)]
    second = [
        (f(e[a] + e[b]) - f(e[a] - e[b]) - f(e[b] - e[a]) + f(-e[a] - e[b])) / (4 * step**2)
        for a, b in zip(i, j, strict=True)
    ]
    return np.array(first), np.array(second)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 10**6), st.integers(1, 8), st.integers(1, 3), st.sampled_from([0.5, 0.99, 1.0, 1.3]))
def test_the_solution_is_scipys(seed, n, ny, radius):
    a, c, q, r = system(np.random.default_rng(seed), n, ny, radius=radius)
    p = riccati(a, c, q, r)
    wanted = solve_discrete_are(a.T, c.T, q, r)
    np.testing.assert_allclose(p, wanted, rtol=1e-6, atol=1e-7 * np.abs(wanted).max())
    s = c @ p @ c.T + r
    rest = a @ p @ a.T - p + q - a @ p @ c.T @ np.linalg.solve(s, c @ p @ a.T)
    assert np.abs(rest).max() < 1e-11 * np.abs(p).max()


def test_slow_modes_at_a_high_rate_equal_a_long_recursion():
    # two masses at 14 402 Hz: all eigenvalues lie within 0.01 of the unit circle
    je, jl, k, c, e = 1 / 2.557, 1 / 5.646, 1992.0, 2.5, 0.1541
    ac = np.array([[-(c + e) / je, c / je, k / je], [c / jl, -c / jl, -k / jl], [-1, 1, 0]])
    a, q = expm(ac / 14402), np.diag([4.0, 1.0, 0.0]) / 14402
    out, r = np.array([[1.0, 0, 0]]), np.array([[0.01]])
    p = np.zeros((3, 3))
    for _ in range(30000):
        k = a @ p @ out.T / (out @ p @ out.T + r)
        p = (a - k @ out) @ p @ (a - k @ out).T + k @ r @ k.T + q
    np.testing.assert_allclose(riccati(a, out, q, r), p, rtol=1e-8, atol=1e-9 * np.abs(p).max())


def test_without_process_noise_a_stable_model_needs_no_correction():
    a = np.array([[0.9, 0.2], [-0.1, 0.8]])
    found = kalman(a[None], np.array([[[1.0, 0.0]]]), np.zeros((1, 2, 2)), np.eye(1)[None], 0)
    assert not found.lift.any()
    np.testing.assert_array_equal(found.innovation[0], np.eye(1))


@pytest.mark.parametrize(
    ("a", "c", "q"),
    [
        (np.diag([1.1, 0.5]), [[0.0, 1.0]], np.eye(2)),  # grows unseen
        (np.diag([1.0, 0.5]), [[0.0, 1.0]], np.eye(2)),  # on the circle, driven, unseen
    ],
)
def test_there_is_no_solution(a, c, q):
    with pytest.raises(FloatingPointError, match="no stabilising solution"):
        riccati(a, np.array(c), q, np.eye(1))


def test_lyapunov_is_scipys_and_refuses_what_grows():
    rng = np.random.default_rng(0)
    f = system(rng, 5, 1, radius=0.999)[0]
    w = rng.normal(size=(4, 5, 5))
    found = lyapunov(f, w)
    for one, right in zip(found, w, strict=True):
        np.testing.assert_allclose(one, solve_discrete_lyapunov(f, right), rtol=1e-8)
    with pytest.raises(FloatingPointError, match="not stable"):
        lyapunov(f * 1.1, w)


@pytest.mark.parametrize(("n", "ny", "d"), [(1, 1, 1), (3, 1, 2), (3, 2, 3), (5, 2, 2)])
def test_derivatives_of_the_predictor_equal_differences(n, ny, d):
    rng = np.random.default_rng(10 * n + ny)
    parts = [curve(rng, part, d, 0.2) for part in system(rng, n, ny)]
    found = kalman(*(jet for jet, _ in parts), d)

    def at(z):
        one = kalman(*(f(z)[None] for _, f in parts), 0)
        return np.concatenate([one.lift[0].ravel(), one.innovation[0].ravel(), one.error[0].ravel()])

    flat = np.concatenate(
        [part.reshape(len(part), -1) for part in (found.lift, found.innovation, found.error)], axis=1
    )
    np.testing.assert_allclose(flat[0], at(np.zeros(d)), rtol=1e-10, atol=1e-12)
    first, _ = moved(at, d, step=1e-5)
    _, second = moved(at, d, step=3e-4)
    np.testing.assert_allclose(flat[1 : 1 + d], first, rtol=1e-5, atol=1e-6 * np.abs(first).max())
    np.testing.assert_allclose(flat[1 + d :], second, rtol=1e-3, atol=1e-4 * np.abs(second).max())
    lower = kalman(*(jet[: 1 + d] for jet, _ in parts), d)
    np.testing.assert_allclose(lower.lift, found.lift[: 1 + d], rtol=1e-12)


@pytest.mark.parametrize("step", [1e-3, 0.4, 7.0])
def test_noise_of_a_step_equals_quadrature_and_differences(step):
    rng = np.random.default_rng(3)
    g = rng.normal(size=(3, 2))
    a, at_a = curve(rng, rng.normal(size=(3, 3)) - 2 * np.eye(3), 2)
    s, at_s = curve(rng, 40 * g @ g.T, 2)

    def at(z):
        matrix, density = at_a(z), at_s(z)
        return quad_vec(
            lambda t: expm(matrix * t) @ density @ expm(matrix.T * t), 0, step, epsabs=1e-13, epsrel=1e-12
        )[0]

    found = step_noise(a, s, step, 2)
    wanted = at(np.zeros(2))
    np.testing.assert_allclose(found[0], wanted, rtol=1e-9, atol=1e-10 * np.abs(wanted).max())
    first, second = moved(lambda z: step_noise(at_a(z)[None], at_s(z)[None], step, 0)[0], 2, step=1e-4)
    np.testing.assert_allclose(found[1:3], first, rtol=1e-5, atol=1e-5 * np.abs(first).max())
    np.testing.assert_allclose(found[3:], second, rtol=1e-3, atol=1e-4 * np.abs(second).max())


@pytest.mark.parametrize("steps", [1, 2, 5, 20])
def test_many_steps_are_one_after_the_other(steps):
    rng = np.random.default_rng(4)
    a, q = curve(rng, system(rng, 3, 1)[0], 2)[0], curve(rng, np.diag([1.0, 2.0, 0.0]), 2)[0]
    power, spread = over_steps(a, q, steps, 2)
    one, total = jets.constant(np.eye(3), 2, 2), np.zeros_like(q)
    for _ in range(steps):
        total = jets.product(jets.product(a, total, 2), jets.transpose(a), 2) + q
        one = jets.product(a, one, 2)
    np.testing.assert_allclose(power, one, atol=1e-12)
    np.testing.assert_allclose(spread, total, atol=1e-12)


def test_jets_of_inverse_and_factor():
    rng = np.random.default_rng(5)
    value = rng.normal(size=(3, 3))
    x, _ = curve(rng, value @ value.T + np.eye(3), 3)
    identity = jets.constant(np.eye(3), 3, 2)
    np.testing.assert_allclose(jets.product(x, jets.inverse(x, 3), 3), identity, atol=1e-10)
    factor = jets.cholesky(x, 3)
    np.testing.assert_allclose(jets.product(factor, jets.transpose(factor), 3), x, atol=1e-12)
    np.testing.assert_array_equal(factor, np.tril(factor))

"""The variational equation against expm, quad precision sums and a general integrator."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from casadi_engine.simulation.variational import balance, phi_functions, scan, step_matrices


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.3, 4.0, 12.0])
def test_phi_functions_are_blocks_of_a_matrix_exponential(size):
    rng = np.random.default_rng(3)
    z = rng.standard_normal((4, 3, 3)) * size
    found = phi_functions(z)
    for k in range(4):
        big = np.zeros((12, 12))
        big[:3, :3] = z[k]
        for block in range(3):
            big[3 * block : 3 * block + 3, 3 * block + 3 : 3 * block + 6] = np.eye(3)
        exact = expm(big)[:3]
        for order, phi in enumerate(found):
            wanted = exact[:, 3 * order : 3 * order + 3]
            assert np.abs(phi[k] - wanted).max() <= 1e-12 * max(1.0, np.abs(wanted).max())


def test_a_constant_matrix_and_a_parabola_are_solved_exactly():
    a = np.array([[[-0.3, 2.0], [-5.0, -0.1]]])
    c0, c1, c2 = np.array([[1.0], [0.5]]), np.array([[-2.0], [1.0]]), np.array([[0.7], [-3.0]])
    h = 0.4

    def g(t):
        return c0 + c1 * t + c2 * t * t

    steps = step_matrices(a, a, a, h)
    end = (steps.f @ np.ones((2, 1)) + steps.start @ g(0) + steps.middle @ g(h / 2) + steps.end @ g(h))[0]
    exact = solve_ivp(
        lambda t, s: a[0] @ s + g(t)[:, 0], (0, h), np.ones(2), "DOP853", rtol=1e-13, atol=1e-14
    )
    assert end[:, 0] == pytest.approx(exact.y[:, -1], rel=1e-10)


def test_a_moving_matrix_is_solved_to_fourth_order():
    def a(t):
        return np.array([[-0.2, 1 + np.sin(3 * t)], [-2 * np.cos(t), -0.4 * t]])

    def g(t):
        return np.array([np.sin(5 * t), np.exp(-t)])

    exact = solve_ivp(lambda t, s: a(t) @ s + g(t), (0, 2), [1.0, -1.0], "DOP853", rtol=1e-12, atol=1e-13)
    errors = []
    for count in (40, 80):
        h = 2 / count
        low = np.arange(count) * h
        matrices = [np.array([a(t) for t in low + share * h]) for share in (0, 0.5, 1)]
        steps = step_matrices(*matrices, h)
        forces = [np.array([g(t) for t in low + share * h])[:, :, None] for share in (0, 0.5, 1)]
        push = steps.start @ forces[0] + steps.middle @ forces[1] + steps.end @ forces[2]
        states = scan(steps.f, push, np.array([[1.0], [-1.0]]))
        errors.append(np.abs(states[-1, :, 0] - exact.y[:, -1]).max())
    assert errors[1] < 1e-5
    assert errors[0] / errors[1] > 12


@pytest.mark.parametrize("count", [1, 2, 7, 50])
@pytest.mark.parametrize("moving", [True, False])
def test_the_scan_is_the_recursion(count, moving):
    rng = np.random.default_rng(count)
    f = 0.6 * rng.standard_normal((count if moving else 1, 3, 3))
    push, start = rng.standard_normal((count, 3, 4)), rng.standard_normal((3, 4))
    states = [start]
    for k in range(count):
        states.append(f[k if moving else 0] @ states[-1] + push[k])
    assert scan(f, push, start) == pytest.approx(np.array(states), rel=1e-12, abs=1e-12)


def test_balancing_makes_a_stiff_spring_small():
    a = np.array([[[0.0, 3e7], [-1.0, 0.0]]])
    scale = balance(a)
    assert np.abs(a / scale[:, None] * scale).sum(axis=1).max() < 2e4


def test_an_infinite_slope_says_nothing_of_the_sizes_of_states():
    """That of a root at 0: a bare ValueError of the balance ended the search."""
    plain = np.array([[[-1.0, 100.0], [0.01, -2.0]]] * 2)
    wild = plain.copy()
    wild[1, 0, 0] = np.inf
    np.testing.assert_allclose(balance(wild), balance(plain))

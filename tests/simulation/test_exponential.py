"""phi functions and transitions against SciPy and scalars, and their derivatives."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.linalg

from casadi_engine.simulation import jets
from casadi_engine.simulation.exponential import balance, phi_functions, transition


def wanted(z):
    """phi_0, phi_1, phi_2 as blocks of the exponential of an augmented matrix."""
    n = len(z)
    eye, none = np.eye(n), np.zeros((n, n))
    big = scipy.linalg.expm(np.block([[z, eye, none], [none, none, eye], [none, none, none]]))
    return big[:n, :n], big[:n, n : 2 * n], big[:n, 2 * n :]


def matrix(seed, n, size):
    z = np.random.default_rng(seed).normal(size=(n, n))
    return z * size / np.abs(z).sum(axis=0).max()


def value(z):
    return [phi[0] for phi in phi_functions(np.asarray(z, dtype=float)[None], 0)]


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-6, 1e-3, 0.3, 0.5, 0.51, 1.0, 3.0, 8.0, 30.0])
@pytest.mark.parametrize("n", [1, 2, 5])
def test_phi_functions_equal_scipys(n, size):
    z = matrix(n, n, size)
    for found, target in zip(value(z), wanted(z), strict=True):
        np.testing.assert_allclose(found, target, atol=1e-12 * max(1.0, np.abs(target).max()), rtol=0)


@pytest.mark.parametrize("a", [-700.0, -40.0, -3.0, -1e-2, -1e-9, 1e-9, 1e-2, 3.0, 40.0])
def test_phi_functions_of_a_number(a):
    found = [phi.item() for phi in value([[a]])]
    assert found[0] == pytest.approx(math.exp(a), rel=abs(a) * 1e-15 + 1e-15)
    assert found[1] == pytest.approx(math.expm1(a) / a, rel=1e-13)
    if abs(a) > 1e-3:
        assert found[2] == pytest.approx((math.expm1(a) / a - 1) / a, rel=1e-12)
    else:
        assert found[2] == pytest.approx(0.5 + a / 6, rel=1e-5)


def test_phi_functions_of_zero_and_of_a_nilpotent_matrix():
    for phi, target in zip(value(np.zeros((2, 2))), (1.0, 1.0, 0.5), strict=True):
        np.testing.assert_array_equal(phi, target * np.eye(2))
    phi0, phi1, phi2 = value([[0.0, 1e6], [0.0, 0.0]])
    np.testing.assert_allclose(phi0, [[1, 1e6], [0, 1]], rtol=1e-14)
    np.testing.assert_allclose(phi1, [[1, 0.5e6], [0, 1]], rtol=1e-14)
    np.testing.assert_allclose(phi2, [[0.5, 1e6 / 6], [0, 0.5]], rtol=1e-14)


def test_stiff_damping_decays(made):
    # eigenvalues -1e-3 and -2000: the fast one is gone, the slow one exact
    v = np.array([[1.0, 2.0], [0.5, -1.0]])
    z = v @ np.diag([-1e-3, -2000.0]) @ np.linalg.inv(v)
    target = np.exp(-1e-3) * np.outer(v[:, 0], np.linalg.inv(v)[0])
    np.testing.assert_allclose(value(z)[0], target, rtol=1e-10)


# ---- badly scaled matrices


def light_beside_heavy(h):
    """h A of two masses 1e-6 and 1e6 kg joined by a spring of 1e6 N/m, (x1, x2, v1, v2), and phi_0 .. phi_2 of it.

    The centre moves steadily, the distance swings: every entry has a closed form.
    """
    m1, m2, k = 1e-6, 1e6, 1e6
    a = np.zeros((4, 4))
    a[0, 2] = a[1, 3] = 1
    a[2, :2], a[3, :2] = [-k / m1, k / m1], [k / m2, -k / m2]
    w, share = math.sqrt(k / m1 + k / m2), m1 / (m1 + m2)
    # (centre, distance) from (x1, x2), and back
    to = np.array([[share, 1 - share], [1.0, -1.0]])
    back = np.array([[1.0, 1 - share], [1.0, -share]])
    c, s = math.cos(w * h), math.sin(w * h)

    def blocks(free, swing):
        return np.block([[back @ np.diag([free[i], swing[i]]) @ to for i in row] for row in ((0, 1), (2, 3))])

    wanted = [
        blocks((1, h, 0, 1), (c, s / w, -w * s, c)),
        blocks((1, h / 2, 0, 1), (s / w / h, (1 - c) / w**2 / h, (c - 1) / h, s / w / h)),
        blocks(
            (0.5, h / 6, 0, 0.5),
            tuple(part / h**2 for part in ((1 - c) / w**2, (h - s / w) / w**2, s / w - h, (1 - c) / w**2)),
        ),
    ]
    return a * h, wanted


@pytest.mark.parametrize("h", [1e-6, 3e-5])
def test_a_light_mass_beside_a_heavy_one_keeps_its_digits(h):
    z, wanted = light_beside_heavy(h)
    scale = balance(z)
    assert scale is not None
    np.testing.assert_array_equal(np.log2(scale) % 1, 0)
    turn = scale[:, None] / scale
    for found, target in zip(value(z), wanted, strict=True):
        np.testing.assert_allclose(
            found / turn, target / turn, rtol=0, atol=2e-12 * np.abs(target / turn).max()
        )
    np.testing.assert_allclose(
        transition(z, 1) / turn, wanted[0] / turn, rtol=0, atol=1e-13 * np.abs(wanted[0] / turn).max()
    )


def test_what_is_scaled_alike_is_left_alone():
    assert balance(matrix(1, 4, 8.0)) is None
    assert balance(np.zeros((3, 3))) is None
    assert balance(np.zeros((0, 0))) is None


@pytest.mark.parametrize("d", [1, 3])
def test_derivatives_of_badly_scaled_matrices(d):
    z_jet, _, _ = jet_of(3, 4, d, 4.0)
    scale = 2.0 ** np.array([20, -15, 0, 7])
    turn = scale[:, None] / scale
    for found, target in zip(phi_functions(z_jet * turn, d), phi_functions(z_jet, d), strict=True):
        np.testing.assert_allclose(found / turn, target, rtol=0, atol=1e-12 * np.abs(target).max())


# ---- derivatives

EPS = 1e-30


def jet_of(seed, n, d, size):
    """The jet of Z(p) = Z0 + sum Z_i p_i + sum Z_ij p_i p_j (i <= j) at p = 0, and Z of a complex p."""
    rng = np.random.default_rng(seed)
    base = matrix(seed, n, size)
    slope = rng.normal(size=(d, n, n)) * 0.5
    i, j = jets.pairs(d)
    bend = rng.normal(size=(len(i), n, n)) * 0.5
    second = bend * np.where(i == j, 2.0, 1.0)[:, None, None]

    def z(p):
        total = base + np.tensordot(p, slope, 1)
        return total + np.tensordot(p[i] * p[j], bend, 1)

    return np.concatenate([base[None], slope, second]), z, d


def complex_phi(z):
    """phi_0, phi_1, phi_2 of a complex matrix by plain series of 90 terms."""
    term = np.eye(len(z), dtype=complex)
    out = [np.zeros_like(term) for _ in range(3)]
    for k in range(90):
        for shift in range(3):
            out[shift] += term * (math.factorial(k) / math.factorial(k + shift))
        term = term @ z / (k + 1)
    return out


@pytest.mark.parametrize(("n", "size"), [(1, 0.0), (2, 0.1), (3, 0.5), (3, 2.0), (4, 6.0)])
@pytest.mark.parametrize("d", [1, 3])
def test_first_derivatives_equal_the_complex_step(n, size, d):
    z_jet, z, _ = jet_of(10 * n + d, n, d, size)
    found = phi_functions(z_jet[: 1 + d], d)
    for k in range(d):
        p = np.zeros(d, dtype=complex)
        p[k] = 1j * EPS
        for phi, target in zip(found, complex_phi(z(p)), strict=True):
            np.testing.assert_allclose(phi[1 + k], target.imag / EPS, atol=3e-13 * (1 + np.abs(target).max()))


@pytest.mark.parametrize(("n", "size"), [(1, 0.0), (2, 0.1), (3, 0.5), (3, 2.0), (4, 6.0)])
@pytest.mark.parametrize("d", [1, 3])
def test_second_derivatives_equal_differences_of_complex_steps(n, size, d):
    z_jet, z, _ = jet_of(10 * n + d, n, d, size)
    found = phi_functions(z_jet, d)
    h = 1e-5
    for row, (i, j) in enumerate(zip(*jets.pairs(d), strict=True)):
        slopes = []
        for side in (-h, h):
            p = np.zeros(d, dtype=complex)
            p[i] += 1j * EPS
            p[j] += side
            slopes.append([part.imag / EPS for part in complex_phi(z(p))])
        for phi, low, high in zip(found, *slopes, strict=True):
            target = (high - low) / (2 * h)
            np.testing.assert_allclose(phi[1 + d + row], target, atol=1e-8 * (1 + np.abs(target).max()))


def test_the_orders_agree():
    z_jet, _, d = jet_of(3, 3, 2, 4.0)
    second = phi_functions(z_jet, d)
    first = phi_functions(z_jet[: 1 + d], d)
    none = phi_functions(z_jet[:1], 0)
    for a, b, c in zip(second, first, none, strict=True):
        np.testing.assert_array_equal(a[: 1 + d], b)
        np.testing.assert_array_equal(a[:1], c)


def test_derivatives_where_the_matrix_vanishes():
    # d/dp exp(p Z) = Z and d2/dp2 = Z^2 at p = 0
    z = matrix(1, 3, 1e3)
    jet = np.stack([np.zeros((3, 3)), z, np.zeros((3, 3))])
    phi0, phi1, phi2 = phi_functions(jet, 1)
    np.testing.assert_allclose(phi0[1], z, rtol=1e-14)
    np.testing.assert_allclose(phi0[2], z @ z, rtol=1e-13, atol=1e-9)
    np.testing.assert_allclose(phi1[2], z @ z / 3, rtol=1e-13, atol=1e-9)
    np.testing.assert_allclose(phi2[2], z @ z / 12, rtol=1e-13, atol=1e-9)


# ---- long transitions


def test_a_long_transition_is_the_exponential_to_the_last_digit():
    # A rotation: cos and sin of the whole angle.
    z = np.array([[0.0, 0.3], [-0.3, 0.0]])
    for steps in (1, 2, 17, 64, 1000):
        found = transition(z, steps)
        angle = np.longdouble(0.3) * steps
        target = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]], dtype=float)
        np.testing.assert_allclose(found, target, atol=2e-16)


def test_a_transition_keeps_the_volume_and_small_entries():
    z = np.array([[0.0, -1e-9, 0.0], [1e-9, 0.0, 0.0], [0.0, 0.0, -1e-12]])
    found = transition(z, 64)
    assert found[0, 1] == pytest.approx(-64e-9, rel=1e-15)
    assert found[2, 2] - 1 == pytest.approx(-64e-12, rel=1e-3)
    np.testing.assert_allclose(transition(np.zeros((2, 2)), 5), np.eye(2), rtol=0, atol=0)

"""The phi functions of a step and its half, and the matrices of Krogstad's scheme."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from casadi_engine.model import Blueprint
from casadi_engine.simulation import jets
from casadi_engine.simulation.exponential import phi_functions
from casadi_engine.simulation.exponential_step import STAGES, StepCore, phi_pair


def augmented_phi(z, highest):
    """phi_0 .. phi_highest by one exponential of a matrix with a chain of identities."""
    n = len(z)
    wide = np.zeros((n * (highest + 1),) * 2)
    wide[:n, :n] = z
    for k in range(highest):
        wide[k * n : (k + 1) * n, (k + 1) * n : (k + 2) * n] = np.eye(n)
    whole = expm(wide)
    return [whole[:n, k * n : (k + 1) * n] for k in range(highest + 1)]


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.3, 0.9, 4.0, 60.0])
def test_phi_functions_of_step_and_half_equal_an_augmented_exponential(size):
    z = np.random.default_rng(1).normal(size=(4, 4)) - 2 * np.eye(4)
    z *= size / np.abs(z).sum(axis=0).max()
    half, whole = phi_pair(z[None], 0)
    for found, wanted in ((half, augmented_phi(z / 2, 2)), (whole, augmented_phi(z, 3))):
        assert len(found) == len(wanted)
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_allclose(one[0], other, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("order", [1, 2])
def test_their_derivatives_equal_those_of_the_exact_discretisation(order):
    rng = np.random.default_rng(2)
    z = 3 * rng.normal(size=(jets.count(3, order), 4, 4))
    half, whole = phi_pair(z, 3)
    for one, other in zip(whole[:3], phi_functions(z, 3), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-10)
    for one, other in zip(half, phi_functions(z / 2, 3), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("d", [0, 2])
def test_badly_scaled_matrices_lose_no_digits(d):
    rng = np.random.default_rng(4)
    z = 2 * rng.normal(size=(jets.count(d, 2), 4, 4))
    scale = 2.0 ** np.array([18, -20, 0, 5])
    turn = scale[:, None] / scale
    for parts, wanted in zip(phi_pair(z * turn, d), phi_pair(z, d), strict=True):
        for one, other in zip(parts, wanted, strict=True):
            np.testing.assert_allclose(one / turn, other, rtol=0, atol=1e-12 * np.abs(other).max())


def test_without_dynamics_the_scheme_is_the_classical_runge_kutta_rule():
    b = Blueprint("still")
    x = b.state("x")
    slot = b.port("law", "inertia", {"speed": x})
    b.ode("x", slot)
    b.output("x", x)
    b.law("law", -(x**2))
    model = b.model()
    core = StepCore(model.linear, model, ca.SX(0, 1), ca.SX(0, 1), hold=(), scale=np.ones(1))
    h = 0.2
    p = core.at(np.zeros(0), 0, h, np.ones((1, 1))).p[0]
    wanted = np.zeros((5, 5))
    wanted[:, 0] = 1.0
    wanted[0, 1:] = h * np.array([1, 2, 2, 1]) / 6
    wanted[2, 1] = wanted[3, 2] = h / 2
    wanted[4, 3] = h
    np.testing.assert_allclose(p, wanted, atol=1e-15)


def test_the_scheme_integrates_torques_that_are_quadratic_in_time_exactly():
    b = Blueprint("shaft")
    w, twist, load = b.state("w", scale=3.0), b.state("twist", scale=0.2), b.input("load")
    slot = b.port("law", "inertia", {"speed": w})
    b.ode("w", load - 30 * twist - 0.7 * w + slot + 0.4)
    b.ode("twist", w)
    b.output("w", w)
    b.law("law", ca.sin(w))
    model, h = b.model(), 0.3
    core = StepCore(
        model.linear, model, ca.SX(0, 1), ca.SX(0, 1), hold=("first",), scale=np.array([3.0, 0.2])
    )
    q = np.array([[0.0, 0.2]])
    made = core.at(np.zeros(0), 0, h, q)
    assert (core.drives, core.groups, core.constant, made.m) == ([(0,)], [(0,)], True, 2)
    a = np.array([[-0.7, -30], [1, 0]])
    v0, v1, coefficients = 1.3, -0.4, np.array([0.6, -2.0, 5.0])  # w(t) = c0 + c1 t + c2 t^2
    x0 = np.array([2.0, 0.1])
    torque = [coefficients @ [1, t, t**2] for t in (0, h / 2, h / 2, h)]
    column = np.concatenate([x0 / [3.0, 0.2], [v0, 1.0], [v1, 1.0], torque])
    found = made.p[0] @ column

    def exact(t):
        # variation of constants: the push is a polynomial, c_k t^k gives k! t^(k+1) phi_(k+1)
        push = coefficients + np.array([0.4 + v0, (v1 - v0) / h, 0.0])
        phi = augmented_phi(a * t, 3)
        parts = [push[k] * math.factorial(k) * t ** (k + 1) * phi[k + 1][:, 0] for k in range(3)]
        return phi[0] @ x0 + sum(parts)

    np.testing.assert_allclose(found[:2] * [3.0, 0.2], exact(h), rtol=1e-13)
    assert found[2] == pytest.approx(0.1, rel=1e-14)
    assert len(found) == 2 + STAGES


def test_a_core_that_is_not_finite_is_reported():
    b = Blueprint("still")
    x, k = b.state("x"), b.parameter("k", 1.0)
    slot = b.port("law", "inertia", {"speed": x})
    b.ode("x", slot / k - x)
    b.output("x", x)
    b.law("law", -(x**2))
    model, z = b.model(), ca.SX.sym("z")
    core = StepCore(model.linear, model, z, z, hold=(), scale=np.ones(1))
    with (
        np.errstate(all="ignore"),
        pytest.raises(FloatingPointError, match="the linear core is not finite here"),
    ):
        core.at(np.zeros(1), 1, 0.1, np.ones((1, 1)))

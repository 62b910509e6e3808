"""Runge-Kutta schemes: their order, and derivatives of a step by the equations that define them."""

from __future__ import annotations

import numpy as np
import pytest

from casadi_engine.deadline import Deadline, TimeUp
from casadi_engine.simulation import tableau
from casadi_engine.simulation.tableau import (
    RADAU,
    RUNGE_KUTTA,
    growth,
    newton_step,
    products,
    stage_multipliers,
    stage_sensitivities,
    step_sensitivities,
)

SCHEMES = pytest.mark.parametrize("scheme", [RUNGE_KUTTA, RADAU], ids=["explicit", "implicit"])


def solved(scheme, rate, slope, x, t, h):
    """One step of dx/dt = rate(x, t), its stages found by Newton's method from x."""
    values = np.tile(x, (scheme.stages, 1))
    for _ in range(30):
        phi = h * np.array([rate(v, t + c * h) for v, c in zip(values, scheme.c, strict=True)])
        by_x = h * np.array([slope(v, t + c * h) for v, c in zip(values, scheme.c, strict=True)])
        residual = values - x - scheme.a @ phi
        if np.abs(residual).max() < 1e-14:
            break
        values = values + newton_step(scheme, by_x[:, None], residual[:, None])[:, 0]
    assert np.abs(residual).max() < 1e-12
    return x + scheme.b @ phi


def forced(x, t):
    """A nonlinear equation in two states that depends on time; its solution: (1 / (1 + t²), sin t)."""
    return np.array([-2 * t * x[0] ** 2, np.cos(t) + x[0] * (1 + t**2) - 1])


def forced_slope(x, t):
    return np.array([[-4 * t * x[0], 0.0], [1 + t**2, 0.0]])


@SCHEMES
def test_order(scheme):
    errors = []
    for steps in (4, 8, 16):
        x, h = np.array([1.0, 0.0]), 1.0 / steps
        for k in range(steps):
            x = solved(scheme, forced, forced_slope, x, k * h, h)
        errors.append(np.abs(x - [0.5, np.sin(1.0)]).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (np.abs(orders - scheme.order) < 0.5).all(), orders
    assert scheme.richardson == pytest.approx(2**scheme.order / (2**scheme.order - 1))


@SCHEMES
def test_quadrature_is_exact_for_polynomials_of_the_order(scheme):
    for power in range(scheme.order):
        assert scheme.b @ scheme.c**power == pytest.approx(1 / (power + 1), abs=1e-15)
    np.testing.assert_allclose(scheme.a.sum(axis=1), scheme.c, atol=1e-15)


def test_implicit_steps_damp_what_is_far_too_fast():
    """L-stability: R(z) -> 0; and R(z) is the Padé fraction (2, 3) of exp(z)."""
    for z in (-0.1, -3.0, -1e3, -1e9):
        end = solved(RADAU, lambda x, t, z=z: z * x, lambda x, t, z=z: np.array([[z]]), np.ones(1), 0.0, 1.0)
        wanted = (1 + 0.4 * z + z**2 / 20) / (1 - 0.6 * z + 3 * z**2 / 20 - z**3 / 60)
        assert end[0] == pytest.approx(wanted, rel=1e-6, abs=1e-11)
    assert RADAU.implicit
    assert not RUNGE_KUTTA.implicit


def slopes_of(scheme, n=3, nz=2, steps=5):
    rng = np.random.default_rng(0)
    return rng.normal(size=(scheme.stages, steps, n, n)), rng.normal(size=(scheme.stages, steps, n, nz))


@SCHEMES
def test_sensitivities_solve_the_equations_of_the_stages(scheme):
    by_x, by_z = slopes_of(scheme)
    slopes, values = stage_sensitivities(scheme, by_x, by_z)
    identity = np.concatenate([np.eye(3), np.zeros((3, 2))], axis=1)
    for i in range(scheme.stages):
        inner = identity + np.tensordot(scheme.a[i], slopes, 1)
        np.testing.assert_allclose(values[i], inner, atol=1e-11)
        direct = np.concatenate([np.zeros_like(by_x[i]), by_z[i]], axis=-1)
        np.testing.assert_allclose(slopes[i], by_x[i] @ inner + direct, atol=1e-11)
    np.testing.assert_allclose(
        step_sensitivities(scheme, slopes), identity + np.tensordot(scheme.b, slopes, 1), atol=1e-12
    )


@SCHEMES
def test_multipliers_are_the_transpose(scheme):
    """What is added to the slopes moves the step's end by sum of nu * added, for a weighted end."""
    by_x, _ = slopes_of(scheme)
    rng = np.random.default_rng(1)
    mu = rng.normal(size=(5, 3))
    nu = stage_multipliers(scheme, by_x, mu)
    # as slopes to one further parameter
    added = rng.normal(size=(scheme.stages, 5, 3, 1))
    moved = step_sensitivities(scheme, stage_sensitivities(scheme, by_x, added)[0])[..., 3]
    np.testing.assert_allclose((nu * added[..., 0]).sum(axis=(0, 2)), (mu * moved).sum(axis=1), atol=1e-11)


def test_growth_leaves_out_what_is_not_finite():
    by_x = np.array([np.diag([3.0, 1.0]), np.full((2, 2), np.nan), np.diag([np.inf, 1.0])])
    assert growth(by_x) == pytest.approx(3.0)
    assert growth(by_x[1:]) == 0.0


def test_growth_is_the_largest_eigenvalue_or_a_norm_that_is_small_enough():
    rng = np.random.default_rng(3)
    by_x = rng.normal(size=(40, 2, 3, 3))
    by_x[7, 1] *= 50.0
    whole = np.abs(np.linalg.eigvals(by_x)).max()
    assert growth(by_x) == pytest.approx(whole)
    by_x[0, 0, 0, 0] = np.nan
    assert growth(by_x) == pytest.approx(whole)
    small = 1e-3 * rng.normal(size=(5, 3, 3))
    assert np.abs(np.linalg.eigvals(small)).max() <= growth(small) < 0.02


def test_products_of_many_small_matrices():
    rng = np.random.default_rng(4)
    for n in (1, 2, 4, 5):
        a, b = rng.normal(size=(6, 7, n, n)), rng.normal(size=(6, 7, n, 3))
        np.testing.assert_allclose(products(a, b), a @ b, atol=1e-12)
        np.testing.assert_allclose(products(a.swapaxes(-1, -2), b), a.swapaxes(-1, -2) @ b, atol=1e-12)


@SCHEMES
def test_many_steps_are_made_in_parts_that_a_deadline_can_end(scheme, monkeypatch):
    by_x, by_z = slopes_of(scheme, steps=50)
    whole = stage_sensitivities(scheme, by_x, by_z)
    monkeypatch.setattr(tableau, "_MANY", 8)
    with Deadline() as deadline:
        for part, wanted in zip(stage_sensitivities(scheme, by_x, by_z), whole, strict=True):
            np.testing.assert_allclose(part, wanted, atol=1e-12)
        deadline.stop()
        with pytest.raises(TimeUp):
            stage_sensitivities(scheme, by_x, by_z)


def test_stages_without_slopes_are_no_step(monkeypatch):
    """An orbit that overflows on the way made a bare LinAlgError of a search that looked for a run."""
    monkeypatch.setattr(tableau, "_coupling", lambda _scheme, by_x: np.zeros((1, 3, 3)))
    with pytest.raises(FloatingPointError, match="implicit step have no slopes"):
        stage_sensitivities(RADAU, np.ones((3, 1, 1, 1)), np.ones((3, 1, 1, 1)))

"""Exact discretisation against SciPy's, and against an integrator at tight tolerance."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import scipy.signal
from scipy.integrate import solve_ivp

from casadi_engine.errors import SimulationError
from casadi_engine.model import Blueprint
from casadi_engine.simulation.discretisation import DiscreteCore

H = 0.07


def core_of(made, model, *, hold=None, method="exact", scale=None, step=H):
    z = ca.SX.sym("z", model.p.numel())
    return DiscreteCore(
        model,
        z,
        z,
        step=step,
        hold=hold or ("first",) * len(model.drives),
        scale=np.ones(len(model.states)) if scale is None else scale,
        method=method,
    )


def matrices(model):
    p = model.parameter_vector()
    core = model.linear
    parts = [ca.densify(part) for part in core.matrices]
    a, b, _, e, c, d, f = (np.asarray(part) for part in ca.Function("m", [model.p], parts)(p))
    return p, a, b, e, c, d, f


@pytest.mark.parametrize("seed", range(4))
def test_the_zero_order_hold_equals_scipys(made, seed):
    model = made.linear(np.random.default_rng(seed), states=1 + seed, inputs=3, outputs=2, offsets=False)
    p, a, b, _, c, d, _ = matrices(model)
    found = core_of(made, model, hold=("zero",) * 3).at(p, 0)
    f, g, *_ = scipy.signal.cont2discrete((a, b, c, d), H, "zoh")
    np.testing.assert_allclose(found.f[0], f, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(found.g0[0], g, rtol=1e-12, atol=1e-14)
    assert not found.g1.any()
    np.testing.assert_array_equal(found.c[0], c)
    np.testing.assert_array_equal(found.d[0], d)


@pytest.mark.parametrize("seed", range(4))
def test_the_first_order_hold_equals_scipys(made, seed):
    model = made.linear(np.random.default_rng(seed), states=1 + seed, inputs=2, outputs=1, offsets=False)
    p, a, b, _, c, d, _ = matrices(model)
    found = core_of(made, model).at(p, 0)
    # SciPy moves the ramp into the state: z[k] = x[k] - G1 u[k].
    f, g, _, through, _ = scipy.signal.cont2discrete((a, b, c, d), H, "foh")
    g0, g1 = found.g0[0], found.g1[0]
    np.testing.assert_allclose(found.f[0], f, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(g0 + f @ g1, g, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(d + c @ g1, through, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("holds", [("first", "first"), ("zero", "zero"), ("first", "zero")])
def test_a_step_equals_an_integrators(made, holds):
    model = made.linear(np.random.default_rng(7), states=3, inputs=2)
    p, a, b, e, *_ = matrices(model)
    found = core_of(made, model, hold=holds).at(p, 0)
    rng = np.random.default_rng(8)
    x, v0, v1 = rng.normal(size=3), rng.normal(size=2), rng.normal(size=2)
    rise = np.where(np.array(holds) == "first", v1 - v0, 0.0)

    def slope(t, x):
        return a @ x + b @ (v0 + rise * t / H) + e[:, 0]

    target = solve_ivp(slope, (0, H), x, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    full0, full1 = np.append(v0, 1.0), np.append(v1, 1.0)
    np.testing.assert_allclose(found.f[0] @ x + found.g0[0] @ full0 + found.g1[0] @ full1, target, rtol=1e-11)


def test_eulers_rule(made):
    model = made.linear(np.random.default_rng(3), states=3, inputs=2)
    p, a, b, e, *_ = matrices(model)
    found = core_of(made, model, method="euler").at(p, 0)
    np.testing.assert_allclose(found.f[0], np.eye(3) + H * a, rtol=1e-14)
    np.testing.assert_allclose(found.g0[0], H * np.hstack([b, e]), rtol=1e-14)
    assert not found.g1.any()


def test_states_are_scaled_inside(made):
    model = made.linear(np.random.default_rng(5), states=3, inputs=2, outputs=2)
    p, *_ = matrices(model)
    s = made.scale(model)
    plain, scaled = core_of(made, model).at(p, 0), core_of(made, model, scale=s).at(p, 0)
    np.testing.assert_allclose(scaled.f[0], plain.f[0] * s[None, :] / s[:, None], rtol=1e-12)
    np.testing.assert_allclose(scaled.g0[0], plain.g0[0] / s[:, None], rtol=1e-12)
    np.testing.assert_allclose(scaled.c[0], plain.c[0] * s[None, :], rtol=1e-14)


def test_derivatives_of_the_discrete_matrices(made):
    model = made.linear(np.random.default_rng(2), states=3, inputs=2, outputs=2)
    core = core_of(made, model)
    p, e = model.parameter_vector(), 1e-5
    found = core.at(p, 2)
    for name in ("f", "g0", "g1", "c", "d"):
        whole = getattr(found, name)
        for i in range(2):
            step = np.eye(2)[i] * e
            high, low = (getattr(core.at(p + s, 1), name) for s in (step, -step))
            slope = (high - low) / (2 * e)
            np.testing.assert_allclose(whole[1 + i], slope[0], atol=1e-9)
            bend = {0: whole[3], 1: whole[4]} if i == 0 else {0: whole[4], 1: whole[5]}
            for j in range(2):
                np.testing.assert_allclose(bend[j], slope[1 + j], atol=1e-8)


# ---- joined drives


def twins():
    """Four drives: two alike, one with another hold, one in the output only."""
    b = Blueprint("twins")
    x, k = b.state("x"), b.parameter("k", 2.0)
    u = [b.input(f"u{i}") for i in range(4)]
    b.ode("x", -x + k * (u[0] + u[1] + u[2]))
    b.output("y", x + u[3])
    return b.model()


def test_drives_that_act_alike_are_joined(made):
    core = core_of(made, twins(), hold=("first", "first", "zero", "first"))
    assert core.groups == ((0, 1), (2,), (3,))
    np.testing.assert_array_equal(core.first, [True, False, True])
    found = core.at(np.array([2.0]), 0)
    assert found.g0.shape == (1, 1, 3)
    assert found.g1[0, 0, 1] == 0
    assert found.g0[0, 0, 0] + found.g1[0, 0, 0] == pytest.approx(found.g0[0, 0, 1], rel=1e-13)


def test_constants_are_a_drive_of_their_own(made):
    b = Blueprint("pushed")
    x, k = b.state("x"), b.parameter("k", 2.0)
    b.ode("x", k - x)
    b.output("y", x + 3 * k)
    core = core_of(made, b.model())
    found = core.at(np.array([2.0]), 0)
    assert core.drives == 1
    assert found.g0[0, 0, 0] == pytest.approx(2 * (1 - np.exp(-H)), rel=1e-13)
    assert found.d[0, 0, 0] == 6


def test_a_model_without_drives_has_none(made):
    b = Blueprint("free")
    x = b.state("x")
    b.ode("x", -x)
    b.output("y", x)
    found = core_of(made, b.model()).at(np.zeros(0), 2)
    assert found.g0.shape == found.g1.shape == (1, 1, 0)
    assert found.f[0, 0, 0] == pytest.approx(np.exp(-H), rel=1e-14)


# ---- trouble


def test_a_general_model_has_no_discretisation(made):
    model = made.general(np.random.default_rng(0))
    with pytest.raises(SimulationError) as info:
        core_of(made, model, hold=("first",))
    assert str(info.value) == (
        "the model has no linear core; seen: bent; do: use the general integrator for this model"
    )


def test_a_point_where_the_matrices_are_not_finite_is_reported(made):
    b = Blueprint("poles")
    x, tau = b.state("x"), b.parameter("tau", 1.0)
    b.ode("x", -x / tau)
    b.output("y", x)
    with pytest.raises(FloatingPointError, match="the linear core is not finite here"):
        core_of(made, b.model()).at(np.array([0.0]), 1)

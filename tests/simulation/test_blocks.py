"""Block matrices against steps taken one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from casadi_engine.simulation.blocks import block_matrices, second_powers, second_products
from casadi_engine.simulation.discretisation import DiscreteCore
from casadi_engine.simulation.linear import corrected


def discrete(made, seed, *, hold=("first", "zero"), order=2, method="exact"):
    model = made.linear(np.random.default_rng(seed), states=3, inputs=2, outputs=2)
    z = model.p
    core = DiscreteCore(model, z, z, step=0.05, hold=hold, scale=np.ones(3), method=method)
    return core.at(np.array([0.7, 1.2]), order)


def stepped(d, length, samples, x, v):
    """[end; outputs at the samples] by the recursion itself; v : (length + 1, m)."""
    rows = []
    for k in range(length + 1):
        if k in samples:
            rows.append(d.c[0] @ x + d.d[0] @ v[k])
        if k < length:
            x = d.f[0] @ x + d.g0[0] @ v[k] + d.g1[0] @ v[k + 1]
    return np.concatenate([x, *rows])


@pytest.mark.parametrize("length", [1, 2, 3, 5, 8, 13, 16, 64])
@pytest.mark.parametrize("gain", [None, 0.3])
def test_a_block_is_its_steps(made, length, gain):
    d = discrete(made, 1)
    if gain is not None:
        d = corrected(d, gain * np.ones((3, 2)))
    rng = np.random.default_rng(2)
    x, v = rng.normal(size=3), rng.normal(size=(length + 1, d.g0.shape[2]))
    for samples in (
        np.arange(length),
        np.arange(length + 1),
        np.arange(length // 2, length, 3),
        np.array([length]),
    ):
        blocks = block_matrices(d, length, samples)
        assert blocks.p.shape == (6, 3 + 2 * len(samples), 3 + (length + 1) * d.g0.shape[2])
        found = blocks.p[0] @ np.concatenate([x, v.ravel()])
        np.testing.assert_allclose(found, stepped(d, length, samples, x, v), rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("method", ["exact", "euler"])
def test_derivatives_of_a_block(made, method):
    model = made.linear(np.random.default_rng(1), states=3, inputs=2, outputs=2)
    core = DiscreteCore(
        model, model.p, model.p, step=0.05, hold=("first", "zero"), scale=np.ones(3), method=method
    )
    at, e, samples = np.array([0.7, 1.2]), 1e-5, np.arange(0, 8, 3)
    p = block_matrices(core.at(at, 2), 7, samples).p
    second = {(0, 0): p[3], (0, 1): p[4], (1, 0): p[4], (1, 1): p[5]}
    for i in range(2):
        step = e * np.eye(2)[i]
        high, low = (block_matrices(core.at(at + s, 1), 7, samples).p for s in (step, -step))
        slope = (high - low) / (2 * e)
        np.testing.assert_allclose(p[1 + i], slope[0], atol=1e-8)
        for j in range(2):
            np.testing.assert_allclose(second[i, j], slope[1 + j], atol=1e-7)


def test_lower_orders_are_the_beginning(made):
    whole = block_matrices(discrete(made, 3), 6, np.arange(6)).p
    first = block_matrices(discrete(made, 3, order=1), 6, np.arange(6)).p
    value = block_matrices(discrete(made, 3, order=0), 6, np.arange(6)).p
    np.testing.assert_allclose(first, whole[:3], rtol=1e-13)
    np.testing.assert_allclose(value, whole[:1], rtol=1e-13)


def test_a_corrected_model_without_memory_forgets_its_state(made):
    d = discrete(made, 4)
    c = np.zeros((6, 3, 3))
    c[0] = np.vstack([d.c[0], [0.0, 0.0, 1.0]])
    all_measured = replace(d, c=c, d=np.zeros((6, 3, d.g0.shape[2])))
    full = corrected(all_measured, np.linalg.inv(c[0]))
    np.testing.assert_allclose(full.f, 0, atol=1e-13)


def test_the_push_of_the_measurement_has_no_ramp(made):
    d = discrete(made, 5)
    gain = np.full((3, 2), 0.2)
    found = corrected(d, gain)
    assert found.g0.shape[2] == d.g0.shape[2] + 2
    assert not found.g1[:, :, -2:].any()
    assert not found.d[:, :, -2:].any()
    np.testing.assert_allclose(found.g0[0, :, -2:], d.f[0] @ gain, rtol=1e-14)
    assert found.generator.size == 0


@pytest.mark.parametrize("hold", [("first", "zero"), ("zero", "zero")])
def test_second_products_are_those_of_the_block_matrix(made, hold):
    d = discrete(made, 3, hold=hold)
    d.c[1:] = 0.0
    for length, samples in ((1, np.arange(1)), (6, np.arange(0, 7, 2)), (9, np.array([9]))):
        p = block_matrices(d, length, samples).p
        outer = np.random.default_rng(4).normal(size=p.shape[1:])
        found = second_products(d, second_powers(d, length), samples, outer)
        np.testing.assert_allclose(found, np.einsum("pij,ij->p", p[3:], outer), rtol=1e-10, atol=1e-12)


def test_second_products_need_outputs_that_no_parameter_moves(made):
    d = discrete(made, 3)
    d.c[1] = 1.0
    assert second_powers(d, 4) is None

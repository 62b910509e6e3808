"""Condensing against the dense Karush-Kuhn-Tucker system of all nodes."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from casadi_engine.estimation.condensing import condense, joint_multipliers

SHAPES = [(2, 3, 5), (4, 1, 7), (0, 3, 4), (3, 2, 1), (1, 4, 2)]


def positive(rng, size):
    root = rng.standard_normal((size, size))
    return root @ root.T + 0.1 * np.eye(size)


def problem(seed, na, n, m, *, common):
    """Random ends, gaps, Hessian blocks and gradients of one record, and its dense Hessian and continuity."""
    rng = np.random.default_rng(seed)
    end_z = rng.standard_normal((na, n, m))
    end_s = rng.standard_normal((1 if common else m, n, n)) * 0.7
    gap = rng.standard_normal((m - 1, n))
    whole = positive(rng, na + m * n)
    zz, cross = whole[:na, :na], whole[:na, na:]
    # states of different pieces do not meet in the Hessian
    ss = np.array([positive(rng, n) for _ in range(m)])
    dense = np.block([[zz + 50 * np.eye(na), cross], [cross.T, block_diag(*ss) + 50 * np.eye(m * n)]])
    ss = ss + 50 * np.eye(n)
    zs = cross.reshape(na, m, n).transpose(0, 2, 1)
    slope = rng.standard_normal(na + m * n)
    rows = np.zeros(((m - 1) * n, na + m * n))
    for i in range(m - 1):
        row = slice(i * n, (i + 1) * n)
        rows[row, :na] = end_z[:, :, i].T
        rows[row, na + i * n : na + (i + 1) * n] = end_s[0 if common else i]
        rows[row, na + (i + 1) * n : na + (i + 2) * n] = -np.eye(n)
    return end_z, end_s, gap, (zs, ss), slope, dense, rows


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("common", [True, False])
def test_the_condensed_step_is_that_of_the_full_system(shape, common):
    na, n, m = shape
    end_z, end_s, gap, blocks, slope, dense, rows = problem(sum(shape), na, n, m, common=common)
    share = condense(end_z, end_s, gap, blocks, slope[na:].reshape(m, n))
    hessian, gradient = share.hessian.copy(), share.gradient.copy()
    hessian[:na, :na] += dense[:na, :na]
    gradient[:na] += slope[:na]
    w = -np.linalg.solve(hessian, gradient)

    count = len(rows)
    matrix = np.block([[dense, rows.T], [rows, np.zeros((count, count))]])
    full = np.linalg.solve(matrix, np.concatenate([-slope, -gap.ravel()]))[: na + m * n]
    np.testing.assert_allclose(w[:na], full[:na], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(share.nodes(w).ravel(), full[na:], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("common", [True, False])
def test_every_condensed_step_closes_the_linearised_gaps(common):
    na, n, m = 3, 2, 6
    end_z, end_s, gap, blocks, slope, _, rows = problem(1, na, n, m, common=common)
    share = condense(end_z, end_s, gap, blocks, slope[na:].reshape(m, n))
    w = np.random.default_rng(2).standard_normal(na + n)
    step = np.concatenate([w[:na], share.nodes(w).ravel()])
    np.testing.assert_allclose(rows @ step + gap.ravel(), 0, atol=1e-10)
    np.testing.assert_array_equal(share.nodes(w)[0], w[na:])


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("common", [True, False])
def test_multipliers_cancel_the_gradient_in_the_later_nodes(shape, common):
    na, n, m = shape
    _, end_s, _, _, slope, _, rows = problem(5, na, n, m, common=common)
    lam = joint_multipliers(end_s, slope[na:].reshape(m, n))
    assert lam.shape == (n, m - 1)
    left = slope[na:] + rows[:, na:].T @ lam.T.ravel()
    np.testing.assert_allclose(left[n:], 0, atol=1e-10)

"""Predictors of records with gaps: against the recursion written out, their derivatives against differences."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_engine.simulation.gain import RiccatiGain, StatedGain
from casadi_engine.simulation.gappy import GappyPredictor
from casadi_engine.simulation.intervals import Intervals

KINDS = ("stated", "riccati", "riccati with levels")


def case(
    made, seed, *, kind="stated", states=3, outputs=2, plan=(3, 2, 4), holes=0.3, stride=1, method="exact"
):
    """A predictor of a random model whose gain hangs on z, and what it was made of."""
    rng = np.random.default_rng(seed)
    model = made.linear(rng, states=states, inputs=2, outputs=outputs)
    m, b, q = plan
    intervals = Intervals(m, b, q, np.arange(0, q, stride))
    samples = intervals.padded - 1
    grid = made.grid(rng.normal(size=(2, samples)), samples=samples, holds=("first", "zero"))
    feedback = rng.normal(size=(outputs, samples))
    seen = rng.random((outputs, samples)) > holes
    if stride > 1:
        seen[:, np.arange(samples) % stride > 0] = False
    feedback[~seen] = 0.0
    count, scale = model.p.numel(), made.scale(model)
    more = states * outputs if kind == "stated" else states + outputs
    z = ca.SX.sym("z", count + more)
    physical = z[:count] * (1 + 0.3 * ca.sin(z[:count]))
    point = rng.uniform(0.5, 1.5, count + more)
    if kind == "stated":
        point[count:] = 0.3 * rng.normal(size=more)
        gain = StatedGain(ca.reshape(ca.sin(z[count:]), states, outputs), z, scale)
    else:
        density = ca.diag(z[count : count + states] ** 2 * (1 + physical[0]))
        level = rng.uniform(0.5, 2, outputs) if kind.endswith("levels") else None
        gain = RiccatiGain(density, z[count + states :], z, scale=scale, every=stride, level=level)
    found = GappyPredictor(
        model,
        grid,
        intervals,
        z,
        physical,
        scale=scale,
        gain=gain,
        feedback=feedback,
        seen=seen,
        method=method,
    )
    return found, grid, feedback, seen, point, rng.normal(size=(m, states)), rng


def by_hand(found, grid, feedback, seen, z, nodes):
    """Outputs (M, L, ny), ends (M, n) of the recursion, one sample at a time."""
    plan, core, ny = found.intervals, found.core, found.ny
    d = core.at(z, 0)
    drives = found.drives_at(z)
    v = np.array([drives[list(group)].sum(axis=0) for group in core.groups] + [np.ones(grid.samples)])
    v = v[: core.drives]
    y, ends = np.zeros((plan.m, plan.length, ny)), np.zeros((plan.m, found.n))
    for i, x in enumerate(nodes):
        for k in range(plan.length):
            at = min(i * plan.length + k, grid.samples - 1)
            later = min(at + 1, grid.samples - 1)
            there = seen[:, at] & (i * plan.length + k < grid.samples)
            correction = found.gain.at(z, core, d, tuple(bool(part) for part in there))
            error = np.where(there, feedback[:, at] - d.c[0] @ x - d.d[0] @ v[:, at], 0.0)
            y[i, k] = d.c[0] @ x + d.d[0] @ v[:, at]
            if correction.whitener is not None:
                given = np.where(there, feedback[:, at], 0.0)
                rest = given + correction.whitener[0] @ (y[i, k] - given)
                y[i, k] = np.where(there, rest, y[i, k])
            x = x + correction.lift[0] @ error
            x = d.f[0] @ x + d.g0[0] @ v[:, at] + d.g1[0] @ v[:, later]
        ends[i] = x
    return y, ends


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("method", ["exact", "euler"])
def test_missing_outputs_are_skipped(made, kind, method):
    found, grid, feedback, seen, z, nodes, _ = case(made, 1, kind=kind, method=method)
    path = found.propagate(z, nodes, 1)
    y, ends = by_hand(found, grid, feedback, seen, z, nodes)
    real = np.arange(grid.samples)
    got = made.by_interval(found.intervals, 2, path.y[0]).reshape(-1, 2)[real]
    wanted = y.reshape(-1, 2)[real]
    # an output that was not measured may be shown whitened or not: nobody asks
    np.testing.assert_allclose(got[seen.T], wanted[seen.T], atol=1e-11)
    np.testing.assert_allclose(path.end[:, :-1], ends[:-1].T, atol=1e-11)
    np.testing.assert_allclose(found.propagate(z, nodes, 0).y[0], path.y[0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "shape", [{}, {"outputs": 1, "stride": 2}, {"outputs": 1, "states": 1, "plan": (4, 1, 1)}]
)
def test_derivatives_equal_differences(made, kind, shape):
    found, *_, z, nodes, rng = case(made, 5, kind=kind, **shape)
    path, e, n = found.propagate(z, nodes, 1), 1e-5, found.n
    rho, lam = rng.normal(size=path.y[0].shape), rng.normal(size=path.end.shape)

    def total(at):
        slope = (rho * at.y[1:]).sum(axis=(1, 2, 3)) + (lam * at.end_z).sum(axis=(1, 2))
        start = np.einsum("kbi,kbia->ai", rho, at.ys) + np.einsum("ai,iac->ci", lam, at.end_s)
        return slope, start

    zz, zs, ss = found.contraction(z, path, rho, lam)
    assert not ss.any()
    for k in range(len(z)):
        step = e * np.eye(len(z))[k]
        high, low = (found.propagate(z + s, nodes, 1) for s in (step, -step))
        assert made.off(path.y[1 + k], (high.y[0] - low.y[0]) / (2 * e)) < 2e-6
        assert made.off(path.end_z[k], (high.end - low.end) / (2 * e)) < 2e-6
        (a, b), (c, d) = total(high), total(low)
        np.testing.assert_allclose(zz[k], (a - c) / (2 * e), atol=1e-5 * np.abs(zz).max())
        np.testing.assert_allclose(zs[k], (b - d) / (2 * e), atol=1e-5 * np.abs(zs).max())
    for a in range(n):  # affine in the start
        ahead = found.propagate(z, nodes + np.eye(n)[a], 0)
        np.testing.assert_allclose(ahead.y[0] - path.y[0], path.ys[..., a], atol=1e-10)
        np.testing.assert_allclose((ahead.end - path.end).T, path.end_s[:, :, a], atol=1e-10)


def test_an_unstable_model_far_off_is_refused(made):
    found, *_, z, nodes, _ = case(made, 1)
    with pytest.raises(FloatingPointError, match="not finite"):
        found.propagate(z, nodes * np.inf, 1)


def test_without_parameters_there_is_no_hessian(made):
    rng = np.random.default_rng(0)
    model = made.linear(rng, states=2, inputs=1, outputs=1)
    grid, plan = made.grid(rng.normal(size=(1, 12))), Intervals(2, 2, 3, np.arange(3))
    none, scale = ca.SX(0, 1), made.scale(model)
    gain = StatedGain(ca.SX([[0.3], [0.1]]), none, scale)
    seen = np.arange(12)[None] % 3 > 0
    found = GappyPredictor(
        model, grid, plan, none, ca.DM(model.parameter_vector()), scale=scale, gain=gain,
        feedback=rng.normal(size=(1, 12)), seen=seen,
    )  # fmt: skip
    path = found.propagate(np.zeros(0), np.zeros((2, 2)), 1)
    zz, zs, ss = found.contraction(np.zeros(0), path, np.ones(path.y[0].shape), np.ones((2, 2)))
    assert (zz.shape, zs.shape, ss.shape) == ((0, 0), (0, 2, 2), (2, 2, 2))

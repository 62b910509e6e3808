"""Derivatives of the general propagator against CasADi, on the same Runge-Kutta recursion written out."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.runge_kutta import Fineness, RungeKuttaPropagator
from casadi_engine.simulation.tableau import RADAU, RUNGE_KUTTA

TOLERANCE = 1e-9


def compared(made, model, seed, *, plan=(2, 2, 2), stride=1, step=0.05, substeps=1, channels=1):
    """Value, first and second differences from the reference."""
    rng = np.random.default_rng(seed)
    m, b, q = plan
    intervals = Intervals(m, b, q, np.arange(0, q, stride))
    samples = intervals.padded + 1
    grid = made.grid(
        rng.normal(size=(channels, samples)), samples=samples, step=step, holds=("first",) * channels
    )
    z = ca.SX.sym("z", model.p.numel())
    physical = z * (1 + 0.3 * ca.sin(z)) if z.numel() else ca.DM.zeros(0, 1)
    scale = made.scale(model)
    fineness = Fineness(RUNGE_KUTTA, np.full(grid.samples - 1, substeps))
    propagator = RungeKuttaPropagator(model, grid, intervals, z, physical, scale=scale, fineness=fineness)
    step_rule = made.runge_kutta_step(substeps)
    reference = made.reference(model, grid, intervals, z, physical, scale, step_rule)
    point, nodes = rng.uniform(0.5, 1.5, z.numel()), rng.normal(size=(m, len(scale)))
    found = made.compare(propagator, reference, point, nodes, rng)
    print("value {:.1e}, first {:.1e}, second {:.1e}".format(*found))
    return found


CASES = {
    "one state": {"states": 1},
    "two states": {"states": 2},
    "three states": {"states": 3},
    "two states, strided": {"states": 2, "plan": (2, 2, 4), "stride": 2},
    "one-sample intervals": {"states": 2, "plan": (5, 1, 1)},
    "single interval": {"states": 2, "plan": (1, 2, 3)},
    "many intervals": {"states": 2, "plan": (45, 1, 2)},
    "three steps a sample": {"states": 2, "substeps": 3},
    "as many intervals as states": {"states": 3, "plan": (3, 1, 2)},
}


@pytest.mark.parametrize("name", CASES)
def test_first_and_second_derivatives_equal_casadis(made, name):
    options = dict(CASES[name])
    model = made.general(np.random.default_rng(len(name)), states=options.pop("states"))
    assert max(compared(made, model, sum(map(ord, name)), **options)) < TOLERANCE


def test_a_linear_model_has_the_same_derivatives_here(made):
    model = made.linear(np.random.default_rng(3), states=2, inputs=2, outputs=2)
    assert max(compared(made, model, 5, channels=2, step=0.02)) < TOLERANCE


def differences(propagator, z, nodes, rho, lam, width=1e-5):
    """Outputs' and ends' derivatives to (z, starts), and those of the weighted gradient, by central differences."""
    m, n = nodes.shape

    def weighted(point):
        path = propagator.propagate(point[: len(z)], point[len(z) :].reshape(m, n), 1)
        in_z = np.einsum("kbm,zkbm->z", rho, path.y[1:]) + np.einsum("nm,znm->z", lam, path.end_z)
        ys = np.broadcast_to(path.ys, (*path.y.shape[1:], n))
        in_nodes = np.einsum("kbm,kbma->ma", rho, ys) + np.einsum("nm,mna->ma", lam, path.end_s)
        value = float((rho * path.y[0]).sum() + (lam * path.end).sum())
        return value, np.concatenate([in_z, in_nodes.ravel()])

    at = np.concatenate([z, nodes.ravel()])
    first, second = [], []
    for i in range(len(at)):
        step = np.zeros(len(at))
        step[i] = width
        (up, up_slope), (down, down_slope) = weighted(at + step), weighted(at - step)
        first.append((up - down) / (2 * width))
        second.append((up_slope - down_slope) / (2 * width))
    return weighted(at)[1], np.array(first), np.array(second)


@pytest.mark.parametrize("scheme", [RUNGE_KUTTA, RADAU], ids=["explicit", "implicit"])
@pytest.mark.parametrize("jumps", [False, True], ids=["smooth", "with jumps in time"])
def test_derivatives_equal_differences(made, scheme, jumps):
    rng = np.random.default_rng(7)
    model = made.switched() if jumps else made.general(rng, states=2)
    intervals = Intervals(3, 2, 2, np.arange(2))
    grid = made.grid(rng.normal(size=(len(model.inputs), 11)), samples=11, step=0.1)
    z, scale = model.p, made.scale(model)
    counts = rng.integers(1, 4, grid.samples - 1)
    propagator = RungeKuttaPropagator(
        model, grid, intervals, z, z, scale=scale, fineness=Fineness(scheme, counts)
    )
    point, nodes = model.parameter_vector(), rng.normal(size=(3, len(scale)))
    path = propagator.propagate(point, nodes, 1)
    rho, lam = rng.normal(size=path.y[0].shape), rng.normal(size=path.end.shape)
    exact, first, second = differences(propagator, point, nodes, rho, lam)
    np.testing.assert_allclose(exact, first, rtol=1e-7, atol=1e-7)
    zz, zs, ss = propagator.contraction(point, path, rho, lam)
    nz, n = len(point), len(scale)
    np.testing.assert_allclose(zz, second[:nz, :nz], rtol=1e-6, atol=1e-6)
    for i in range(3):
        rows = slice(nz + i * n, nz + (i + 1) * n)
        np.testing.assert_allclose(zs[:, :, i], second[:nz, rows], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(ss[i], second[rows, rows], rtol=1e-6, atol=1e-6)

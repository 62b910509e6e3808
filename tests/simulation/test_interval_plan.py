"""Cutting a record into intervals: every length gives the same trajectory and the same outputs."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.simulation.grid import Grid, Measured
from casadi_engine.simulation.intervals import Observation, cut
from casadi_engine.simulation.linear import LinearPropagator
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator

LENGTHS = [1, 2, 3, 7, 16, 17, 20, 31, 37, 48, 97, 144, 293, 10_000, None]


@pytest.fixture(scope="module")
def shaft(made):
    """A linear model with two outputs and its function of z."""
    return made.linear(np.random.default_rng(0), states=2, inputs=1, outputs=2)


def grid_of(made, samples, measured=None, seed=0):
    return made.grid(np.random.default_rng(seed).normal(size=(1, samples)), measured=measured, step=0.02)


def continuous(propagator, z, start):
    """Starts of all intervals on one trajectory, and d(starts)/d(start, z): (M, n), (M, n, n + nz)."""
    plan, n, nz = propagator.intervals, len(start), len(z)
    nodes, slopes = np.zeros((plan.m, n)), np.zeros((plan.m, n, n + nz))
    nodes[0], slopes[0, :, :n] = start, np.eye(n)
    for i in range(plan.m - 1):
        path = propagator.propagate(z, nodes, 1)
        free = np.broadcast_to(path.end_s, (plan.m, n, n))[i]
        nodes[i + 1] = path.end[:, i]
        slopes[i + 1] = free @ slopes[i]
        slopes[i + 1, :, n:] += path.end_z[:, :, i].T
    return nodes, slopes


def measured_response(propagator, observation, z, start):
    """Outputs at the measured samples, and their derivatives in (start, z), in the order of the samples."""
    nodes, slopes = continuous(propagator, z, start)
    path = propagator.propagate(z, nodes, 1)
    y = observation.observe(path.y)
    ys = observation.observe_starts(path.ys)
    ys = np.repeat(ys[:, None], propagator.intervals.m, axis=1) if ys.ndim == 2 else ys
    total = np.einsum("kma,mab->kmb", ys, slopes)
    total[..., len(start) :] += y[1:].transpose(1, 2, 0)
    found = {}
    for name in observation.where:
        flat = observation.where[name]
        found[name] = (y[0].ravel()[flat], total.reshape(-1, total.shape[-1])[flat])
    return found


def response(made, model, grid, length, kind=LinearPropagator):
    z = ca.SX.sym("z", model.p.numel())
    plan = cut(grid, length)
    propagator = kind(model, grid, plan, z, z, scale=made.scale(model))
    observation = Observation(grid, plan, tuple(v.name for v in model.outputs))
    return measured_response(propagator, observation, np.array([0.8, 1.2]), np.array([0.3, -0.5]))


# ---- any length


def check_same(made, model, grid, tolerance, kind=LinearPropagator, lengths=LENGTHS):
    wanted = response(made, model, grid, None, kind)
    for length in lengths:
        found = response(made, model, grid, length, kind)
        for name, (values, slopes) in wanted.items():
            assert made.off(found[name][0], values) < tolerance, length
            assert made.off(found[name][1], slopes) < tolerance, length


@pytest.mark.parametrize("samples", [293, 288])
def test_every_length_gives_the_same_trajectory_and_derivatives(made, shaft, samples):
    grid = grid_of(made, samples)
    every = {name: made.points(grid, np.arange(samples)) for name in ("y0", "y1")}
    check_same(made, shaft, grid_of(made, samples, every), 1e-11)


@pytest.mark.parametrize(("stride", "offset"), [(2, 0), (5, 3), (15, 0), (20, 7), (64, 1), (100, 10)])
def test_outputs_at_a_stride(made, shaft, stride, offset):
    grid = grid_of(made, 293)
    position = np.arange(offset, 293, stride)
    some = {name: made.points(grid, position) for name in ("y0", "y1")}
    check_same(made, shaft, grid_of(made, 293, some), 1e-11, lengths=[1, 7, 20, 37, 97, 144])
    # The same numbers as with outputs at every sample.
    every = {name: made.points(grid, np.arange(293)) for name in ("y0", "y1")}
    whole = response(made, shaft, grid_of(made, 293, every), None)
    for name, (values, slopes) in response(made, shaft, grid_of(made, 293, some), 20).items():
        assert made.off(values, whole[name][0][position]) < 1e-11
        assert made.off(slopes, whole[name][1][position]) < 1e-11


def test_outputs_at_different_strides_and_with_missing_samples(made, shaft):
    grid = grid_of(made, 293)
    rng = np.random.default_rng(2)
    first = np.setdiff1d(np.arange(0, 293, 3), rng.choice(293, 60))
    some = {"y0": made.points(grid, first), "y1": made.points(grid, np.arange(6, 293, 12))}
    every = {name: made.points(grid, np.arange(293)) for name in ("y0", "y1")}
    whole = response(made, shaft, grid_of(made, 293, every), None)
    for length in (1, 7, 48, None):
        found = response(made, shaft, grid_of(made, 293, some), length)
        for name, sample in some.items():
            assert made.off(found[name][0], whole[name][0][sample.position]) < 1e-11


def test_an_output_that_was_not_measured_is_left_out(made, shaft):
    grid = grid_of(made, 50)
    grid = grid_of(made, 50, {"y1": made.points(grid, np.arange(50), np.arange(50.0))})
    plan = cut(grid, 20)
    observation = Observation(grid, plan, ("y0", "y1"))
    assert observation.valid.sum() == 50
    assert set(np.unique(observation.column[observation.valid])) == {1}
    np.testing.assert_array_equal(observation.series(observation.measured, "y1"), np.arange(50.0))


@pytest.mark.parametrize("samples", [2, 3, 4, 5, 17])
def test_short_records(made, shaft, samples):
    grid = grid_of(made, samples)
    every = {name: made.points(grid, np.arange(samples)) for name in ("y0", "y1")}
    check_same(made, shaft, grid_of(made, samples, every), 1e-12, lengths=[1, 2, 3, 16, 100])


def test_a_single_measured_sample(made, shaft):
    grid = grid_of(made, 40)
    lone = {"y0": made.points(grid, [23])}
    check_same(made, shaft, grid_of(made, 40, lone), 1e-12, lengths=[1, 7, 16, 100])


def test_the_general_propagator_too(made):
    model = made.general(np.random.default_rng(1))
    grid = grid_of(made, 61)
    strided = {"y0": made.points(grid, np.arange(0, 61, 4)), "y1": made.points(grid, np.arange(61))}
    check_same(
        made,
        model,
        grid_of(made, 61, strided),
        1e-11,
        kind=RungeKuttaPropagator,
        lengths=[1, 2, 7, 16, 20, 60],
    )


# ---- the plan


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.integers(2, 3000), st.integers(1, 400), st.integers(1, 70))
def test_a_plan_holds_every_sample(samples, length, stride):
    position = np.arange(0, samples, stride)
    at = Measured(position * 1.0, position * 1.0, position, np.arange(len(position)))
    grid = Grid(0.0, 1.0, samples, np.zeros((0, samples)), (), {"y": at})
    plan = cut(grid, length)
    assert plan.padded >= samples
    assert plan.padded - samples < max(plan.length, 1)
    assert plan.q <= 128
    assert length <= plan.length < max(2 * length, length + 64, 65) or plan.m == 1
    observation = Observation(grid, plan, ("y",))
    assert observation.valid.sum() == len(position)
    np.testing.assert_array_equal(observation.series(observation.measured, "y"), position)


def test_blocks_suit_the_stride(made):
    grid = grid_of(made, 1440)
    some = {"y": made.points(grid, np.arange(0, 1440, 15))}
    plan = cut(grid_of(made, 1440, some), 144)
    assert plan.length == 150
    assert plan.q % 15 == 0
    assert len(plan.samples) == plan.q // 15


def test_wanted_lengths_with_a_good_block_are_kept(made):
    grid = grid_of(made, 14400)
    lengths = [cut(grid, length).length for length in (1, 13, 20, 144, 1440, 1009)]
    assert lengths == [1, 13, 20, 144, 1440, 1024]


def test_the_adjoint_is_the_transpose(made):
    rng = np.random.default_rng(6)
    grid = grid_of(made, 50)
    position = np.arange(0, 50, 2)
    measured = {"y1": made.points(grid, position), "y0": made.points(grid, np.arange(0, 50, 4))}
    grid = grid_of(made, 50, measured)
    plan = cut(grid, 8)
    observation = Observation(grid, plan, ("y0", "y1"))
    y = rng.normal(size=(len(plan.samples) * 2, plan.b, plan.m))
    rho = rng.normal(size=observation.shape)
    assert (observation.observe(y) * rho).sum() == pytest.approx(
        (observation.adjoint(rho) * y).sum(), rel=1e-12
    )
    ys = rng.normal(size=(len(plan.samples) * 2, plan.b, 3))
    shared = observation.observe_starts(ys)
    own = observation.observe_starts(np.repeat(ys[:, :, None], plan.m, axis=2))
    np.testing.assert_allclose(
        own, shared if shared.ndim == 3 else np.repeat(shared[:, None], plan.m, axis=1)
    )


def test_points_that_are_left_out_do_not_count(made):
    grid = grid_of(made, 30)
    grid = grid_of(
        made, 30, {"y0": made.points(grid, np.arange(30)), "y1": made.points(grid, np.arange(0, 30, 5))}
    )
    observation = Observation(grid, cut(grid, 8), ("y0", "y1"))
    gone = np.zeros(30, dtype=bool)
    gone[[5, 6]] = True
    observation.leave_out(gone)
    np.testing.assert_array_equal(np.flatnonzero(~observation.series(observation.valid, "y0")), [5, 6])
    np.testing.assert_array_equal(np.flatnonzero(~observation.series(observation.valid, "y1")), [1])

"""The linear propagator: energy over a long time, joined drives, overflow, many random models."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from casadi_engine.experiment import Channel, Experiment
from casadi_engine.model import Blueprint
from casadi_engine.simulation.grid import lay_grid
from casadi_engine.simulation.intervals import Intervals, cut
from casadi_engine.simulation.linear import LinearPropagator

NONE, NOTHING = np.zeros(0), ca.SX(0, 1)

INERTIAS = (0.03, 0.045, 0.045, 0.045, 0.045, 0.168, 0.177)
STIFFNESSES = (241.8e3, 1270e3, 1270e3, 1270e3, 1427e3, 1992.0)


def chain(count):
    """An undamped chain of inertias, with the numbers of an engine's crankshaft; all states are outputs."""
    b = Blueprint("chain")
    speed = [b.state(f"w{i}", scale=100.0) for i in range(count)]
    twist = [b.state(f"t{i}", scale=1e-3) for i in range(count - 1)]
    for i in range(count):
        torque = STIFFNESSES[i] * twist[i] if i < count - 1 else 0
        torque = torque - STIFFNESSES[i - 1] * twist[i - 1] if i else torque
        b.ode(f"w{i}", torque / INERTIAS[i])
    for i in range(count - 1):
        b.ode(f"t{i}", speed[i + 1] - speed[i])
    for state in (*speed, *twist):
        b.output(str(state), state)
    return b.model()


@pytest.mark.parametrize("count", [2, 3, 7])
@pytest.mark.parametrize("length", [None, 144])
def test_an_undamped_chain_keeps_its_energy_over_1e5_steps(made, count, length):
    model = chain(count)
    # 100 000 steps at 14 402 Hz; in intervals: one after the other, each from the end of the last.
    samples = 100_001 if length is None else 144 * 30
    grid = made.grid(np.zeros((0, samples)), samples=samples, step=1 / 14402)
    plan, scale = cut(grid, length), made.scale(model)
    propagator = LinearPropagator(model, grid, plan, NOTHING, NOTHING, scale=scale)
    start = np.array([120.0 + 3 * i for i in range(count)] + [1e-3 * (i + 1) for i in range(count - 1)])
    nodes = np.tile(start / scale, (plan.m, 1))
    for i in range(plan.m - 1):
        nodes[i + 1] = propagator.propagate(NONE, nodes, 0).end[:, i]
    path = propagator.propagate(NONE, nodes, 0)
    x = made.by_interval(plan, len(start), path.y)[..., 0].reshape(-1, len(start))[:samples]
    speed, twist = x[:, :count], x[:, count:]
    kinetic = (np.array(INERTIAS[:count]) * speed**2).sum(axis=1) / 2
    energy = kinetic + (np.array(STIFFNESSES[: count - 1]) * twist**2).sum(axis=1) / 2
    momentum = speed @ np.array(INERTIAS[:count])
    vibration = energy - momentum**2 / (2 * sum(INERTIAS[:count]))
    assert len(energy) == samples
    assert np.abs(energy / energy[0] - 1).max() < 1e-12
    assert np.abs(vibration / vibration[0] - 1).max() < 1e-11
    assert np.abs(momentum / momentum[0] - 1).max() < 1e-12


def test_a_record_equals_an_integrators(made):
    model = made.linear(np.random.default_rng(11), states=3, inputs=2, outputs=2)
    rng = np.random.default_rng(12)
    # The random models have drives that hang on time; fine steps make their broken line as good as the curve.
    grid = made.grid(rng.normal(size=(2, 60)), step=0.05)
    p, scale = model.parameter_vector(), made.scale(model)
    propagator = LinearPropagator(model, grid, cut(grid, None), NOTHING, ca.DM(p), scale=scale)
    drives = propagator.drives_at(NONE)
    rate = ca.Function("rate", [model.x, model.d, model.p], [model.ode])
    out = ca.Function("out", [model.x, model.d, model.p], [model.output_expressions])
    start = rng.normal(size=3)
    path = propagator.propagate(NONE, (start / scale)[None], 0)
    found = made.by_interval(propagator.intervals, 2, path.y)[0, :60, :, 0]
    x = start
    for k in range(59):
        np.testing.assert_allclose(
            found[k], np.asarray(out(x, drives[:, k], p)).ravel(), rtol=1e-9, atol=1e-9
        )

        def slope(t, x, k=k):
            d = drives[:, k] + (drives[:, k + 1] - drives[:, k]) * t / grid.step
            return np.asarray(rate(x, d, p)).ravel()

        x = solve_ivp(slope, (0, grid.step), x, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.data())
def test_derivatives_of_random_models_equal_casadis(made, data):
    seed = data.draw(st.integers(0, 10**6))
    rng = np.random.default_rng(seed)
    inputs = data.draw(st.integers(0, 3))
    model = made.linear(
        rng,
        states=data.draw(st.integers(1, 4)),
        inputs=inputs,
        outputs=data.draw(st.integers(1, 2)),
        parameters=data.draw(st.integers(1, 2)),
        through=data.draw(st.booleans()),
        offsets=data.draw(st.booleans()),
    )
    m, b, q = (data.draw(st.integers(1, 2)) for _ in range(3))
    plan = Intervals(m, b, q, np.arange(q))
    holds = tuple(data.draw(st.sampled_from(["first", "zero"])) for _ in range(inputs))
    samples = max(2, plan.padded)
    plan = plan if plan.padded >= samples else Intervals(2, b, q, plan.samples)
    grid = made.grid(
        rng.normal(size=(inputs, samples)).reshape(inputs, samples), samples=samples, holds=holds
    )
    z = ca.SX.sym("z", model.p.numel())
    physical, scale = z * (1 + 0.3 * ca.sin(z)), made.scale(model)
    propagator = LinearPropagator(model, grid, plan, z, physical, scale=scale)
    step = made.exact_step(propagator._drives.holds)
    reference = made.reference(model, grid, plan, z, physical, scale, step)
    point, nodes = rng.uniform(0.5, 1.5, z.numel()), rng.normal(size=(plan.m, len(scale)))
    assert max(made.compare(propagator, reference, point, nodes, rng)) < 1e-9


def test_drives_that_act_alike_are_summed(made):
    b = Blueprint("engine")
    w, k = b.state("w"), b.parameter("k", 2.0)
    torques = [b.input(f"T{i}") for i in range(4)]
    b.ode("w", sum(torques[:3]) - 0.1 * w - k * torques[3])
    b.output("w", w)
    model = b.model()
    values = np.random.default_rng(0).normal(size=(4, 80))
    apart = made.grid(values, step=0.05)
    together = made.grid(np.vstack([values[:3].sum(axis=0), np.zeros((2, 80)), values[3:]]), step=0.05)
    found = []
    for grid in (apart, together):
        propagator = LinearPropagator(model, grid, cut(grid, 16), model.p, model.p, scale=np.ones(1))
        assert propagator.core.drives == 2
        found.append(propagator.propagate(np.array([2.0]), np.ones((5, 1)), 1).y)
    np.testing.assert_allclose(found[0], found[1], atol=1e-13)


def test_the_sensitivity_to_the_start_is_shared_by_all_intervals(made):
    model = made.linear(np.random.default_rng(0), states=3)
    grid = made.grid(np.random.default_rng(1).normal(size=(1, 50)))
    propagator = LinearPropagator(model, grid, cut(grid, 10), model.p, model.p, scale=made.scale(model))
    path = propagator.propagate(np.ones(2), np.zeros((5, 3)), 1)
    assert path.end_s.shape == (1, 3, 3)
    assert path.ys.shape == (10, 1, 3)


def test_second_derivatives_after_a_new_point_are_those_of_the_new_point(made):
    model = made.linear(np.random.default_rng(4), states=2)
    grid = made.grid(np.random.default_rng(5).normal(size=(1, 30)))
    plan, scale = cut(grid, 10), made.scale(model)

    def hessian(points):
        propagator = LinearPropagator(model, grid, plan, model.p, model.p, scale=scale)
        for z in points:
            path = propagator.propagate(np.array(z), np.ones((3, 2)), 1)
            found = propagator.contraction(np.array(z), path, np.ones(path.y[0].shape), np.ones((2, 3)))
        return found

    for once, twice in zip(hessian([(1.0, 0.7)]), hessian([(0.3, 0.2), (1.0, 0.7)]), strict=True):
        np.testing.assert_array_equal(once, twice)


def test_a_model_without_parameters_has_no_hessian(made):
    grid = made.grid(np.zeros((0, 20)), samples=20)
    propagator = LinearPropagator(chain(2), grid, cut(grid, 5), NOTHING, NOTHING, scale=np.ones(3))
    path = propagator.propagate(NONE, np.ones((4, 3)), 1)
    found = propagator.contraction(NONE, path, np.ones(path.y[0].shape), np.ones((3, 4)))
    assert [part.shape for part in found] == [(0, 0), (0, 3, 4), (4, 3, 3)]


@pytest.mark.parametrize("rate", [1e2, 1e6, 1e200, 1e306])
@pytest.mark.parametrize("order", [0, 1])
def test_a_state_that_overflows_is_reported_without_noise(made, rate, order):
    b = Blueprint("unstable")
    x, a, u = b.state("x"), b.parameter("a", 1.0), b.input("u")
    b.ode("x", a * x + u)
    b.output("x", x)
    grid = made.grid(np.ones((1, 500)), step=0.1)
    propagator = LinearPropagator(
        b.model(), grid, cut(grid, None), ca.SX.sym("z"), ca.SX(-1.0), scale=np.ones(1)
    )
    assert np.isfinite(propagator.propagate(np.ones(1), np.ones((1, 1)), order).y).all()
    model = b.model()
    propagator = LinearPropagator(model, grid, cut(grid, None), model.p, model.p, scale=np.ones(1))
    with pytest.raises(FloatingPointError, match="is not finite here"):
        propagator.propagate(np.array([rate]), np.ones((1, 1)), order)


def test_channels_of_different_rates_and_a_resampled_output_give_the_same_end(made):
    """The whole way from an experiment: what is known of the inputs is the same at all output rates."""
    b = Blueprint("lag")
    x, u, v = b.state("x"), b.input("u"), b.input("v")
    b.ode("x", u - v - 2 * x)
    b.output("x", x)
    model = b.model()
    fast, slow = np.arange(1001) / 1000, np.arange(51) / 50
    channels = [
        Channel("u", "1", time=fast, values=np.sin(20 * fast)),
        Channel("v", "1", time=slow, values=np.cos(5 * slow), hold="zero"),
    ]
    ends = []
    for stride in (1, 4, 20):
        output = Channel("x", "1", time=fast[::stride], values=0 * fast[::stride])
        grid = lay_grid(model, Experiment("run", (*channels, output)))
        assert grid.samples == 1001
        propagator = LinearPropagator(model, grid, cut(grid, None), NOTHING, NOTHING, scale=np.ones(1))
        path = propagator.propagate(NONE, np.ones((1, 1)), 0)
        plan = propagator.intervals
        y = made.by_interval(plan, 1, path.y)[0, :, 0, 0]
        ends.append(y[list(made.sample_numbers(plan)).index(1000)])
    np.testing.assert_allclose(ends, ends[0], rtol=1e-13)

    def slope(t, x):
        return np.interp(t, fast, np.sin(20 * fast)) - np.cos(5 * np.floor(t * 50 + 1e-9) / 50) - 2 * x

    x = np.ones(1)
    for k in range(50):
        inside = (k / 50 + 1e-12, (k + 1) / 50 - 1e-12)
        x = solve_ivp(slope, inside, x, rtol=1e-10, atol=1e-12, max_step=1e-3).y[:, -1]
    assert ends[0] == pytest.approx(x[0], rel=1e-8)

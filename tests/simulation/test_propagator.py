"""Which propagator a model gets, and the correction gain with and without missing samples."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_engine.errors import SimulationError
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.model import Blueprint, one_inertia
from casadi_engine.simulation.exponential_runge_kutta import ExponentialPropagator
from casadi_engine.simulation.gappy import GappyPredictor
from casadi_engine.simulation.grid import lay_grid
from casadi_engine.simulation.intervals import cut
from casadi_engine.simulation.linear import LinearPropagator
from casadi_engine.simulation.propagator import after_missing, make_propagator
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator

NONE = np.zeros(0)


def shaft(*, outputs=("w", "twist"), output_gain=None):
    """Two states; by default both are measured."""
    b = Blueprint("shaft")
    w, twist, torque = b.state("w", scale=10.0), b.state("twist", scale=0.1), b.input("T")
    k = b.parameter("k", 4.0)
    b.ode("w", torque - k * twist - 0.3 * w)
    b.ode("twist", w - 0.1 * twist)
    factor = b.parameter("s", 1.0) if output_gain else 1.0
    for name, state in (("w", w), ("twist", twist)):
        if name in outputs:
            b.output(name, factor * state)
    return b.model()


def arrays(model, *, gone=(), count=30, rate=10.0, stride=1):
    """Channels of random numbers; ``gone``: samples of w that are missing."""
    rng = np.random.default_rng(0)
    time = np.arange(count) / rate
    values = {"T": rng.normal(size=count)}
    for out in model.outputs:
        row = rng.normal(size=count)
        if out.name == "w":
            row[list(gone)] = np.nan
        values[out.name] = (time[::stride], row[::stride])
    return time, values


def propagator(made, model, gain, *, length=7, method="exact", **kind):
    time, values = arrays(model, **kind)
    grid = lay_grid(model, made.experiment(model, time, **values))
    scale = made.scale(model)
    p = ca.DM(model.parameter_vector())
    scaled = None if gain is None else np.asarray(gain, dtype=float) / scale[:, None]
    plan = cut(grid, length)
    return make_propagator(model, grid, plan, ca.SX(0, 1), p, scale=scale, gain=scaled, method=method), grid


# ---- the choice


def test_a_linear_model_is_propagated_exactly_and_any_other_by_steps(made):
    assert isinstance(propagator(made, shaft(), None)[0], LinearPropagator)
    model = made.general(np.random.default_rng(0))
    grid = made.grid(np.zeros((1, 5)))
    made_for = make_propagator(
        model, grid, cut(grid, None), model.p, model.p, scale=made.scale(model), method="exact"
    )
    assert isinstance(made_for, RungeKuttaPropagator)


@pytest.mark.parametrize(
    ("law", "kind"),
    [
        (lambda q, t: -(q**3), ExponentialPropagator),
        (lambda q, t: -2 * q, LinearPropagator),
        # time itself is known between the samples, where a line through them is not enough
        (lambda q, t: -2 * q + ca.sin(t), ExponentialPropagator),
        (lambda q, t: ca.sin(t), ExponentialPropagator),
        (lambda q, t: ca.if_else(t > 0.3, 1, 0), RungeKuttaPropagator),
        (lambda q, t: ca.sin(t) * q, ExponentialPropagator),
    ],
)
def test_a_law_of_the_states_takes_the_exponential_integrator_and_others_join_the_core(made, law, kind):
    b = Blueprint("sprung")
    q = b.state("q")
    slot = b.port("spring", "coupling", {"stretch": q})
    b.law("spring", law(q, b.time))
    b.ode("q", slot - q)
    b.output("y", q)
    model = b.model()
    grid = made.grid(np.zeros((0, 5)), samples=5)
    found = make_propagator(model, grid, cut(grid, None), ca.SX(0, 1), ca.SX(0, 1), scale=np.ones(1))
    assert isinstance(found, kind)
    assert found.drives_at(NONE).shape == (0, 5)


def test_an_unknown_method_is_an_error(made):
    with pytest.raises(SimulationError) as info:
        propagator(made, shaft(), None, method="exakt")
    assert str(info.value) == (
        'the method is not known; seen: \'exakt\'; allowed: "exact" or "euler"; do: leave it out for "exact"'
    )


@pytest.mark.parametrize(
    ("options", "seen"), [({"method": "euler"}, "method='euler'"), ({"gain": np.eye(2)}, "a correction gain")]
)
def test_options_for_linear_models_are_refused_by_others(made, options, seen):
    model = made.general(np.random.default_rng(0))
    grid = made.grid(np.zeros((1, 5)))
    with pytest.raises(SimulationError) as info:
        make_propagator(model, grid, cut(grid, None), model.p, model.p, scale=made.scale(model), **options)
    assert str(info.value) == (
        f"this model has nonlinear terms, and the option is for linear models; seen: {seen}; allowed: "
        'method="exact" without a gain; do: take the linear form of the model, or leave the option out'
    )


# ---- the gain


def one_step(made, model, grid, x, k):
    """The exact step of the model from sample k, by a propagator without gain."""
    part = made.grid(grid.channels[:, k : k + 2], step=grid.step, holds=grid.holds)
    p = ca.DM(model.parameter_vector())
    plain = make_propagator(model, part, cut(part, 1), ca.SX(0, 1), p, scale=np.ones(len(x)))
    return plain.propagate(NONE, np.tile(x, (2, 1)), 0).end[:, 0]


@pytest.mark.parametrize("method", ["exact", "euler"])
@pytest.mark.parametrize("length", [1, 7, None])
def test_the_state_is_corrected_before_each_step(made, method, length):
    model = shaft(outputs=("w",))
    gain = np.array([[0.4], [-0.05]])
    found, grid = propagator(made, model, gain, length=length, method=method)
    plan, scale = found.intervals, made.scale(model)
    nodes = np.random.default_rng(1).normal(size=(plan.m, 2))
    y = made.by_interval(plan, 1, found.propagate(NONE, nodes, 0).y)[..., 0, 0]
    measured = grid.measured["w"].values
    for i in range(plan.m):
        x = nodes[i] * scale
        for k in range(i * plan.length, min((i + 1) * plan.length, grid.samples - 1)):
            assert y[i, k - i * plan.length] == pytest.approx(x[0], rel=1e-12, abs=1e-12)
            corrected = x + gain[:, 0] * (measured[k] - x[0])
            if method == "exact":
                x = one_step(made, model, grid, corrected, k)
            else:
                slope = [
                    grid.channels[0, k] - 4 * corrected[1] - 0.3 * corrected[0],
                    corrected[0] - 0.1 * corrected[1],
                ]
                x = corrected + grid.step * np.array(slope)


def test_the_gain_has_the_right_derivatives(made):
    model = shaft(outputs=("w",))
    time, values = arrays(model)
    grid = lay_grid(model, made.experiment(model, time, **values))
    z = ca.SX.sym("z", 1)
    gain = np.array([[0.04], [-0.5]])
    path = make_propagator(model, grid, cut(grid, 7), z, z, scale=made.scale(model), gain=gain)
    nodes = np.random.default_rng(1).normal(size=(path.intervals.m, 2))
    at, e = np.array([3.0]), 1e-5
    low, high = (path.propagate(at + s, nodes, 1) for s in (-e, e))
    middle = path.propagate(at, nodes, 1)
    made_slope = (high.y[0] - low.y[0]) / (2 * e)
    assert made.off(middle.y[1], made_slope) < 1e-8
    rho, lam = np.ones(middle.y[0].shape), np.ones((2, path.intervals.m))
    zz, zs, _ = path.contraction(at, middle, rho, lam)
    sums = [part.y[1].sum() + part.end_z.sum() for part in (low, high)]
    assert zz[0, 0] == pytest.approx((sums[1] - sums[0]) / (2 * e), rel=1e-7)
    ends = [np.einsum("kba->a", part.ys) + part.end_s.sum(axis=(0, 1)) for part in (low, high)]
    np.testing.assert_allclose(
        zs[0], np.tile((ends[1] - ends[0])[:, None] / (2 * e), path.intervals.m), rtol=1e-6
    )


# ---- missing samples


def test_a_full_correction_goes_over_missing_samples(made):
    gone = (4, 11, 12, 13, 20)
    found, grid = propagator(made, shaft(), np.eye(2), gone=gone, length=9)
    whole, _ = propagator(made, shaft(), np.eye(2), length=9)
    nodes = np.zeros((found.intervals.m, 2))
    after = after_missing(grid)
    np.testing.assert_array_equal(np.flatnonzero(after), [5, 12, 13, 14, 21])
    y, wanted = (
        made.by_interval(part.intervals, 2, part.propagate(NONE, nodes, 0).y)[..., 0].reshape(-1, 2)[:30]
        for part in (found, whole)
    )
    assert np.isfinite(y).all()
    np.testing.assert_allclose(y[~after], wanted[~after], rtol=1e-13)
    assert (np.abs(y[after] - wanted[after]).max(axis=1) > 1e-3).all()


def test_samples_after_a_missing_one_do_not_count(made):
    model = one_inertia()
    rng = np.random.default_rng(0)
    time = np.arange(50) * 0.02
    torque, speed = rng.normal(size=50), 20 + rng.normal(size=50)
    speed[[7, 8, 30]] = np.nan
    data = made.experiment(model, time, omega=speed, T=torque)
    z = model.p
    term = RecordTerm(model, data, z, z, length=16, gain=np.eye(1) / 100, method="exact")
    assert term.count == 50 - 3 - 2  # sample 8 is missing and follows a missing one
    counts = term.observation.series(term.observation.valid, "omega")
    np.testing.assert_array_equal(term.grid.measured["omega"].index[~counts], [9, 31])
    point = term.evaluate(np.array([0.4, 0.1]), np.full((term.plan.m, 1), 20.0))
    assert np.isfinite(point.r).all()
    assert not point.r[~term.observation.valid].any()
    plain = RecordTerm(model, data, z, z, length=16, gain=None, method="exact")
    assert plain.count == 47


@pytest.mark.parametrize("length", [7, None])
def test_a_gain_with_memory_skips_its_correction_where_a_sample_is_missing(made, length):
    gone, model, gain = (4, 5, 20), shaft(outputs=("w",)), np.array([[0.4], [-0.05]])
    found, grid = propagator(made, model, gain, gone=gone, length=length)
    plan, scale = found.intervals, made.scale(model)
    nodes = np.random.default_rng(1).normal(size=(plan.m, 2))
    y = made.by_interval(plan, 1, found.propagate(NONE, nodes, 0).y)[..., 0, 0]
    measured = dict(zip(grid.measured["w"].position.astype(int), grid.measured["w"].values, strict=True))
    assert sorted(set(range(grid.samples)) - set(measured)) == list(gone)
    for i in range(plan.m):
        x = nodes[i] * scale
        for k in range(i * plan.length, min((i + 1) * plan.length, grid.samples - 1)):
            assert y[i, k - i * plan.length] == pytest.approx(x[0], rel=1e-11, abs=1e-11)
            error = measured[k] - x[0] if k in measured else 0.0
            x = one_step(made, model, grid, x + gain[:, 0] * error, k)


def test_a_gain_for_outputs_that_hang_on_parameters_has_a_memory(made):
    found, _ = propagator(made, shaft(output_gain=True), np.eye(2), gone=(4,))
    assert isinstance(found, GappyPredictor)
    found, _ = propagator(made, shaft(), np.eye(2), gone=(4,))
    assert isinstance(found, LinearPropagator)


def test_outputs_without_neighbours_cannot_be_predicted(made):
    with pytest.raises(SimulationError) as info:
        propagator(made, shaft(), np.eye(2), stride=3)
    assert str(info.value) == (
        "there are no two neighbouring samples to predict one from the other; seen: 18 of 28 samples "
        "of w missing, 18 of 28 samples of twist missing; allowed: outputs at the rate of the inputs; "
        "do: resample the inputs to the output's times, or take output error (no gain)"
    )


def test_outputs_off_the_grid_cannot_be_predicted(made):
    model = shaft(outputs=("w",))
    time, values = arrays(model)
    values["w"] = (time[:-1] + 0.03, values["w"][1][:-1])
    grid = lay_grid(model, made.experiment(model, time, **values))
    with pytest.raises(SimulationError) as info:
        make_propagator(
            model, grid, cut(grid, 5), model.p, model.p, scale=made.scale(model), gain=np.ones((2, 1))
        )
    assert str(info.value) == (
        "the samples of this record are not equally spaced, or inputs and outputs were not sampled together, and "
        "the option is for linear models on equal steps; seen: a correction gain; allowed: "
        'method="exact" without a gain; do: resample the inputs to the outputs\' times, or leave the option out'
    )

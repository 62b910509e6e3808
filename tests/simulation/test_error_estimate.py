"""The estimated integration error against the true one, for every kind of propagator."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_engine.errors import SimulationError
from casadi_engine.model import Blueprint
from casadi_engine.simulation.error_estimate import (
    ErrorEstimate,
    estimate_error,
    refined_to,
)
from casadi_engine.simulation.exponential_runge_kutta import ExponentialPropagator
from casadi_engine.simulation.intervals import cut
from casadi_engine.simulation.propagator import make_propagator
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator

NONE = np.zeros(0)


def shaft(law):
    b = Blueprint("shaft")
    w, twist, torque = b.state("w", scale=10.0), b.state("twist"), b.input("T")
    slot = b.port("joint", "coupling", {"twist": twist, "twist_rate": w})
    b.ode("w", torque - 40 * twist - 0.3 * w - slot)
    b.ode("twist", w)
    b.output("w", w)
    b.output("twist", twist)
    b.law("joint", law(w))
    return b.model()


def tank():
    b = Blueprint("tank")
    level, inflow = b.state("level"), b.input("T")
    b.ode("level", 0.3 + 0.2 * inflow - 0.5 * ca.sqrt(level))
    b.output("level", level)
    return b.model()


def duffing():
    b = Blueprint("duffing")
    q, v, force = b.state("q"), b.state("v"), b.input("T")
    b.ode("q", v)
    b.ode("v", force - 0.2 * v - q - 3 * q**3)
    b.output("q", q)
    return b.model()


SYSTEMS = {
    "friction": (lambda: shaft(lambda w: 2 * ca.tanh(w)), [1.0, 0.0], ExponentialPropagator),
    "duffing": (duffing, [0.5, -1.0], RungeKuttaPropagator),
    "tank": (tank, [0.4], RungeKuttaPropagator),
}


def made_for(made, model, start, *, length=None, step=0.1, count=83, **options):
    grid = made.grid(np.sin(0.5 * np.arange(count)), step=step)
    plan = cut(grid, length)
    propagator = make_propagator(
        model, grid, plan, ca.SX(0, 1), ca.DM(model.parameter_vector()), scale=made.scale(model), **options
    )
    nodes = np.tile(np.array(start) / made.scale(model), (plan.m, 1))
    about = {"outputs": tuple(v.name for v in model.outputs), "samples": count}
    return propagator, nodes, about


@pytest.mark.parametrize("length", [None, 10])
@pytest.mark.parametrize("name", SYSTEMS)
def test_the_estimate_is_the_true_error_within_a_fifth(made, name, length):
    model, start, kind = SYSTEMS[name]
    propagator, nodes, about = made_for(made, model(), start, length=length)
    assert isinstance(propagator, kind)
    plan, ny = propagator.intervals, len(about["outputs"])

    def whole_run(own):
        for k in range(plan.m - 1):  # each interval begins where the one before ends
            nodes[k + 1] = own.propagate(NONE, nodes, 0).end[:, k]
        return own.propagate(NONE, nodes, 0).y[0]

    coarse = whole_run(propagator)
    exact = whole_run(propagator.finer(32))
    off = made.by_interval(plan, ny, np.abs(coarse - exact)).reshape(-1, ny)[: about["samples"]].max(axis=0)
    whole_run(propagator)
    found = estimate_error(propagator, NONE, nodes, **about)
    np.testing.assert_allclose(found.absolute, off, rtol=0.2)
    assert found.substeps == propagator.substeps


@pytest.mark.parametrize("name", SYSTEMS)
def test_errors_of_intervals_add_up_to_that_of_the_whole_run(made, name):
    model, start, _ = SYSTEMS[name]
    single, node, about = made_for(made, model(), start)
    whole = estimate_error(single, NONE, node, **about)
    cut_up, nodes, _ = made_for(made, model(), start, length=10)
    for k in range(len(nodes) - 1):  # continuous
        nodes[k + 1] = cut_up.propagate(NONE, nodes, 0).end[:, k]
    found = estimate_error(cut_up, NONE, nodes, **about)
    np.testing.assert_allclose(found.absolute, whole.absolute, rtol=1e-3)
    np.testing.assert_allclose(found.relative, whole.relative, rtol=1e-3)
    assert found.substeps == whole.substeps


@pytest.mark.parametrize("name", SYSTEMS)
def test_refining_reaches_the_tolerance_without_many_more_steps(made, name):
    model, start, kind = SYSTEMS[name]
    propagator, nodes, about = made_for(made, model(), start)
    first = estimate_error(propagator, NONE, nodes, **about)
    tolerance = first.largest / 50  # a factor 16 for each doubling
    refined, found = refined_to(propagator, NONE, nodes, tolerance=tolerance, **about)
    assert found.within
    assert refined.substeps == found.substeps
    # a factor 16 for each doubling: two are enough, and Runge-Kutta steps are cut where the error arises
    assert refined.substeps == 4 * propagator.substeps or (
        kind is RungeKuttaPropagator
        and refined.fineness.counts.mean() <= 4 * propagator.fineness.counts.mean()
    )
    assert found.largest < tolerance < first.largest


def test_a_linear_model_is_exact(made):
    propagator, nodes, about = made_for(made, shaft(lambda w: 2 * w), [1.0, 0.0])
    refined, found = refined_to(propagator, NONE, nodes, **about)
    assert refined is propagator
    assert found.relative == (0.0, 0.0)
    assert str(found) == "integration: exact"


def test_a_tolerance_out_of_reach_is_an_error(made):
    propagator, nodes, about = made_for(made, shaft(lambda w: 2 * ca.tanh(w / 1e-5)), [1.0, 0.0], step=0.5)
    with pytest.raises(SimulationError) as info:
        refined_to(propagator, NONE, nodes, tolerance=1e-12, **about)
    message = str(info.value)
    assert message.startswith(
        "the integration does not reach its tolerance: a law is too sharp for the record's rate"
    )
    assert "with 64 steps to a sample; allowed: a relative error of 1e-12; " in message
    assert message.endswith("do: make the law's smoothing wider, or the tolerance larger")


def test_an_estimate_says_what_it_is():
    found = ErrorEstimate(("w", "q"), (2e-8, 1e-9), (1e-9, 2e-9), 1, 1e-6)
    assert str(found) == (
        "integration: exponential Runge-Kutta steps of order 4, one step to a sample, estimated relative error "
        "w 1.0e-09, q 2.0e-09"
    )
    assert found.to_dict() == {
        "integrator": "exponential Runge-Kutta steps of order 4",
        "substeps": 1,
        "tolerance": 1e-6,
        "relative": {"w": 1e-9, "q": 2e-9},
        "absolute": {"w": 2e-8, "q": 1e-9},
    }
    loose = ErrorEstimate(("w",), (2e-4,), (1e-5,), 2, 1e-6)
    assert str(loose) == (
        "integration: exponential Runge-Kutta steps of order 4, 2 steps to a sample, estimated relative error "
        "w 1.0e-05; more than the tolerance 1.0e-06"
    )
    assert not loose.within


def test_padding_behind_the_record_does_not_count(made):
    model = shaft(lambda w: 2 * ca.tanh(w))
    propagator, nodes, about = made_for(made, model, [1.0, 0.0], length=50)
    found = [
        estimate_error(propagator, NONE, nodes, **(about | {"samples": count})).absolute[0]
        for count in (1, 4, 83)
    ]
    # The first sample is the start, which is given; the error grows from there.
    assert found[0] == 0.0
    assert 0.0 < found[1] < found[2]

"""Outputs that show a law's torque, or bend: the states by the exponential integrator, the outputs beside them."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import casadi_engine as ce
from casadi_engine.model import Blueprint
from casadi_engine.simulation.exponential_runge_kutta import ExponentialPropagator
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.observed import ObservedPropagator
from casadi_engine.simulation.propagator import make_propagator
from casadi_engine.simulation.split import split

TOLERANCE = 1e-9


def rubbing(rng, *, bent=False):
    """Two states with a friction law; the first output shows its torque at once, as a delayed sensor does."""
    b = Blueprint("rubbing")
    p = [b.parameter(f"p{i}", rng.uniform(0.5, 1.5)) for i in range(3)]
    x = [b.state(f"x{i}", scale=rng.uniform(0.5, 2)) for i in range(2)]
    u = b.input("u0")
    d = b.drive("d0", p[0] ** 2 * u + 0.3 * ca.sin(b.time), unit="1")
    slot = b.port("s", "coupling", {"twist_rate": x[0] - x[1]})
    b.law("s", -p[2] * ca.tanh(x[0] - x[1]) * (1 + 0.2 * u**2))
    b.ode("x0", -p[0] * x[0] + x[1] + d + p[1] * slot)
    b.ode("x1", -x[1] - 0.4 * slot)
    b.output("y0", x[0])
    b.output("y1", ca.sin(x[1] * p[0]) * (1 + d**2) if bent else x[1])
    model = b.model()
    late = model.x[0] - 0.2 * model.p[1] * model.ode[0]
    shown = ca.vertcat(late, model.output_expressions[1])
    return replace(model, output_expressions=shown, u=model.channels, rates=())  # grids of channels alone


CASES = {
    "linear but for the law": {},
    "bent outputs": {"bent": True},
    "strided": {"plan": (2, 2, 4), "stride": 2},
    "two steps to a sample": {"bent": True, "substeps": 2},
    "zero hold": {"holds": ("zero",)},
    "single interval": {"plan": (1, 2, 3)},
}


@pytest.mark.parametrize("name", CASES)
def test_first_and_second_derivatives_equal_casadis(made, name):
    options = dict(CASES[name])
    m, b, q = options.pop("plan", (2, 2, 2))
    stride = options.pop("stride", 1)
    substeps, holds = options.pop("substeps", 1), options.pop("holds", ("first",))
    rng = np.random.default_rng(5)
    model = rubbing(rng, **options)
    assert split(model) is None
    plan = Intervals(m, b, q, np.arange(0, q, stride))
    samples = plan.padded - (1 if m > 1 else 0)
    grid = made.grid(rng.normal(size=(1, samples)), samples=samples, step=0.1, holds=holds)
    z = ca.SX.sym("z", 3)
    physical, scale = z * (1 + 0.3 * ca.sin(z)), made.scale(model)
    propagator = make_propagator(model, grid, plan, z, physical, scale=scale, steps=substeps)
    assert isinstance(propagator, ObservedPropagator)
    reference = made.reference(model, grid, plan, z, physical, scale, made.krogstad_step(holds, substeps))
    found = made.compare(
        propagator, reference, rng.uniform(0.5, 1.5, 3), rng.normal(size=(m, len(scale))), rng
    )
    assert propagator.substeps == substeps
    assert max(found) < TOLERANCE


def test_a_delayed_sensor_changes_nothing_of_how_its_model_is_integrated():
    plain = ce.two_mass(outputs=("omega", "omega_load"), reciprocating_speed="model")
    late = plain.with_effect(ce.effects.SensorDelay(), at="sensor_omega", values={"delay": 0.0})
    data = ce.read_experiment("data/misfire_1200rpm.csv.gz", optional=("omega_load",)).between(0.0, 0.1)
    first = {"omega_eng": data["omega"].values[0], "omega_load": data["omega"].values[0], "twist": -0.03}
    one, other = (ce.simulate(model, data, initial=first) for model in (plain, late))
    for name in ("omega", "omega_load"):
        np.testing.assert_allclose(other[name].values, one[name].values, rtol=1e-12)


def test_a_small_delay_shows_the_speed_that_was():
    plain = ce.two_mass(reciprocating_speed="model")
    data = ce.read_experiment("data/misfire_1200rpm.csv.gz", optional=("omega_load",)).between(0.0, 0.1)
    first = {"omega_eng": data["omega"].values[0], "omega_load": data["omega"].values[0], "twist": -0.03}
    tau = 1e-4
    late = plain.with_effect(ce.effects.SensorDelay(), at="sensor_omega", values={"delay": tau})
    one, other = (ce.simulate(model, data, initial=first)["omega"] for model in (plain, late))
    before = CubicSpline(one.time, one.values)(one.time[4:-2] - tau)
    moved = np.abs(one.values[4:-2] - before).max()
    np.testing.assert_allclose(other.values[4:-2], before, atol=3e-3 * moved)


def test_refined_steps_leave_the_coarse_propagator_alone(made):
    rng = np.random.default_rng(1)
    model = rubbing(rng)
    plan = Intervals(1, 2, 3, np.arange(3))
    grid = made.grid(rng.normal(size=(1, 6)), step=0.1)
    p = ca.DM(model.parameter_vector())
    coarse = make_propagator(model, grid, plan, ca.SX(0, 1), p, scale=made.scale(model))
    fine = coarse.refined(4)
    assert (coarse.substeps, fine.substeps) == (1, 4)
    assert isinstance(coarse.states, ExponentialPropagator)
    nodes = rng.normal(size=(1, 2))
    a, b = (one.propagate(np.zeros(0), nodes, 0).y[0] for one in (coarse, fine))
    assert 0 < np.abs(a - b).max() < 1e-4
    np.testing.assert_allclose(coarse.drives_at(np.zeros(0)), fine.drives_at(np.zeros(0)))


def test_what_overflows_is_refused(made):
    model = rubbing(np.random.default_rng(1), bent=True)
    plan = Intervals(1, 2, 3, np.arange(3))
    grid = made.grid(np.full((1, 6), 1e200), step=0.1)
    p = ca.DM(model.parameter_vector())
    propagator = make_propagator(model, grid, plan, ca.SX(0, 1), p, scale=made.scale(model))
    with pytest.raises(FloatingPointError, match="not finite here"):
        propagator.propagate(np.zeros(0), np.full((1, 2), 1e308), 0)

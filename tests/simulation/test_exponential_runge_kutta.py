"""The exponential integrator's solutions: against SciPy, in the limit of sharp laws, and with states of its own."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from casadi_engine.deadline import TimeUp
from casadi_engine.errors import SimulationError
from casadi_engine.model import Blueprint, crankshaft, one_inertia, two_mass
from casadi_engine.simulation import exponential_runge_kutta
from casadi_engine.simulation.exponential_runge_kutta import ExponentialPropagator
from casadi_engine.simulation.intervals import cut
from casadi_engine.simulation.linear import LinearPropagator
from casadi_engine.simulation.propagator import make_propagator
from casadi_engine.simulation.runge_kutta import Fineness, RungeKuttaPropagator
from casadi_engine.simulation.split import split
from casadi_engine.simulation.tableau import RUNGE_KUTTA

NONE = np.zeros(0)
STEP = 1 / 14402


def pair(law=None, *, stiffness=1992.0, name="coupling"):
    """Two inertias with a coupling and torques on both; ``law`` (twist, rate, twist_rate symbol use) acts in it."""
    b = Blueprint("pair")
    one, two = b.state("one", scale=100.0), b.state("two", scale=100.0)
    twist = b.state("twist", scale=0.1)
    push, load = b.input("push"), b.input("load")
    slot = b.port(name, "coupling", {"twist": twist, "twist_rate": two - one})
    inner = stiffness * twist + 2.5 * (two - one) + slot
    b.ode("one", 2.557 * (inner - 0.15 * one + push))
    b.ode("two", 5.646 * (-inner - load))
    b.ode("twist", two - one)
    b.output("one", one)
    b.output("twist", twist)
    if law is not None:
        b.law(name, law(twist, two - one))
    return b.model()


def run(model, grid, start, *, substeps=1, length=None, kind=None, p=None):
    """States at the samples, (N, n), from one start."""
    scale = np.array([state.scale for state in model.states])
    p = ca.DM(model.parameter_vector() if p is None else p)
    plan = cut(grid, length)
    if kind is RungeKuttaPropagator:
        fineness = Fineness(RUNGE_KUTTA, np.full(grid.samples - 1, substeps))
        made = RungeKuttaPropagator(model, grid, plan, ca.SX(0, 1), p, scale=scale, fineness=fineness)
    else:
        made = make_propagator(model, grid, plan, ca.SX(0, 1), p, scale=scale, steps=substeps)
        assert isinstance(made, ExponentialPropagator)
    nodes = np.tile(np.asarray(start, dtype=float) / scale, (plan.m, 1))
    path = made.propagate(NONE, nodes, 0)
    assert made.substeps == substeps or kind is RungeKuttaPropagator
    return path.x[: grid.samples, :, 0] * scale


def torques(samples, step=STEP):
    """An engine's torque of second order with a kick, and a load, as broken lines at the samples."""
    t = step * np.arange(samples)
    push = 57 + 150 * np.sin(2 * np.pi * 40 * t) + 60 * np.sin(2 * np.pi * 80 * t + 1)
    return np.array([push, np.full(samples, 57.0)])


def reference(slope, channels, start, step=STEP, **options):
    """SciPy's DOP853 from sample to sample, where the inputs are straight lines."""
    states, x = [np.array(start, dtype=float)], np.array(start, dtype=float)
    for k in range(channels.shape[1] - 1):
        u0, rise = channels[:, k], (channels[:, k + 1] - channels[:, k]) / step

        def rate(t, x, u0=u0, rise=rise):
            return slope(x, u0 + rise * t)

        options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13} | options
        x = solve_ivp(rate, (0, step), x, **options).y[:, -1]
        states.append(x)
    return np.array(states)


def pair_slope(torque):
    def slope(x, u):
        inner = 1992 * x[2] + 2.5 * (x[1] - x[0]) + torque(x)
        return [2.557 * (inner - 0.15 * x[0] + u[0]), 5.646 * (-inner - u[1]), x[1] - x[0]]

    return slope


START = (120.0, 120.0, -57 / 1992)


@pytest.mark.parametrize(
    ("law", "torque"),
    [
        (lambda a, v: 5 * ca.tanh(v / 0.5), lambda x: 5 * np.tanh((x[1] - x[0]) / 0.5)),
        (lambda a, v: 2e6 * a**3, lambda x: 2e6 * x[2] ** 3),
        (lambda a, v: 0.5 * ca.fabs(v) * v, lambda x: 0.5 * abs(x[1] - x[0]) * (x[1] - x[0])),
    ],
    ids=["smooth Coulomb friction", "cubic stiffness", "quadratic drag"],
)
def test_smooth_laws_equal_scipy_to_1e_minus_8(made, law, torque):
    channels = torques(300)
    found = run(pair(law), made.grid(channels, step=STEP), START)
    wanted = reference(pair_slope(torque), channels, START)
    assert np.abs(found - wanted).max(axis=0)[0] < 1e-8 * np.abs(wanted[:, 0]).max()
    assert (np.abs(found - wanted).max(axis=0) < 1e-7 * np.abs(wanted).max(axis=0)).all()


def test_a_crankshaft_with_friction_equals_scipy_to_1e_minus_8(made):
    b = crankshaft(reciprocating_speed="measured")
    index = [port.name for port in b.ports.with_slot].index("coupling_76")
    rate = b.ports["coupling_76"].signals["twist_rate"]
    laws = ca.densify(b.laws)
    laws[index] = 5 * ca.tanh(rate / 0.1)
    model = replace(b, laws=laws)
    rng = np.random.default_rng(0)
    count = 150
    t = STEP * np.arange(count)
    channels = np.zeros((len(model.inputs), count))
    names = [v.name for v in model.inputs]
    channels[names.index("theta")] = 126 * t + 0.02 * np.sin(250 * t)
    channels[names.index("omega")] = 126 + np.cumsum(rng.normal(size=count)) * 0.02
    for k in range(4):
        channels[names.index(f"p{k + 1}")] = 1e5 + 2e6 * np.exp(-(((t - 0.002 * (k + 1)) / 6e-4) ** 2))
    channels[names.index("T_load")] = 57.0
    start = np.array([126.0 if s.name.startswith("omega") else 0.0 for s in model.states])
    start[-1] = -57 / 1992
    grid = made.grid(channels, step=STEP, start=0.0)
    found = run(model, grid, start)
    core, p = model.linear, model.parameter_vector()
    a, bm, g = (
        np.array(m) for m in ca.Function("m", [model.p], [ca.densify(m) for m in (core.A, core.B, core.G)])(p)
    )
    plain = LinearPropagator(b, grid, cut(grid, None), ca.SX(0, 1), ca.DM(p), scale=made.scale(model))
    drives = plain.drives_at(NONE)

    def slope(x, d):
        return a @ x + bm @ d + g[:, index] * 5 * np.tanh((x[11] - x[9]) / 0.1)

    wanted = reference(slope, drives, start)
    off = np.abs(found - wanted).max(axis=0) / np.abs(wanted).max(axis=0)
    assert off[0] < 1e-8
    assert off.max() < 1e-5


def test_sharp_friction_is_the_limit_of_a_vanishing_width(made):
    # A pulse sets a braked mass sliding; dry friction stops it, and the exact motion is a parabola, then rest.
    def braked(width):
        b = Blueprint("braked")
        v, q, force = b.state("v"), b.state("q"), b.input("F")
        slot = b.port("ground", "inertia", {"speed": v})
        b.ode("v", force + slot)
        b.ode("q", v)
        b.law("ground", -2.0 * ca.tanh(v / width))
        b.output("q", q)
        return b.model()

    step, count = 1e-3, 1500
    grid = made.grid(np.zeros((1, count)), step=step)
    t = step * np.arange(count)
    stop = 0.5  # v0 = 1, deceleration 2
    sharp = np.where(t < stop, t - t**2, stop / 2)
    errors = []
    for width, substeps in ((0.1, 1), (0.01, 1), (0.001, 4), (0.0001, 32)):
        errors.append(np.abs(run(braked(width), grid, [1.0, 0.0], substeps=substeps)[:, 1] - sharp).max())
    # The smooth law gives away about width * log: ten times less for each tenth of the width.
    assert errors[-1] < 1e-4
    assert all(later < earlier / 5 for earlier, later in pairwise(errors))


def test_the_scheme_is_of_fourth_order(made):
    law = lambda a, v: 5 * ca.tanh(v / 2)  # noqa: E731
    model, ends = pair(law), []
    for count in (8, 16, 32, 256):
        step = 4e-3 / count
        grid = made.grid(np.array([np.linspace(57, 200, count + 1), np.full(count + 1, 57.0)]), step=step)
        ends.append(run(model, grid, START)[-1])
    errors = np.abs(np.array(ends[:-1]) - ends[-1]).max(axis=1)
    orders = np.log2(errors[:-1] / errors[1:])
    assert ((orders > 3.7) & (orders < 4.4)).all()


def test_substeps_are_as_good_as_a_finer_grid(made):
    model = pair(lambda a, v: 5 * ca.tanh(v / 0.05))
    coarse = torques(60, step=4 * STEP)
    at = np.arange(59 * 4 + 1) / 4
    fine = np.array([np.interp(at, np.arange(60), row) for row in coarse])
    wanted = run(model, made.grid(fine, step=STEP), START)[::4]
    found = run(model, made.grid(coarse, step=4 * STEP), START, substeps=4)
    np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-12)


def test_few_intervals_in_casadis_machine_equal_many_in_arrays(made, monkeypatch):
    model = pair(lambda a, v: 5 * ca.tanh(v / 0.1))
    grid = made.grid(torques(700), step=STEP)
    for length in (None, 100):
        found = []
        for wide in (1, 1000):
            monkeypatch.setattr(exponential_runge_kutta, "WIDE", wide)
            found.append(run(model, grid, START, length=length))
        np.testing.assert_allclose(found[0], found[1], rtol=1e-11, atol=1e-12)


def test_strong_feedback_refines_the_steps_by_itself(made):
    model = pair(lambda a, v: -40 * ca.tanh(v / 0.001))
    grid = made.grid(torques(40, step=4 * STEP), step=4 * STEP)
    scale = made.scale(model)
    p = ca.DM(model.parameter_vector())
    propagator = make_propagator(model, grid, cut(grid, None), ca.SX(0, 1), p, scale=scale)
    path = propagator.propagate(NONE, np.array([START]) / scale, 1)
    assert propagator.substeps == path.substeps > 8
    assert np.isfinite(path.y).all()


def test_a_wild_point_does_not_make_later_ones_pay_for_its_short_steps(made):
    b = Blueprint("braked")
    torque = b.parameter("torque", 0.1)
    v = b.state("v")
    slot, push = b.port("shaft", "inertia", {"speed": v}), b.input("T")
    b.ode("v", push + slot)
    b.law("shaft", -torque * ca.tanh(v / 0.05))
    b.output("v", v)
    model, z = b.model(), ca.SX.sym("z")
    grid = made.grid(np.ones((1, 60)), step=STEP)
    propagator = make_propagator(model, grid, cut(grid, 20), z, z, scale=np.ones(1))
    nodes = np.zeros((propagator.intervals.m, 1))
    calm = propagator.propagate(np.array([0.1]), nodes, 1)
    assert calm.substeps == 1
    with pytest.raises(FloatingPointError, match="the laws are far stiffer here than at the point before"):
        propagator.propagate(np.array([20000.0]), nodes, 1)
    propagator.propagate(np.array([8000.0]), nodes, 1)
    wild = propagator.propagate(np.array([20000.0]), nodes, 1)
    assert wild.substeps > 16
    fewer = []
    for _ in range(4):
        again = propagator.propagate(np.array([0.1]), nodes, 1)
        fewer.append(again.substeps)
        np.testing.assert_allclose(again.y, calm.y, rtol=0, atol=1e-6)
    assert fewer[0] == wild.substeps
    assert fewer == sorted(fewer, reverse=True)
    assert fewer[-1] == 1
    # and the derivatives of a point made with other steps than the propagator has now are still its own
    rho, lam = np.ones_like(wild.y[0]), np.zeros((1, propagator.intervals.m))
    late = propagator.contraction(np.array([20000.0]), wild, rho, lam)
    fresh = make_propagator(model, grid, cut(grid, 20), z, z, scale=np.ones(1))
    path = fresh.propagate(np.array([20000.0]), nodes, 1)
    for one, other in zip(late, fresh.contraction(np.array([20000.0]), path, rho, lam), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)


def test_steps_whose_laying_was_stopped_are_not_half_laid(made, monkeypatch):
    """The time may be up while shorter steps are laid; the propagator serves the next search as well."""
    model, z = pair(lambda a, v: -40 * ca.tanh(v / 0.001)), ca.SX(0, 1)
    grid = made.grid(torques(40, step=4 * STEP), step=4 * STEP)
    scale, p = made.scale(model), ca.DM(model.parameter_vector())
    propagator = make_propagator(model, grid, cut(grid, None), z, p, scale=scale)
    nodes = np.array([START]) / scale
    with monkeypatch.context() as patched:
        patched.setattr(propagator.laws, "given", lambda *_: (_ for _ in ()).throw(TimeUp))
        with pytest.raises(TimeUp):
            propagator.propagate(NONE, nodes, 1)
    assert propagator.steps == propagator.intervals.length * propagator.substeps == len(propagator._given)
    fresh = make_propagator(model, grid, cut(grid, None), z, p, scale=scale)
    np.testing.assert_array_equal(propagator.propagate(NONE, nodes, 1).y, fresh.propagate(NONE, nodes, 1).y)


def test_a_law_that_runs_away_is_reported_without_noise(made):
    b = Blueprint("burst")
    x = b.state("x")
    slot = b.port("push", "inertia", {"speed": x})
    b.ode("x", slot)
    b.law("push", x**3)
    b.output("x", x)
    grid = made.grid(np.zeros((0, 300)), samples=300, step=0.05)
    for length in (None, 10):
        with pytest.raises(FloatingPointError, match="the model's state is not finite here"):
            run(b.model(), grid, [5.0], length=length)


@pytest.mark.parametrize("substeps", [0, 65, 1.5, True])
def test_substeps_out_of_range_are_an_error(made, substeps):
    model = pair(lambda a, v: 5 * ca.tanh(v))
    grid = made.grid(torques(9), step=STEP)
    with pytest.raises(SimulationError) as info:
        ExponentialPropagator(
            model, split(model), grid, cut(grid, None), ca.SX(0, 1), ca.SX(0, 1),
            scale=made.scale(model), substeps=substeps,
        )  # fmt: skip
    assert str(info.value) == (
        f"the number of integration steps to a sample is not acceptable; seen: {substeps!r}; allowed: a whole number "
        "from 1 to 64; do: leave it out, or give substeps=4, for instance"
    )


# ---- laws with states of their own


def bouc_wen(*, slot_for_rate):
    """A hysteretic coupling: torque 40 z with the Bouc-Wen state z, whose rate is smooth here."""
    b = Blueprint("bouc_wen")
    one, two = b.state("one", scale=100.0), b.state("two", scale=100.0)
    twist, z = b.state("twist", scale=0.1), b.state("z")
    push, load = b.input("push"), b.input("load")
    inner = 1992 * twist + 2.5 * (two - one) + 40 * z
    b.ode("one", 2.557 * (inner - 0.15 * one + push))
    b.ode("two", 5.646 * (-inner - load))
    b.ode("twist", two - one)
    rate = two - one
    growth = 100 * (rate - 0.5 * ca.sqrt(rate**2 + 1e-4) * z - 0.5 * rate * ca.sqrt(z**2 + 1e-4))
    if slot_for_rate:
        slot = b.port("hysteresis", "internal")
        b.law("hysteresis", growth)
        b.ode("z", slot)
    else:
        b.ode("z", growth)
    b.output("one", one)
    return b.model()


@pytest.mark.parametrize("slot_for_rate", [True, False])
def test_a_hysteretic_state_equals_scipy(made, slot_for_rate):
    model, channels = bouc_wen(slot_for_rate=slot_for_rate), torques(300)
    assert (model.linear is None) is not slot_for_rate
    found = run(model, made.grid(channels, step=STEP), (*START, 0.0))

    def slope(x, u):
        v = x[1] - x[0]
        growth = 100 * (v - 0.5 * np.sqrt(v**2 + 1e-4) * x[3] - 0.5 * v * np.sqrt(x[3] ** 2 + 1e-4))
        return [*pair_slope(lambda x: 40 * x[3])(x[:4], u), growth]

    wanted = reference(slope, channels, (*START, 0.0))
    off = np.abs(found - wanted).max(axis=0) / np.abs(wanted).max(axis=0)
    assert off[0] < 1e-8
    assert off.max() < 1e-6


# ---- the engine models in their nonlinear forms


def engine_channels(model, count, step):
    t = step * np.arange(count)
    rows = {"theta": 126 * t + 0.3, "T_load": np.full(count, 57.0), "omega": np.full(count, 126.0)}
    for k in range(4):
        rows[f"p{k + 1}"] = 1e5 + 1e6 * (1 + np.sin(80 * np.pi * t + k)) ** 2
    return np.array([rows[v.name] for v in model.inputs])


MODELS = {
    "two masses": lambda: two_mass(),
    "two masses, variable inertia": lambda: two_mass(reciprocating_inertia="variable"),
    "crankshaft": lambda: crankshaft(),
    "crankshaft, angle a state": lambda: crankshaft(angle="state"),
    "crankshaft, variable inertia": lambda: crankshaft(reciprocating_inertia="variable"),
    "one inertia": lambda: one_inertia(cylinders=4, reciprocating_speed="model", load="measured"),
}


@pytest.mark.parametrize("name", MODELS)
def test_nonlinear_engine_models_equal_fine_runge_kutta_steps(made, name):
    model = MODELS[name]()
    step, count = 1 / 144020, 40  # so fine that both ways to hold the inputs between samples agree
    grid = made.grid(engine_channels(model, count, step), step=step, start=0.0)
    start = [126.0 if s.unit == "rad/s" else -0.01 for s in model.states]
    found = run(model, grid, start)
    wanted = run(model, grid, start, kind=RungeKuttaPropagator)
    size = np.abs(wanted).max(axis=0)
    assert (np.abs(found - wanted).max(axis=0) < 1e-7 * size).all()

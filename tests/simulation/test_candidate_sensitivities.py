"""Sensitivities of terms that are not in the model, against the propagators and the independent simulator."""

import dataclasses
import math
import sys
import time
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects import candidate, library
from casadi_engine.errors import ModelError
from casadi_engine.simulation.candidate_sensitivities import (
    Direction,
    Sweep,
    at_measurements,
    grid_sensitivities,
    initial_direction,
    parameter_direction,
    slot_direction,
    torque_direction,
)
from casadi_engine.simulation.grid import lay_grid
from casadi_engine.simulation.intervals import cut
from casadi_engine.simulation.knot_sensitivities import knot_sensitivities
from casadi_engine.simulation.null_path import null_path
from casadi_engine.simulation.propagator import make_propagator
from casadi_engine.simulation.sensitivity_columns import OwnStates
from tests.quick import few

DATA = Path(__file__).parents[2] / "data"
START = np.array([125.6, 125.6, -0.03])
LEVELS = {"theta": "rad", "T_load": "N m", "omega": "rad/s", "omega_load": "rad/s"}


@pytest.fixture(scope="module")
def record():
    return ce.read_experiment(DATA / "misfire_1200rpm.csv.gz", optional=("omega_load",))


def propagated(model, grid, start, names):
    """Outputs (ny, N) and their slopes in relative parameters and scaled initial states, by the propagator."""
    p = model.parameter_vector()
    v = ca.SX.sym("v", len(names))
    physical = ca.SX(ca.DM(p))
    for k, name in enumerate(names):
        i = model.parameter_names.index(name)
        physical[i] = p[i] * v[k]
    plan = cut(grid, None)
    scale = np.array([s.scale for s in model.states])
    propagator = make_propagator(model, grid, plan, v, physical, scale=scale)
    path = propagator.propagate(np.ones(len(names)), (start / scale)[None], 1)
    ny = len(model.outputs)

    def laid(y):
        rows = y.reshape(len(y), len(plan.samples), ny, plan.b).transpose(0, 2, 3, 1)
        return rows.reshape(len(y), ny, -1)[:, :, : grid.samples]

    starts = laid(np.moveaxis(path.ys.reshape(*path.y.shape[1:3], -1), -1, 0))
    return np.concatenate([laid(path.y[..., 0]), starts])


@pytest.mark.parametrize("form", ["measured", "model"])
def test_a_parameter_and_an_initial_state_have_the_propagators_slopes(record, form):
    model = ce.two_mass(reciprocating_speed=form, outputs=("omega", "omega_load"))
    piece = record.cycles(1, 3)
    grid = lay_grid(model, piece)
    names = ("J_eng", "J_load", "K_el", "C_el", "C_eng")
    p = model.parameter_vector()
    path = null_path(model, grid, p, START)
    wanted = propagated(model, grid, START, names)
    directions = []
    for name in names:
        slope = np.zeros(len(p))
        slope[model.parameter_names.index(name)] = p[model.parameter_names.index(name)]
        directions.append(parameter_direction(model, slope, name=name))
    directions += [initial_direction(model, k, s.scale, name=s.name) for k, s in enumerate(model.states)]
    found = grid_sensitivities(path, directions)
    for k in range(len(directions)):
        size = np.abs(wanted[1 + k]).max()
        # the general propagator takes Runge-Kutta steps of its own
        assert np.abs(found[k] - wanted[1 + k]).max() < (1e-10 if form == "measured" else 1e-5) * size


def linear(*, pulls=-1):
    b = ce.Blueprint("pair")
    j, k = b.parameter("J", 0.4), b.parameter("K", 300.0)
    w, q = b.state("w", scale=10), b.state("q", scale=0.1)
    torque = b.input("T")
    spring = b.port("spring", "coupling", {"twist": q, "twist_rate": w})
    b.ode("w", (torque - k * q - pulls * spring) / j)
    b.ode("q", w)
    b.output("w", w)
    return b.model()


def drifting(model, hold="first", *, n=900, step=2e-3):
    t = np.arange(n) * step
    torque = 5 * np.sin(7 * t) + 3 * np.sin(2.3 * t)
    return ce.Experiment.from_arrays(
        "r", time=t, units={"T": "1", "w": "1"}, hold=hold, T=torque, w=np.zeros(n)
    )


def test_a_law_is_the_slope_of_the_model_that_has_it():
    """Central differences of a model with the law, simulated by the propagator of such models."""
    b = ce.Blueprint("pair")
    j, k, psi = b.parameter("J", 0.4), b.parameter("K", 300.0), b.parameter("psi", 0.0)
    w, q = b.state("w", scale=10), b.state("q", scale=0.1)
    torque = b.input("T")
    spring = b.port("spring", "coupling", {"twist": q})
    b.law("spring", -psi * q**3 * 1e4)
    b.ode("w", (torque - k * q + spring) / j)
    b.ode("q", w)
    b.output("w", w)
    full, model = b.model(), linear()
    data = drifting(model)
    path = null_path(model, lay_grid(model, data), model.parameter_vector(), np.array([0.5, 0.01]))
    cubic = torque_direction(model, "spring", -(model.x[1] ** 3) * 1e4, name="cubic")
    found = grid_sensitivities(path, [cubic])[0, 0]
    runs = [
        ce.simulate(full, data, parameters={"psi": h}, initial={"w": 0.5, "q": 0.01})["w"].values
        for h in (1e-4, -1e-4)
    ]
    wanted = (runs[0] - runs[1]) / 2e-4
    assert np.abs(found - wanted).max() < 2e-4 * np.abs(wanted).max()


def test_held_inputs_jump_at_samples():
    model = linear()
    for hold in ("zero", "first"):
        data = drifting(model, hold)
        grid = lay_grid(model, data)
        path = null_path(model, grid, model.parameter_vector(), np.array([0.5, 0.01]))
        # the channel itself as a torque: the same as the slope in a gain of the channel
        found = grid_sensitivities(path, [torque_direction(model, "spring", model.d[0], name="T")])[0, 0]
        start = {"w": 0.0, "q": 0.0}
        wanted = ce.simulate(model, data, initial=start)["w"].values
        assert np.abs(found - wanted).max() < 1e-9 * np.abs(wanted).max()


def test_a_term_with_a_state_of_its_own_is_filtered_first():
    """A first-order lag of the speed as a torque, against the model that has both as equations."""
    b = ce.Blueprint("lagged")
    j, k, psi = b.parameter("J", 0.4), b.parameter("K", 300.0), b.parameter("psi", 0.0)
    w, q, z = b.state("w", scale=10), b.state("q", scale=0.1), b.state("z", scale=10)
    torque = b.input("T")
    b.ode("w", (torque - k * q - psi * z) / j)
    b.ode("q", w)
    b.ode("z", (w - z) / 0.05)
    b.output("w", w)
    full, model = b.model(), linear()
    data = drifting(model)
    path = null_path(model, lay_grid(model, data), model.parameter_vector(), np.array([0.5, 0.01]))
    own = ca.SX.sym("z")
    term = slot_direction(model, ca.SX(-own), name="lag")
    term = Direction("lag", term.ode, term.output, states=own, rates=(model.x[0] - own) / 0.05, start=(0.2,))
    found = grid_sensitivities(path, [term])[0, 0]
    runs = [
        ce.simulate(full, data, parameters={"psi": h}, initial={"w": 0.5, "q": 0.01, "z": 0.2})["w"].values
        for h in (1e-4, -1e-4)
    ]
    wanted = (runs[0] - runs[1]) / 2e-4
    assert np.abs(found - wanted).max() < 1e-4 * np.abs(wanted).max()


def test_sensors_have_no_equation_of_motion():
    model = linear()
    path = null_path(model, lay_grid(model, drifting(model)), model.parameter_vector(), np.array([0.5, 0.01]))
    zero = ca.SX.zeros(2, 1)
    rate = ca.jtimes(model.output_expressions, model.x, model.ode)
    found = grid_sensitivities(
        path,
        [
            Direction("offset", zero, ca.SX(1)),
            Direction("gain", zero, model.x[0]),
            Direction("delay", zero, -rate),
        ],
    )
    assert found[0, 0] == pytest.approx(np.ones(900))
    assert found[1, 0] == pytest.approx(path.x[0], rel=1e-12)
    assert found[2, 0] == pytest.approx(-path.slope[0], rel=1e-9, abs=1e-9)


def test_a_sharp_law_between_coarse_samples_needs_substeps():
    model = linear()
    fine, coarse = drifting(model, n=3601, step=5e-4), drifting(model, n=181, step=1e-2)
    cubic = torque_direction(model, "spring", -ca.tanh(model.x[0] / 0.01), name="friction")
    p, start = model.parameter_vector(), np.array([0.5, 0.01])
    dense = grid_sensitivities(null_path(model, lay_grid(model, fine), p, start), [cubic])[0, 0, ::20]
    path = null_path(model, lay_grid(model, coarse), p, start)
    errors = [
        np.abs(grid_sensitivities(path, [cubic], substeps=n)[0, 0] - dense).max() / np.abs(dense).max()
        for n in (1, 8)
    ]
    assert errors[1] < 0.01
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.parametrize(("softens", "most"), [(0.05, 1), (0.9, 8)])
def test_steps_follow_the_change_of_the_slopes_not_their_size(softens, most):
    """A stiff mode that hardly changes is solved in one step to a sample, where its size alone asked for eight."""
    b = ce.Blueprint("stiff")
    z, v = b.state("z"), b.state("v")
    push = b.port("mass", "inertia", {"speed": v})
    b.ode("z", v)
    b.ode("v", -400.0 * (z + softens * z**3) - 5.0 * v + push)
    b.output("y", z)
    model, t = b.model(), np.arange(401) * 0.01 * 2.0**softens
    data = ce.Experiment.from_arrays("r", time=t, units={"y": "1"}, y=0 * t)
    path = null_path(model, lay_grid(model, data), model.parameter_vector(), np.array([0.4, 0.0]))
    drag = torque_direction(model, "mass", -(model.x[1] ** 2), name="drag")
    sweep = Sweep(path, [drag])
    assert sweep.substeps <= most
    fine = grid_sensitivities(path, [drag], substeps=16)
    assert grid_sensitivities(path, [drag]) == pytest.approx(fine, abs=1e-3 * np.abs(fine).max())


def test_knots_add_up_to_the_whole_torque_and_are_causal():
    model = linear()
    path = null_path(model, lay_grid(model, drifting(model)), model.parameter_vector(), np.array([0.5, 0.01]))
    unit = torque_direction(model, "spring", ca.SX(1), name="unit")
    knots = np.linspace(path.grid.time[0], path.grid.time[-1], 31)
    found = knot_sensitivities(path, unit, knots)
    whole = grid_sensitivities(path, [unit])[0]
    assert found.sum(axis=0) == pytest.approx(whole, abs=1e-10 * np.abs(whole).max())
    before = path.grid.time < knots[9]
    assert np.abs(found[10, 0, before]).max() < 1e-12
    mean = knot_sensitivities(path, unit, knots, every=4)
    assert mean == pytest.approx(found[:, :, :900].reshape(31, 1, 225, 4).mean(axis=3), abs=1e-12)


@pytest.mark.parametrize("count", few([2, 31, 602], 2, 31))
@pytest.mark.parametrize("dragged", [False, True])
def test_a_knot_is_a_hat_over_time(count, dragged):
    """Knots far apart and closer than samples, of a linear model and of one whose equation varies along the path."""
    model = linear(pulls=1)
    if dragged:
        model = model.with_effect(ce.effects.CubicStiffness(), at="spring", values={"stiffness": 2e4})
    data = drifting(model, n=301)
    path = null_path(model, lay_grid(model, data), model.parameter_vector(), np.array([0.5, 0.01]))
    units = [torque_direction(model, "spring", g, name="g") for g in (ca.SX(1), 10 * model.x[1])]
    knots = np.linspace(path.grid.time[0], path.grid.time[-1], count)
    found = knot_sensitivities(path, units, knots)
    assert found.shape == (2, count, 1, 301)
    assert found[1] == pytest.approx(knot_sensitivities(path, units[1], knots), abs=1e-13)
    gap = knots[1] - knots[0]
    some = [0, count // 2, count - 1]
    for unit, own in zip((ca.SX(1), 10 * model.x[1]), found, strict=True):
        hats = [
            torque_direction(
                model, "spring", unit * ca.fmax(0, 1 - ca.fabs(model.t - knots[k]) / gap), name="h"
            )
            for k in some
        ]
        wanted = grid_sensitivities(path, hats)
        assert own[some] == pytest.approx(wanted, abs=1e-9 * np.abs(wanted).max())


def test_groups_of_columns_change_nothing(record, monkeypatch):
    model = ce.two_mass(reciprocating_speed="model", outputs=("omega", "omega_load"))
    grid = lay_grid(model, record.cycles(1, 3))
    path = null_path(model, grid, model.parameter_vector(), START)
    # torques on both inertias, in the coupling, a sensor's offset and a first state
    directions = [
        torque_direction(model, port, model.x[k % 3] ** (k % 2), name=port)
        for k, port in enumerate(["engine", "load", "coupling", "engine"])
    ]
    offset = slot_direction(model, ca.SX.zeros(model.w.numel(), 1), name="offset", outputs=ca.SX([1.0, 0.0]))
    directions += [offset, initial_direction(model, 1, 100.0, name="start")]
    plain = grid_sensitivities(path, directions)
    monkeypatch.setattr("casadi_engine.simulation.candidate_sensitivities._WIDE", 0)
    grouped = grid_sensitivities(path, directions)
    for one, other in zip(grouped, plain, strict=True):
        assert one == pytest.approx(other, abs=1e-11 * np.abs(other).max())


def test_outputs_between_the_inputs_samples_are_points_of_the_grid():
    model = linear()
    t = np.arange(900) * 2e-3
    odd = np.sort(np.random.default_rng(0).uniform(0.01, 1.7, 300))
    data = ce.Experiment.from_arrays("r", time=t, units={"T": "1"}, T=np.sin(9 * t))
    data = data.with_channel(ce.experiment.Channel("w", "1", time=odd, values=np.zeros(300)))
    path = null_path(model, lay_grid(model, data), model.parameter_vector(), np.array([0.5, 0.01]))
    unit = torque_direction(model, "spring", ca.SX(1), name="unit")
    whole = grid_sensitivities(path, [unit])
    found = at_measurements(path, whole)["w"][0]
    wanted = np.interp(odd, path.grid.time, whole[0, 0])
    assert np.abs(found - wanted).max() < 1e-12 * np.abs(wanted).max()


def test_a_port_that_is_not_there_is_named():
    model = linear()
    with pytest.raises(ModelError, match=r"the model has no such port; seen: 'sprung'; allowed: .*spring"):
        torque_direction(model, "sprung", ca.SX(1), name="no")


# ---- the sharp, independent simulator


@pytest.fixture(scope="module")
def simulator():
    if str(DATA) not in sys.path:
        sys.path.insert(0, str(DATA))
    import simulator
    from simulator.run import Plant, integrate
    from simulator.simulate import observe

    shaft, cylinders = simulator.two_mass_shaft(), simulator.unequal_cylinders()
    engine = simulator.Engine(cylinders, simulator.burn_factors(cylinders, cycles=1, seed=3))
    engine = engine.with_strength(engine.strength_for(57 + 0.1541 * 125.66))
    times = np.arange(1440) / 14402.0

    def run(extra=None):
        start = np.array([0.0, 125.66, 125.66, -57 / 1992])
        plant = Plant(shaft, engine, lambda _: 57.0, extra)
        return observe(shaft, engine, lambda _: 57.0, times, integrate(plant, start, times, rtol=1e-11))

    return run


PAIR, BRAKE = np.array([1.0, -1.0]), np.array([0.0, -1.0])
SHARP = {
    "coulomb_friction": ("coupling", 1.0, lambda t, x: PAIR * np.sign(x[2] - x[1])),
    "cubic_stiffness": ("coupling", 1e5, lambda t, x: PAIR * 1e5 * x[3] ** 3),
    "quadratic_drag": ("load", 1e-3, lambda t, x: BRAKE * 1e-3 * x[2] * abs(x[2])),
    "viscous_friction": ("load", 1e-2, lambda t, x: BRAKE * 1e-2 * x[2]),
    "constant_torque": ("engine", 1.0, lambda t, x: np.array([1.0, 0.0])),
    "load_step": ("load", 1.0, lambda t, x: BRAKE * (t > 0.05)),
}


@pytest.mark.parametrize("name", few(SHARP, "cubic_stiffness", "load_step"))
def test_candidates_are_the_slopes_of_the_sharp_independent_simulator(simulator, name):
    """The residual of the null model on a record with a little of the effect, less that without."""
    port, unit, law = SHARP[name]
    model = ce.two_mass(outputs=("omega", "omega_load"))
    p, size = model.parameter_vector(), 0.02

    def residual(run):
        units = LEVELS | {f"p{k}": "Pa" for k in range(1, 5)}
        channels = {k: run[k] for k in ("theta", "p1", "p2", "p3", "p4", "T_load")}
        outputs = {"omega": run["omega_true"], "omega_load": run["omega_load_true"]}
        data = ce.Experiment.from_arrays("r", time=run["time"], units=units, **channels, **outputs)
        path = null_path(model, lay_grid(model, data), p, run["states"][1:, 0])
        return path, np.array(list(outputs.values())) - path.x[:2]

    path, moved = residual(simulator(lambda t, x: size * law(t, x)))
    wanted = (moved - residual(simulator())[1]) / size
    effect = library(name)[0]
    made = candidate(model, effect, port, {"time": 0.05} if name == "load_step" else None)
    direction = slot_direction(model, made.slots, name=name, drives=made.drives, outputs=made.outputs)
    found = grid_sensitivities(path, [direction])[0] * unit
    assert np.linalg.norm(found - wanted) < 0.01 * np.linalg.norm(wanted)


def test_sixty_candidates_of_a_long_record_take_a_fraction_of_a_second(record):
    model = ce.two_mass(outputs=("omega", "omega_load"))
    path = null_path(model, lay_grid(model, record), model.parameter_vector(), START)
    directions = []
    for port, signal in (("coupling", "twist_rate"), ("engine", "speed"), ("load", "speed")):
        v = model.ports[port].signals[signal]
        directions += [
            torque_direction(model, port, ca.tanh((v - 6 * k) / (0.5 + k)), name=f"{k}") for k in range(20)
        ]
    begun = time.process_time()
    found = grid_sensitivities(path, directions)
    assert found.shape == (60, 2, 14400)
    assert np.isfinite(found).all()
    assert time.process_time() - begun < 2.0


@pytest.mark.parametrize("hold", ["first", "zero"])
def test_samples_at_unequal_times(hold):
    """A swing, its slopes to K, to a torque and to one that lags behind, against SciPy's solution of all together."""
    rng = np.random.default_rng(1)
    t = np.concatenate([[0.0], np.cumsum(rng.uniform(1e-3, 7e-3, 300))])
    data = ce.Experiment.from_arrays(
        "r", time=t, units={"T": "1", "w": "1"}, T=np.zeros(301), w=np.zeros(301)
    )
    data = ce.Experiment("r", tuple(dataclasses.replace(c, hold=hold) for c in data.channels))
    model = linear()
    grid = lay_grid(model, data)
    assert not grid.uniform
    path = null_path(model, grid, np.array([0.4, 300.0]), np.array([10.0, 0.0]))
    law = torque_direction(model, "spring", ca.cos(model.t), name="law")
    own = ca.SX.sym("own")
    late = torque_direction(model, "spring", own, name="late")
    late = dataclasses.replace(late, states=own, rates=(ca.cos(model.t) - own) / 0.05, start=(0.2,))
    slope = parameter_direction(model, np.array([0.0, 1.0]), name="K")
    found = grid_sensitivities(path, [slope, law, late])[:, 0]

    def rates(now, x):
        w, q, wk, qk, wl, ql, ws, qs, lag = x
        own = [-(300 * qk + q) / 0.4, wk, (math.cos(now) - 300 * ql) / 0.4, wl, (lag - 300 * qs) / 0.4, ws]
        return [-300 * q / 0.4, w, *own, (math.cos(now) - lag) / 0.05]

    start = [10.0, *[0.0] * 7, 0.2]
    true = solve_ivp(rates, (0, t[-1]), start, t_eval=t, rtol=1e-11, atol=1e-13, method="DOP853").y
    np.testing.assert_allclose(path.x, true[:2], rtol=0, atol=1e-5)
    for row, wanted in zip(found, true[[2, 4, 6]], strict=True):
        np.testing.assert_allclose(row, wanted, rtol=0, atol=1e-4 * np.abs(wanted).max())


@pytest.mark.parametrize("count", [1, 255, 256, 257, 700])
def test_states_of_terms_are_those_of_one_run_whatever_its_length(count):
    """In pieces: CasADi took 2.3 s to lay out a run of 14 401 steps that it makes in half a second."""
    x, given = ca.SX.sym("x", 2), ca.SX.sym("given", 3)
    step = ca.Function("step", [x, given], [0.9 * x + given[:2] * given[2], x + given[:2]])
    own = OwnStates.__new__(OwnStates)
    own._step, own.start = step, np.array([1.0, -2.0])
    drawn = np.random.default_rng(0).standard_normal((3, count))
    after, half = own._swept(drawn)
    whole = step.mapaccum(count)(own.start, drawn)
    np.testing.assert_allclose(after, np.asarray(whole[0], dtype=float), rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(half, np.asarray(whole[1], dtype=float), rtol=1e-13, atol=1e-13)

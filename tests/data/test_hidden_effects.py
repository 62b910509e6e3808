"""Runs with sharp hidden effects: against another integrator with events, half steps, and laws by hand."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from simulator import Engine, simulate_two_mass, unequal_cylinders
from simulator.hidden import PLACES, hidden
from simulator.hidden_runs import Case, simulate_hidden
from simulator.run import Plant
from simulator.shaft import crankshaft_shaft, two_mass_shaft

LENGTH = 0.04
J, K = 1.0 / np.array([2.557, 5.646]), 1992.0

TWO_MASS = {
    "none": (),
    "coulomb in the coupling": (hidden("coulomb_friction", "coupling", 5.0),),
    "coulomb that sticks": (hidden("coulomb_friction", "coupling", 60.0),),
    "coulomb on the load": (hidden("coulomb_friction", "load", 5.0),),
    "viscous": (hidden("viscous_friction", "load", 0.05), hidden("viscous_friction", "coupling", 0.5)),
    "drag": (hidden("quadratic_drag", "engine", 3e-4),),
    "stribeck": (hidden("stribeck_friction", "load", 5.0, fading=140.0),),
    "constant": (hidden("constant_torque", "engine", -3.0),),
    "cubic": (hidden("cubic_stiffness", "coupling", 1e6),),
    "backlash": (hidden("backlash", "coupling", 0.03),),
    "misfire": (hidden("misfire", "cylinder_3", 1.0, cycles=(1,)),),
    "imbalance": (hidden("cylinder_imbalance", "cylinder_1", 0.1),),
    "step": (hidden("load_step", "load", 10.0, time=0.02003),),
    "offset": (hidden("sensor_offset", "sensor_omega", 0.2),),
    "delay": (hidden("sensor_delay", "sensor_omega", 1.3e-4),),
    "play and friction": (hidden("backlash", "coupling", 0.03), hidden("coulomb_friction", "coupling", 5.0)),
}


def run_all(kind, effects, duration=LENGTH, **options):
    cases = [Case(effects=one, scatter_seed=3) for one in effects.values()]
    records = simulate_hidden(kind, cases, cycles=1, duration=duration, sigma=0.0, **options)
    return dict(zip(effects, records, strict=True))


@pytest.fixture(scope="module")
def runs():
    return run_all("two_mass", TWO_MASS)


@pytest.fixture(scope="module")
def finer():
    return run_all("two_mass", TWO_MASS, steps=2)


@pytest.mark.parametrize("name", TWO_MASS)
def test_finer_steps_change_nothing(name, runs, finer):
    for key in ("omega_true", "omega_load_true", "theta"):
        np.testing.assert_allclose(runs[name][key], finer[name][key], rtol=0, atol=1e-9)


def plant(record, extra):
    """The scalar simulator's equation with an extra torque, for another integrator."""
    engine = Engine(unequal_cylinders(), record["factors"], float(record["strength"]))
    return Plant(two_mass_shaft(), engine, lambda _time: 57.0, extra).equation()


SMOOTH = {
    "viscous": lambda _t, x: np.array([0.5 * (x[2] - x[1]), -0.5 * (x[2] - x[1]) - 0.05 * x[2]]),
    "drag": lambda _t, x: np.array([-3e-4 * x[1] ** 2, 0.0]),
    "stribeck": lambda _t, x: np.array([0.0, -5.0 * np.exp(-((x[2] / 140.0) ** 2))]),
    "constant": lambda _t, x: np.array([-3.0, 0.0]),
    "cubic": lambda _t, x: np.array([1e6 * x[3] ** 3, -1e6 * x[3] ** 3]),
    "coulomb on the load": lambda _t, x: np.array([0.0, -5.0]),
    "misfire": lambda _t, x: np.zeros(2),
    "imbalance": lambda _t, x: np.zeros(2),
    "none": lambda _t, x: np.zeros(2),
}


@pytest.mark.parametrize("name", SMOOTH)
def test_smooth_torques_are_those_of_the_scalar_simulator(name, runs):
    record = runs[name]
    some = slice(0, None, 25)
    again = solve_ivp(
        plant(record, SMOOTH[name]),
        (0, LENGTH),
        record["states"][:, 0],
        "DOP853",
        record["time"][some],
        rtol=1e-13,
        atol=1e-12,
    )
    np.testing.assert_allclose(again.y[1:3], record["states"][1:3, some], rtol=0, atol=2e-9)


def piecewise(record, laws, events, after, mode):
    """Integrate with laws by mode up to each event; `after(mode, which, state)` gives the next mode."""
    time, state = 0.0, record["states"][:, 0].copy()
    times, found, modes = record["time"], [state.copy()], [mode]
    while time < times[-1]:
        ahead = times[times > time + 1e-15]
        checks = events(mode)
        for check in checks:
            check.terminal, check.direction = True, -1
        equation = plant(record, lambda t, x, m=mode: laws(m, x))
        part = solve_ivp(
            equation, (time, times[-1]), state, "DOP853", ahead, events=checks, rtol=1e-12, atol=1e-12
        )
        found += list(part.y.T)
        hits = [(t[0], which) for which, t in enumerate(part.t_events or []) if len(t)]
        if not hits:
            break
        time, which = min(hits)
        state = part.y_events[which][0].copy()
        mode = after(mode, which, state)
        modes.append(mode)
    return np.array(found).T, modes


def test_play_against_another_integrator(runs):
    gap, record = 0.03, runs["backlash"]

    def laws(mode, x):
        torque = -K * x[3] if mode == 0 else -K * mode * gap
        return np.array([torque, -torque])

    def events(mode):
        if mode == 0:
            return [lambda _t, x: gap - x[3], lambda _t, x: gap + x[3]]
        return [lambda _t, x: mode * x[3] - gap]

    start = record["states"][3, 0]
    mode = int(np.sign(start) * (abs(start) > gap))
    found, modes = piecewise(record, laws, events, lambda m, w, _x: (1 - 2 * w) if m == 0 else 0, mode)
    assert len(modes) > 1
    np.testing.assert_allclose(found[1:3], record["states"][1:3], rtol=0, atol=1e-8)


@pytest.mark.parametrize(("name", "limit"), [("coulomb in the coupling", 5.0), ("coulomb that sticks", 60.0)])
def test_dry_friction_against_another_integrator(name, limit, runs):
    record = runs[name]
    free = plant(record, None)

    def needed(x):
        """Torque on the engine's side that keeps both speeds equal."""
        rate = free(0.0, x)
        return float((rate[2] - rate[1]) / (1 / J).sum())

    def laws(mode, x):
        torque = needed(x) if mode == 0 else limit * mode
        return np.array([torque, -torque])

    def events(mode):
        if mode == 0:
            return [lambda _t, x: limit - needed(x), lambda _t, x: limit + needed(x)]
        return [lambda _t, x: mode * (x[2] - x[1])]

    def after(mode, which, x):
        if mode == 0:
            return 1 if which == 0 else -1
        x[1:3] = (J @ x[1:3]) / J.sum()
        return 0 if abs(needed(x)) <= limit else int(np.sign(needed(x)))

    start = record["states"][:, 0]
    found, modes = piecewise(record, laws, events, after, int(np.sign(start[2] - start[1])))
    assert len(modes) > 2
    assert (0 in modes) == (limit > 50)
    np.testing.assert_allclose(found[1:3], record["states"][1:3], rtol=0, atol=1e-8)


def test_a_stuck_coupling_moves_as_one(runs):
    states = runs["coulomb that sticks"]["states"]
    rate = states[2] - states[1]
    stuck = np.abs(rate) < 1e-12
    assert 20 < np.count_nonzero(stuck) < len(rate)
    together = stuck[1:] & stuck[:-1]
    assert np.abs(np.diff(states[3]))[together].max() < 1e-15


def test_play_leaves_the_spring_alone_inside_and_shifts_it_outside(runs):
    twist = runs["backlash"]["states"][3]
    assert (np.abs(twist) < 0.03).any()
    assert (np.abs(twist) > 0.03).any()


def test_a_step_comes_at_its_time(runs):
    before = runs["none"]["time"] < 0.02003
    gap = runs["step"]["omega_load_true"] - runs["none"]["omega_load_true"]
    assert not np.abs(gap[before]).any()
    first = np.flatnonzero(~before)[0]
    late = runs["none"]["time"][first] - 0.02003
    assert gap[first] == pytest.approx(-10.0 * late / J[1], rel=1e-3)


def test_sensors_with_effects(runs):
    none, time = runs["none"], runs["none"]["time"]
    np.testing.assert_allclose(runs["offset"]["omega_true"], none["omega_true"] + 0.2, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(runs["offset"]["omega_load_true"], none["omega_load_true"])
    engine = Engine(unequal_cylinders(), none["factors"], float(none["strength"]))
    equation = Plant(two_mass_shaft(), engine, lambda _t: 57.0).equation()
    dense = solve_ivp(
        equation, (0, LENGTH), none["states"][:, 0], "DOP853", dense_output=True, rtol=1e-13, atol=1e-12
    )
    late = time >= 1.3e-4
    expected = dense.sol(time[late] - 1.3e-4)[1]
    np.testing.assert_allclose(runs["delay"]["omega_true"][late], expected, rtol=0, atol=5e-9)
    slope = none["omega_true"][0] - 1.3e-4 * equation(0.0, none["states"][:, 0])[1]
    assert runs["delay"]["omega_true"][0] == pytest.approx(slope, abs=1e-3)


def test_pressures_do_not_tell_of_hidden_misfire(runs):
    none, silent = runs["none"], runs["misfire"]
    theta = silent["theta"]
    np.testing.assert_allclose(silent["p3"], np.interp(theta, none["theta"], none["p3"]), rtol=2e-3)
    assert silent["factors"][2, 1] == 0.0
    assert runs["imbalance"]["factors"][0, 1] == pytest.approx(1.1 * none["factors"][0, 1])
    assert silent["omega_true"][-1] < none["omega_true"][-1] - 0.3


def test_a_run_does_not_depend_on_its_company(runs):
    alone = run_all("two_mass", {"play and friction": TWO_MASS["play and friction"]})["play and friction"]
    np.testing.assert_allclose(alone["states"], runs["play and friction"]["states"], rtol=0, atol=1e-12)


def test_runs_without_effects_are_those_of_the_scalar_simulator():
    record = simulate_hidden("two_mass", [Case(scatter_seed=5)], cycles=1, sigma=0.1)[0]
    reference = simulate_two_mass(1200.0, cycles=1, scatter_seed=5, sigma=0.1, rtol=1e-12)
    assert set(record) == set(reference)
    assert len(record["time"]) == len(reference["time"])
    for key, tolerance in (
        ("omega_true", 2e-9),
        ("omega", 2e-9),
        ("theta", 1e-9),
        ("p1", 1e-2),
        ("T_load", 0),
    ):
        np.testing.assert_allclose(record[key], reference[key], rtol=0, atol=tolerance)


@pytest.mark.slow
def test_the_crankshaft_with_its_effects():
    effects = {
        "none": (),
        "friction": (hidden("coulomb_friction", "coupling_76", 5.0),),
        "play": (hidden("backlash", "coupling_76", 0.03),),
        "cubic": (hidden("cubic_stiffness", "coupling_76", 1e6),),
        "torque": (
            hidden("constant_torque", "inertia_4", 2.0),
            hidden("viscous_friction", "inertia_7", 0.02),
        ),
        "late": (hidden("sensor_delay", "sensor_omega", 5e-5),),
    }
    rough, fine = (run_all("crankshaft", effects, duration=0.01, steps=steps) for steps in (1, 2))
    for name in effects:
        # dry friction's jumps shake the 1600 Hz mode, of which a step of one sample sees only nine
        allowed = 1e-8 if name == "friction" else 1e-9
        for key in ("omega_true", "omega_load_true"):
            np.testing.assert_allclose(rough[name][key], fine[name][key], rtol=0, atol=allowed)
    engine = Engine(unequal_cylinders(), rough["torque"]["factors"], float(rough["torque"]["strength"]))

    def extra(_time, x):
        torque = np.zeros(7)
        torque[3], torque[6] = 2.0, -0.02 * x[7]
        return torque

    equation = Plant(crankshaft_shaft(), engine, lambda _t: 57.0, extra).equation()
    start, times = rough["torque"]["states"][:, 0], rough["torque"]["time"][:120:20]
    again = solve_ivp(equation, (0, times[-1]), start, "DOP853", times, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(again.y[1:8], rough["torque"]["states"][1:8, :120:20], rtol=0, atol=2e-9)


def test_wrong_effects_are_refused():
    with pytest.raises(ValueError, match="unknown effect 'rust'"):
        hidden("rust", "load", 1.0)
    with pytest.raises(ValueError, match="needs the details"):
        hidden("load_step", "load", 1.0)
    with pytest.raises(ValueError, match="backlash cannot be at 'load'; places are coupling"):
        simulate_hidden("two_mass", [Case(effects=(hidden("backlash", "load", 1.0),))])
    one = hidden("misfire", "cylinder_1", 1.0, cycles=(9,))
    with pytest.raises(ValueError, match="misfire in cycle 9"):
        simulate_hidden("two_mass", [Case(effects=(one,))], cycles=1, duration=0.01)
    twice = (hidden("constant_torque", "load", 1.0), hidden("constant_torque", "load", 2.0))
    with pytest.raises(ValueError, match="an effect twice at one place"):
        simulate_hidden("two_mass", [Case(effects=twice)], cycles=1, duration=0.01)
    assert len(PLACES) == 12

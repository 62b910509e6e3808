"""Large laws of what a port does not know: between two bodies, in a parameter, by an input that nothing uses."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.law_refit import _with_unused
from casadi_engine.discrepancy.random_families import smooth_family

STEP, COUNT = 60.0, 600


def rooms():
    """A heater that gives its heat to a room, and the room to the outside, all in SI; the sun is recorded alone."""
    b = ce.Blueprint("rooms")
    heavy, light = b.parameter("Ch", 1.5e4, unit="J/K", min=1e3), b.parameter("C", 3e5, unit="J/K", min=1e4)
    gives, loses = b.parameter("G", 12.0, unit="W/K", min=0), b.parameter("L", 40.0, unit="W/K", min=0)
    heater, room = b.state("Th", unit="degC"), b.state("T", unit="degC")
    power, outside = b.input("P", unit="W"), b.input("To", unit="degC")
    b.input("sun", unit="W/m2")
    at_heater = b.port("heater", "inertia", {"speed": heater}, unit="W")
    at_room = b.port("room", "inertia", {"speed": room}, unit="W")
    b.ode("Th", (power - gives * (heater - room) + at_heater) / heavy)
    b.ode("T", (gives * (heater - room) - loses * (room - outside) + at_room) / light)
    b.output("heater_seen", heater, unit="degC")
    b.output("room_seen", room, unit="degC")
    return b.model()


def record(seed, name, *, exponent=1.0, window=0.0):
    rng = np.random.default_rng(seed)
    time = STEP * np.arange(COUNT)
    power = np.repeat(rng.uniform(100, 1500, 20), COUNT // 20)
    outside = 5 + 4 * np.sin(2 * np.pi * time / 2e4 + rng.uniform(0, 6))
    sun = 500 * np.maximum(np.sin(2 * np.pi * time / 1.3e4 + rng.uniform(0, 6)), 0)

    def ode(t, x):
        k = min(int(t / STEP), COUNT - 1)
        off = x[0] - x[1]
        flow = 15 * off * (abs(off) / 30) ** (exponent - 1)
        to, by = (np.interp(t, time, one) for one in (outside, sun))
        return [(power[k] - flow) / 2e4, (flow - 50 * (x[1] - to) + window * by) / 4e5]

    seen = solve_ivp(ode, (0, time[-1]), [30.0, 18.0], t_eval=time, rtol=1e-8, atol=1e-8, max_step=STEP).y
    seen = seen + 0.1 * rng.standard_normal(seen.shape)
    return ce.Experiment.from_arrays(
        name, time=time, units={"P": "W", "To": "degC", "sun": "W/m2", "heater_seen": "degC", "room_seen": "degC"},
        hold={"P": "zero", "To": "first", "sun": "first"}, P=power, To=outside, sun=sun,
        heater_seen=seen[0], room_seen=seen[1],
    )  # fmt: skip


def repaired(*effects, **law):
    effects = list(effects or ("constant_torque", "quadratic_drag", "overflow"))
    data, fresh = record(1, "data", **law), record(2, "fresh", **law)
    return ce.repair(rooms(), data, fresh=fresh, effects=effects, starts=1, progress=False)


def test_what_passes_between_two_bodies_is_a_function_of_their_difference():
    found = repaired("quadratic_drag", exponent=1.6)
    assert found.verdict == "unnamed"
    assert (found.unknown.port, found.unknown.signal) == ("heater_and_room", "difference")
    assert "an unknown power between heater and room that depends on" in found.unknown.sentence
    assert "the curve of the unknown power" in str(found)


def test_an_input_that_no_equation_uses_acts_where_it_does():
    found = repaired(window=3.0)
    assert found.verdict == "unnamed"
    assert (found.unknown.port, found.unknown.signal) == ("room", "sun")
    words = "no effect of the library names it: an unknown power at room that depends on sun"
    assert words in " ".join(str(found).split())


def test_beside_a_function_of_time_stand_those_of_inputs_that_no_equation_uses():
    """A drum that is cooled by a recorded flow of air: "the parameter G depends on time and looks cubic"."""
    refits = SimpleNamespace(refitter=SimpleNamespace(model=rooms()))
    blank = np.array([0.0, 1.0])
    of_time, of_state = (smooth_family("parameter_G", signal, blank) for signal in ("time", "Th"))
    found = _with_unused(refits, [of_time, of_state])
    assert found[:2] == [of_time, of_state]
    assert [(one.port, one.signal) for one in found[2:]] == [("parameter_G", "sun")]
    assert _with_unused(refits, [of_state]) == [of_state]
    assert rooms().unused_inputs == ("sun",)


def test_nothing_is_found_where_there_is_nothing():
    found = repaired()
    assert found.verdict == "nothing missing"


def spring():
    """A spring whose force is measured too."""
    b = ce.Blueprint("spring")
    mass, stiff = b.parameter("m", 1.5, unit="kg", min=0.1), b.parameter("K", 300.0, unit="N/m", min=1)
    damping = b.parameter("c", 2.0, unit="N s/m", min=0)
    x, v = b.state("x", unit="m", scale=0.05), b.state("v", unit="m/s", scale=0.5)
    at_mass = b.port("mass", "inertia", {"speed": v}, unit="N")
    b.ode("x", v)
    b.ode("v", (b.input("F", unit="N") - stiff * x - damping * v + at_mass) / mass)
    b.output("place", x, unit="m")
    b.output("force", stiff * x, unit="N")
    return b.model()


def pulled(seed, name):
    rng = np.random.default_rng(seed)
    time = 0.01 * np.arange(1200)
    rate, phase = rng.uniform(0.2, 3.0, 8), rng.uniform(0, 6.3, 8)
    force = 6 + 5 * np.sin(2 * np.pi * np.outer(time, rate) + phase).sum(axis=1) / 2

    def tension(x):
        return 250 * x * (1 + 200 * x**2)

    def ode(t, z):
        return [z[1], (np.interp(t, time, force) - tension(z[0]) - 3 * z[1]) / 1.2]

    x = solve_ivp(ode, (0, time[-1]), [0.02, 0.0], t_eval=time, rtol=1e-8, atol=1e-10, max_step=0.01).y[0]
    units = {"F": "N", "place": "m", "force": "N"}
    place, tense = x + 3e-4 * rng.standard_normal(len(x)), tension(x) + 0.1 * rng.standard_normal(len(x))
    return ce.Experiment.from_arrays(name, time=time, units=units, F=force, place=place, force=tense)


@pytest.mark.slow
def test_a_parameter_that_depends_on_a_state_is_no_three_effects():
    found = ce.repair(spring(), pulled(1, "data"), fresh=pulled(2, "fresh"), starts=1, progress=False)
    assert found.verdict == "unnamed"
    assert (found.unknown.port, found.unknown.signal) == ("parameter_K", "x")


@pytest.mark.slow  # the quick run has the same input at a port
def test_a_sensor_that_feels_a_recorded_input_is_told_so():
    """Of what no equation uses; a power at the room that depends on time had been in its place."""
    data, fresh = ({c.name: c for c in record(seed, "r").channels} for seed in (1, 2))
    records = []
    for name, own in (("data", data), ("fresh", fresh)):
        values = {key: np.asarray(c.values) for key, c in own.items()}
        values["heater_seen"] = values["heater_seen"] + 0.004 * values["sun"]
        units = {key: c.unit for key, c in own.items()}
        hold = {"P": "zero", "To": "first", "sun": "first"}
        records.append(
            ce.Experiment.from_arrays(name, time=np.asarray(own["P"].time), units=units, hold=hold, **values)
        )
    found = ce.repair(
        rooms(), records[0], fresh=records[1], effects=["constant_torque"], starts=1, progress=False
    )
    assert found.verdict == "unnamed"
    assert (found.unknown.port, found.unknown.signal) == ("sensor_heater_seen", "sun")
    assert "the sensor heater_seen depends on sun too" in " ".join(str(found).split())

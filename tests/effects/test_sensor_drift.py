"""A sensor whose zero wanders evenly: its law, what it is fitted to, and that a repair names it."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects import SensorDrift, library

TIME = 3.0 + np.arange(500) * 0.1


def drive():
    b = ce.Blueprint("drive")
    inertia = b.parameter("J", 1.5, unit="kg m2", min=0.1, max=20)
    friction = b.parameter("d", 1.0, unit="N m s/rad", min=0, max=20)
    speed, torque = b.state("w", unit="rad/s"), b.input("T", unit="N m")
    slot = b.port("shaft", "inertia", {"speed": speed}, unit="N m")
    b.ode("w", (torque - friction * speed + slot) / inertia)
    b.output("n", 30 / np.pi * speed, unit="rpm")
    return b.model()


def record(name, seed, drift=0.6, friction=0.0):
    """By SciPy; the tachometer wanders by so much [rpm/s]."""
    rng = np.random.default_rng(seed)
    torque = 12 + 8 * np.sign(np.sin((0.31 + 0.05 * seed) * TIME)) + 3 * np.sin(0.9 * TIME + seed)

    def rate(t, w):
        return (np.interp(t, TIME, torque) - 1.4 * w - friction * np.sign(w)) / 2.2

    w = solve_ivp(rate, (TIME[0], TIME[-1]), [8.0], t_eval=TIME, rtol=1e-9, atol=1e-11, max_step=0.1).y[0]
    shown = w * 30 / np.pi + drift * (TIME - TIME[0]) + 1.0 * rng.standard_normal(len(TIME))
    return ce.Experiment.from_arrays(name, time=TIME, units={"T": "N m", "n": "rpm"}, T=torque, n=shown)


def test_it_is_right_where_the_record_begins_and_off_by_the_drift_at_its_end():
    model, data = drive(), record("run", 1)
    assert "sensor_drift" in [one.name for one in library()]
    fitted = SensorDrift().fitted(model.ports["sensor_n"], data, {})
    assert (fitted.span, fitted.first) == (pytest.approx(49.9), 3.0)
    assert SensorDrift(span=10.0).fitted(model.ports["sensor_n"], data, {}) == SensorDrift(span=10.0)
    drifting = model.with_effect(fitted, at="sensor_n", values={"drift": 5.0})
    with_it, without = (ce.simulate(one, data, initial={"w": 8.0})["n"].values for one in (drifting, model))
    assert with_it - without == pytest.approx(5.0 * (TIME - 3.0) / 49.9, abs=1e-9)


def test_a_repair_names_it_and_by_how_much():
    """A drift of the only sensor was "a negative spring and a load that begins, confirmed on fresh data"."""
    found = ce.repair(drive(), record("run", 1), fresh=record("fresh", 2), progress=False)
    assert (found.verdict, found.confirmed) == ("named", True)
    (one,) = found.effects
    assert one.key == "sensor_n.sensor_drift"
    assert one.amplitude.unit == "rpm"
    assert abs(one.amplitude.value - 0.6 * 49.9) < 3 * one.amplitude.stderr


def test_beside_dry_friction_both_are_named():
    records = [record(name, seed, friction=2.0) for name, seed in (("run", 1), ("fresh", 2))]
    found = ce.repair(drive(), records[0], fresh=records[1], progress=False)
    keys = {member.label for one in found.effects for member in one.members} | {
        f"{one.name} at {one.at}" for one in found.effects
    }
    assert "sensor_drift at sensor_n" in keys


def test_nothing_is_missing_where_the_sensor_stays():
    found = ce.repair(
        drive(), record("run", 3, drift=0.0), fresh=record("fresh", 4, drift=0.0), progress=False
    )
    assert found.verdict == "nothing missing"

"""Candidates of several records: an effect that acts in all of them is one candidate, whatever their motion."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.library_candidates import library_candidates
from casadi_engine.discrepancy.null_model import null_model

TIME = 0.01 * np.arange(300)


def record(name, size, model):
    """A swing of a size in N m, with noise."""
    torque = size * np.sin(3 * TIME)
    units = {"T": "N m", "omega": "rad/s"}
    exp = ce.Experiment.from_arrays(name, time=TIME, units=units, T=torque, omega=np.zeros(300))
    speed = ce.simulate(model, exp, initial={"omega_eng": 0.0})["omega"].values
    noisy = speed + 0.01 * np.random.default_rng(0).standard_normal(300)
    return ce.Experiment.from_arrays(name, time=TIME, units=units, T=torque, omega=noisy)


@pytest.mark.parametrize("sizes", [(30.0, 3.0), (3.0, 30.0)])
def test_a_fast_and_a_slow_record_share_the_fading_speeds(sizes):
    model = ce.one_inertia()
    data = [record(name, size, model) for name, size in zip(("first", "second"), sizes, strict=True)]
    fit = ce.estimate(model, data, noise=ce.Noise(omega=0.01), progress=False)
    found = library_candidates(null_model(fit), data, [ce.effects.StribeckFriction()])
    fastest = max(np.abs(one["omega"].values).max() for one in data)
    speeds = [one.nuisance["fading"] for one in found]
    assert len(speeds) == 8
    assert max(speeds) == pytest.approx(3.03 * fastest, rel=0.02)
    assert all(set(one.direction) == {"first", "second"} for one in found)


def test_records_of_two_lengths_have_the_same_effect():
    """A photometer's drift over each record's own length was no drift by time, and lost to a constant rate."""
    model = ce.one_inertia()
    long, short = record("long", 30.0, model), record("short", 20.0, model).between(0.0, 1.5)
    drifting = [
        ce.Experiment.from_arrays(
            one.name,
            time=one["T"].time,
            units={"T": "N m", "omega": "rad/s"},
            T=one["T"].values,
            omega=one["omega"].values + 0.4 * one["T"].time / TIME[-1],
        )
        for one in (long, short)
    ]
    fit = ce.estimate(model, drifting, noise=ce.Noise(omega=0.01), progress=False)
    effects = [ce.effects.SensorDrift(), ce.effects.SensorLag(), ce.effects.InputLag()]
    found = library_candidates(null_model(fit), drifting, effects)
    assert all(set(one.direction) == {"long", "short"} for one in found)
    assert {one.effect for one in found} == {"sensor_drift", "sensor_lag", "input_lag"}
    screened = ce.discrepancy.screen(fit, effects=["sensor_drift"])
    assert screened.scores.amplitude[0] == pytest.approx(0.4, abs=0.01)
    assert screened.scores.error[0] < 0.01

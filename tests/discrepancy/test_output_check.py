"""Outputs that a search has no use for are refused or named within a second, and no others are."""

from dataclasses import replace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.output_check import noise_alone, refuse_still
from casadi_engine.errors import ExperimentError

T = np.arange(400) * 0.01


def spring():
    b = ce.Blueprint("spring")
    m = b.parameter("m", 1.5, unit="kg", min=0.01, max=100)
    c = b.parameter("c", 1.0, unit="N s/m", min=0, max=100)
    k = b.parameter("k", 150.0, unit="N/m", min=1, max=1e4)
    x, v = b.state("x", unit="m"), b.state("v", unit="m/s")
    force = b.input("F", unit="N")
    b.ode("x", v)
    b.ode("v", (force - c * v - k * x + b.port("mass", "inertia", {"speed": v})) / m)
    b.output("pos", 1000 * x, unit="mm")
    return b.model()


def record(pos, force=None):
    force = 8 * np.sin(2 * np.pi * 0.7 * T) if force is None else force
    return ce.Experiment.from_arrays("run", time=T, units={"F": "N", "pos": "mm"}, F=force, pos=pos)


@pytest.fixture(scope="module")
def moved():
    """(N,) mm of a run with noise of 0.3 mm."""
    run = ce.simulate(spring(), record(T), initial={"x": 0.0, "v": 0.0})
    return run["pos"].values + 0.3 * np.random.default_rng(0).standard_normal(len(T))


@pytest.mark.parametrize("pos", [np.full(len(T), 3.0), np.where(np.arange(len(T)) % 7 < 3, 3.0, 3.1)])
def test_an_output_that_does_not_move_is_refused(pos):
    with pytest.raises(ExperimentError, match="no output moves") as refused:
        ce.repair(spring(), record(pos), progress=False)
    text = str(refused.value)
    assert "seen: pos of run is 3" in text
    assert "allowed: an output that moves by more than its resolution" in text
    assert "do: look whether the sensor is connected" in text


def test_one_record_with_motion_is_enough(moved):
    refuse_still(spring(), [record(np.full(len(T), 3.0)), record(moved)])


def test_a_sensor_that_shows_noise_alone_is_named():
    noise = 3.0 + 0.3 * np.random.default_rng(1).standard_normal(len(T))
    found = ce.repair(spring(), record(noise), starts=1, progress=False)
    assert (found.status, found.verdict, found.effects) == ("the data are at fault", None, ())
    assert "pos of run does not follow the inputs: it is noise about a constant" in found.messages[0]
    assert "Next: look at the data, as said above, and repair again" in str(found)


def test_at_rest_noise_is_what_is_expected():
    noise = 0.3 * np.random.default_rng(1).standard_normal(len(T))
    fit = ce.estimate(spring(), record(noise, 0 * T), progress=False)
    assert noise_alone(fit) is None


def test_a_model_that_is_wrong_is_not_a_sensor_that_is_stuck(moved):
    """A model that fits worse than a constant, of an output that moves."""
    fit = ce.estimate(spring(), record(moved), progress=False)
    assert noise_alone(fit) is None
    worse = {name: replace(one, simulated=-5 * one.simulated) for name, one in fit.traces["run"].items()}
    assert noise_alone(replace(fit, traces={"run": worse})) is None


def test_a_wild_sample_is_named_with_its_place(moved):
    wild = moved.copy()
    wild[123] = 1e4
    found = ce.repair(spring(), record(wild), starts=1, progress=False)
    assert (found.status, found.verdict) == ("the data are at fault", None)
    assert "1 single sample holds most of what the model leaves: pos of run at 1.23 s" in found.messages[0]
    assert 'record.masked("pos", keep)' in found.messages[0]
    kept = record(wild).masked("pos", np.arange(len(T)) != 123)
    assert ce.repair(spring(), kept, starts=1, progress=False).verdict == "nothing missing"


def test_a_sensor_at_its_limit_is_named(moved):
    """What was clipped had come out as a load that comes and goes, and a fresh record that was not confirmed it."""
    limit = 0.7 * np.abs(moved).max()
    clipped = np.clip(moved, -limit, limit)
    found = ce.repair(spring(), record(clipped), starts=1, progress=False)
    assert (found.status, found.verdict) == ("the data are at fault", None)
    assert f"pos of run reads {limit:.6g} in " in found.messages[0]
    assert "samples and never more: the sensor is at its limit there" in found.messages[0]
    kept = record(clipped).masked("pos", np.abs(clipped) < limit)
    assert ce.repair(spring(), kept, starts=1, progress=False).verdict == "nothing missing"


def test_an_output_that_is_one_number_beside_others_that_move_is_refused(moved):
    b = ce.Blueprint("spring")
    x, v = b.state("x", unit="m"), b.state("v", unit="m/s")
    force = b.input("F", unit="N")
    b.ode("x", v)
    b.ode("v", force - b.parameter("c", 1.0, unit="1/s") * v - b.parameter("k", 100.0, unit="1/s2") * x)
    b.output("pos", 1000 * x, unit="mm")
    b.output("speed", v, unit="m/s")
    units = {"F": "N", "pos": "mm", "speed": "m/s"}
    stuck, live = (
        ce.Experiment.from_arrays(name, time=T, units=units, F=np.sin(T), pos=moved, speed=speed)
        for name, speed in (("stuck", np.zeros(len(T))), ("live", np.sin(T)))
    )
    with pytest.raises(ExperimentError, match="an output does not move at all") as refused:
        refuse_still(b.model(), [stuck])
    assert "seen: speed of stuck is 0 in all samples" in str(refused.value)
    refuse_still(b.model(), [stuck, live])

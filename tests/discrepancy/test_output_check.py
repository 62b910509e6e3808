"""Outputs that a search has no use for are refused or named within a second, and no others are."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.output_check import (
    at_its_limit,
    noise_alone,
    refuse_still,
    stands_still,
    wild_samples,
)
from casadi_engine.errors import ExperimentError
from casadi_engine.estimation.fit import Trace

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


@pytest.mark.parametrize(
    ("bend", "limited"),
    [
        (lambda y: np.minimum(y, 0.8), True),
        (lambda y: y, False),
        (
            lambda y: np.round(np.minimum(y, 0.8) / 0.1) * 0.1,
            False,
        ),  # it reads in steps, of which one is the largest
        (lambda y: np.where(np.arange(len(y)) < 300, 2.0, y), False),  # it rests there once
        (lambda y: np.zeros(len(y)), False),
        (lambda y: np.maximum(y, 0.0), False),  # a machine that stands still now and then
    ],
)
def test_a_limit_is_met_more_than_once_and_is_no_step(bend, limited):
    y = bend(np.sin(0.05 * np.arange(1000)) + 1e-3 * np.random.default_rng(0).standard_normal(1000))
    trace = Trace(np.arange(1000) * 1.0, y, np.ones(1000, bool), y)
    assert (at_its_limit(SimpleNamespace(traces={"run": {"y": trace}})) is not None) == limited


def fit_that_leaves(e):
    n = len(e)
    trace = Trace(np.arange(n) * 1.0, np.asarray(e, float), np.ones(n, bool), np.zeros(n))
    return SimpleNamespace(traces={"run": {"y": trace}})


def test_the_wild_are_counted_and_the_first_ones_listed():
    e = np.random.default_rng(0).standard_normal(1000)
    e[50:750:100] = 400.0
    said = wild_samples(fit_that_leaves(e))
    assert said.startswith("7 single samples hold")
    assert "y of run at 50, 150, 250, 350, 450 s and 2 more" in said


@pytest.mark.parametrize(
    "e",
    [
        np.random.default_rng(2).standard_normal(2000),
        np.random.default_rng(2).standard_t(3, 2000),
        np.where(np.abs(np.arange(1000) - 500) < 4, 300.0, 1.0)
        * np.random.default_rng(0).standard_normal(1000),
        np.where(np.arange(1000) % 20 == 0, 300.0, 1.0) * np.random.default_rng(0).standard_normal(1000),
        np.zeros(1000),
    ],
    ids=["white", "heavy tails", "an event", "many", "nothing left"],
)
def test_what_lasts_or_is_common_is_not_wild(e):
    assert wild_samples(fit_that_leaves(e)) is None


def test_a_sample_on_the_way_from_one_level_to_another_is_not_wild():
    """A titration passes six units of pH from one sample to the next: a model that is late by half a sample misses that
    one sample alone, and the measurement has no fault."""
    fit = fit_that_leaves(np.random.default_rng(0).standard_normal(1000))
    seen = fit.traces["run"]["y"]
    level = 300.0 * (np.arange(1000) // 100 % 2)
    late = level.copy()
    late[100::100] = 150.0
    fit.traces["run"]["y"] = Trace(seen.time, late + seen.measured, seen.mask, level)
    assert wild_samples(fit) is None
    late[[345, 745]] = 500.0, -300.0
    fit.traces["run"]["y"] = Trace(seen.time, late + seen.measured, seen.mask, level)
    assert "y of run at 345, 745 s" in wild_samples(fit)


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


def seen(y, simulated):
    trace = Trace(T, y, np.ones(len(T), dtype=bool), simulated)
    return stands_still(SimpleNamespace(traces={"run": {"y": trace}}))


def test_a_sensor_that_stands_still_is_named():
    """A gyro that stood still for half of a record was "an unknown torque that depends on its speed"."""
    motion = 3 * np.sin(2 * np.pi * 0.7 * T)
    y = motion + 0.3 * np.random.default_rng(0).standard_normal(len(T))
    assert seen(y, motion) is None
    y[100:200] = y[100]
    said = seen(y, motion)
    assert f"y of run reads {y[100]:.6g} in all 100 samples from 1 to 1.99 s" in said
    assert 'record.masked("y", keep) with keep False there' in said


def test_a_machine_at_rest_does_not_stand_still_for_its_sensor():
    """Without noise, and in a sensor's steps, a machine that friction holds reads one number too."""
    held = 3 * np.sin(2 * np.pi * 0.7 * np.minimum(T, 1.5))
    moving = 3 * np.sin(2 * np.pi * 0.7 * T)
    assert seen(held, moving) is None
    noisy = held + 0.3 * np.random.default_rng(0).standard_normal(len(T))
    assert seen(np.round(noisy / 0.5) * 0.5, moving) is None
    noisy[150:] = noisy[150]
    assert seen(noisy, held) is None  # nothing moves meanwhile

"""Events in several records: one amplitude, or one for each, and a time of its own in every record."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.events import by_one_step, place_of_event
from casadi_engine.discrepancy.linearised import OneStep
from casadi_engine.effects import Grid

TIMES = (1.0, 2.0, 3.0)


def candidates(records, over="time", whole=False):
    effect = SimpleNamespace(nuisance={"time": Grid(0, 1, over=over, whole=whole)})
    return [
        SimpleNamespace(nuisance={"time": t}, direction={name: None}, source=SimpleNamespace(effect=effect))
        for name in records
        for t in TIMES
    ]


def step_of(amplitude):
    """One step of unit errors, in which candidate k alone would take amplitude[k]^2 of chi-squared 1000."""
    amplitude = np.array(amplitude, dtype=float)
    return OneStep(1000 - amplitude**2, amplitude, np.ones(len(amplitude)), 1000.0)


def test_one_amplitude_takes_the_best_time_of_every_record():
    step = step_of([1, 9, 2, 3, 4, 8])
    step.error[3:] = 2.0
    step.cost[3:] = 1000 - (step.amplitude[3:] / 2) ** 2
    found = by_one_step(candidates("ab"), step, range(6))
    assert found.times == {"time": {"a": 2.0, "b": 3.0}}
    assert found.amplitude == 9
    # what 9 takes in b, where 8 would be best
    assert found.cost == pytest.approx(1000 - 81 - 9 * (2 * 8 - 9) / 4)


def test_a_record_that_an_event_only_makes_worse_has_none():
    found = by_one_step(candidates("ab"), step_of([0, 9, 0, 1, -8, 2]), range(6))
    assert found.times == {"time": {"a": 2.0, "b": math.inf}}


@pytest.mark.filterwarnings("error")
def test_an_amplitude_far_beyond_a_candidate_only_adds():
    """In a record where one time explains hardly anything, with an amplitude that another record asks for."""
    step = step_of([1, 9, 2, 0, 0, 2])
    step.amplitude[3], step.error[3] = 1e-170, 1e-170
    found = by_one_step(candidates("ab"), step, range(6))
    assert found.times == {"time": {"a": 2.0, "b": math.inf}}


def test_no_time_where_the_error_is_not_known():
    step = step_of([0, 9, 0, 9, 0, 0])
    step.error[3] = np.inf
    assert by_one_step(candidates("ab"), step, range(6)).times["time"]["b"] == math.inf


@pytest.mark.parametrize("own", [candidates("a") * 2, candidates("ab", over="cycle", whole=True)])
def test_an_event_of_one_record_or_in_whole_cycles_is_one_candidate(own):
    found = by_one_step(own, step_of([0, 9, 0, 1, 8, 2]), range(6))
    assert (found.times, found.lead, found.cost) == ({}, 1, 1000 - 81)


def test_the_time_of_an_event_of_known_amplitude():
    assert place_of_event(step_of([1, 4, 5]), 4.0) == (2, 4.0)
    assert place_of_event(step_of([-1, -4, 1]), 4.0) is None


def test_the_time_of_an_event_of_any_amplitude():
    step = step_of([1, -5, 4])
    assert place_of_event(step, None) == (1, -5.0)
    step.error[1] = np.inf
    assert place_of_event(step, None) is None


# ---- by the public verb

T = np.arange(0, 6, 0.02)


@pytest.fixture(scope="module")
def fan():
    b = ce.Blueprint("fan")
    inertia = b.parameter("J", 0.5, unit="kg m2", min=0.01, max=50)
    damping = b.parameter("c", 0.3, unit="N m s/rad", min=0, max=50)
    speed = b.state("w", unit="rad/s")
    torque = b.input("T", unit="N m")
    rotor = b.port("rotor", "inertia", {"speed": speed})
    b.ode("w", (torque - damping * speed + rotor) / inertia)
    b.output("n", speed, unit="rad/s")
    return b.model()


def record(name, seed, at, size=3.0):
    """A load of `size` N m from the time `at`: none where that is beyond the end."""
    torque = 10 + 6 * np.sign(np.sin(np.pi * T + seed))
    found = solve_ivp(
        lambda t, x: (np.interp(t, T, torque) - 0.35 * x - size * (t > at)) / 0.6, (0, T[-1]), [10.0], t_eval=T,
        max_step=0.02, rtol=1e-8, atol=1e-9,
    )  # fmt: skip
    noise = np.random.default_rng(seed).normal(0, 0.2, T.size)
    units = {"time": "s", "T": "N m", "n": "rad/s"}
    return ce.Experiment.from_arrays(name, time=T, units=units, T=torque, n=found.y[0] + noise)


def repaired(model, data, fresh=None, effects=("load_step", "coulomb_friction")):
    return ce.repair(model, data, fresh=fresh, effects=effects, starts=1, progress=False)


def test_records_with_a_load_at_their_own_times(fan):
    found = repaired(fan, [record("a", 1, 1.5), record("b", 2, 3.0)], record("c", 3, 2.0))
    (effect,) = found.effects
    values = {name.rpartition(".")[2]: one for name, one in effect.parameters.items()}
    assert set(values) == {"torque", "time@a", "time@b"}
    assert values["torque"].value == pytest.approx(3.0, abs=4 * values["torque"].stderr)
    assert (values["time@a"].value, values["time@b"].value) == pytest.approx((1.5, 3.0), abs=0.05)
    # at its own time in the fresh record
    assert found.confirmed is True
    assert found.gaps.validation_after.gap.chi2_per_sample < 1.3


@pytest.mark.slow
def test_loads_of_other_sizes_and_a_record_without(fan):
    found = repaired(
        fan, [record("a", 1, 1.5), record("b", 2, 3.0, size=5.0)], record("c", 3, 2.0, size=-4.0)
    )
    values = {name.rpartition(".")[2]: one.value for name, one in found.effects[0].parameters.items()}
    assert (values["torque@a"], values["torque@b"]) == pytest.approx((3.0, 5.0), abs=0.3)
    assert found.confirmed is True
    found = repaired(fan, [record("a", 1, 1.5), record("b", 2, 9.0)], effects=["load_step"])
    assert "record b shows no load_step at rotor" in found.messages
    assert found.confirmed is True

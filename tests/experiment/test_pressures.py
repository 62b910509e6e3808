"""Pressures made by shifting measured ones."""

import numpy as np
import pytest

from casadi_engine.errors import ExperimentError
from casadi_engine.experiment import Experiment

BAD = ExperimentError
CYCLE = 4 * np.pi
TDC = {"p1": 0.0, "p3": np.pi, "p4": 2 * np.pi, "p2": 3 * np.pi}


def trace(theta, tdc):
    return 1e5 + 4e6 * np.exp(-8 * (1 - np.cos((theta - tdc) / 2)))


def record(cycles=3.0, start=0.0, count=6000, **changes):
    theta = start + np.linspace(0, cycles * CYCLE, count) + 0.01 * np.sin(np.linspace(0, 40, count))
    options = {
        "time": np.linspace(0, cycles / 10, count),
        "units": {"theta": "rad", "p1": "Pa", "p2": "Pa", "omega": "rad/s"},
        "theta": theta,
        "p1": trace(theta, 0.0),
        "p2": trace(theta, 3 * np.pi),
        "omega": np.full(count, 125.0),
    }
    return Experiment.from_arrays("r", **(options | changes))


@pytest.mark.parametrize("start", [0.0, -7.0, 100.0])
@pytest.mark.parametrize("cycles", [1.0, 1.3, 3.0])
def test_the_shifted_trace_is_that_of_the_other_cylinder(start, cycles):
    made = record(cycles, start).shift_pressures({"p3": "p1", "p4": "p2"})
    for name in ("p3", "p4"):
        channel = made[name]
        np.testing.assert_allclose(channel.values, trace(made["theta"].values, TDC[name]), rtol=2e-3)
        assert (channel.origin, channel.unit, channel.hold) == ("assumed", "Pa", "first")
    step = made.history[-1]
    assert step.function == "shift_pressures"
    assert step.arguments["pairs"] == {"p3": "p1", "p4": "p2"}
    assert step.arguments["offsets"] == {"p3": np.pi, "p4": 2 * np.pi, "p1": 0.0, "p2": 3 * np.pi}


def test_other_firing_orders_by_offsets():
    offsets = {"p1": 0.0, "p5": 2.1}
    made = record().shift_pressures({"p5": "p1"}, offsets=offsets)
    np.testing.assert_allclose(made["p5"].values, trace(made["theta"].values, 2.1), rtol=2e-3)
    far = record().shift_pressures({"p5": "p1"}, offsets={"p1": 0.0, "p5": 2.1 - 5 * CYCLE})
    np.testing.assert_allclose(far["p5"].values, made["p5"].values, rtol=1e-9)


def test_a_scatter_from_cycle_to_cycle_moves_along():
    plain = record()
    theta = plain["theta"].values
    scattered = record(p1=trace(theta, 0.0) * (1 + 0.1 * np.floor((theta + np.pi) / CYCLE)))
    made = scattered.shift_pressures({"p3": "p1"})["p3"].values
    inside = (theta > np.pi) & (theta < 2.5 * CYCLE)
    expected = trace(theta, np.pi) * (1 + 0.1 * np.floor(theta / CYCLE))
    steady = np.abs(((theta + CYCLE / 2) % CYCLE) - CYCLE / 2) > 0.1  # away from the jumps of this test
    np.testing.assert_allclose(made[inside & steady], expected[inside & steady], rtol=2e-3)


def test_a_pressure_made_of_an_input_is_an_input():
    made = record(inputs=["p1", "theta"]).shift_pressures({"p3": "p1", "p4": "p2"})
    assert made.inputs == ("p1", "theta", "p3")
    assert record().shift_pressures({"p3": "p1"}).inputs == ()


def test_a_record_of_one_cycle_may_end_a_step_before_it_repeats(refused):
    theta = np.linspace(0, CYCLE, 6000, endpoint=False)
    one = record(theta=theta, p1=trace(theta, 0.0))
    made = one.shift_pressures({"p3": "p1"})["p3"]
    np.testing.assert_allclose(made.values, trace(theta, np.pi), rtol=2e-3)
    fewer = one.between(0, 0.2999)
    refused(BAD, ["too short to shift pressure"], fewer.shift_pressures, {"p3": "p1"})


def test_a_pressure_with_its_own_time():
    theta = record()["theta"].values
    coarse = record(p1=(np.linspace(0, 0.3, 6000)[::2], trace(theta, 0.0)[::2]))
    made = coarse.shift_pressures({"p3": "p1"})["p3"]
    assert len(made) == 3000
    np.testing.assert_allclose(made.values, trace(theta[::2], np.pi), rtol=5e-3)


def test_what_is_refused(refused):
    shift = record().shift_pressures
    for pairs in ({}, None, ["p3"]):
        refused(BAD, ["no pressure to make", repr(pairs), "{new: measured}", '{"p3": "p1"'], shift, pairs)
    refused(BAD, ["channel 'p2' is there already", "measured", "without('p2')"], shift, {"p2": "p1"})
    refused(BAD, ["no channel 'p9'"], shift, {"p3": "p9"})
    refused(BAD, ["'omega' is not a pressure", "rad/s", "Pa"], shift, {"p3": "omega"})
    refused(
        BAD, ["no firing offset of pressure 'p7'", "p1, p3, p4, p2", "offsets={'p7'"], shift, {"p7": "p1"}
    )
    refused(BAD, ["no firing offset of pressure 'p1'"], shift, {"p3": "p1"}, offsets={"p3": 0})
    bad = {"p1": 0, "p3": float("nan")}
    refused(BAD, ["firing offset of 'p3' is not a number"], shift, {"p3": "p1"}, offsets=bad)
    refused(BAD, ["cycle_length is not positive"], shift, {"p3": "p1"}, cycle_length=-1)
    refused(BAD, ["shift_pressures: not a channel name", "'p[3'"], shift, {"p[3": "p1"})
    gap = record().masked("p1", np.arange(6000) != 7)
    refused(BAD, ["'p1' has missing samples", "1 of 6000"], gap.shift_pressures, {"p3": "p1"})
    short = record(0.9)
    refused(
        BAD, ["too short to shift pressure 'p1'", "0.901 engine cycles"], short.shift_pressures, {"p3": "p1"}
    )
    late = record().with_channel(record().between(0.1, 0.2)["theta"])
    pieces = ["crank angle 'theta' does not cover pressure 'p1'", "0 to 0.3 s"]
    refused(BAD, pieces, late.shift_pressures, {"p3": "p1"})


@pytest.mark.parametrize("offsets", [3, [0.0, 1.0], {1: 0.0}])
def test_offsets_that_are_no_mapping_of_names(offsets):
    with pytest.raises(ExperimentError, match="no firing offset of pressure"):
        record().shift_pressures({"p3": "p1"}, offsets=offsets)

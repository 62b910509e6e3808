"""Pieces by time and by engine cycle."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.errors import ExperimentError
from casadi_engine.experiment import Experiment

BAD = ExperimentError
CYCLE = 4 * np.pi


@pytest.fixture
def mixed():
    """An input every 10 ms and an output at times between."""
    return Experiment.from_arrays(
        "mixed",
        units={"u": "1", "y": "1"},
        u=(np.arange(11) / 100, np.arange(11.0)),
        y=((2 * np.arange(10) + 1) / 200, np.arange(10.0)),
        inputs=["u"],
    )


def turning(start, stop, count=2000):
    theta = np.linspace(start, stop, count)
    units = {"theta": "rad", "omega": "rad/s"}
    return Experiment.from_arrays(
        "t", time=theta / 100 + 5, units=units, theta=theta, omega=np.cos(theta) + 100
    )


def test_between_keeps_both_ends(engine):
    piece = engine.between(0.1, 0.2)
    assert piece["omega"].span == (0.1, 0.2)
    assert len(piece["omega"]) == 201
    assert piece["omega"].time is piece["p1"].time
    assert piece.history[-1].arguments == {"start": 0.1, "stop": 0.2, "inputs": []}
    assert (piece.history[-1].rows_in, piece.history[-1].rows_out) == (601, 201)
    assert engine.duration == pytest.approx(0.3)


def test_inputs_keep_a_sample_beyond_each_end(mixed):
    piece = mixed.between(0.03, 0.062)
    assert piece["u"].span == (0.03, 0.07)
    assert piece["y"].span == (0.035, 0.055)
    piece.require(outputs=["y"])
    piece = mixed.between(0.033, 0.067)
    assert piece["u"].span == (0.03, 0.07)
    assert piece["y"].span == (0.035, 0.065)
    assert mixed.between(-1, 1)["u"].span == (0.0, 0.1)


def test_the_inputs_of_the_call_come_before_those_of_the_experiment(mixed, refused):
    assert mixed.between(0.033, 0.067, inputs=())["u"].span == (0.04, 0.06)
    assert mixed.between(0.033, 0.067, inputs="y")["y"].span == (0.025, 0.075)
    refused(BAD, ["no channel 'z'"], mixed.between, 0, 1, inputs=["z"])


def test_a_resampled_output_stays_covered(engine):
    piece = engine.resample(omega=7).between(0.0512, 0.2123)
    piece.require(inputs=["theta", "p1", "T_load"], outputs=["omega"])


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(st.floats(0, 0.25), st.floats(0.03, 0.3), st.integers(1, 9), st.integers(1, 9))
def test_inputs_cover_the_outputs_after_every_slice(start, length, fine, coarse):
    time = np.arange(301) / 1000
    experiment = Experiment.from_arrays(
        "h",
        units={"u": "1", "y": "1"},
        u=(time[::coarse], time[::coarse]),
        y=(time[: 1 + 300 // coarse * coarse : fine], time[: 1 + 300 // coarse * coarse : fine]),
    )
    experiment.require(inputs=["u"], outputs=["y"])
    inside = (experiment["y"].time >= start) & (experiment["y"].time <= start + length)
    if inside.sum() < 2:
        with pytest.raises(ExperimentError, match="fewer than two samples of channel 'y'"):
            experiment.between(start, start + length, inputs=["u"])
    else:
        piece = experiment.between(start, start + length, inputs=["u"])
        piece.require(inputs=["u"], outputs=["y"])
        assert piece["y"].time.tolist() == experiment["y"].time[inside].tolist()


def test_pieces_that_are_refused(engine, refused):
    refused(BAD, ["the piece has no length", "0.2 to 0.1 s", "start < stop"], engine.between, 0.2, 0.1)
    refused(BAD, ["the piece has no length"], engine.between, 0.1, 0.1)
    refused(BAD, ["fewer than two samples of channel", "2 to 3 s", "0 to 0.3 s"], engine.between, 2, 3)
    refused(BAD, ["fewer than two samples"], engine.between, 0.1, 0.1001)
    refused(BAD, ["start is not a number", "nan"], engine.between, float("nan"), 1)
    refused(BAD, ["stop is not a number", "'1'"], engine.between, 0, "1")
    refused(BAD, ["stop is not a number", "True"], engine.between, 0, True)


def test_cycles_cut_at_combustion_tdc():
    record = turning(0, 5 * CYCLE)
    piece = record.cycles(2, 3)
    assert CYCLE <= piece["theta"].values[0] < CYCLE + 0.05
    assert 3 * CYCLE - 0.05 < piece["theta"].values[-1] < 3 * CYCLE
    assert piece.history[-1].function == "cycles"
    assert piece.history[-1].arguments["tdc"] == 0.0


def test_cycles_of_another_cylinder_start_at_its_own_tdc():
    piece = turning(0, 5 * CYCLE).cycles(1, 2, tdc=3 * np.pi)
    assert 3 * np.pi <= piece["theta"].values[0] < 3 * np.pi + 0.05
    assert 3 * np.pi + 2 * CYCLE - 0.05 < piece["theta"].values[-1] < 3 * np.pi + 2 * CYCLE


def test_two_stroke_cycles_and_another_name():
    record = turning(0, 5 * CYCLE)
    record = record.with_channel(record["theta"]).cycles(3, 3, cycle_length=2 * np.pi)
    assert CYCLE <= record["theta"].values[0] < CYCLE + 0.05
    assert record["theta"].values[-1] < 6 * np.pi


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(st.floats(-30, 30), st.integers(2, 6), st.floats(0, 12))
def test_cycles_part_a_record_without_gap_or_overlap(start, number, tdc):
    record = turning(start, start + (number + 1) * CYCLE)
    low = int(np.ceil((start - tdc) / CYCLE)) + 1
    pieces = [record.cycles(k, k, tdc=tdc)["theta"].values for k in range(low, low + number)]
    whole = record.cycles(low, low + number - 1, tdc=tdc)["theta"].values
    np.testing.assert_array_equal(np.concatenate(pieces), whole)
    for k, piece in enumerate(pieces, start=low):
        assert np.all(np.floor((piece - tdc) / CYCLE + 1e-9) + 1 >= k)
        assert np.all(np.floor((piece - tdc) / CYCLE - 1e-9) + 1 <= k)


def test_a_record_cut_a_little_short_still_holds_its_last_cycle(refused):
    assert (
        turning(0.1, 3 * CYCLE - 0.1).cycles(1, 3)["theta"].span
        == turning(0.1, 3 * CYCLE - 0.1)["theta"].span
    )
    refused(BAD, ["whole cycles of the record: 2 to 2"], turning(0.5, 3 * CYCLE - 0.5).cycles, 1, 3)


def test_cycles_that_are_refused(engine, refused):
    ask = engine.cycles
    pieces = ["not whole in the record", "cycles 2 to 4", "whole cycles of the record: 1 to 3"]
    refused(BAD, pieces, ask, 2, 4)
    for first, last in ((0, 1), (2, 1), (1.0, 2), (True, 2), ("1", 2)):
        refused(BAD, ["not whole", f"cycles {first!r} to {last!r}", "first <= last"], ask, first, last)
    refused(BAD, ["none: it is shorter than a cycle"], engine.between(0, 0.05).cycles, 1, 1)
    refused(BAD, ["'omega' is not an angle", "rad/s", "theta="], ask, 1, 2, theta="omega")
    refused(BAD, ["no channel 'phi'"], ask, 1, 2, theta="phi")
    refused(BAD, ["cycle_length is not positive", "4 pi"], ask, 1, 2, cycle_length=0)
    refused(BAD, ["tdc is not a number", "nan"], ask, 1, 2, tdc=float("nan"))


def test_an_angle_that_does_not_increase_is_refused(refused):
    theta = np.arange(100) % 13 / 2
    record = Experiment.from_arrays("r", time=np.arange(100.0), units={"theta": "rad"}, theta=theta)
    refused(
        BAD, ["'theta' does not increase at 13 s", "0 rad after 6 rad", "numpy.unwrap"], record.cycles, 1, 2
    )
    empty = Experiment.from_arrays("r", time=[0, 1], units={"theta": "rad"}, theta=[np.nan, 1])
    refused(BAD, ["fewer than two valid samples", "seen: 1"], empty.cycles, 1, 1)


def test_missing_angles_are_left_out():
    record = turning(0, 3 * CYCLE)
    gaps = record.masked("theta", np.arange(2000) % 3 > 0)
    assert len(gaps.cycles(2, 2)["omega"]) == len(record.cycles(2, 2)["omega"])


def test_a_number_beyond_floating_point(engine):
    with pytest.raises(ExperimentError, match="start is not a number"):
        engine.between(10**400, 1.0)

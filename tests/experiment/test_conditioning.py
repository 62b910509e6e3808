"""Filters and resampling."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.errors import ExperimentError
from casadi_engine.experiment import Experiment

BAD = ExperimentError


def one(values, rate=1000.0, **options):
    time = np.arange(len(values)) / rate
    return Experiment.from_arrays("r", time=time, units={"y": "1", "u": "1"}, y=values, u=time, **options)


def test_resampling_touches_the_named_output_alone(engine):
    coarse = engine.resample(omega=15)
    np.testing.assert_array_equal(coarse["omega"].values, engine["omega"].values[::15])
    np.testing.assert_array_equal(coarse["omega"].time, engine["omega"].time[::15])
    assert coarse["T_load"] is engine["T_load"]
    assert len(engine["omega"]) == 601
    step = coarse.history[-1]
    assert step.to_dict() == {
        "function": "resample",
        "arguments": {"omega": 15},
        "rows_in": 601,
        "rows_out": 41,
    }
    assert engine.resample(omega=1)["omega"].values.tolist() == engine["omega"].values.tolist()


def test_resampling_keeps_masks_and_rows_in_step():
    values = np.arange(10.0)
    values[4] = np.nan
    coarse = one(values).resample(y=2)
    assert coarse["y"].mask.tolist() == [True, True, False, True, True]


@pytest.mark.parametrize("factor", [0, -1, 2.5, "2", True, 601, None])
def test_factors_that_are_refused(engine, refused, factor):
    pieces = ["resampling factor of 'omega'", repr(factor), "a whole number from 1 to 600"]
    refused(BAD, pieces, engine.resample, omega=factor)


def test_verbs_without_a_channel_or_with_an_unknown_one(engine, refused):
    refused(BAD, ["resample was given no channel", "resample(omega=15)"], engine.resample)
    refused(BAD, ["moving_average was given no channel"], engine.moving_average)
    refused(BAD, ["low_pass was given no channel"], engine.low_pass, cutoff_hz=10, channels=())
    refused(BAD, ["no channel 'omgea'", "did you mean 'omega'?"], engine.resample, omgea=2)
    refused(BAD, ["no channel 'x'", "theta, p1"], engine.low_pass, cutoff_hz=10, channels="x")


def test_the_low_pass_has_no_phase_and_its_known_gain():
    time = np.arange(4000) / 1000
    for frequency, cutoff, order in ((20, 50, 2), (50, 50, 4), (80, 50, 1), (5, 50, 4)):
        y = np.sin(2 * np.pi * frequency * time)
        out = one(y).low_pass(cutoff_hz=cutoff, order=order, channels="y")["y"].values
        # The bilinear transform bends the frequency axis: compare with the warped analogue gain, squared
        # because the filter runs twice.
        ratio = np.tan(np.pi * frequency / 1000) / np.tan(np.pi * cutoff / 1000)
        gain = 1 / (1 + ratio ** (2 * order))
        middle = slice(1000, 3000)
        np.testing.assert_allclose(out[middle], gain * y[middle], atol=2e-6)


def test_the_low_pass_leaves_a_straight_line_and_the_rest_alone(engine):
    line = 3 + 2 * np.arange(500) / 1000
    np.testing.assert_allclose(one(line).low_pass(cutoff_hz=40, channels=["y"])["y"].values, line, rtol=1e-9)
    smooth = engine.low_pass(cutoff_hz=200, channels=("omega",))
    assert smooth["p1"] is engine["p1"]
    assert smooth.history[-1].arguments == {"cutoff_hz": 200.0, "order": 4, "channels": ["omega"]}
    assert smooth["omega"].hold == "first"


def test_what_the_low_pass_refuses(engine, refused):
    low = engine.low_pass
    for cutoff in (0, -1, 1000, 1e9, float("nan"), float("inf"), "50", None, True):
        pieces = ["cutoff frequency is not acceptable", f"{cutoff!r} Hz", "1000 Hz", "change cutoff_hz"]
        refused(BAD, pieces, low, cutoff_hz=cutoff, channels="omega")
    for order in (0, 13, 1.5, True):
        pieces = ["order of the low-pass", repr(order), "from 1 to 12"]
        refused(BAD, pieces, low, cutoff_hz=50, order=order, channels="omega")
    gap = engine.masked("omega", np.arange(601) != 5)
    refused(
        BAD, ["missing samples", "1 of 601", "moving_average"], gap.low_pass, cutoff_hz=50, channels="omega"
    )
    uneven = Experiment.from_arrays("r", time=np.arange(100) ** 1.1, units={"y": "1"}, y=np.arange(100))
    refused(
        BAD,
        ["not sampled uniformly", "steps from", "moving_average"],
        uneven.low_pass,
        cutoff_hz=0.1,
        channels="y",
    )
    short = one(np.arange(15.0))
    pieces = ["too short for this low-pass", "15 samples", "more than 15 samples at order 4"]
    refused(BAD, pieces, short.low_pass, cutoff_hz=50, channels="y")
    assert len(one(np.arange(16.0)).low_pass(cutoff_hz=50, channels="y")["y"]) == 16


def test_times_rounded_when_written_still_count_as_uniform():
    time = np.round(np.arange(400) / 14402, 8)
    experiment = Experiment.from_arrays("r", time=time, units={"y": "1"}, y=np.sin(time))
    assert experiment["y"].rate is None
    assert len(experiment.low_pass(cutoff_hz=900, channels="y")["y"]) == 400


def test_the_moving_average_by_hand():
    values = np.array([1.0, 2, 4, 8, 16, 32])
    averaged = one(values).moving_average(y=3)
    np.testing.assert_allclose(averaged["y"].values, [1, 7 / 3, 14 / 3, 28 / 3, 56 / 3, 32])
    assert averaged.history[-1].arguments == {"y": 3}
    np.testing.assert_allclose(one(values).moving_average(y=5)["y"].values, [1, 7 / 3, 6.2, 12.4, 56 / 3, 32])


def test_the_moving_average_leaves_missing_samples_out_and_missing():
    averaged = one([1.0, np.nan, 5.0, 7.0, 9.0]).moving_average(y=3)["y"]
    np.testing.assert_allclose(averaged.values, [1, np.nan, 6, 7, 9])
    assert averaged.mask.tolist() == [True, False, True, True, True]
    assert one([np.nan] * 4).moving_average(y=3)["y"].missing == 4


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(
    st.lists(st.floats(-1e6, 1e6) | st.just(float("nan")), min_size=2, max_size=40),
    st.integers(0, 10),
    st.data(),
)
def test_the_moving_average_against_its_definition(values, half, data):
    size = len(values)
    half = min(half, (size - 1) // 2)
    found = one(values).moving_average(y=2 * half + 1)["y"].values
    for k in range(size):
        reach = min(half, k, size - 1 - k)
        window = [v for v in values[k - reach : k + reach + 1] if v == v]
        expected = sum(window) / len(window) if values[k] == values[k] else float("nan")
        assert found[k] == pytest.approx(expected, rel=1e-9, abs=1e-7, nan_ok=True)


@settings(max_examples=30, deadline=None, derandomize=True, database=None)
@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.integers(0, 30))
def test_the_moving_average_leaves_a_straight_line(offset, slope, half):
    line = offset + slope * np.arange(61) / 1000
    np.testing.assert_allclose(
        one(line).moving_average(y=2 * half + 1)["y"].values, line, rtol=1e-9, atol=1e-9
    )


def test_windows_that_are_refused(engine, refused):
    pieces = ["window of 'T_load' is even", "seen: 50", "an odd number", "use 51 or 49"]
    refused(BAD, pieces, engine.moving_average, T_load=50)
    for length in (0, -3, 603, 1.5, "3"):
        pieces = ["window of 'T_load'", repr(length), "an odd whole number from 1 to 601"]
        refused(BAD, pieces, engine.moving_average, T_load=length)


def test_masking(engine, refused):
    keep = np.arange(601) % 2 == 0
    once = engine.masked("omega", keep)
    assert once["omega"].missing == 300
    assert np.isnan(once["omega"].values[1])
    twice = once.masked("omega", np.arange(601) > 9)
    assert twice["omega"].missing == 305
    assert twice.history[-1].arguments == {"name": "omega", "newly_missing": 5}
    assert engine["omega"].missing == 0
    refused(
        BAD, ["mask for channel 'omega' does not fit", "(3,)", "(601,)"], engine.masked, "omega", [True] * 3
    )
    refused(
        BAD, ["mask for channel 'omega' does not fit", "int64"], engine.masked, "omega", np.ones(601, int)
    )

"""Channel: what it keeps and what it refuses."""

import json

import numpy as np
import pytest

from casadi_engine.errors import ExperimentError, UnitError
from casadi_engine.experiment import Channel, Experiment, Step

T = [0.0, 0.1, 0.2, 0.3]
BAD = ExperimentError


def make(**changes):
    return Channel(**{"name": "omega", "unit": "rad/s", "time": T, "values": [1.0, 2.0, 3.0, 4.0], **changes})


def test_what_it_knows():
    channel = make()
    assert len(channel) == 4
    assert channel.rate == pytest.approx(10)
    assert channel.span == (0.0, 0.3)
    assert channel.missing == 0
    assert (channel.hold, channel.origin) == ("first", "measured")
    assert channel.mask.tolist() == [True] * 4
    assert channel.rows.size == 0


def test_the_rate_is_none_when_the_steps_differ_by_more_than_a_millionth():
    time = np.arange(1000) / 14402
    assert make(time=time, values=time).rate == pytest.approx(14402)
    assert make(time=time + 1000, values=time).rate == pytest.approx(14402)
    moved = time.copy()
    moved[500] += 3e-6 / 14402
    assert make(time=moved, values=time).rate is None
    moved[500] = time[500] + 3e-7 / 14402
    assert make(time=moved, values=time).rate == pytest.approx(14402)
    assert make(time=[-1e308, 0.0, 1e308], values=[1, 2, 3]).rate is None
    assert make(time=[0.0, 5e-324, 1e-323], values=[1, 2, 3]).rate is None


def test_arrays_are_copies_and_read_only():
    values, time, mask = np.arange(4.0), np.arange(4.0), np.array([True, True, False, True])
    channel = make(values=values, time=time, mask=mask)
    values[0] = time[0] = 99
    mask[0] = False
    assert channel.values[0] == channel.time[0] == 0
    assert channel.mask[0]
    for array in (channel.values, channel.time, channel.mask, channel.rows):
        assert not array.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        channel.values[0] = 1


def test_a_read_only_view_of_a_writeable_array_is_copied():
    base = np.arange(4.0)
    view = base[:]
    view.setflags(write=False)
    channel = make(values=view)
    base[0] = 99
    assert channel.values[0] == 0


def test_frozen_arrays_are_shared():
    first = make()
    assert make(name="b", time=first.time).time is first.time


def test_nan_and_mask_say_the_same_thing():
    channel = make(values=[1, np.nan, 3, 4])
    assert channel.mask.tolist() == [True, False, True, True]
    channel = make(values=[1, np.nan, 3, 4], mask=[True, True, False, True])
    assert channel.mask.tolist() == [True, False, False, True]
    assert np.isnan(channel.values).tolist() == [False, True, True, False]
    channel = make(values=np.ma.masked_array([1, 2, 3, 4], [0, 1, 0, 0]))
    assert channel.missing == 1


@pytest.mark.parametrize("dtype", ["float32", "int64", "uint8", "int16"])
def test_any_real_number_type_is_taken(dtype):
    assert make(values=np.arange(4, dtype=dtype)).values.dtype == np.float64


@pytest.mark.parametrize(
    ("changes", "error", "pieces"),
    [
        ({"unit": "warp"}, UnitError, ["channel 'omega': unknown unit 'warp'", "warp\n  ^^^^", "s/rad"]),
        ({"unit": ""}, UnitError, ["channel 'omega': unknown unit", "write 1"]),
        ({"name": ""}, BAD, ["not a channel name", "''", "rename"]),
        ({"name": "a [Pa]"}, BAD, ["not a channel name", "brackets"]),
        ({"name": " a"}, BAD, ["not a channel name"]),
        ({"name": "a\nb"}, BAD, ["not a channel name"]),
        ({"name": 3}, BAD, ["not a channel name", "3"]),
        ({"name": "time"}, BAD, ["cannot be called 'time'", "rename"]),
        ({"hold": "second"}, BAD, ["channel 'omega': unknown hold", "second", "first, zero"]),
        ({"origin": "guessed"}, BAD, ["unknown origin", "guessed", "measured, assumed, derived"]),
        ({"values": [1.0]}, BAD, ["different number", "1 values, 4 times", "pair (time, values)"]),
        ({"values": [1.0], "time": [0.0]}, BAD, ["fewer than two samples", "seen: 1", "two or more"]),
        ({"values": [], "time": []}, BAD, ["fewer than two samples", "seen: 0"]),
        ({"time": [0, 1, 1, 2]}, BAD, ["does not increase at sample 2", "1.0 after 1.0", "sort"]),
        ({"time": [0, 2, 1, 3]}, BAD, ["does not increase at sample 2", "1.0 after 2.0"]),
        ({"time": [0, np.nan, 1, 2]}, BAD, ["time of channel 'omega' is not finite at sample 1", "nan"]),
        ({"time": [0, 1, 2, np.inf]}, BAD, ["not finite at sample 3", "inf"]),
        ({"values": [1, 2, np.inf, 4]}, BAD, ["'omega' is not finite at sample 2", "inf", "NaN"]),
        ({"values": np.ones((4, 1))}, BAD, ["not a list of real numbers", "(4, 1)", "ravel"]),
        ({"values": ["1", "2", "3", "4"]}, BAD, ["not a list of real numbers", "one-dimensional"]),
        ({"values": [1j, 2, 3, 4]}, BAD, ["not a list of real numbers", "complex"]),
        ({"values": [True, False, True, True]}, BAD, ["not a list of real numbers", "bool"]),
        ({"values": [[1], [2, 3]]}, BAD, ["not a list of real numbers"]),
        ({"values": None}, BAD, ["not a list of real numbers", "NoneType"]),
        ({"mask": [True, False]}, BAD, ["mask of channel 'omega' does not fit", "(2,)", "(4,)"]),
        ({"mask": [1, 0, 1, 1]}, BAD, ["mask of channel 'omega' does not fit", "bool"]),
        ({"recorded": "bar"}, UnitError, ["recorded in a unit of another dimension", "bar for rad/s"]),
        ({"rows": [1, 2]}, BAD, ["row numbers of channel 'omega' do not fit", "(2,)"]),
    ],
)  # fmt: skip
def test_refusals(refused, changes, error, pieces):
    refused(error, pieces, make, **changes)


def test_a_step_of_history_is_text_and_json():
    step = Step("resample", {"omega": 15}, 14400, 960)
    assert str(step) == "resample(omega=15): 14400 -> 960 samples"
    assert json.loads(json.dumps(step.to_dict())) == {
        "function": "resample",
        "arguments": {"omega": 15},
        "rows_in": 14400,
        "rows_out": 960,
    }


def test_it_knows_the_unit_in_which_it_was_recorded(refused):
    shown = Experiment.from_arrays(
        "a",
        time=[0.0, 1.0],
        units={"x": "deg", "y": "N m", "z": "-"},
        x=[0.0, 180.0],
        y=[1.0, 2.0],
        z=[1.0, 2.0],
    )
    assert [shown[name].recorded for name in "xyz"] == ["deg", "", ""]
    assert shown.in_units({"x": "deg"})["x"].recorded == "deg"

"""Experiments from arrays and data frames."""

import numpy as np
import pandas as pd
import pytest

from casadi_engine.errors import ExperimentError, UnitError
from casadi_engine.experiment import Experiment

T = np.arange(5) / 10
BAD = ExperimentError


def make(**changes):
    options = {"time": T, "units": {"omega": "rpm", "p1": "Pa"}, "omega": T, "p1": T + 1}
    return Experiment.from_arrays("r", **(options | changes))


def test_a_common_time_and_an_own_time():
    experiment = make(p1=([0.0, 0.2, 0.35], [1, np.nan, 3]), hold={"p1": "zero"}, origin="derived")
    assert experiment.names == ("omega", "p1")
    assert len(experiment["omega"]) == 5
    assert experiment["p1"].time.tolist() == [0.0, 0.2, 0.35]
    assert experiment["p1"].mask.tolist() == [True, False, True]
    assert (experiment["p1"].hold, experiment["omega"].hold) == ("zero", "first")
    assert experiment["omega"].origin == "derived"
    assert experiment["omega"].values[1] == pytest.approx(0.1 * np.pi / 30)
    assert (experiment.source, experiment.sha256, experiment.name) == (None, None, "r")
    assert experiment.history[0].to_dict() == {
        "function": "from_arrays",
        "arguments": {"channels": ["omega", "p1"]},
        "rows_in": 5,
        "rows_out": 5,
    }


def test_channels_on_the_common_time_share_it():
    experiment = make()
    assert experiment["omega"].time is experiment["p1"].time


def test_time_in_milliseconds():
    units = {"omega": "rpm", "time": "ms"}
    experiment = Experiment.from_arrays("r", time=T * 1000, units=units, omega=T)
    np.testing.assert_allclose(experiment["omega"].time, T)
    experiment = Experiment.from_arrays("r", units=units, omega=(T * 1000, T))
    np.testing.assert_allclose(experiment["omega"].time, T)


def test_the_users_arrays_are_left_alone():
    mine = T.copy()
    experiment = make(omega=mine, time=mine)
    mine[0] = 99
    assert experiment["omega"].time[0] == 0
    assert mine.flags.writeable


@pytest.mark.parametrize(
    ("changes", "error", "pieces"),
    [
        ({"units": {"omega": "rpm"}}, UnitError,
         ["no unit given for channel 'p1'", "units of omega", "{'p1': ...}"]),
        ({"units": {"omega": "rpm", "p1": "psig"}}, UnitError, ["channel 'p1': unknown unit", "psig"]),
        ({"units": {"omega": "rpm", "p1": "Pa", "q": "Pa"}}, BAD, ["units speaks of", "'q'", "omega, p1"]),
        ({"units": {"omega": "rpm", "p1": "Pa", "time": "Pa"}}, UnitError,
         ["the time has no unit of time", "s, ms"]),
        ({"hold": {"q": "zero"}}, BAD, ["hold speaks of a channel that is not there", "'q'"]),
        ({"origin": {"q": "zero"}}, BAD, ["origin speaks of", "'q'"]),
        ({"inputs": ["q"]}, BAD, ["inputs speaks of", "'q'"]),
        ({"time": None}, BAD, ["channel 'omega' has no time", "give time= or a pair"]),
        ({"time": T[:3]}, BAD, ["channel 'omega' has values and times", "5 values, 3 times"]),
        ({"time": "abc"}, BAD, ["the time is not a list of real numbers"]),
        ({"p1": (T, T, T)}, BAD, ["channel 'p1' is a tuple of 3", "a pair (time, values)"]),
        ({"p1": (T, T[:2])}, BAD, ["channel 'p1' has values and times"]),
        ({"p1": "text"}, BAD, ["channel 'p1' is not a list of real numbers", "str"]),
        ({"p1": [1, 2, np.nan, 4, 5], "inputs": "p1"}, BAD,
         ["input 'p1' is missing at sample 2", "0.2 s", "fill"]),
        ({"a b ": T}, BAD, ["not a channel name", "'a b '"]),
    ],
)  # fmt: skip
def test_refusals(refused, changes, error, pieces):
    refused(error, pieces, make, **changes)


def test_no_channel(refused):
    refused(BAD, ["no channel given", "omega=values"], Experiment.from_arrays, "r", time=T, units={})


def test_a_frame_with_headers():
    frame = pd.DataFrame({"time [ms]": T * 1000, "omega [rpm]": T, "p1 [bar]": [1, 2, None, 4, 5]})
    experiment = Experiment.from_dataframe(frame, name="f", inputs=["omega"], origin={"p1": "assumed"})
    assert experiment.names == ("omega", "p1")
    np.testing.assert_allclose(experiment["p1"].time, T)
    assert experiment["p1"].missing == 1
    assert experiment["p1"].origin == "assumed"
    assert experiment.inputs == ("omega",)
    assert experiment.history[0].function == "from_dataframe"


def test_a_frame_with_units_apart_and_the_time_as_index():
    frame = pd.DataFrame({"omega": np.arange(5), "p1 [Pa]": T}, index=pd.Index(T, name="time"))
    experiment = Experiment.from_dataframe(frame, name="f", units={"omega": "rpm"})
    assert experiment.names == ("omega", "p1")
    assert experiment["omega"].time.tolist() == T.tolist()


@pytest.mark.parametrize(
    ("columns", "units", "error", "pieces"),
    [
        ({"omega [rpm]": T}, None, BAD, ["no column for the time", "seen: omega [rpm]", "rename"]),
        ({"time [s]": T, "omega": T}, None, UnitError, ["no unit given for channel 'omega'"]),
        ({"time [s]": T, "omega [rpm]": T, "omega [Hz]": T}, None, BAD, ["column 'omega [Hz]' is repeated"]),
        ({"time [s]": T, "omega [rpm]": T}, {"omega": "Hz"}, UnitError, ["units= disagree", "Hz", "rpm"]),
        ({"time [s]": T, 3: T}, None, BAD, ["label is not text", "3"]),
        ({"time [s]": T, "omega [rpm]": list("abcde")}, None, BAD,
         ["channel 'omega' is not a list of real numbers"]),
        ({"time [s]": T[::-1], "omega [rpm]": T}, None, BAD, ["does not increase"]),
        ({"time [s]": T}, None, BAD, ["no channel given"]),
    ],
)  # fmt: skip
def test_faulty_frames(refused, columns, units, error, pieces):
    refused(error, pieces, Experiment.from_dataframe, pd.DataFrame(columns), name="f", units=units)


def test_a_frame_with_the_same_label_twice(refused):
    frame = pd.DataFrame(np.column_stack([T, T, T]), columns=["time [s]", "p [Pa]", "p [Pa]"])
    refused(
        BAD, ["column 'p [Pa]' is repeated", "rename or drop"], Experiment.from_dataframe, frame, name="f"
    )


@pytest.mark.parametrize("units", [None, "rad/s", ["rad/s"], {1: "rad/s"}])
def test_units_that_are_no_mapping(units):
    with pytest.raises(UnitError, match="units is not a mapping from channel to unit") as caught:
        make(units=units)
    assert 'units={"omega": "rad/s", "T": "N m"}' in str(caught.value)


@pytest.mark.parametrize("option", ["hold", "origin"])
@pytest.mark.parametrize("given", [None, 1, ["first"]])
def test_a_hold_or_origin_that_is_no_word(option, given):
    with pytest.raises(BAD, match=f"{option} is not acceptable"):
        make(**{option: given})


@pytest.mark.parametrize("frame", [None, "run.csv", {"time [s]": T}, pd.Series(T), np.zeros((5, 2))])
def test_what_is_no_data_frame(frame):
    with pytest.raises(BAD, match="this is not a data frame"):
        Experiment.from_dataframe(frame, name="r")


def test_units_of_a_frame_that_are_no_mapping():
    with pytest.raises(UnitError, match="units is not a mapping"):
        Experiment.from_dataframe(pd.DataFrame({"time": T, "omega": T}), name="r", units="rad/s")

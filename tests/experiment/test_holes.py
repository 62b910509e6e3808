"""Rows that are missing: where they are found, where not, and what can be said of them."""

import numpy as np
import pytest

from casadi_engine.errors import ExperimentError
from casadi_engine.experiment import Experiment, read_experiment
from casadi_engine.experiment.holes import holes_in

T = np.arange(2000) / 100


def without(*spans, time=T):
    keep = np.ones(len(time), bool)
    for first, last in spans:
        keep[first:last] = False
    return time[keep]


def record(time, **options):
    units = {"u": "N m", "y": "rad/s"}
    return Experiment.from_arrays("run", time=time, units=units, u=np.sin(time), y=np.cos(time), **options)


def run_up():
    """Times at which 60 teeth pass, 600 to 6000 rpm at an even rate in 2 s."""
    turns = np.arange(0, 110, 1 / 60)
    return (-10 + np.sqrt(100 + 2 * 45 * turns)) / 45


def run_down():
    """Times at which 1200 teeth pass until standstill, at an even rate: the last steps grow beyond all bounds."""
    return 10 - 10 * np.sqrt(np.arange(1200, -1, -1) / 1200)


@pytest.mark.parametrize("hold", ["first", "zero"])
def test_missing_rows_are_holes_and_the_step_before_names_them(hold):
    assert holes_in(without((300, 800)), hold).tolist() == [299]
    assert holes_in(without((300, 305)), hold).tolist() == [299]
    assert holes_in(without((2, 30)), hold).tolist() == [1]
    assert holes_in(without((1970, 1999)), hold).tolist() == [1969]
    near = without((300, 350), (353, 400), (404, 500))
    assert holes_in(near, "first").tolist() == [299, 302, 306]


def test_holes_in_jittered_times_and_in_tooth_events():
    jittered = T + 0.004 * np.random.default_rng(0).uniform(-1, 1, T.size)
    assert holes_in(without((300, 400), time=jittered), "first").tolist() == [299]
    for events in (run_up(), run_down()[:-40]):
        at = np.searchsorted(events, np.median(events))
        gone = without((at, at + 60), time=events)
        assert holes_in(gone, "first").tolist() == [at - 1]


@pytest.mark.parametrize(
    "time",
    [
        T,
        T + 0.004 * np.random.default_rng(1).uniform(-1, 1, T.size),
        run_up(),
        run_down(),
        np.array([0, 1, 1.1, 50, 100.0]),  # a profile of a few points
        np.geomspace(1e-3, 1e3, 200),
        np.arange(6000)[np.arange(6000) % 60 < 58] * 1e-3,  # a wheel of 60 teeth without two
        without((300, 304)),  # four rows are as long as five steps: the limit that is stated
    ],
)
def test_what_is_no_hole(time):
    assert not holes_in(time, "first").size


def test_samples_that_hold_may_come_whenever_they_like():
    events = np.cumsum(np.random.default_rng(3).lognormal(size=5000))
    assert holes_in(events, "first").size
    assert not holes_in(events, "zero").size


def test_a_hole_in_an_input_is_refused_with_its_place(refused):
    experiment = record(without((300, 800), (1000, 1200)))
    pieces = [
        "experiment 'run', column 'u', after sample 299: rows are missing",
        "nothing from 2.99 to 8 s, 5.01 s where 0.01 s is usual; 2 holes in all",
        "split_at_holes()",
        'bridged(u="join")',
        'bridged(u="hold")',
    ]
    refused(ExperimentError, pieces, experiment.require, inputs=["u"], outputs=["y"])
    experiment.require(inputs=[], outputs=["y"])  # outputs may have holes


def test_a_hole_of_a_file_is_named_by_its_row(tmp_path, refused):
    path = tmp_path / "run.csv"
    record(without((300, 800))).to_csv(path)
    read = read_experiment(path)
    refused(
        ExperimentError, [f"{path}, column 'u', after row 301: rows are missing"], read.require, inputs=["u"]
    )


def test_a_hole_is_bridged_when_told(refused):
    experiment = record(without((300, 800)))
    joined = experiment.bridged(u="join")
    joined.require(inputs=["u"], outputs=["y"])
    assert joined["u"].values is experiment["u"].values
    assert str(joined.history[-1]) == "bridged(u='join'): 1500 -> 1500 samples"
    held = experiment.bridged(u="hold")
    held.require(inputs=["u"], outputs=["y"])
    between = np.interp([3.0, 5.0, 7.98, 8.0], held["u"].time, held["u"].values)
    assert between == pytest.approx([np.sin(2.99), np.sin(2.99), np.sin(2.99), np.sin(8.0)], rel=1e-12)
    held.between(1.0, 15.0).require(inputs=["u"])
    zero = experiment.with_hold(u="zero")
    refused(ExperimentError, ["rows are missing"], zero.require, inputs=["u"])
    zero.bridged(u="hold").require(inputs=["u"])
    refused(ExperimentError, ["holds its samples", "with_hold(u="], zero.bridged, u="join")
    refused(
        ExperimentError,
        ["to do in its holes is not known", "'line'", "hold, join"],
        experiment.bridged,
        u="line",
    )
    refused(ExperimentError, ["bridged was given no channel"], experiment.bridged)
    refused(ExperimentError, ["no channel 'v'"], experiment.bridged, v="join")


def test_a_record_is_split_at_the_holes_of_its_inputs():
    time = without((300, 800), (1000, 1200))
    pieces = record(time, inputs=("u",)).split_at_holes()
    assert [piece.name for piece in pieces] == ["run/1", "run/2", "run/3"]
    assert [piece.span for piece in pieces] == [(0.0, 2.99), (8.0, 9.99), (12.0, 19.99)]
    assert sum(len(piece["y"]) for piece in pieces) == len(time)
    assert pieces[1].inputs == ("u",)
    assert pieces[1].history[-1].arguments == {"start": 8.0, "stop": 9.99}
    for piece in pieces:
        piece.require(inputs=["u"], outputs=["y"])
    whole = record(T)
    assert whole.split_at_holes() == (whole,)


def test_the_channels_holes_are_joined_and_short_pieces_left_out(refused):
    units = {"u": "1", "v": "1", "y": "1"}
    make = Experiment.from_arrays
    own = {"u": without((300, 800)), "v": without((500, 900)), "y": T}
    experiment = make("r", units=units, inputs=("u", "v"), **{name: (t, t) for name, t in own.items()})
    assert [piece.span for piece in experiment.split_at_holes()] == [(0.0, 2.99), (9.0, 19.99)]
    seldom = experiment.only("u").with_channel(make("s", units={"y": "1"}, y=([0.0, 19.0], [1, 2]))["y"])
    refused(ExperimentError, ["no piece between the holes", "without(...)"], seldom.split_at_holes)


def test_conditioning_does_not_run_across_a_hole(refused):
    experiment = record(without((300, 800)))
    low_pass = {"cutoff_hz": 5.0, "channels": "y"}
    refused(
        ExperimentError,
        ["column 'y', after sample 299", "low-pass", "split_at"],
        experiment.low_pass,
        **low_pass,
    )
    line = Experiment.from_arrays("run", time=without((300, 800)), units={"y": "1"}, y=without((300, 800)))
    assert line.moving_average(y=51)["y"].values == pytest.approx(line["y"].values, abs=1e-12)
    refused(ExperimentError, ["the hole would not be seen any more", "with_inputs"],
            record(without((300, 320))).resample, u=15)  # fmt: skip
    assert len(record(without((300, 320)), inputs=("u",)).resample(y=15)["y"]) == 132


def test_a_pressure_is_not_shifted_across_a_hole(refused):
    time = without((300, 800))
    units = {"theta": "rad", "p1": "Pa"}
    experiment = Experiment.from_arrays("run", time=time, units=units, theta=10 * time, p1=np.cos(5 * time))
    pieces = ["column 'p1', after sample 299", "shifted pressure", "split_at_holes()"]
    refused(ExperimentError, pieces, experiment.shift_pressures, {"p3": "p1"})
    own = experiment.with_channel(
        Experiment.from_arrays("r", time=T, units={"p1": "Pa"}, p1=np.cos(5 * T))["p1"]
    )
    refused(
        ExperimentError,
        ["column 'theta', after sample 299"],
        own.between(0, 19.9).shift_pressures,
        {"p3": "p1"},
    )


def test_a_value_held_over_a_hole_ends_a_local_step_before_the_next_sample():
    # among short steps a hole of 11 ms, far below the median step of 1 s
    time = np.concatenate([np.arange(50) * 1e-3, 0.06 + np.arange(50) * 1e-3, 1.0 + np.arange(2000)])
    assert holes_in(time, "first").tolist() == [49]
    experiment = record(time)
    held = experiment.bridged(u="hold")
    held.require(inputs=["u"])
    assert np.setdiff1d(held["u"].time, time) == pytest.approx([0.059])


def test_channels_that_share_their_times_are_each_judged_by_their_own_hold():
    """Rows missing where steps grow by a tenth: a hole between samples of a line, none of a stair's."""
    time = np.cumsum(np.r_[np.tile([0.01, 0.012], 100), 0.2, np.tile([0.01, 0.012], 100)])
    assert len(holes_in(time, "first")) == 1
    assert not len(holes_in(time, "zero"))
    units = {"stair": "1", "line": "1", "y": "1"}
    shared = Experiment.from_arrays(
        "run", time=time, units=units, hold={"stair": "zero"}, stair=time, line=time, y=time
    )
    shared.require(inputs=("stair",), outputs=("y",))
    with pytest.raises(ExperimentError, match="column 'line', after sample 199: rows are missing"):
        shared.require(inputs=("stair", "line"), outputs=("y",))

"""The time grid of a record: rates, holds, spans, rounded times and the errors."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.errors import DataFileError, ExperimentError, SimulationError, UnitError
from casadi_engine.experiment import Channel, Experiment
from casadi_engine.model import Blueprint
from casadi_engine.simulation.drives import Drives
from casadi_engine.simulation.grid import lay_grid


@pytest.fixture(scope="module")
def model():
    """Two inputs, two outputs."""
    b = Blueprint("lag")
    x = b.state("x")
    a, c = b.input("a"), b.input("c")
    b.ode("x", a + c - x)
    b.output("y", x, unit="1")
    b.output("w", 2 * x)
    return b.model()


def ramp(rate, count, start=0.0):
    """Times, and 3 t + 1."""
    time = start + np.arange(count) / rate
    return time, 3 * time + 1


def record(**channels):
    made = [
        Channel(name, "1", time=part[0], values=part[1], hold=part[2] if len(part) > 2 else "first")
        for name, part in channels.items()
    ]
    return Experiment("run", tuple(made))


# ---- rates


def test_the_fastest_input_sets_the_grid_and_slower_ones_are_interpolated(model):
    grid = lay_grid(model, record(a=ramp(100, 101), c=ramp(25, 26), y=ramp(50, 51), w=ramp(100, 101)))
    assert grid.samples == 101
    assert grid.step == pytest.approx(0.01, rel=1e-14)
    np.testing.assert_allclose(grid.channels[1], 3 * grid.time + 1, rtol=1e-13)
    np.testing.assert_array_equal(grid.measured["y"].position, 2 * np.arange(51))


def test_channels_that_share_an_array_of_times_have_the_grid_of_those_that_do_not(model):
    time = np.arange(60) / 50
    slow, values = time[::3].copy(), np.random.default_rng(1).normal(size=60)
    once, again = (
        lay_grid(
            model,
            record(a=(time, values), c=(times, values[::3]), y=(slow, values[::3]), w=(times, values[::3])),
        )
        for times in (slow, slow.copy())
    )
    np.testing.assert_array_equal(once.channels[0], values[:58])
    np.testing.assert_allclose(once.channels[1], np.interp(once.time, slow, values[::3]), rtol=1e-13)
    for one, other in ((once.channels, again.channels), (once.time, again.time)):
        np.testing.assert_array_equal(one, other)


def test_a_channel_on_the_grid_is_taken_as_it_is(model):
    rng = np.random.default_rng(0)
    time, values = np.arange(50) / 14402, rng.normal(size=50)
    grid = lay_grid(model, record(a=(time, values), c=(time, values), y=(time, values), w=(time, values)))
    np.testing.assert_array_equal(grid.channels, [values, values])


@pytest.mark.parametrize(("rate", "parts"), [(40, 4), (2, 1), (30, 3)])
def test_an_output_faster_than_the_inputs_refines_the_grid(model, rate, parts):
    count = int(2 * rate) + 1
    grid = lay_grid(model, record(a=ramp(10, 21), c=ramp(5, 11), y=ramp(rate, count), w=ramp(2, 5)))
    assert grid.uniform
    assert grid.step == pytest.approx(0.1 / parts, rel=1e-12)
    # The corners of the interpolated inputs stay on the grid.
    np.testing.assert_allclose((0.1 / grid.step) % 1, 0, atol=1e-9)


@pytest.mark.parametrize("rate", [35, 10.4, 11.5])
def test_an_output_between_the_inputs_samples_adds_its_own_times(model, rate):
    count = int(2 * rate) + 1
    y = ramp(rate, count)
    grid = lay_grid(model, record(a=ramp(10, 21), c=ramp(5, 11), y=y, w=ramp(2, 5)))
    assert not grid.uniform
    measured = grid.measured["y"]
    np.testing.assert_allclose(grid.time[measured.position], y[0], rtol=1e-12)
    assert grid.samples <= 21 + count
    np.testing.assert_allclose(grid.channels[0], 3 * grid.time + 1, rtol=1e-12)


def test_an_output_that_is_on_the_refined_grid_needs_no_interpolation(model):
    grid = lay_grid(model, record(a=ramp(10, 21), c=ramp(5, 11), y=ramp(30, 61), w=ramp(10, 21)))
    np.testing.assert_array_equal(grid.measured["w"].position, 3 * np.arange(21))


def test_missing_samples_of_an_output_do_not_coarsen_the_grid(model):
    time, values = ramp(40, 81)
    values = np.where(np.arange(81) % 3 == 1, np.nan, values)
    grid = lay_grid(model, record(a=ramp(10, 21), c=ramp(10, 21), y=(time, values), w=ramp(10, 21)))
    assert grid.step == pytest.approx(0.025)
    assert len(grid.measured["y"].values) == 54
    np.testing.assert_array_equal(grid.measured["y"].index, np.flatnonzero(np.arange(81) % 3 != 1))
    assert np.isfinite(grid.measured["y"].values).all()


# ---- holds


def test_a_zero_hold_keeps_the_last_sample(model):
    slow = (np.array([0.0, 0.04, 0.1]), np.array([1.0, 2.0, 3.0]), "zero")
    grid = lay_grid(model, record(a=ramp(100, 11), c=slow, y=ramp(100, 11), w=ramp(100, 11)))
    np.testing.assert_array_equal(grid.channels[1], [1, 1, 1, 1, 2, 2, 2, 2, 2, 2, 3])
    assert grid.holds == ("first", "zero")


def test_a_zero_hold_switches_at_its_sample_in_spite_of_rounding(model):
    # 0.03 + 1e-9 counts as 0.03: the value holds from there on.
    slow = (np.array([0.0, 0.03 + 1e-9, 0.1]), np.array([1.0, 2.0, 3.0]), "zero")
    grid = lay_grid(model, record(a=ramp(100, 11), c=slow, y=ramp(100, 11), w=ramp(100, 11)))
    np.testing.assert_array_equal(grid.channels[1], [1, 1, 1, 2, 2, 2, 2, 2, 2, 2, 3])


def test_a_drive_of_any_held_channel_is_held(made):
    b = Blueprint("mixed")
    x, u, v = b.state("x"), b.input("u"), b.input("v")
    b.ode("x", b.drive("both", u * v) + b.drive("ramp", v + b.time) + b.drive("held", ca.sin(u)))
    b.output("y", x)
    grid = made.grid(np.ones((2, 5)), holds=("zero", "first"))
    drives = Drives(b.model(), grid, ca.SX(0, 1), ca.SX(0, 1))
    assert drives.holds == ("zero", "first", "zero")


def test_drives_come_with_their_derivatives(made):
    b = Blueprint("driven")
    p, q = b.parameter("p", 1.0), b.parameter("q", 1.0)
    x, u = b.state("x"), b.input("u")
    b.ode("x", q * x + b.drive("d", u * p**3 + b.time) + b.drive("e", 2 * u))
    b.output("y", x)
    rng = np.random.default_rng(1)
    grid = made.grid(rng.normal(size=(1, 7)))
    z = ca.SX.sym("z", 3)
    drives = Drives(b.model(), grid, z, ca.vertcat(z[2] * z[0], z[1]))
    found = drives.at(np.array([2.0, 5.0, 0.5]))
    u = grid.channels[0]
    np.testing.assert_allclose(found.value, [u + grid.time, 2 * u])
    np.testing.assert_array_equal(found.active, [0, 2])
    # d = u (z2 z0)^3 + t at z0 = 2, z2 = 1/2
    np.testing.assert_allclose(found.first[:, 0], [1.5 * u, 6 * u])
    np.testing.assert_allclose(found.second[:, 0], [1.5 * u, 9 * u, 24 * u])
    assert not found.first[:, 1].any()
    assert not found.second[:, 1].any()


# ---- spans


def test_inputs_longer_than_the_outputs_are_cut_to_them(model):
    channels = record(
        a=ramp(100, 301, -1.0), c=ramp(100, 401, -2.0), y=ramp(100, 51, 0.25), w=ramp(50, 11, 0.5)
    )
    grid = lay_grid(model, channels)
    assert grid.start == pytest.approx(0.25)
    assert grid.samples == 51
    np.testing.assert_allclose(grid.channels[0], 3 * grid.time + 1, rtol=1e-12)
    np.testing.assert_array_equal(grid.measured["w"].position, 25 + 2 * np.arange(11))


def test_outputs_between_grid_points_keep_their_times(model):
    time = 0.123 + np.cumsum(np.random.default_rng(2).uniform(0.005, 0.04, 30))
    grid = lay_grid(model, record(a=ramp(100, 201), c=ramp(100, 201), y=(time, time), w=(time, -time)))
    assert grid.time[0] == time[0]
    assert grid.time[-1] == time[-1]
    np.testing.assert_array_equal(grid.time[grid.measured["y"].position], time)
    # the corners of the inputs are points too
    inside = np.arange(201) / 100
    inside = inside[(inside > time[0]) & (inside < time[-1])]
    assert np.abs(grid.time[:, None] - inside).min(axis=0).max() < 1e-12


def test_the_grid_grows_with_the_samples_and_not_with_the_time_between_them():
    b = Blueprint("alone")
    x = b.state("x")
    b.ode("x", -x)
    b.output("y", x)
    bursts = np.concatenate([3600 * k + np.arange(1000) / 1000 for k in range(3)])
    grid = lay_grid(b.model(), record(y=(bursts, np.cos(bursts))))
    np.testing.assert_array_equal(grid.time, bursts)


def test_a_stair_between_the_samples_steps_where_it_was_sampled(model):
    stair = (np.array([0.0, 0.333, 1.0]), np.array([1.0, 5.0, 5.0]), "zero")
    grid = lay_grid(model, record(a=ramp(10, 11), c=stair, y=ramp(10, 11), w=ramp(10, 11)))
    assert 0.333 in grid.time
    np.testing.assert_array_equal(grid.channels[1], np.where(grid.time < 0.333, 1.0, 5.0))


def test_without_outputs_the_common_span_of_the_inputs_is_simulated(model):
    grid = lay_grid(model, record(a=ramp(10, 31), c=ramp(10, 21, 0.5)), outputs=())
    assert grid.start == pytest.approx(0.5)
    assert grid.time[-1] == pytest.approx(2.5)
    assert grid.measured == {}


def test_inputs_on_an_uneven_time_are_taken_where_they_were_sampled(model):
    time = np.cumsum(np.random.default_rng(3).uniform(0.008, 0.012, 200))
    grid = lay_grid(model, record(a=(time, 3 * time + 1), c=(time, time), y=(time, time), w=(time, time)))
    np.testing.assert_array_equal(grid.time, time)
    assert grid.step == pytest.approx(np.median(np.diff(time)))
    np.testing.assert_array_equal(grid.channels[0], 3 * time + 1)


# ---- rounded times


@pytest.mark.parametrize("decimals", [6, 7, 9, 12])
def test_times_rounded_in_a_file_count_as_uniform(model, decimals):
    exact = np.arange(3000) / 14402
    time = np.round(exact, decimals)
    values = np.sin(exact)
    slow = (time[::15], values[::15])
    grid = lay_grid(model, record(a=(time, values), c=(time, values), y=(time, values), w=slow))
    assert grid.samples == 3000
    assert grid.step == pytest.approx(1 / 14402, rel=1e-5)
    np.testing.assert_array_equal(grid.channels[0], values)
    np.testing.assert_array_equal(grid.measured["w"].position, 15 * np.arange(200))


def test_two_samples_at_one_grid_point_are_not_merged(model):
    time = np.array([0.0, 0.1, 0.10005, 0.2])
    grid = lay_grid(model, record(a=ramp(10, 4), c=ramp(10, 4), y=(time, time), w=ramp(10, 3)))
    assert len(np.unique(grid.measured["y"].position)) == 4
    assert 0.10005 in grid.time


# ---- errors


def test_a_missing_channel_is_named(model):
    with pytest.raises(
        ExperimentError, match=r"input channel 'c' is missing; seen: a, y, w; .*a channel 'c'"
    ):
        lay_grid(model, record(a=ramp(10, 21), y=ramp(10, 21), w=ramp(10, 21)))


def test_a_gap_in_an_input_is_named(model):
    time, values = ramp(10, 21)
    values[4] = np.nan
    with pytest.raises(
        ExperimentError, match=r"'a', sample 4: a missing sample in an input; seen: 1 missing"
    ) as info:
        lay_grid(model, record(a=(time, values), c=ramp(10, 21), y=ramp(10, 21), w=ramp(10, 21)))
    assert not isinstance(info.value, DataFileError)
    assert "do: fill the gap" in str(info.value)


def test_inputs_that_do_not_cover_the_outputs_are_an_error(model):
    with pytest.raises(
        ExperimentError, match=r"input 'a' does not cover output 'y' in time; seen: input from 0 to 1 s"
    ):
        lay_grid(model, record(a=ramp(10, 11), c=ramp(10, 21), y=ramp(10, 21), w=ramp(10, 11)))


def test_a_wrong_unit_is_an_error(model):
    channels = record(a=ramp(10, 21), c=ramp(10, 21), w=ramp(10, 21))
    time, values = ramp(10, 21)
    with pytest.raises(
        UnitError,
        match=r"column 'y': the unit is of another dimension than the model declares; seen: rad/s in the data "
        r"\(dimension s-1 rad\); allowed: 1 \(dimension 1\),",
    ):
        lay_grid(model, channels.with_channel(Channel("y", "rad/s", time=time, values=values)))


def test_inputs_that_do_not_overlap_are_an_error(model):
    channels = record(a=ramp(10, 11), c=ramp(10, 11, 5.0))
    with pytest.raises(SimulationError) as info:
        lay_grid(model, channels, outputs=())
    assert str(info.value) == (
        "the inputs do not overlap in time; seen: experiment 'run': a from 0 to 1 s, c from 5 to 6 s; "
        "allowed: a span of time that all inputs cover; do: take records of the same run, "
        "or correct the times"
    )


def test_one_sample_is_too_short(model):
    lone = (np.array([0.0, 0.1]), np.array([1.0, np.nan]))
    with pytest.raises(SimulationError) as info:
        lay_grid(model, record(a=ramp(10, 21), c=ramp(10, 21), y=lone, w=lone))
    assert str(info.value) == (
        "the record is too short: there are fewer than two points of its time grid; seen: experiment 'run': "
        "1 in 0 s, step 0.1 s; allowed: two or more; do: take a longer record"
    )


def test_nothing_to_take_times_from_is_an_error():
    b = Blueprint("free")
    x = b.state("x")
    b.ode("x", -x)
    b.output("y", x)
    with pytest.raises(
        SimulationError,
        match=r"there is no time grid; seen: experiment 'run': other; allowed: a record with y",
    ):
        lay_grid(b.model(), record(other=ramp(10, 3)), outputs=())


@pytest.mark.parametrize("column", ["a", "y"])
def test_a_value_whose_square_is_no_number(model, column):
    time = np.arange(5.0)
    values = {name: np.ones(5) for name in ("a", "c", "y", "w")}
    values[column] = np.array([1, 1, -1e160, 1, 1])
    experiment = Experiment.from_arrays("big", time=time, units=dict.fromkeys(values, "1"), **values)
    with pytest.raises(ExperimentError, match=f"column '{column}': a value is too large") as caught:
        lay_grid(model, experiment)
    assert "seen: -1e+160 1 at 2 s" in str(caught.value)
    assert lay_grid(model, experiment.masked("y", np.arange(5) != 2)).samples == 5 if column == "y" else True


@pytest.mark.parametrize("decades", [3, 9])
def test_times_spaced_by_their_logarithm_keep_every_sample(made, decades):
    """A point at every time that was asked for, however far apart: the first ones are not merged into one."""
    model = made.linear(np.random.default_rng(0), states=1, inputs=0, outputs=1)
    time = np.concatenate([[0.0], np.logspace(-6, decades - 6, 4 * decades + 1)])
    grid = lay_grid(model, made.experiment(model, time, y0=np.zeros(len(time))))
    np.testing.assert_array_equal(grid.time, time)
    np.testing.assert_array_equal(grid.measured["y0"].position, np.arange(len(time)))
    assert grid.span == time[-1]


def test_times_that_agree_up_to_rounding_are_one(model):
    """Two channels of one logger whose times were calculated in two ways."""
    rng = np.random.default_rng(2)
    time = np.cumsum(rng.uniform(0.01, 1.0, 60))
    other = (time * 1e3 + 1e-9 * rng.normal(size=60)) / 1e3
    zeros = np.zeros(60)
    grid = lay_grid(model, record(a=(time, zeros), c=(other, zeros), y=(time, zeros), w=(other, zeros)))
    assert grid.samples == 60
    for name in ("y", "w"):
        np.testing.assert_array_equal(grid.measured[name].position, np.arange(60))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.integers(2, 30), st.integers(2, 30), st.sampled_from([1e-9, 1.0, 1e7]))
def test_any_times_of_channels_are_points_of_the_grid(made, seed, inputs, outputs, unit):
    """Every output keeps its samples, each at a point of its own at its time; every input its corners."""
    rng = np.random.default_rng(seed)
    model = made.linear(rng, states=1, inputs=1, outputs=1)
    at_output = unit * np.cumsum(rng.uniform(0.1, 3.0, outputs))
    inner = rng.uniform(at_output[0], at_output[-1], inputs - 2)
    at_input = np.unique(np.concatenate([[at_output[0]], inner, [at_output[-1]]]))
    values = rng.normal(size=len(at_input))
    experiment = made.experiment(model, at_output, u0=(at_input, values), y0=rng.normal(size=outputs))
    experiment = experiment.bridged(u0="join")  # random times leave holes
    grid = lay_grid(model, experiment)
    measured = grid.measured["y0"]
    assert (np.diff(grid.time) > 0).all()
    assert (np.diff(measured.position) > 0).all()
    assert len(measured.position) == outputs
    slack = 1e-2 * grid.step if grid.uniform else 1e-6 * unit
    np.testing.assert_allclose(grid.time[measured.position], at_output, rtol=0, atol=slack)
    wanted = np.interp(grid.time, at_input, values)
    np.testing.assert_allclose(grid.channels[0], wanted, atol=1e-5 if not grid.uniform else 1e-12)
    if not grid.uniform:
        assert grid.samples <= inputs + outputs

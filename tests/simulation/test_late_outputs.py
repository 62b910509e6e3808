"""Late outputs: what their sensors show of a simulation, and where their samples are on the grid of a record."""

import numpy as np
import pytest

from casadi_engine.effects import SensorDelay
from casadi_engine.errors import SimulationError
from casadi_engine.experiment import Channel, Experiment
from casadi_engine.model import Blueprint
from casadi_engine.model.lags import lagged
from casadi_engine.simulation.grid import Grid, lay_grid
from casadi_engine.simulation.late_outputs import as_shown

STEP = 0.1


def model_of(*, inputs=1, **lags):
    """y and z, of which those with a lag are late."""
    b = Blueprint("lag")
    x = b.state("x")
    b.ode("x", -x + (b.input("a") if inputs else 0))
    b.output("y", x, unit="1")
    b.output("z", 2 * x, unit="1")
    model = b.model()
    for name in lags:
        model = model.with_effect(SensorDelay(), at=f"sensor_{name}")
    return lagged(model, lags)


def grid_of(samples=40, time=None):
    return Grid(0.5, STEP, samples, [], (), {}, time)


def shown(rows, lag, grid=None):
    """What a sensor of y shows of these values (N,)."""
    rows = np.asarray(rows, dtype=float)
    grid = grid_of(len(rows)) if grid is None else grid
    return as_shown(model_of(y=lag), grid, np.array([rows, -rows]))[0]


# ---- what is shown of a simulation


def test_sensors_that_are_not_late_show_what_is_there():
    outputs = np.random.default_rng(0).normal(size=(2, 40))
    assert as_shown(model_of(), grid_of(), outputs) is outputs


@pytest.mark.parametrize("steps", [1, 7, 39, -1, -7])
def test_whole_steps_are_the_samples_themselves(steps):
    rows = np.random.default_rng(0).normal(size=40)
    found = shown(rows, steps * STEP)
    if steps > 0:
        np.testing.assert_array_equal(found[steps:], rows[: 40 - steps])
    else:
        np.testing.assert_array_equal(found[:steps], rows[-steps:])


def test_each_output_has_a_lag_of_its_own_in_every_run():
    """Of outputs (runs, ny, N), which are not changed themselves."""
    outputs = np.random.default_rng(0).normal(size=(3, 2, 40))
    before = outputs.copy()
    found = as_shown(model_of(y=2 * STEP, z=-3 * STEP), grid_of(), outputs)
    np.testing.assert_array_equal(found[:, 0, 2:], outputs[:, 0, :-2])
    np.testing.assert_array_equal(found[:, 1, :-3], outputs[:, 1, 3:])
    alone = as_shown(model_of(z=-3 * STEP), grid_of(), outputs)
    np.testing.assert_array_equal(alone[:, 0], outputs[:, 0])
    np.testing.assert_array_equal(alone[:, 1], found[:, 1])
    np.testing.assert_array_equal(outputs, before)


@pytest.mark.parametrize("lag", [0.25, 0.013, -0.37])
def test_a_part_of_a_step_is_read_off_a_cubic(lag):
    """Exactly of a cubic; of a sine to the fourth order."""
    grid = grid_of()
    inside = (grid.time - lag >= grid.time[0]) & (grid.time - lag <= grid.time[-1])
    for curve in (lambda t: 1 - t + 0.3 * t**2 - 0.1 * t**3, np.polynomial.Polynomial([2.0, 1.0])):
        np.testing.assert_allclose(
            shown(curve(grid.time), lag)[inside], curve(grid.time - lag)[inside], rtol=1e-12
        )
    wave = shown(np.sin(3 * grid.time), lag)
    error = np.abs(wave - np.sin(3 * (grid.time - lag)))
    assert error[inside].max() < 2 * (3 * STEP) ** 4 / 24
    assert np.median(error[inside]) < 5 / 384 * (3 * STEP) ** 4


def test_times_that_are_not_equally_spaced_are_read_off_a_cubic_too():
    time = 0.5 + np.cumsum(np.random.default_rng(1).uniform(0.05, 0.15, 40))
    grid = grid_of(40, time)
    assert not grid.uniform
    curve = np.polynomial.Polynomial([1.0, -2.0, 0.5, 0.1])
    found = shown(curve(time), 2 * STEP, grid)
    inside = time - 2 * STEP >= time[0]
    np.testing.assert_allclose(found[inside], curve(time - 2 * STEP)[inside], rtol=1e-11)


@pytest.mark.parametrize("lag", [5 * STEP, 5.4 * STEP])
def test_what_was_before_goes_on_as_the_first_samples_do(lag):
    """By a parabola: exactly where that is what happens, with no more than three samples looked at."""
    grid = grid_of()
    curve = np.polynomial.Polynomial([3.0, -2.0, 0.5])(grid.time - 0.5)
    rows = np.where(np.arange(40) < 3, curve, np.sin(grid.time) * 10)
    before = grid.time - lag < grid.time[0] - 1e-9
    assert before.sum() == np.ceil(lag / STEP - 1e-9)
    wanted = np.polynomial.Polynomial([3.0, -2.0, 0.5])(grid.time - lag - 0.5)
    np.testing.assert_allclose(shown(rows, lag)[before], wanted[before], rtol=1e-12)


@pytest.mark.parametrize("lag", [5 * STEP, 5.4 * STEP])
def test_what_comes_after_goes_on_as_the_last_samples_do(lag):
    grid = grid_of()
    end = np.polynomial.Polynomial([3.0, -2.0, 0.5])
    rows = np.where(np.arange(40) > 36, end(grid.time - grid.time[-1]), np.sin(grid.time) * 10)
    after = grid.time + lag > grid.time[-1] + 1e-9
    wanted = end(grid.time + lag - grid.time[-1])
    np.testing.assert_allclose(shown(rows, -lag)[after], wanted[after], rtol=1e-12)


@pytest.mark.parametrize("lag", [20 * STEP, -20 * STEP, 33.3 * STEP, -33.3 * STEP, 500.0])
def test_what_is_beyond_the_record_stays_within_what_is_shown(lag):
    """A parabola runs away otherwise."""
    rows = np.exp(-np.arange(40.0) / 3)[:: 1 if lag > 0 else -1]
    found = shown(rows, lag)
    assert found.max() == rows.max()
    assert found.min() >= rows.min()


def test_of_two_samples_the_nearest_one_is_shown_beyond():
    np.testing.assert_array_equal(shown([1.0, 3.0], STEP), [1.0, 1.0])
    np.testing.assert_array_equal(shown([1.0, 3.0], -STEP), [3.0, 3.0])


# ---- where the samples of late sensors are on a grid


def sampled(rate, count, start=0.0):
    time = start + np.arange(count) / rate
    return time, np.sin(5 * time)


def record(**channels):
    made = [Channel(name, "1", time=time, values=values) for name, (time, values) in channels.items()]
    return Experiment("run", tuple(made))


def test_a_late_output_is_read_earlier():
    """At a rate of 10: three of 31 samples show what was before; the grid ends with what is shown last."""
    data = record(a=sampled(10, 31), y=sampled(10, 31), z=sampled(10, 31))
    grid = lay_grid(model_of(y=0.3), data, outputs=("y",))
    own = grid.measured["y"]
    assert grid.uniform
    assert (grid.start, grid.samples) == (pytest.approx(0.0, abs=1e-12), 28)
    np.testing.assert_array_equal(own.index, np.arange(3, 31))
    np.testing.assert_array_equal(own.position, np.arange(28))
    np.testing.assert_array_equal(own.beyond, [0, 1, 2])
    np.testing.assert_array_equal(own.values, data["y"].values[3:])
    np.testing.assert_allclose(own.time, grid.time[own.position], atol=1e-12)
    np.testing.assert_allclose(grid.channels[0], np.sin(5 * grid.time), atol=1e-12)


def test_an_early_output_is_read_later():
    """Its last samples show what comes after the record, and none its first instants."""
    data = record(a=sampled(10, 31), y=sampled(10, 31), z=sampled(10, 31))
    grid = lay_grid(model_of(y=-0.3), data, outputs=("y",))
    own = grid.measured["y"]
    assert (grid.start, grid.samples) == (pytest.approx(0.0, abs=1e-12), 31)
    np.testing.assert_array_equal(own.index, np.arange(28))
    np.testing.assert_array_equal(own.position, np.arange(3, 31))
    np.testing.assert_array_equal(own.beyond, [28, 29, 30])


def test_of_two_outputs_one_is_late():
    """The other keeps its samples, and the record its length."""
    data = record(a=sampled(10, 31), y=sampled(10, 31), z=sampled(10, 31))
    grid = lay_grid(model_of(y=0.4), data)
    assert grid.samples == 31
    np.testing.assert_array_equal(grid.measured["z"].position, np.arange(31))
    assert grid.measured["z"].beyond.size == 0
    np.testing.assert_array_equal(grid.measured["y"].index, np.arange(4, 31))
    np.testing.assert_array_equal(grid.measured["y"].position, np.arange(27))
    both = lay_grid(model_of(y=0.4, z=-0.2), data)
    np.testing.assert_array_equal(both.measured["y"].position, np.arange(27))
    np.testing.assert_array_equal(both.measured["z"].position, np.arange(2, 31))
    np.testing.assert_array_equal(both.measured["z"].beyond, [29, 30])


def test_a_late_sensor_of_another_rate():
    """Samples of 4 Hz on a grid of 20 Hz, late by whole samples, and by whole steps of the grid alone."""
    data = record(a=sampled(20, 81), y=sampled(4, 17), z=sampled(20, 81))
    for lag, first in ((0.5, 2), (0.35, 2)):
        grid = lay_grid(model_of(y=lag), data)
        own = grid.measured["y"]
        assert grid.uniform
        assert grid.step == pytest.approx(0.05)
        np.testing.assert_array_equal(own.index, np.arange(first, 17))
        np.testing.assert_allclose(grid.time[own.position], data["y"].time[first:] - lag, atol=1e-9)
        np.testing.assert_array_equal(own.beyond, np.arange(first))
        np.testing.assert_array_equal(grid.measured["z"].position, np.arange(81))


@pytest.mark.parametrize("inputs", [0, 1])
def test_a_lag_between_the_points_of_the_grid_has_points_of_its_own(inputs):
    """Of records of several rates, of which the slowest gives the lag."""
    channels = {"y": sampled(10, 31), "z": sampled(10, 31)} | ({"a": sampled(10, 31)} if inputs else {})
    lag = 0.0437
    grid = lay_grid(model_of(inputs=inputs, y=lag), record(**channels))
    own = grid.measured["y"]
    assert not grid.uniform
    np.testing.assert_allclose(grid.time[own.position], sampled(10, 31)[0][1:] - lag, atol=1e-9)
    np.testing.assert_allclose(grid.time[grid.measured["z"].position], sampled(10, 31)[0], atol=1e-9)
    np.testing.assert_array_equal(own.beyond, [0])


def test_a_late_sensor_at_irregular_times():
    rng = np.random.default_rng(5)
    time = np.cumsum(rng.uniform(0.05, 0.15, 60))
    values = rng.normal(size=60)
    data = record(a=(time, values), y=(time, values), z=(time, values))
    lag = 0.31
    grid = lay_grid(model_of(y=lag), data)
    own = grid.measured["y"]
    there = time - lag >= time[0]
    np.testing.assert_array_equal(own.index, np.flatnonzero(there))
    np.testing.assert_array_equal(own.beyond, np.flatnonzero(~there))
    np.testing.assert_allclose(grid.time[own.position], time[there] - lag, atol=1e-7)
    np.testing.assert_array_equal(own.values, values[there])
    np.testing.assert_array_equal(grid.measured["z"].values, values)
    # corners of the input and samples of both outputs are points, each once
    assert (np.diff(grid.time) > 0).all()
    assert grid.samples == 60 + there.sum()


def test_missing_samples_are_neither_on_the_grid_nor_beyond_it():
    time, values = sampled(10, 31)
    holes = values.copy()
    holes[[1, 5, 30]] = np.nan
    data = record(a=(time, values), y=(time, holes), z=(time, values))
    own = lay_grid(model_of(y=0.3), data).measured["y"]
    np.testing.assert_array_equal(own.beyond, [0, 2])
    np.testing.assert_array_equal(own.index, np.setdiff1d(np.arange(3, 30), [5]))
    np.testing.assert_array_equal(own.position, own.index - 3)


def test_the_grid_of_a_whole_simulation_counts_no_lags():
    data = record(a=sampled(10, 31))
    assert lay_grid(model_of(y=0.3), data, outputs=()).samples == 31


@pytest.mark.parametrize("lag", [2.95, 3.0, 40.0, -2.95, -40.0])
def test_too_short_a_record_is_refused(lag):
    data = record(a=sampled(10, 31), y=sampled(10, 31), z=sampled(10, 31))
    with pytest.raises(SimulationError, match="the record is too short") as caught:
        lay_grid(model_of(y=lag), data)
    left = 1 if abs(lag) <= 3 else 0
    assert f"seen: experiment 'run': {left} in " in str(caught.value)
    assert "step 0.1 s; allowed: two or more; do: take a longer record" in str(caught.value)
    assert lay_grid(model_of(y=np.sign(lag) * 2.9), data).measured["y"].index.size == 2

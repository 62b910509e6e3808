"""Samples of late sensors that show what was before a record: where they count, and as what."""

from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine.discrepancy.fresh import told_by_both
from casadi_engine.discrepancy.late_samples import beyond, completed, leaving_out, with_all_samples
from casadi_engine.discrepancy.null_model import NullModel, RecordNull
from casadi_engine.effects import SensorDelay
from casadi_engine.experiment import Channel, Experiment
from casadi_engine.model import Blueprint
from casadi_engine.model.lags import lagged
from casadi_engine.simulation.grid import Measured, lay_grid


def seen(index, beyond):
    """An output with these of its samples on a grid and these beyond it."""
    index = np.asarray(index, dtype=np.intp)
    return Measured(
        0.1 * index, np.sin(index), np.arange(len(index)), index, np.asarray(beyond, dtype=np.intp)
    )


ROWS = np.array([1.0, 2.0, 3.0, 4.0])


@pytest.mark.parametrize(
    ("index", "beyond", "wanted"),
    [
        ([2, 3, 4, 5], [0, 1], [2, 1, 1, 2, 3, 4]),
        ([0, 1, 2, 3], [4, 5, 6], [1, 2, 3, 4, 4, 3, 2]),
        ([1, 3, 4, 7], [0, 8, 9], [1, 1, 2, 3, 4, 4, 3]),  # at both ends, and with samples missing
        ([4, 5, 6, 7], [0, 1, 2, 3], [4, 3, 2, 1, 1, 2, 3, 4]),
    ],
)
def test_residuals_beyond_the_grid_are_those_next_to_it_mirrored(index, beyond, wanted):
    np.testing.assert_array_equal(completed(seen(index, beyond), ROWS, mirror=True), wanted)


@pytest.mark.parametrize(("first", "last"), [(6, 0), (0, 6), (9, 0), (0, 13), (5, 7)])
def test_more_samples_beyond_than_there_are_go_back_and_forth(first, last):
    index = first + np.arange(4)
    beyond = np.concatenate([np.arange(first), first + 4 + np.arange(last)])
    wave = np.concatenate([ROWS, ROWS[::-1]])  # period of a sequence that is mirrored at both ends
    wanted = wave[np.arange(-first, 4 + last) % 8]
    np.testing.assert_array_equal(completed(seen(index, beyond), ROWS, mirror=True), wanted)


def test_of_one_sample_all_are_that():
    np.testing.assert_array_equal(completed(seen([2], [0, 1, 3]), np.array([7.0]), mirror=True), [7.0] * 4)


@pytest.mark.parametrize(
    ("index", "beyond"), [([2, 3, 4, 5], [0, 1]), ([1, 2, 3, 4], [0, 5]), ([0, 1, 2, 3], [4])]
)
def test_slopes_beyond_the_grid_are_none(index, beyond):
    rows = np.arange(12.0).reshape(4, 3) + 1
    found = completed(seen(index, beyond), rows, mirror=False)
    assert found.shape == (4 + len(beyond), 3)
    inside = np.isin(np.sort([*index, *beyond]), index)
    np.testing.assert_array_equal(found[inside], rows)
    assert not found[~inside].any()


def test_rows_of_several_columns_are_mirrored_row_by_row():
    rows = np.arange(8.0).reshape(4, 2)
    found = completed(seen([1, 2, 3, 4], [0, 5, 6]), rows, mirror=True)
    np.testing.assert_array_equal(found, rows[[0, 0, 1, 2, 3, 3, 2]])


@pytest.mark.parametrize("mirror", [True, False])
def test_where_no_sample_is_beyond_the_rows_stay_as_they_are(mirror):
    assert completed(seen([0, 1, 2, 3], []), ROWS, mirror=mirror) is ROWS


def test_mirrored_residuals_cost_what_those_next_to_them_do():
    """So that no structure gains by what it cannot tell of."""
    e = np.random.default_rng(0).normal(size=50)
    found = completed(seen(7 + np.arange(50), np.arange(7)), e, mirror=True)
    assert (found**2).sum() - (e**2).sum() == pytest.approx((e[:7] ** 2).sum(), rel=1e-12)


# ---- on a grid


def model_of(**lags):
    b = Blueprint("lag")
    x = b.state("x")
    b.ode("x", -x + b.input("a"))
    b.output("y", x, unit="1")
    b.output("z", 2 * x, unit="1")
    model = b.model()
    for name in lags:
        model = model.with_effect(SensorDelay(), at=f"sensor_{name}")
    return lagged(model, lags)


def record(missing=()):
    time = np.arange(31) / 10
    values = {name: np.sin((k + 2) * time) for k, name in enumerate("ayz")}
    values["y"][list(missing)] = np.nan
    made = [Channel(name, "1", time=time, values=own) for name, own in values.items()]
    return Experiment("run", tuple(made))


def test_a_grid_without_late_sensors_has_all_samples():
    data = record()
    grid = lay_grid(model_of(), data)
    assert with_all_samples(grid, data) is grid


@pytest.mark.parametrize("lag", [0.3, -0.3])
@pytest.mark.parametrize("missing", [(), (0, 7, 29)])
def test_late_outputs_have_all_valid_samples_at_the_times_when_these_were_taken(lag, missing):
    data = record(missing)
    grid = lay_grid(model_of(y=lag), data)
    whole = with_all_samples(grid, data)
    own, before = whole.measured["y"], grid.measured["y"]
    valid = np.setdiff1d(np.arange(31), missing)
    np.testing.assert_array_equal(own.index, valid)
    np.testing.assert_array_equal(own.time, data["y"].time[valid])
    np.testing.assert_array_equal(own.values, data["y"].values[valid])
    np.testing.assert_array_equal(own.beyond, before.beyond)
    # samples on the grid stay at their points, the others are at the nearest of those
    inside = np.isin(own.index, before.index)
    np.testing.assert_array_equal(own.position[inside], before.position)
    edge = before.position[0] if lag > 0 else before.position[-1]
    np.testing.assert_array_equal(own.position[~inside], edge)
    assert (~inside).sum() == len(before.beyond) > 0
    np.testing.assert_array_equal(whole.time, grid.time)
    assert whole.measured["z"] is grid.measured["z"]


def test_rows_and_samples_are_in_the_same_order():
    """What is completed belongs to the samples that the whole grid has."""
    data = record((0, 7, 29))
    grid = lay_grid(model_of(y=0.3, z=-0.2), data)
    whole = with_all_samples(grid, data)
    for name in ("y", "z"):
        before, own = grid.measured[name], whole.measured[name]
        rows = completed(before, before.values, mirror=True)
        assert rows.shape == own.values.shape
        inside = np.isin(own.index, before.index)
        np.testing.assert_array_equal(rows[inside], own.values[inside])


def null_of(residual, slopes, late=()):
    """One record of an output whose sensor tells nothing of some samples; the last column is a first state's."""
    measured = SimpleNamespace(beyond=np.array(late, dtype=np.intp))
    record = RecordNull(
        name="run", path=SimpleNamespace(grid=SimpleNamespace(measured={"y": measured})), residual={"y": residual},
        time={}, index={"y": np.arange(len(residual))}, length={}, cycle={}, slopes={"y": slopes}, starts=("x",),
    )  # fmt: skip
    return NullModel(None, ("k",), ("1",), np.ones(1), np.eye(1), np.zeros((0, 2)), (record,))


def test_a_model_is_held_against_another_by_the_samples_that_both_tell_of():
    """A delay of 0.48 s left out the time in which a hand still drove the pendulum, and was "confirmed"."""
    rng = np.random.default_rng(2)
    noise = rng.normal(size=200)
    decay = np.exp(-np.arange(200) / 80)  # what a first state does
    driven = noise + 50.0 * (np.arange(200) < 20) + 3 * decay
    plain = null_of(driven, np.column_stack([np.ones(200), decay]))
    late = null_of(noise, np.column_stack([np.ones(200), decay]), late=range(20))
    assert beyond(plain) == {}
    assert {key: list(own) for key, own in beyond(late).items()} == {("run", "y"): list(range(20))}
    (first,), (then,) = told_by_both([plain], [late])
    rms = [np.sqrt(np.mean(one.records[0].residual["y"] ** 2)) for one in (first, then)]
    # the first state goes along; a level beside it stays where it is
    assert rms[0] == pytest.approx(1.0, abs=0.1)
    assert rms[1] == pytest.approx(1.0, abs=0.1)
    np.testing.assert_array_equal(first.records[0].slopes["y"][:20], 0.0)
    assert told_by_both([plain], [plain]) == ([plain], [plain])


def test_samples_that_are_left_out_are_those_next_to_them():
    plain = null_of(np.array([9.0, 9.0, 1.0, 2.0, 3.0]), np.ones((5, 2)))
    (record,) = leaving_out(plain, {("run", "y"): np.array([0, 1])}).records
    np.testing.assert_array_equal(record.residual["y"], [2.0, 1.0, 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(record.slopes["y"][:, 0], [0.0, 0.0, 1.0, 1.0, 1.0])
    assert leaving_out(plain, {("other", "y"): np.array([0])}).records[0] is plain.records[0]
    whole = leaving_out(plain, {("run", "y"): np.arange(5)})  # nothing would be left to stand in
    assert whole.records[0] is plain.records[0]

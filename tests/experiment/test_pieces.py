"""Pieces of a record, for motions that no simulation follows for long."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import ExperimentError


def _record(count=101, inputs=("u",)):
    time = 0.1 * np.arange(count)
    return ce.Experiment.from_arrays(
        "run", time=time, units={"u": "N", "y": "m"}, inputs=inputs, u=np.sin(time), y=np.cos(time)
    )


def test_every_sample_of_an_output_is_in_one_piece():
    record = _record()
    found = record.pieces(3.0)
    assert [one.name for one in found] == ["run/1", "run/2", "run/3", "run/4"]
    assert max(one["y"].time[-1] - one["y"].time[0] for one in found) <= 3.0
    np.testing.assert_array_equal(np.concatenate([one["y"].time for one in found]), record["y"].time)
    np.testing.assert_array_equal(np.concatenate([one["y"].values for one in found]), record["y"].values)


def test_inputs_cover_the_outputs_of_a_piece():
    for one in _record().pieces(3.0):
        assert one["u"].time[0] <= one["y"].time[0]
        assert one["u"].time[-1] >= one["y"].time[-1]


def test_a_record_that_is_short_comes_back_alone():
    record = _record()
    assert record.pieces(10.0) == (record,)
    assert record.pieces(1e9) == (record,)


@pytest.mark.parametrize("length", [0.0, -1.0, float("nan"), "long", None])
def test_a_length_that_is_none_is_refused(length):
    with pytest.raises(ExperimentError, match=r"no length|not a number"):
        _record().pieces(length)


def test_pieces_without_samples_are_refused():
    with pytest.raises(ExperimentError, match="fewer than two samples"):
        _record().pieces(0.05)

"""Writing data files, and reading them back."""

import gzip
import os
import pathlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.errors import DataFileError, ExperimentError, OutputError
from casadi_engine.experiment import Channel, Experiment, read_experiment
from casadi_engine.experiment.csv_reader import read_csv
from casadi_engine.experiment.csv_writer import csv_text
from casadi_engine.experiment.header import make_request
from casadi_engine.experiment.source import Source
from casadi_engine.experiment.units import SI_UNITS

NUMBERS = st.floats(allow_nan=True, allow_infinity=False, width=64)
NAMES = st.text(
    st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"], exclude_characters='[],"'), min_size=1
)


@st.composite
def experiments(draw):
    size = draw(st.integers(2, 8))
    time = sorted(
        draw(st.sets(st.floats(allow_nan=False, allow_infinity=False), min_size=size, max_size=size))
    )
    names = draw(
        st.sets(NAMES.map(str.strip).filter(lambda n: n not in ("", "time")), min_size=1, max_size=3)
    )
    channels = [
        Channel(
            name,
            draw(st.sampled_from(SI_UNITS)),
            time=time,
            values=draw(st.lists(NUMBERS, min_size=size, max_size=size)),
        )
        for name in sorted(names)
    ]
    experiment = Experiment("h", channels)
    if draw(st.booleans()):
        experiment = experiment.resample(
            **{draw(st.sampled_from(sorted(names))): draw(st.integers(1, size - 1))}
        )
    return experiment


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(experiments())
def test_what_is_written_is_read_back_exactly(experiment):
    content = csv_text(experiment).encode()
    loaded = read_csv(Source("h.csv", content, ""), make_request())
    assert [(c.name, c.unit) for c in loaded.channels] == [(c.name, c.unit) for c in experiment.channels]
    for again, channel in zip(loaded.channels, experiment.channels, strict=True):
        place = np.flatnonzero(np.isin(again.time, channel.time))
        assert place.size == len(channel)
        np.testing.assert_array_equal(again.values[place], channel.values)
        np.testing.assert_array_equal(again.mask[place], channel.mask)
        assert again.mask.sum() == channel.mask.sum()


def test_the_file(engine, tmp_path):
    path = tmp_path / "out.csv"
    engine.between(0, 0.001).to_csv(path)
    lines = path.read_bytes().decode().split("\n")
    assert lines[0] == "time [s],theta [rad],p1 [Pa],p2 [Pa],T_load [N m],omega [rad/s]"
    assert lines[1].startswith("0.0,0.0,")
    assert len(lines) == 5
    assert lines[4] == ""
    assert os.listdir(tmp_path) == ["out.csv"]


def test_a_resampled_output_has_empty_cells_and_comes_back_as_missing_samples(engine, tmp_path):
    coarse = engine.resample(omega=15)
    coarse.to_csv(tmp_path / "out.csv.gz")
    again = read_experiment(tmp_path / "out.csv.gz", inputs=["theta", "p1", "p2", "T_load"])
    assert len(again["omega"]) == 601
    np.testing.assert_array_equal(again["omega"].values[again["omega"].mask], coarse["omega"].values)
    assert again["omega"].missing == 601 - 41
    np.testing.assert_array_equal(again["T_load"].values, engine["T_load"].values)


def test_the_same_experiment_gives_the_same_bytes(engine, tmp_path):
    engine.to_csv(tmp_path / "a.csv.gz")
    engine.to_csv(tmp_path / "b.csv.GZ")
    first = (tmp_path / "a.csv.gz").read_bytes()
    assert first == (tmp_path / "b.csv.GZ").read_bytes()
    assert first[4:8] == b"\x00" * 4  # the time stamp of the gzip header
    assert gzip.decompress(first).startswith(b"time [s],")
    engine.to_csv(str(tmp_path / "a.csv"))
    assert (tmp_path / "a.csv").read_bytes() == gzip.decompress(first)


def test_an_old_file_is_replaced(engine, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("old")
    engine.to_csv(path)
    assert read_experiment(path).names == engine.names


def test_channels_that_do_not_share_a_time(refused, tmp_path):
    units = {"a": "1", "b": "1"}
    apart = Experiment.from_arrays("r", units=units, a=([0, 1, 2], [1, 2, 3]), b=([0, 1.5], [1, 2]))
    pieces = [
        "experiment 'r': the channels do not share a time",
        "'b' that are not among those of 'a'",
        "only(...)",
    ]
    refused(ExperimentError, pieces, apart.to_csv, tmp_path / "a.csv")
    beyond = Experiment.from_arrays("r", units=units, a=([0, 1, 2], [1, 2, 3]), b=([0, 3], [1, 2]))
    refused(ExperimentError, ["do not share a time"], beyond.to_csv, tmp_path / "a.csv")
    assert os.listdir(tmp_path) == []


def test_a_path_that_cannot_be_written(engine, refused, tmp_path):
    target = tmp_path / "no" / "a.csv"
    refused(
        OutputError,
        [f"{target}: cannot be written", "No such file", "check the directory"],
        engine.to_csv,
        target,
    )
    (tmp_path / "dir.csv").mkdir()
    refused(OutputError, ["dir.csv: cannot be written"], engine.to_csv, tmp_path / "dir.csv")
    refused(OutputError, ["cannot be written", "null"], engine.to_csv, str(tmp_path / "a\x00b.csv"))
    refused(DataFileError, ["not the path"], engine.to_csv, None)
    assert [p.name for p in pathlib.Path(tmp_path).iterdir()] == ["dir.csv"]


def test_a_failure_while_writing_leaves_the_old_file(engine, monkeypatch, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("old")

    def full(_):
        raise OSError("No space left on device")

    monkeypatch.setattr("casadi_engine.experiment.csv_writer.os.fsync", full)
    with pytest.raises(OutputError, match="No space left on device"):
        engine.to_csv(path)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.csv"]

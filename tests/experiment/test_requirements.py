"""What a model needs of an experiment."""

import numpy as np
import pytest

from casadi_engine.errors import DataFileError, ExperimentError, UnitError
from casadi_engine.experiment import Experiment, read_experiment

BAD = ExperimentError


@pytest.fixture
def from_file(tmp_path):
    path = tmp_path / "run.csv"
    rows = "".join(f"{k / 100},{k},{'' if k == 40 else k},{k}\n" for k in range(100))
    path.write_text(f"time [s],theta [rad],p1 [bar],omega [rpm]\n{rows}")
    return read_experiment(path)


def test_a_complete_experiment_passes(engine):
    engine.require(inputs=["theta", "p1", "T_load"], outputs=["omega"])
    engine.require(inputs={"theta": "deg", "p1": "Pa"}, outputs={"omega": "rpm"})
    engine.require(inputs="theta", outputs="omega")
    engine.resample(omega=20).require(inputs=["theta"], outputs=["omega"])
    engine.require()


def test_a_missing_channel(engine, refused):
    pieces = [
        "experiment 'engine': input channel 'thet' is missing",
        "theta, p1, p2, T_load, omega",
        "did you mean",
    ]
    refused(BAD, pieces, engine.require, inputs=["theta", "thet"])
    pieces = ["output channel 'torque' is missing", "record it, or take a model"]
    refused(BAD, pieces, engine.require, outputs=["torque"])


def test_a_missing_channel_that_was_ignored_on_reading(tmp_path, refused):
    path = tmp_path / "run.csv"
    path.write_text("time [s],p1 [bar],omega [rpm]\n0,1,1\n1,1,1\n")
    experiment = read_experiment(path, required=["omega"])
    pieces = [
        f"{path}: input channel 'p1' is missing",
        "column 'p1 [bar]' was left out on reading",
        "required=",
    ]
    refused(BAD, pieces, experiment.require, inputs=["p1"])


def test_a_unit_of_the_wrong_kind(engine, refused):
    pieces = [
        "experiment 'engine', column 'omega': the unit is of another dimension than the model declares",
        "seen: rad/s in the data (dimension s-1 rad)",
        "allowed: bar (dimension s-2 m-1 kg)",
        "correct the unit in the header",
        "unit='rad/s'",
    ]
    refused(UnitError, pieces, engine.require, outputs={"omega": "bar"})
    refused(
        UnitError,
        ["channel 'theta': unknown unit 'turns'", "did you mean 'rev'?"],
        engine.require,
        inputs={"theta": "turns"},
    )


def test_an_empty_input_cell_names_file_column_and_row(from_file, refused):
    pieces = [
        f"{from_file.source}, column 'p1', row 42: a missing sample in an input",
        "1 missing",
        "0.4 s",
        "fill",
    ]
    refused(DataFileError, pieces, from_file.require, inputs=["theta", "p1"], outputs=["omega"])
    from_file.require(inputs=["theta"], outputs=["p1", "omega"])


def test_the_row_is_that_of_the_file_after_conditioning(from_file, refused):
    piece = from_file.between(0.155, 0.9).resample(p1=4)
    refused(DataFileError, ["column 'p1', row 42"], piece.require, inputs=["p1"])
    from_file.between(0.5, 0.9).require(inputs=["p1"])


def test_an_experiment_of_arrays_names_the_sample(engine, refused):
    gap = engine.masked("p1", np.arange(601) != 9)
    pieces = ["experiment 'engine', column 'p1', sample 9: a missing sample in an input", "0.0045 s"]
    refused(BAD, pieces, gap.require, inputs=["p1"])
    gap.require(inputs=["theta"], outputs=["p1"])


def test_an_output_without_a_valid_sample(engine, refused):
    empty = engine.masked("omega", np.zeros(601, dtype=bool))
    refused(BAD, ["column 'omega': every sample", "601 missing"], empty.require, outputs=["omega"])


def test_inputs_that_do_not_cover_the_outputs(engine, refused):
    for start, stop in ((0.1, 0.3), (0.0, 0.2)):
        short = engine.with_channel(engine.between(start, stop)["p1"])
        pieces = [
            "experiment 'engine': input 'p1' does not cover output 'omega' in time",
            f"input from {start:g} to {stop:g} s",
            "at least 0 to 0.3 s",
            "between(start, stop, inputs=",
        ]
        refused(BAD, pieces, short.require, inputs=["theta", "p1"], outputs=["omega"])


def test_times_that_differ_in_their_last_digits_cover():
    time = np.arange(100) / 3
    moved = time * (1 + 1e-12) + 1e-9
    experiment = Experiment.from_arrays("r", units={"u": "1", "y": "1"}, u=(moved, time), y=(time, time))
    experiment.require(inputs=["u"], outputs=["y"])


def test_inputs_of_the_experiment_are_required_when_none_are_named(engine, refused):
    gap = engine.with_inputs("p1").masked("p1", np.arange(601) != 9)
    refused(BAD, ["column 'p1', sample 9"], gap.require, outputs=["omega"])
    gap.require(inputs=(), outputs=["omega"])
    refused(BAD, ["inputs is not a list"], gap.require, inputs=3)

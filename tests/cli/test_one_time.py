"""Simulated records on one time axis."""

from __future__ import annotations

import numpy as np

from casadi_engine.cli.one_time import on_one_time
from casadi_engine.experiment import Experiment, read_experiment

UNITS = {"T": "N m", "p": "Pa", "omega": "rad/s"}
HOLDS = {"T": "first", "p": "zero", "omega": "first"}


def experiment(**channels):
    units, holds = ({name: table[name] for name in channels} for table in (UNITS, HOLDS))
    return Experiment.from_arrays("run", units=units, hold=holds, **channels)


def test_rounding_of_the_times_is_taken_away(tmp_path):
    time = np.array([0.0, 0.1, 0.2, 0.3])
    given = experiment(T=(time, [1.0, 2.0, 3.0, 4.0]), omega=(time * (1 + 1e-12), [5.0, 6.0, 7.0, 8.0]))
    made = on_one_time(given, ["omega"])
    assert made["omega"].time is made["T"].time
    np.testing.assert_array_equal(made["T"].time, time)
    np.testing.assert_array_equal(made["omega"].values, [5.0, 6.0, 7.0, 8.0])
    made.to_csv(tmp_path / "run.csv")
    np.testing.assert_array_equal(read_experiment(tmp_path / "run.csv")["T"].values, given["T"].values)


def test_other_times_are_taken_by_the_hold():
    given = experiment(
        T=([0.0, 0.2], [1.0, 3.0]), p=([0.0, 0.2], [1.0, 3.0]), omega=([0.0, 0.1, 0.2], [5.0, 6.0, 7.0])
    )
    made = on_one_time(given, ["omega"])
    np.testing.assert_allclose(made["T"].values, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(made["p"].values, [1.0, 1.0, 3.0])
    assert made["p"].hold == "zero"
    np.testing.assert_array_equal(given["p"].values, [1.0, 3.0])

"""Make the independent simulator importable, and turn its records into experiments."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

DATA = Path(__file__).resolve().parents[2] / "data"
if str(DATA) not in sys.path:
    sys.path.insert(0, str(DATA))

UNITS = {"theta": "rad", "p1": "Pa", "p2": "Pa", "p3": "Pa", "p4": "Pa", "T_load": "N m",
         "omega": "rad/s", "omega_load": "rad/s"}  # fmt: skip


def as_experiment(record: dict[str, Any], name: str = "record") -> Any:
    from casadi_engine import Experiment

    columns = {key: np.asarray(record[key]) for key in UNITS}
    return Experiment.from_arrays(name, time=record["time"], units=UNITS, **columns)


@pytest.fixture(scope="session")
def experiment_of() -> Any:
    return as_experiment

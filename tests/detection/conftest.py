"""Engines fitted to records of the independent simulator, and records to look for misfires in."""

import sys
from pathlib import Path

import pytest

import casadi_engine as ce

DATA = Path(__file__).resolve().parents[2] / "data"
if str(DATA) not in sys.path:
    sys.path.insert(0, str(DATA))

UNITS = {"theta": "rad", **dict.fromkeys(("p1", "p2", "p3", "p4"), "Pa"), "T_load": "N m", "omega": "rad/s"}


def _speed_only(made, name="record"):
    channels = {key: made[key] for key in ("theta", "omega")}
    return ce.Experiment.from_arrays(
        name, time=made["time"], units={"theta": "rad", "omega": "rad/s"}, **channels
    )


def _fit_of(model):
    records = [
        ce.read_experiment(DATA / f"{kind}_1200rpm.csv.gz", optional=("omega_load",))
        for kind in ("normal", "misfire")
    ]
    return ce.estimate(model, records, noise=ce.Noise(omega=0.1), progress=False)


@pytest.fixture(scope="session")
def speed_only():
    """Makes of a simulated record what the detector needs."""
    return _speed_only


@pytest.fixture(scope="session")
def fit_of():
    """Fits a model to a normal and a misfire record."""
    return _fit_of


@pytest.fixture(scope="session")
def fit():
    return _fit_of(ce.two_mass(reciprocating_speed="measured"))


@pytest.fixture(scope="session")
def lost():
    """Cylinder -> cycles that do not burn: single ones, a pair in a row (4 and 2), one cylinder twice running."""
    return {1: [4], 4: [6], 2: [6], 3: [8, 9]}


@pytest.fixture(scope="session")
def made(lost):
    from simulator import simulate_two_mass

    return simulate_two_mass(1200.0, cycles=12, misfire=lost, scatter_seed=7, noise_seed=8, rtol=1e-7)


@pytest.fixture(scope="session")
def record(made):
    return _speed_only(made)

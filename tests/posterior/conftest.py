"""Densities that are known in closed form, and fits of small records."""

from pathlib import Path

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.posterior.states import WIDTHS
from casadi_engine.posterior.target import Target

SCALE = 100.0  # of the speed, as the model declares it
DATA = Path(__file__).resolve().parents[2] / "data"


def _normal(x, mean, covariance):
    """Log density (n,) of a normal distribution at x (n, d)."""
    away = np.linalg.solve(np.linalg.cholesky(covariance), (x - mean).T)
    return -0.5 * np.square(away).sum(axis=0) - 0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1]


@pytest.fixture(scope="session")
def normal():
    """Log density of a normal distribution."""
    return _normal


@pytest.fixture(scope="session")
def covariance():
    """(4, 4), far from round."""
    turn = np.random.default_rng(3).standard_normal((4, 4))
    return turn @ turn.T + 0.1 * np.eye(4)


def _run_up(seed=1, sigma=0.02, gap=False):
    time = np.arange(200) * 0.01
    speed = 4 * (1 - np.exp(-time / 0.8)) + sigma * np.random.default_rng(seed).standard_normal(200)
    if gap:
        speed[50:60] = np.nan
    return ce.Experiment.from_arrays(
        "run_up",
        time=time,
        units={"T": "N m", "omega": "rad/s"},
        hold="zero",
        T=np.full(200, 2.0),
        omega=speed,
    )


@pytest.fixture(scope="session")
def run_up():
    """Makes a record of an inertia that a torque sets going."""
    return _run_up


def _closed_form(record, inertia, damper, sigma, likelihood):
    """Log likelihood of the run-up but for its constants, its initial speed integrated over the likelihood's prior
    at each of its widths."""
    time, speed = record["omega"].time, record["omega"].values
    seen = np.isfinite(speed)
    decay = np.exp(-damper / inertia * time)[seen]
    rest, rows = 2.0 / damper * (1 - decay) - speed[seen], SCALE * decay
    (states,) = likelihood.states if likelihood.bins is None else likelihood.first
    rest, rows, logs = rest / sigma, rows / sigma, []
    for mean, factor in zip(states.means[:, 0], states.factors[:, 0, 0], strict=True):
        left = rest + mean * rows
        for variance in np.square(WIDTHS * factor):
            grown = 1 + variance * (rows @ rows)
            logs.append(-0.5 * (left @ left - variance * (rows @ left) ** 2 / grown + np.log(grown)))
    return np.logaddexp.reduce(logs) - np.log(len(logs)) - seen.sum() * np.log(sigma)


@pytest.fixture(scope="session")
def closed_form():
    """Log likelihood of a run-up, by its equation."""
    return _closed_form


@pytest.fixture(scope="session")
def fit():
    """One inertia and its damper at a known noise level."""
    return ce.estimate(ce.one_inertia(), _run_up(), noise=ce.Noise(omega=0.02), progress=False)


@pytest.fixture(scope="session")
def post(fit):
    """The posterior of that fit."""
    return ce.posterior(fit)


@pytest.fixture(scope="session")
def two_masses():
    """The fit of two masses to a second of a kept record, and its target."""
    record = ce.read_experiment(DATA / "misfire_1200rpm.csv.gz", optional=("omega_load",))
    model = ce.two_mass(reciprocating_speed="measured")
    found = ce.estimate(model, record, noise=ce.Noise(omega=0.1), progress=False)
    return found, Target(found)

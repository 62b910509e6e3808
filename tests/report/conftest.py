"""Hand-made results, so that what is shown can be tested without an estimation."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine.estimation.fit import Direction, Estimate, Fit, Optimum, Trace
from casadi_engine.experiment import Experiment
from casadi_engine.model import two_mass
from casadi_engine.validation import OutputCheck, Validation, check_residual, fit_measures, rejected

RATE, SIGMA = 2000.0, 0.1
VALUES = {"J_eng": 0.391083, "J_load": 0.177117, "K_el": 1992.0, "C_el": 0.0, "C_eng": 0.1541}
ERRORS = {"J_eng": 0.00042, "J_load": 0.0021, "K_el": 12.0, "C_el": None, "C_eng": 0.00031}
CORRELATION = np.array(
    [
        [1.0, 0.2, -0.93, 0.0, 0.1],
        [0.2, 1.0, 0.61, 0.0, 0.0],
        [-0.93, 0.61, 1.0, 0.0, -0.3],
        [0.0, 0.0, 0.0, 0.0, 0.0],
        [0.1, 0.0, -0.3, 0.0, 1.0],
    ]
)


def make_experiment(name="misfire_1200rpm", *, n=1200, seed=0, missing=(100, 130), theta=True):
    """Speed with the firing ripple of four cylinders at 1200 rpm, white noise, and a gap."""
    rng = np.random.default_rng(seed)
    time = np.arange(n) / RATE
    angle = 2 * np.pi * 20 * time
    truth = 125.0 + 3 * np.sin(2 * angle) + 0.8 * np.sin(0.5 * angle)
    measured = truth + SIGMA * rng.standard_normal(n)
    if missing:
        measured[slice(*missing)] = np.nan
    pressure = 1e5 * (1 + 10 * np.exp(-(((angle % (4 * np.pi)) - 0.4) ** 2)))
    channels = {f"p{k}": pressure for k in range(1, 5)} | {"T_load": np.full(n, 57.0), "omega": measured}
    units = {f"p{k}": "Pa" for k in range(1, 5)} | {"T_load": "N m", "omega": "rad/s"}
    if theta:
        channels["theta"], units["theta"] = angle, "rad"
    return Experiment.from_arrays(
        name,
        time=time,
        units=units,
        origin={key: "assumed" if key in ("p3", "p4") else "measured" for key in channels},
        inputs=[key for key in channels if key != "omega"],
        **channels,
    ), truth


def make_trace(experiment, truth, *, predicted=False):
    channel = experiment["omega"]
    simulated = truth + 0.02 * np.sin(9 * channel.time)
    return Trace(channel.time, channel.values, channel.mask, simulated, truth.copy() if predicted else None)


def make_fit(*, records=("misfire_1200rpm",), predicted=False, samples=1200, theta=True, **changes):
    model = changes.pop("model", None) or two_mass()
    pars = model.parameters()
    for name, value in VALUES.items():
        pars[name].set(value, min=0.0)
    pars["C_eng"].set(prior=(0.15, 0.01))
    pars.add("C_half", 0.07, unit="N m s/rad")
    pars.tie("C_half", "C_eng/2")
    fixed = [name for name in model.parameter_names if name not in VALUES]
    estimates = {
        name: Estimate(
            VALUES[name],
            ERRORS[name],
            model.parameters()[name].unit,
            at_bound="min" if name == "C_el" else False,
            why="at its lower bound" if name == "C_el" else None,
        )
        for name in VALUES
    }
    estimates |= {
        name: Estimate(float(pars[name].value), None, pars[name].unit, why="fixed", fixed=True)
        for name in fixed
    }
    estimates["C_half"] = Estimate(0.07705, 0.000155, "N m s/rad")
    spread = np.array([ERRORS[name] or 0.0 for name in VALUES])
    made = [make_experiment(name, n=samples, seed=k, theta=theta) for k, name in enumerate(records)]
    data = tuple(experiment for experiment, _ in made)
    given = {
        "model": model,
        "parameters": pars.frozen(),
        "data": data,
        "status": "converged",
        "estimates": estimates,
        "start": {name: 0.6 * value for name, value in VALUES.items()} | {"C_el": 1.5},
        "free": tuple(VALUES),
        "z": np.array(list(VALUES.values())),
        "covariance": CORRELATION * np.outer(spread, spread),
        "undetermined": (),
        "initial": {
            name: {
                "omega_eng": Estimate(125.0123, 0.021, "rad/s"),
                "omega_load": Estimate(124.98, None, "rad/s", why="not determined"),
                "twist": Estimate(-0.0286, None, "rad", fixed=True, why="fixed"),
            }
            for name in records
        },
        "noise": {"omega": (0.1001, True)},
        "cost": 1168.25,
        "n": 1170 * len(records),
        "dof": 1164.0,
        "iterations": 12,
        "nodes": 60,
        "optima": (Optimum(1168.25, dict(VALUES), 1, "converged"),),
        "traces": {
            experiment.name: {"omega": make_trace(experiment, truth, predicted=predicted)}
            for experiment, truth in made
        },
        "drives": {
            experiment.name: {
                "T_1": np.vstack([experiment["p1"].time, experiment["p1"].values * 1e-4]),
                "T_load": np.vstack([experiment["T_load"].time, experiment["T_load"].values]),
            }
            for experiment, _ in made
        },
        "fit_percent": {
            name: {"omega": {"simulation": 95.123, "prediction": 96.2 if predicted else None}}
            for name in records
        },
        "timing": {"setup": 0.021, "solve": 0.034, "covariance": 0.005},
        "options": {"interval": 0.01, "loss": "square"},
    }
    return Fit(**(given | changes))


@pytest.fixture
def factory():
    return SimpleNamespace(
        fit=make_fit,
        validation=make_validation,
        experiment=make_experiment,
        values=VALUES,
        direction=Direction(
            "J_eng and K_el together, with nearly constant ratio", {"J_eng": 0.7, "K_el": 0.71}
        ),
        optimum=Optimum,
    )


@pytest.fixture
def fit():
    return make_fit()


def make_validation(fit=None, *, white=True):
    """Residual tests of the traces; with ``white=False`` a sine is left in the residual."""
    fit = fit or make_fit()
    records, tests = {}, {}
    for record, outputs in fit.traces.items():
        for output, trace in outputs.items():
            time = trace.time
            extra = 0.0 if white else 0.1 * np.sin(2 * np.pi * 40 * time)
            simulated = trace.simulated - 0.02 * np.sin(9 * time) + extra
            trace = Trace(time, trace.measured, trace.mask, simulated)
            drives = {key: np.interp(time, *value) for key, value in fit.drives[record].items()}
            found = check_residual(trace.residual, drives, mask=trace.mask)
            size = fit_measures(trace.measured, trace.simulated, mask=trace.mask)
            records.setdefault(record, {})[output] = OutputCheck(
                {"simulation": size.fit_percent, "prediction": None}, size.rmse, size.S1, size.S2,
                found.whiteness, found.cross, found.autocorrelation, found.cross_correlation, trace,
            )  # fmt: skip
            tests[f"{record}/{output}/whiteness"] = found.whiteness
            tests |= {f"{record}/{output}/{drive}": test for drive, test in found.cross.items()}
    failed = rejected(tests)
    return Validation(records, not failed, failed, 0.01, fit)


@pytest.fixture
def validation():
    return make_validation()

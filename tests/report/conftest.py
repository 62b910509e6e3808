"""Hand-made results, so that what is shown can be tested without an estimation."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine import effects
from casadi_engine.discrepancy.confirmation import Gap, PairedGain
from casadi_engine.discrepancy.latent_torque import LatentCourse, LatentTorque
from casadi_engine.discrepancy.random_families import Course, Family
from casadi_engine.discrepancy.repaired import (
    ClassMatrix,
    Equation,
    FoundEffect,
    Gaps,
    Member,
    NoiseFound,
    NotFound,
    Place,
    Repair,
    Round,
    ScoreRow,
    Side,
    Unknown,
)
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


def doubted(fit):
    """The same fit, its K_el without an error and J_load with an interval in place of one."""
    k_el, j_load = (fit.estimates[name] for name in ("K_el", "J_load"))
    k_el = replace(k_el, stderr=None, why="not known (see note)", quadratic=k_el.stderr)
    j_load = replace(
        j_load, stderr=None, why="not symmetric (see note)", quadratic=j_load.stderr, interval=(0.12, 0.27)
    )
    return replace(fit, estimates={**fit.estimates, "K_el": k_el, "J_load": j_load})


@pytest.fixture
def factory():
    return SimpleNamespace(
        fit=make_fit,
        doubted=doubted,
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


KEY = "coupling.coulomb_friction.torque"


def make_repair(**changes):
    """A repair made by hand: dry friction in a coupling, its gap an order of 2 that is gone afterwards."""
    model = two_mass()
    mended = model.with_effect(effects.CoulombFriction(), at="coupling")
    null_fit, fresh_fit = make_fit(model=model), make_fit(model=model, records=("normal_1400rpm",))
    fit = make_fit(model=mended, noise={"omega": (0.1001, True)})
    found = dict(fit.estimates) | {KEY: Estimate(8.05, 0.07, "N m"), "J_load": Estimate(0.17, 0.002, "kg m2")}
    fit = replace(fit, estimates=found, free=(*fit.free, KEY))

    def side(one, gap):
        traces = {}
        for name, outputs in one.traces.items():
            theta = next(e for e in one.data if e.name == name)["theta"].values
            trace = outputs["omega"]
            truth = trace.simulated - 0.02 * np.sin(9 * trace.time)
            traces[name] = {"omega": replace(trace, simulated=truth - gap * np.cos(2 * theta))}
        level = float(np.hypot(0.1, gap / np.sqrt(2)))
        size = Gap((level / 0.1) ** 2, {"omega": level}, {"omega": 95.0 - 20 * gap}, one.n)
        return Side(size, {name: {"omega": 1e-20 if gap else 0.4} for name in traces}, traces)

    data, fresh = null_fit.data, fresh_fit.data
    time = data[0]["theta"].time
    knots = np.linspace(time[0], time[-1], 60)
    rate = 3 * np.sin(40 * np.pi * knots)
    law = np.vstack([time, 8.05 * np.sign(np.sin(40 * np.pi * time))])
    course = LatentCourse(
        knots, 8 * np.tanh(rate) - 1.5 * rate, np.full(60, 0.8),
        {"twist": -0.03 + 0.01 * np.cos(40 * np.pi * knots), "twist_rate": rate, "stiffness": np.full(60, 1992.0)},
    )  # fmt: skip
    effect = FoundEffect(
        "coulomb_friction", "coupling", "dry friction at coupling", {}, {KEY: found[KEY]}, {}, 95.0, 1e-200, 5000.0,
        0.99, {"C_eng": 0.001, "J_load": -0.005}, {"C_eng": 0.0, "J_load": -0.007117}, 1.0,
        (Member("coulomb_friction", "coupling", 1.0, 1.0),), {data[0].name: law},
    )  # fmt: skip

    def row(name, at, z, threshold=3.8, testable=True):
        return ScoreRow(
            name, at, f"{name} at {at}", {}, z, abs(z), 0.5, 1.0, 0.1, "N m", 0.4 if testable else np.inf,
            1.0 if testable else 0.0, testable, testable and abs(z) > threshold,
        )  # fmt: skip

    given = {
        "status": "answered", "verdict": "named", "confirmed": True, "null_fit": null_fit, "fit": fit, "alpha": 0.01,
        "threshold": 3.8, "threshold_p": 1e-4, "candidates": 380,
        "scores": (
            row("coulomb_friction", "coupling", 95.0), row("backlash", "coupling", 50.0),
            row("backlash", "coupling", 2.0),
            row("load_step", "load", -3.0), row("viscous_friction", "coupling", 0.0, testable=False),
        ),
        "matrix": ClassMatrix(
            ("a", "b"), (("coulomb_friction", "coupling"), ("backlash", "coupling")),
            np.array([[1.0, -0.37], [-0.37, 1.0]]),
        ),
        "effects": (effect,),
        "where": Place("coupling", data[0].name, (0.1, 0.3), (2, 3, 4), (12.3, 2.4), 1.5, {data[0].name: 1.0}),
        "gaps": Gaps(
            side(null_fit, 0.15), side(fit, 0.0), side(fresh_fit, 0.15), side(fresh_fit, 0.0),
            PairedGain(339.0, 36.0, 10, True), "records",
        ),
        "not_found": (
            NotFound("backlash", "coupling", 3e-4, "rad", True),
            NotFound("viscous_friction", "coupling", np.inf, "N m s/rad", False),
        ),
        "equation": Equation(mended.equations(), mended.latex(), ("w_coupling = torque*tanh(rate/0.02)",)),
        "noise": NoiseFound({"omega": (0.1, True)}, {"misfire_1200rpm/omega": 2}, {"combustion": 0.02}, True),
        "latent": (LatentTorque("coupling", "exponential", 4739.0, 4.7, 0.0076, {data[0].name: course}),),
        "rounds": (Round((("coulomb_friction at coupling", 0.0),), (("coulomb_friction at coupling", 1168.0, True),),
                         "coulomb_friction at coupling", ()),),
        "data": data, "fresh": fresh, "timing": {"null fit": 1.5, "total": 12.5}, "options": {"starts": 4},
    }  # fmt: skip
    return Repair(**(given | changes))


@pytest.fixture(scope="session")
def repaired():
    return make_repair()


@pytest.fixture(scope="session")
def nothing_missing(repaired):
    """The same records where nothing was found."""
    gaps, after = repaired.gaps, repaired.gaps.estimation_after
    fresh = gaps.validation_after
    return replace(
        repaired, verdict="nothing missing", confirmed=None, fit=repaired.null_fit, effects=(), where=None,
        unknown=None,
        gaps=replace(
            gaps, estimation_before=after, validation_before=fresh, gain_per_cycle=None,
        ),
        scores=repaired.scores[3:], equation=None, rounds=(),
    )  # fmt: skip


@pytest.fixture(scope="session")
def unnamed(repaired):
    """Residuals that are not white, and a torque that looks like a cubic of the twist."""
    signal = np.linspace(-0.05, 0.0, 40)
    family = Family("coupling", "twist", (0, 1), np.ones(2), -0.05, 0.0, np.ones(64) / 64)
    course = Course(family, signal, 1e5 * signal**3, np.full(40, 1.0), 2.0, {"cubic": 0.97, "linear": 0.8})
    unknown = Unknown(
        "a torque at the coupling that depends on its twist and looks cubic",
        {"misfire_1200rpm/omega/whiteness": 1e-20}, "coupling", "twist", 1e-9, course,
    )  # fmt: skip
    gaps = repaired.gaps
    gaps = replace(
        gaps, estimation_after=gaps.estimation_before, validation_before=None, validation_after=None,
        gain_per_cycle=None, source=None,
    )  # fmt: skip
    return replace(
        repaired, verdict="unnamed", confirmed=None, fit=repaired.null_fit, effects=(), unknown=unknown, gaps=gaps,
        equation=None, fresh=(),
    )  # fmt: skip


@pytest.fixture(scope="session")
def no_answer(repaired):
    """The fit without effects did not converge."""
    failed = make_fit(status="not converged: Maximum_Iterations_Exceeded")
    return Repair(
        f"the fit without effects has {failed.status}", None, None, failed, failed, 0.01, data=failed.data,
        timing={"total": 1.0}, messages=("no effect can be looked for before the model without effects fits",),
    )  # fmt: skip

"""How finely fits are integrated: its effect on the estimates is bounded, and no steps are wasted."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import casadi_engine as ce
from casadi_engine.estimation import integration
from casadi_engine.estimation import search as search_module
from casadi_engine.estimation.integration import SHIFT, shorten_steps
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator

DATA = Path(__file__).parents[2] / "data"


def solved(slope, start, time, method="DOP853"):
    """States (n, N) by SciPy at a tight tolerance."""
    found = solve_ivp(slope, (time[0], time[-1]), start, t_eval=time, rtol=1e-11, atol=1e-13, method=method)
    return found.y


def record(time, y, sigma, seed=1):
    noise = sigma * np.random.default_rng(seed).standard_normal(len(time))
    return ce.Experiment.from_arrays("run", time=time, units={"y": "1"}, y=y + noise)


def duffing(k3=3.0):
    b = ce.Blueprint("duffing")
    c, k3 = b.parameter("c", 0.2, min=0), b.parameter("k3", k3, min=0)
    q, v = b.state("q", scale=1.0), b.state("v", scale=1.0)
    b.ode("q", v)
    b.ode("v", -c * v - q - k3 * q**3)
    b.output("y", q)
    return b.model()


def pendulums():
    """A chain of linear springs with one nonlinear law: a linear core with a law, for the exponential integrator."""
    b = ce.Blueprint("chain")
    c, k3 = b.parameter("c", 0.2, min=0), b.parameter("k3", 3.0, min=0)
    q, v = b.state("q", scale=1.0), b.state("v", scale=1.0)
    r, w = b.state("r", scale=1.0), b.state("w", scale=1.0)
    b.ode("q", v)
    b.ode("v", -c * v - q - k3 * q**3 + 4 * (r - q))
    b.ode("r", w)
    b.ode("w", 4 * (q - r))
    b.output("y", q)
    return b.model()


SYSTEMS = {
    # name -> model, slope for SciPy, start, times of the record
    "explicit": (
        duffing,
        lambda t, x, c, k3: [x[1], -c * x[1] - x[0] - k3 * x[0] ** 3],
        [0.9, 0.0],
        np.sort(np.r_[0.0, np.random.default_rng(3).uniform(0, 12, 118), 12.0]),
    ),
    "exponential": (
        pendulums,
        lambda t, x, c, k3: [
            x[1],
            -c * x[1] - x[0] - k3 * x[0] ** 3 + 4 * (x[2] - x[0]),
            x[3],
            4 * (x[0] - x[2]),
        ],
        [0.9, 0.0, 0.0, 0.0],
        np.linspace(0, 12, 61),
    ),
}
KINDS = {"explicit": "Runge-Kutta steps", "exponential": "exponential Runge-Kutta steps"}
SIGMA = 1e-4


@pytest.fixture
def no_refinement(monkeypatch):
    """Fits keep the steps that they begin with."""

    def keep():
        monkeypatch.setattr(search_module, "shorten_steps", lambda *_: False)

    yield keep
    monkeypatch.undo()


# ---- the bound


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_shift_bounds_what_coarse_steps_do_to_the_estimates(name, no_refinement, monkeypatch):
    make, slope, start, time = SYSTEMS[name]
    data = record(time, solved(lambda t, x: slope(t, x, 0.2, 3.0), start, time)[0], SIGMA)
    initial = dict(zip((state.name for state in make().states), start, strict=True))
    fine = ce.estimate(make(), data, noise=ce.Noise(y=SIGMA), initial=initial, progress=False)
    no_refinement()
    coarse = ce.estimate(make(), data, noise=ce.Noise(y=SIGMA), initial=initial, progress=False)
    (told,), (better,) = coarse.integration.values(), fine.integration.values()
    assert KINDS[name] in told.integrator
    difference = coarse.z - fine.z
    moved = float(np.sqrt(difference @ np.linalg.solve(fine.covariance, difference)))
    assert told.shift > 5 * SHIFT  # the steps are coarse enough for the data to feel them
    assert (
        0.01 * told.shift < moved <= 1.1 * told.shift + better.shift
    )  # estimated to the leading order of the steps
    each = np.abs(difference) / np.sqrt(np.diag(fine.covariance))
    assert each.max() <= 1.1 * told.shift + better.shift
    assert better.shift <= SHIFT
    assert better.substeps > told.substeps
    assert any("the integration of run moves the estimates by up to" in text for text in coarse.messages)
    assert not any("integration" in text for text in fine.messages)


@pytest.mark.parametrize("name", ["explicit", pytest.param("exponential", marks=pytest.mark.slow)])
def test_the_refined_fit_is_scipys_least_squares(name):
    make, slope, start, time = SYSTEMS[name]
    data = record(time, solved(lambda t, x: slope(t, x, 0.2, 3.0), start, time)[0], SIGMA)
    initial = dict(zip((state.name for state in make().states), start, strict=True))
    fit = ce.estimate(make(), data, noise=ce.Noise(y=SIGMA), initial=initial, progress=False)

    def residual(p):
        return (solved(lambda t, x: slope(t, x, *p), start, time)[0] - data["y"].values) / SIGMA

    truth = least_squares(
        residual, [0.2, 3.0], xtol=1e-12, ftol=1e-12, gtol=1e-10, diff_step=1e-4, jac="3-point"
    )
    off = np.array([fit.values["c"], fit.values["k3"]]) - truth.x
    assert np.abs(off / [fit.stderr["c"], fit.stderr["k3"]]).max() <= SHIFT


# ---- no cost where none is needed


def test_an_integration_error_is_worked_out_once_for_each_place_and_fineness(monkeypatch):
    make, slope, start, time = SYSTEMS["exponential"]
    y = solved(lambda t, x: slope(t, x, 0.2, 3.0), start, time)[0]
    places = []
    original = integration.signed_error
    monkeypatch.setattr(
        integration, "signed_error", lambda p, v, at: places.append((p, p.substeps)) or original(p, v, at)
    )
    fit = ce.estimate(make(), record(time, y, SIGMA), noise=ce.Noise(y=SIGMA), progress=False)
    assert len(set(places)) == len(places) > 1  # shorter steps are judged anew
    assert fit.integration["run"].substeps == places[-1][1]
    assert fit.integration["run"].shift <= SHIFT


def test_steps_that_suffice_stay(monkeypatch):
    calls = []

    def watched(*arguments):
        calls.append(shorten_steps(*arguments))
        return calls[-1]

    monkeypatch.setattr(search_module, "shorten_steps", watched)
    make, slope, start, _ = SYSTEMS["explicit"]
    time = np.linspace(0, 12, 1201)
    data = record(time, solved(lambda t, x: slope(t, x, 0.2, 3.0), start, time)[0], 1e-2)
    fit = ce.estimate(make(), data, noise=ce.Noise(y=1e-2), progress=False)
    assert fit.converged
    assert calls == [False]
    assert [one.substeps for one in fit.integration.values()] == [1]


@pytest.mark.parametrize("chain", ["two_mass", pytest.param("crankshaft", marks=pytest.mark.slow)])
def test_the_examples_with_a_nonlinear_law_are_not_refined(chain):
    path = "misfire_1200rpm.csv.gz" if chain == "two_mass" else "crankshaft/normal_1200rpm.csv.gz"
    data = ce.read_experiment(DATA / path).between(0, 0.1)
    model = getattr(ce, chain)(reciprocating_speed="model")
    pars = model.parameters()
    for name in pars.names:
        pars.fix(name)
    free = "J_load" if chain == "two_mass" else "J1"
    pars[free].set(1.1 * pars[free].value, vary=True)
    fit = ce.estimate(model, data, parameters=pars, noise=ce.Noise(omega=0.1), progress=False)
    assert fit.converged
    (found,) = fit.integration.values()
    assert found.substeps == 1
    assert found.shift < SHIFT


# ---- records that are too coarse for one step to a sample


def test_an_optimum_that_asks_for_more_steps_than_the_start():
    """A reaction whose rate is started at a tenth."""
    b = ce.Blueprint("reaction")
    k, x = b.parameter("k", 0.5, min=0), b.state("x", scale=1.0)
    b.ode("x", -k * x**2)
    b.output("y", x)
    time = np.arange(40) * 0.25
    data = record(time, 2 / (1 + 2 * 5.0 * time), 1e-3)  # the closed form from 2 with the rate 5
    fit = ce.estimate(b.model(), data, noise=ce.Noise(y=1e-3), progress=False)
    assert fit.converged
    assert abs(fit.values["k"] - 5.0) < 3 * fit.stderr["k"]
    assert abs(fit.cost / fit.n - 1) < 0.7
    (found,) = fit.integration.values()
    assert found.shift <= SHIFT
    assert found.substeps > 1


# ---- several searches


def test_many_starts_and_processes_end_at_the_same_refined_answer():
    make, slope, start, time = SYSTEMS["explicit"]
    data = record(time, solved(lambda t, x: slope(t, x, 0.2, 3.0), start, time)[0], SIGMA)
    options = {"noise": ce.Noise(y=SIGMA), "progress": False}
    one = ce.estimate(make(), data, **options)
    several = ce.estimate(make(), data, starts=3, **options)
    shared = ce.estimate(make(), data, starts=3, jobs=2, **options)
    for fit in (several, shared):
        assert fit.converged
        np.testing.assert_allclose(fit.z, one.z, atol=0.01 * min(one.stderr.values()))
        (found,) = fit.integration.values()
        assert found.shift <= SHIFT
    np.testing.assert_allclose(shared.z, several.z, rtol=1e-9)
    assert several.optima[0].values == pytest.approx(several.values)


def test_a_warm_start_integrates_as_finely_as_the_fit_did():
    """A mass that sticks: steps are short where it is caught and let go, and a fit that goes on knows where."""
    b = ce.Blueprint("stick")
    m, c, x, u = (
        b.parameter("m", 2.0, min=0.1),
        b.parameter("F", 1.0, min=0),
        b.state("v"),
        b.input("u", unit="N"),
    )
    b.ode("v", (u - c * ca.tanh(x / 1e-4)) / m)
    b.output("v", x)
    model, time = b.model(), np.arange(150) * 0.02
    rng = np.random.default_rng(0)
    data = ce.Experiment.from_arrays(
        "push",
        time=time,
        units={"u": "N", "v": "1"},
        u=2 * np.sin(2.5 * time),
        v=np.zeros(150),
        inputs=("u",),
    )
    v = ce.simulate(model, data, initial={"v": 0.0})["v"].values + 0.01 * rng.standard_normal(150)
    data = ce.Experiment.from_arrays(
        "push", time=time, units={"u": "N", "v": "1"}, u=2 * np.sin(2.5 * time), v=v, inputs=("u",)
    )
    options = {"noise": ce.Noise(v=0.01), "initial": {"v": 0.0}, "progress": False}
    fit = ce.estimate(model, data, **options)
    counts = fit.fineness["push"].counts
    assert counts.max() > 4 * np.median(counts)  # short in places alone
    begun = []
    real = RungeKuttaPropagator.propagate

    def propagate(self, *arguments, **named):
        found = real(self, *arguments, **named)
        begun.append(self.fineness.counts)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RungeKuttaPropagator, "propagate", propagate)
        again = ce.estimate(model, data, warm=fit, **options)
    assert any(np.array_equal(counts, one) for one in begun[:3])
    assert again.converged
    assert again.cost == pytest.approx(fit.cost, abs=1e-2)

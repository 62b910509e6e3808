"""Operating points: settled starts, starts of measured records, planned outputs, messages."""

import math
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import ExperimentError, SimulationError
from casadi_engine.identifiability import PlannedExperiment, fisher, plan
from casadi_engine.identifiability.fisher import Frame
from casadi_engine.identifiability.operating import planned
from casadi_engine.model import thesis_ties

DATA = Path(__file__).resolve().parents[2] / "data"
NOISE = ce.Noise(omega=0.1)


def start_of(model, plan_, parameters=None):
    frame = Frame(model, parameters, (plan_.name,))
    _, seen = frame.linearise(plan_)
    return dict(zip([state.name for state in model.states], seen.start.tolist(), strict=True))


@pytest.fixture(scope="module")
def normal():
    return ce.read_experiment(DATA / "normal_1200rpm.csv.gz")


def test_the_settled_start_is_near_the_true_one(normal):
    """The record begins where a warm-up of the mean cycle ends; the plan knows neither speeds nor twist."""
    model = ce.two_mass()
    found = start_of(model, PlannedExperiment(normal.without("omega")))
    with_speeds = ce.read_experiment(DATA / "normal_1200rpm.csv.gz", optional=("omega_load",))
    assert found["omega_eng"] == pytest.approx(normal["omega"].values[:8].mean(), abs=0.2)
    assert found["omega_load"] == pytest.approx(with_speeds["omega_load"].values[:8].mean(), abs=0.2)
    assert found["twist"] == pytest.approx(-57 / 1992, rel=0.1)


def test_a_settled_motion_repeats(normal):
    model = ce.two_mass(reciprocating_speed="measured")
    pars = model.parameters()
    there = plan(model, normal, parameters=pars)
    first = start_of(model, there, pars)
    run = ce.simulate(model, there.experiment, parameters=pars, initial=first)["omega"].values
    theta = there.experiment["theta"].values
    cycle = np.interp([0, 4 * math.pi, 8 * math.pi], theta, np.arange(len(theta)))
    points = np.interp(cycle, np.arange(len(run)), run)
    assert np.ptp(run) > 1.0
    assert abs(points[1] - points[0]) < 0.3
    assert run.mean() == pytest.approx(1200 * math.pi / 30, rel=3e-3)


def test_without_a_crank_angle_the_start_is_the_equilibrium():
    model = ce.one_inertia()
    time = np.arange(50) * 0.01
    data = ce.Experiment.from_arrays("run", time=time, units={"T": "N m"}, T=np.full(50, 3.0))
    pars = model.parameters()
    pars["C_eng"].set(0.5)
    assert start_of(model, PlannedExperiment(data), pars)["omega_eng"] == pytest.approx(6.0)


def tank(level):
    """A tank whose outflow is the root of its level, filled from ``level`` [m] by two steps of its inflow."""
    b = ce.Blueprint("tank")
    area, outflow = b.parameter("A", 1.0, unit="m2", min=0.1), b.parameter("k", 0.5, min=0.01)
    h, inflow = b.state("h", unit="m"), b.input("u", unit="m3/s")
    b.ode("h", (inflow - outflow * ca.sqrt(h)) / area)
    b.output("h", h, unit="m")
    model, time = b.model(), np.arange(200) * 0.1
    channels = {"u": 0.5 + 0.3 * (time % 8 >= 4)}
    plain = ce.Experiment.from_arrays("t", time=time, units={"u": "m3/s"}, **channels)
    h = ce.simulate(model, plain, initial={"h": level})["h"].values
    noisy = h + 0.005 * np.random.default_rng(0).standard_normal(200)
    return model, ce.Experiment.from_arrays(
        "t", time=time, units={"u": "m3/s", "h": "m"}, h=noisy, **channels
    )


@pytest.mark.parametrize("level", [0.02, 1.0, 30.0])
def test_a_start_is_found_where_the_equations_have_no_slope_at_zero(level):
    model, record = tank(level)
    assert start_of(model, PlannedExperiment(record))["h"] == pytest.approx(level, abs=0.02)
    assert start_of(model, PlannedExperiment(record.without("h")))["h"] == pytest.approx(1.0)
    foreseen = fisher(model, record, noise=ce.Noise(h=0.005))
    fit = ce.estimate(model, record, noise=ce.Noise(h=0.005), progress=False)
    for name in ("A", "k"):
        assert foreseen.errors[name].stderr == pytest.approx(fit.stderr[name], rel=0.1)


def test_noise_of_a_measured_start_promises_nothing():
    """A crankshaft's fast modes ring from a start that is fitted to noise; errors taken there are far too small."""
    model = ce.crankshaft(reciprocating_speed="measured")
    pars = thesis_ties(model.parameters())
    for name in ("C21", "C32"):
        pars[name].set(vary=True)
    record = ce.read_experiment(DATA / "crankshaft" / "normal_1200rpm.csv.gz")
    measured = fisher(model, record, parameters=pars, noise=NOISE)
    speed = record["omega"]
    derived = ce.Experiment.from_arrays(
        "x", time=speed.time, units={"omega": "rad/s"}, origin="derived", omega=speed.values
    )
    settled = start_of(model, PlannedExperiment(record.with_channel(derived["omega"])), pars)
    truth = fisher(model, PlannedExperiment(record, start=settled), parameters=pars, noise=NOISE)
    frame = Frame(model, pars, ("r",))
    (there,) = planned({"r": record})
    line, _ = frame.linearise(there)
    closest = line.at(frame.v, closest=True)
    promised = frame.conclude(
        {"r": frame.information(False, closest, {"omega": (0.1, False)})}, {}, samples=1, duration=1.0
    )
    for name in ("J2", "K21", "C21", "C32"):
        assert measured.relative[name] == pytest.approx(truth.relative[name], rel=0.1), name
    assert promised.relative["C32"] < 0.6 * measured.relative["C32"]


def test_a_planned_output_counts_at_every_so_many_points(normal):
    model = ce.two_mass(reciprocating_speed="measured")
    data = normal.between(0, 0.3)
    inputs = plan(model, data, duration=0.3).experiment
    every = fisher(model, PlannedExperiment(inputs), noise=NOISE)
    tenth = fisher(model, PlannedExperiment(inputs, every=10), noise=NOISE)
    assert tenth.n == math.ceil(every.n / 10)
    ratio = tenth.relative["K_el"] / every.relative["K_el"]
    assert ratio == pytest.approx(math.sqrt(10), rel=0.05)


def test_an_added_sensor_helps(normal):
    model = ce.two_mass(outputs=("omega", "omega_load"), reciprocating_speed="measured")
    noise = ce.Noise(omega=0.1, omega_load=0.1)
    alone = fisher(model, PlannedExperiment(normal, outputs=("omega",)), noise=noise)
    both = fisher(model, PlannedExperiment(normal, outputs=("omega", "omega_load")), noise=noise)
    assert alone.n == 14_400
    assert both.n == 28_800
    assert both.relative["C_el"] < 0.5 * alone.relative["C_el"]


def test_missing_samples_tell_nothing():
    model, time = ce.one_inertia(), np.arange(100) * 0.02
    omega = 4 * (1 - np.exp(-time / 0.8))
    units = {"T": "N m", "omega": "rad/s"}
    data = ce.Experiment.from_arrays(
        "run", time=time, units=units, hold="zero", T=np.full(100, 2.0), omega=omega
    )
    early = fisher(model, data.masked("omega", time < 0.999), noise=NOISE)
    cut = fisher(model, data.between(0, 0.99), noise=NOISE)
    assert early.n == 50
    np.testing.assert_allclose(early.matrix, cut.matrix, rtol=1e-9)


def test_names_of_records_differ(normal):
    labels = [one.name for one in planned([normal, normal, PlannedExperiment(normal, "normal_1200rpm_2")])]
    assert labels == ["normal_1200rpm", "normal_1200rpm_2", "normal_1200rpm_2_2"]
    assert [one.name for one in planned({"a": normal, "b": PlannedExperiment(normal)})] == ["a", "b"]


def test_messages(normal):
    model = ce.two_mass()
    with pytest.raises(ExperimentError, match="`every` of a planned experiment is not acceptable; seen: 0"):
        PlannedExperiment(normal, every=0)
    with pytest.raises(ExperimentError, match="has no such output; seen: 'omega_load'; allowed: omega"):
        fisher(model, PlannedExperiment(normal, outputs=("omega_load",)), noise=NOISE)
    with pytest.raises(ExperimentError, match=r"no output is measured; seen: outputs=\(\)"):
        fisher(model, PlannedExperiment(normal, outputs=()), noise=NOISE)
    with pytest.raises(ExperimentError, match="the model two_mass has no such state; seen: 'omega'"):
        fisher(model, PlannedExperiment(normal, start={"omega": 1.0}), noise=NOISE)
    b = ce.Blueprint("runaway")
    k, x = b.parameter("k", 1.0), b.state("x")
    b.ode("x", k * x**3 + b.input("T"))
    b.output("x", x)
    data = ce.Experiment.from_arrays("run", time=[0.0, 1.0, 2.0, 3.0], units={"T": "1"}, T=[1.0] * 4)
    with pytest.raises(SimulationError, match="the simulation of run is not finite"):
        fisher(b.model(), PlannedExperiment(data, start={"x": 1e3}), noise=ce.Noise(x=0.1))

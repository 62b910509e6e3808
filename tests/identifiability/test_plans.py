"""Planned engine experiments against records of the independent simulator at the same operating points."""

import math
from pathlib import Path

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import ExperimentError
from casadi_engine.identifiability import fisher, plan
from casadi_engine.identifiability.fisher import Frame

DATA = Path(__file__).resolve().parents[2] / "data"
NOISE = ce.Noise(omega=0.1)
RPM = math.pi / 30


@pytest.fixture(scope="module")
def normal():
    return ce.read_experiment(DATA / "normal_1200rpm.csv.gz")


@pytest.fixture(scope="module")
def model():
    return ce.two_mass(reciprocating_speed="measured")


def simulated(model, planned, parameters=None):
    frame = Frame(model, parameters, (planned.name,))
    _, seen = frame.linearise(planned)
    start = dict(zip([state.name for state in model.states], seen.start.tolist(), strict=True))
    return ce.simulate(model, planned.experiment, parameters=frame.parameters, initial=start)["omega"].values


@pytest.mark.parametrize(
    ("options", "file", "within"),
    [
        ({"misfire": {2: "all"}}, "misfire_1200rpm", 0.05),
        ({"speed": 1400 * RPM}, "normal_1400rpm", 0.4),
        ({}, "normal_1200rpm", 0.03),
    ],
)
def test_the_errors_foreseen_are_those_of_the_record_that_was_made(model, normal, options, file, within):
    """Planned from the normal record at 1200 RPM alone.

    The others have a scatter of 2 % of their own, most of what excites the shaft without a misfire: over six seeds of
    it the simulator's records at 1400 RPM give K_el to 1.3 ... 2.2 %.
    """
    foreseen = fisher(model, plan(model, normal, **options), noise=NOISE)
    made = fisher(model, ce.read_experiment(DATA / f"{file}.csv.gz"), noise=NOISE)
    for name in made.free:
        assert foreseen.relative[name] == pytest.approx(made.relative[name], rel=within), name


@pytest.mark.parametrize(
    "options",
    [{}, {"speed": 1800 * RPM}, {"load": 90.0}, {"misfire": {3: "all"}}, {"speed": 1000 * RPM, "load": 30.0}],
)
@pytest.mark.parametrize("form", ["measured", "model"])
def test_the_combustion_balances_load_and_friction(normal, options, form):
    model = ce.two_mass(reciprocating_speed=form)
    there = plan(model, normal, duration=0.5, **options)
    if form == "measured":
        run = simulated(model, there)
        assert run.mean() == pytest.approx(options.get("speed", 1200 * RPM), rel=0.01)
    pressures = np.array([there.experiment[f"p{k}"].values for k in range(1, 5)])
    assert pressures.min() > 0
    assert 1.2e6 < pressures.max() < 6e6


def test_a_run_up_follows_its_speeds(model, normal):
    run = simulated(model, plan(model, normal, run_up=(1000 * RPM, 2000 * RPM), duration=2.0))
    time = np.linspace(0, 2, len(run))
    slope, middle = np.polyfit(time - 1, run, 1)
    assert slope == pytest.approx(500 * RPM, rel=0.03)
    assert middle == pytest.approx(1500 * RPM, rel=0.01)


def test_a_silent_cylinder_is_motored(model, normal):
    there = plan(model, normal, misfire={2: "all", 4: [3]}).experiment
    fired = plan(model, normal).experiment
    theta = there["theta"].values
    own = theta - 3 * math.pi  # cylinder 2 fires last
    near = np.abs(own - 4 * math.pi) < 2.0
    p = there["p2"].values[near]
    mirrored = np.interp(-(own[near] - 4 * math.pi), own[near] - 4 * math.pi, p)
    assert np.abs(p - mirrored).max() < 0.02 * p.max()
    assert p.max() < 0.7 * fired["p2"].values.max()
    fourth = theta - 2 * math.pi  # cycle 3 of cylinder 4: its TDC at 2 pi + 2*4 pi
    third = np.abs(fourth - 8 * math.pi) < 1.0
    second = np.abs(fourth - 4 * math.pi) < 1.0
    assert there["p4"].values[third].max() < 0.7 * there["p4"].values[second].max()


def test_a_load_step_is_there(model, normal):
    load = plan(model, normal, load=50.0, load_step=(0.4, 20.0)).experiment["T_load"]
    assert set(np.unique(load.values)) == {50.0, 70.0}
    assert load.values[load.time < 0.4].max() == 50.0


def test_a_crankshaft_can_be_planned(normal):
    model = ce.crankshaft(reciprocating_speed="measured", outputs=("omega", "omega_load"))
    record = ce.read_experiment(DATA / "crankshaft" / "normal_1200rpm.csv.gz")
    there = plan(model, record, speed=1400 * RPM, duration=0.4, outputs=["omega"], label="1400")
    assert there.name == "1400"
    assert there.outputs == ("omega",)
    assert simulated(model, there).mean() == pytest.approx(1400 * RPM, rel=0.01)


def test_messages(model, normal):
    with pytest.raises(ExperimentError, match="is not driven by crank angle, pressures and a load; seen: T"):
        plan(ce.one_inertia(), normal)
    with pytest.raises(ExperimentError, match="a plan has either a speed or a run-up"):
        plan(model, normal, speed=100.0, run_up=(100.0, 200.0))
    with pytest.raises(ExperimentError, match="a crank speed is not acceptable"):
        plan(model, normal, speed=-3.0)
    with pytest.raises(ExperimentError, match="the duration is not acceptable"):
        plan(model, normal, duration=0.01)
    with pytest.raises(ExperimentError, match="the load step is not acceptable"):
        plan(model, normal, load_step=(0.3, 20.0, 1.0))
    with pytest.raises(ExperimentError, match="the misfire is not acceptable; seen: 5"):
        plan(model, normal, misfire={5: "all"})
    with pytest.raises(ExperimentError, match="no cylinder is left that burns"):
        plan(model, normal, misfire=dict.fromkeys((1, 2, 3, 4), "all"))
    with pytest.raises(ExperimentError, match="no whole cycle of cylinder 1"):
        plan(model, normal.between(0, 0.09))
    with pytest.raises(ExperimentError, match="has no channel 'p3'"):
        plan(model, normal.without("p3"))


@pytest.mark.parametrize(
    ("options", "problem", "seen"),
    [
        ({"speed": 0}, "a crank speed is not acceptable", "0.0 to 0.0"),
        ({"speed": "fast"}, "the speed of a plan is not a number", "'fast'"),
        ({"load": "much"}, "the load of a plan is not a number", "'much'"),
        ({"duration": "long"}, "the duration of a plan is not a number", "'long'"),
        ({"run_up": 3}, "the run-up is not acceptable", "3"),
        ({"run_up": (100.0,)}, "the run-up is not acceptable", "(100.0,)"),
        ({"run_up": ("a", "b")}, "the run-up is not acceptable", "('a', 'b')"),
        ({"load_step": 3}, "the load step is not acceptable", "3"),
        ({"load_step": (0.1, math.nan)}, "the load step is not acceptable", "(0.1, nan)"),
        ({"load_step": (99.0, 3.0)}, "the load step is not within the plan", "99 s"),
        ({"misfire": 3}, "the misfire is not acceptable", "3"),
        ({"misfire": {2: 3}}, "the misfire is not acceptable", "2: 3"),
        ({"misfire": {2: []}}, "the misfire is not acceptable", "2: []"),
        ({"misfire": {2: [1.5]}}, "the misfire is not acceptable", "2: [1.5]"),
        ({"misfire": {2: [99]}}, "the misfire is of a cycle that the plan does not hold", "2: [99]"),
        ({"outputs": 3}, "the outputs of a plan are not acceptable", "3"),
        ({"outputs": []}, "the outputs of a plan are not acceptable", "[]"),
        ({"outputs": "omega"}, "the outputs of a plan are not acceptable", "'omega'"),
        ({"outputs": ["twist"]}, "the outputs of a plan are not acceptable", "['twist']"),
        ({"parameters": 3}, "the parameters are not a parameter set", "int"),
    ],
)
def test_a_plan_that_cannot_be_is_refused(model, normal, options, problem, seen):
    with pytest.raises(ExperimentError) as caught:
        plan(model, normal.between(0, 0.4), **options)
    assert problem in str(caught.value)
    assert caught.value.seen.startswith(seen)
    assert caught.value.cure


def test_a_plan_of_something_else_is_refused(model, normal):
    with pytest.raises(ExperimentError, match="the model of a plan is not acceptable; seen: 3"):
        plan(3, normal)
    with pytest.raises(ExperimentError, match="the record of a plan is not acceptable; seen: 3"):
        plan(model, 3)

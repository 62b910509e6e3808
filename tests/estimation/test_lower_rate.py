"""Searching on records of a lower rate: the same answer as on the whole data, and the loss is computed."""

import sys

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.errors import EstimationError, SimulationError
from casadi_engine.estimation.loss import read_loss
from casadi_engine.estimation.lower_rate import (
    LOST,
    lost_information,
    lower_rate,
    unsuitable_record,
    whole_slopes,
)
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.two_stages import lower_search, on_whole_data
from casadi_engine.simulation.grid import lay_grid

STEP, SAMPLES, SIGMA = 1e-3, 10_001, 0.02
TRUTH = {"c": 0.8, "k": 60.0, "k3": 30.0}


def _drive(time):
    return 15 * np.sin(2 * np.pi * 0.7 * time) + 12 * np.sin(2 * np.pi * 1.6 * time + 1)


def _model():
    b = ce.Blueprint("hardening_spring")
    c, k, k3 = (b.parameter(name, 0.7 * value, min=0.01) for name, value in TRUTH.items())
    x, v, u = b.state("x", scale=1.0), b.state("v", scale=5.0), b.input("u")
    b.ode("x", v)
    b.ode("v", u - c * v - k * x - k3 * x**3)
    b.output("y", x)
    return b.model()


@pytest.fixture(scope="module")
def record():
    """Simulated by SciPy, the drive being the straight lines between its samples."""
    time = np.arange(SAMPLES) * STEP
    u = _drive(time)

    def slope(t, s):
        force = np.interp(t, time, u)
        return [s[1], force - TRUTH["c"] * s[1] - TRUTH["k"] * s[0] - TRUTH["k3"] * s[0] ** 3]

    run = solve_ivp(slope, (0, time[-1]), [0.1, 0.0], t_eval=time, rtol=1e-9, atol=1e-11, max_step=0.01)
    noise = SIGMA * np.random.default_rng(3).standard_normal(SAMPLES)
    return ce.Experiment.from_arrays("spring", time=time, units={"u": "1", "y": "1"}, u=u, y=run.y[0] + noise)


def _fit(record, **options):
    given = {"noise": ce.Noise(y=SIGMA), "progress": False, "starts": 2, **options}
    return ce.estimate(_model(), record, **given)


ARGUMENTS = {
    "noise": ce.Noise(y=SIGMA), "interval": "auto", "initial": None, "loss": read_loss("square"),
    "ties": "substitute", "method": "exact", "max_iterations": 50, "tolerance": 1e-9, "warm": None,
}  # fmt: skip


def _search(record, model=None, **options):
    model = model or _model()
    return Search(model, (record,), model.parameters(), **{**ARGUMENTS, "progress": None, **options})


@pytest.fixture(scope="module")
def short(record):
    """The fit from two starts, searched on records of a lower rate."""
    return _fit(record)


def test_the_answer_is_that_of_a_search_on_the_whole_data(record, short, monkeypatch):
    monkeypatch.setattr(sys.modules["casadi_engine.estimation.estimate"], "lower_rate", lambda _: "asked")
    whole = _fit(record)
    assert short.options["searched on"].startswith("records of a rate ")
    assert whole.options["searched on"] == "all samples: asked"
    assert short.converged
    assert short.n == whole.n == SAMPLES
    for name, value in TRUTH.items():
        error = whole.estimates[name].stderr
        assert abs(short.values[name] - whole.values[name]) < 0.01 * error
        assert short.estimates[name].stderr == pytest.approx(error, rel=1e-4)
        assert abs(short.values[name] - value) < 4 * error


def test_one_search_is_made_on_all_samples(record):
    fit = _fit(record, starts=1)
    assert fit.options["searched on"] == "all samples: one search is as fast on them"


@pytest.mark.slow
def test_several_starts_end_where_they_end_on_the_whole_data(record):
    fit = _fit(record, starts=3)
    assert sum(optimum.starts for optimum in fit.optima) == 3
    assert fit.optima[0].status == "converged"
    assert fit.cost == pytest.approx(SAMPLES, rel=0.05)


@pytest.mark.slow
def test_the_first_states_that_are_given_hold_where_the_record_begins(record):
    fit = _fit(record, initial={"x": 0.1, "v": 0.0})
    assert fit.options["searched on"].startswith("records of a rate ")
    assert fit.initial["spring"]["x"].value == 0.1
    for name, value in TRUTH.items():
        assert abs(fit.values[name] - value) < 4 * fit.estimates[name].stderr


def test_what_is_lost_is_that_of_the_information_of_both_searches(record, short):
    """Against the covariances that fits of the whole record and of the thinned one report."""
    search = _search(record)
    lower = lower_rate(search)
    assert lower.lost <= LOST
    whole = short  # whose errors are of the whole data
    thin = ce.estimate(_model(), lower.data[0], noise=lower.noise, progress=False)
    ends = 1 - thin.n * lower.factor / SAMPLES
    ratio = [thin.estimates[name].stderr / whole.estimates[name].stderr for name in TRUTH]
    assert max(ratio) ** 2 - 1 < lower.lost + 3 * ends
    assert min(ratio) ** 2 - 1 > -0.02


def test_a_rate_too_low_for_the_motion_loses_information(record):
    search = _search(record)
    point = search.problem.at(search.first_point())
    (lay,) = search.problem.layouts
    slopes = [whole_slopes(search.records[0], point.records[0], lay.m)]
    lost = [lost_information(search, slopes, factor) for factor in (24, 96, 240)]
    assert lost[0] < 1e-3 < lost[1] < lost[2]


def _without(record, index):
    mask = np.ones(SAMPLES, dtype=bool)
    mask[index] = False
    return record.masked("y", mask)


def _linear():
    b = ce.Blueprint("line")
    k = b.parameter("k", 1.0, min=0.01)
    x, u = b.state("x"), b.input("u")
    b.ode("x", u - k * x)
    b.output("y", x)
    return b.model()


def _switching():
    b = ce.Blueprint("relay")
    k = b.parameter("k", 1.0, min=0.01)
    x, u = b.state("x"), b.input("u")
    b.ode("x", u - k * ca.sign(x))
    b.output("y", x)
    return b.model()


@pytest.mark.parametrize(
    ("change", "options", "why"),
    [
        (lambda r: _without(r, 4000), {}, "samples are missing"),
        (lambda r: r.between(0.0, 2.0), {}, "the records are short"),
        (lambda r: r.resample(y=5), {}, "the channels were not sampled together at equal steps"),
        (None, {"interval": 50}, "a shooting interval was given"),
        (None, {"loss": read_loss("huber")}, "the loss is robust"),
        (None, {"model": _linear()}, "a linear model is as fast"),
    ],
)
def test_a_search_on_the_whole_data_says_why(record, change, options, why):
    assert lower_rate(_search(change(record) if change else record, **options)) == why


def test_equations_that_jump_with_their_states_meet_every_sample(record):
    short = record.between(0.0, 0.5)
    search = _search(short, _switching())
    (term,) = search.records
    assert unsuitable_record(search.model, term.grid, short) == "the equations jump with their states"


def test_a_model_that_takes_the_square_of_a_fast_input_is_searched_on_all_samples():
    """Its mean square passes no filter."""
    b = ce.Blueprint("heated")
    a, k = b.parameter("a", 1.0, min=0.01), b.parameter("k", 1.0)
    n = b.parameter("n", 0.1, min=0)
    x, u = b.state("x"), b.input("u")
    b.ode("x", k * u**2 - a * x - n * x**3)
    b.output("y", x)
    time = np.arange(4000) / 1000
    current = (1 + np.sin(1.1 * time)) * np.sin(2 * np.pi * 230 * time)

    def slope(t, s):
        return 3 * np.interp(t, time, current) ** 2 - 2 * s - 0.3 * s**3

    run = solve_ivp(slope, (0, time[-1]), [0.5], t_eval=time, rtol=1e-6, atol=1e-8, max_step=1e-3)
    y = run.y[0] + 0.01 * np.random.default_rng(0).standard_normal(4000)
    data = ce.Experiment.from_arrays("r", time=time, units={"u": "1", "y": "1"}, u=current, y=y)
    fit = ce.estimate(b.model(), data, starts=2, progress=False)
    assert fit.options["searched on"] == "all samples: y depends on what a filter would take from the inputs"
    assert abs(fit.values["k"] - 3) < 4 * fit.stderr["k"]


def test_a_record_of_a_lower_rate_that_was_cut_is_refused(record):
    thin = lower_rate(_search(record)).data[0]
    with pytest.raises(SimulationError, match="cut or resampled after it was made") as told:
        lay_grid(_model(), thin.between(1.0, 5.0))
    assert "cut the whole record" in str(told.value)


def test_a_first_stage_that_ends_where_the_model_fails_is_left(record, monkeypatch):
    search = _search(record)
    first = lower_search(
        search, ARGUMENTS | {"model": search.model, "parameters": search.parameters}, lower_rate(search), None
    )
    attempt, run, starts = first.run(first.pmap.start), search.run, []

    def failing(z, *, first=True):
        starts.append((z, first))
        if first:
            raise EstimationError("it cannot be evaluated", cure="none")
        return run(z, first=False)

    monkeypatch.setattr(search, "run", failing)
    (found,) = on_whole_data(search, first, [attempt])
    assert [first for _, first in starts] == [True, False]
    assert np.array_equal(starts[1][0], attempt.start)
    assert found.solution.status == "converged"


def test_a_fit_that_ends_where_nothing_can_be_evaluated_says_so(record, monkeypatch):
    def fails(*_):
        raise FloatingPointError("the state is not finite")

    monkeypatch.setattr(sys.modules["casadi_engine.estimation.answer"], "uncertainty", fails)
    with pytest.raises(EstimationError, match="cannot be evaluated where the search ended") as told:
        _fit(record.between(0.0, 0.5), starts=1)
    assert "give other start values" in str(told.value)


def test_a_record_of_a_lower_rate_is_not_thinned_again(record):
    thin = lower_rate(_search(record)).data[0]
    assert lower_rate(_search(thin)) == "the records are of a lower rate"

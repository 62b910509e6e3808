"""Fits that begin in the frequency domain: which ones, their answer, what they say, and how they end early."""

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.single_shots import SingleShots
from casadi_engine.estimation.spectral_start import SpectralStarts

NOISE = ce.Noise(omega=0.05)
SEARCHED = "searched on"


@pytest.fixture
def in_full_alone(monkeypatch):
    """Make the frequency domain lead nowhere."""
    return lambda: monkeypatch.setattr(SpectralStarts, "search", lambda *_, **__: None)


def fitted(data, model=None, **options):
    return ce.estimate(model or ce.one_inertia(), data, **{"noise": NOISE, "progress": False, **options})


# ---- the answer is that of all samples


@pytest.mark.parametrize(
    "options", [{}, {"noise": None}, {"method": "euler"}, {"interval": "single"}, {"starts": 3}]
)
def test_the_answer_is_that_of_a_search_on_all_samples(run_up, in_full_alone, options):
    data = run_up()
    fit = fitted(data, **options)
    assert "frequency bins" in fit.options[SEARCHED]
    in_full_alone()
    whole = fitted(data, **options)
    assert whole.options[SEARCHED].startswith("all samples")
    assert fit.status == whole.status == "converged"
    for name, error in fit.stderr.items():
        assert abs(fit.values[name] - whole.values[name]) < 1e-3 * error
        assert error == pytest.approx(whole.stderr[name], rel=1e-4)
    assert fit.cost == pytest.approx(whole.cost, rel=1e-8)
    assert fit.optima[0].starts == whole.optima[0].starts == options.get("starts", 1)


def test_two_outputs_of_unknown_levels_and_priors(shaft, shaft_model, in_full_alone):
    model, data = shaft_model(), shaft().data
    pars = model.parameters()
    pars["K_el"].prior = (pars["K_el"].value * 1.1, pars["K_el"].value * 0.05)
    fit = fitted(data, model, parameters=pars, noise=None)
    assert "frequency bins" in fit.options[SEARCHED]
    in_full_alone()
    whole = fitted(data, model, parameters=pars, noise=None)
    for name, (level, _) in fit.noise.items():
        assert level == pytest.approx(whole.noise[name][0], rel=1e-6)
    np.testing.assert_allclose(fit.z, whole.z, rtol=1e-5)


def test_records_of_different_lengths_and_parameters_of_their_own(run_up, in_full_alone):
    data = [run_up("one", n=300), run_up("two", n=401, seed=1, C=0.6)]
    pars = ce.one_inertia().parameters()
    pars.vary_by_experiment("C_eng")
    fit = fitted(data, parameters=pars)
    in_full_alone()
    whole = fitted(data, parameters=pars)
    np.testing.assert_allclose(fit.z, whole.z, rtol=1e-5)
    assert "frequency bins" in fit.options[SEARCHED]


def test_bounds_hold(run_up, in_full_alone):
    pars = ce.one_inertia().parameters()
    pars["C_eng"].set(0.3, min=0.1, max=0.45)  # the record's is 0.5
    fit = fitted(run_up(), parameters=pars)
    assert fit.estimates["C_eng"].at_bound == "max"
    assert "frequency bins" in fit.options[SEARCHED]
    in_full_alone()
    whole = fitted(run_up(), parameters=pars)
    assert fit.values["J_eng"] == pytest.approx(whole.values["J_eng"], rel=1e-6)


@pytest.mark.slow  # test_batch.py has starts in processes
def test_several_starts_agree_with_those_in_processes(run_up):
    one, two = (fitted(run_up(), starts=4, neighbours=1, jobs=jobs) for jobs in (1, 2))
    np.testing.assert_allclose(one.z, two.z, rtol=1e-12)
    assert [o.starts for o in one.optima] == [o.starts for o in two.optima] == [6]


# ---- what is searched in full, and why


def nonlinear():
    b = ce.Blueprint("bent")
    a, x, u = b.parameter("a", 1.0, min=0), b.state("x"), b.input("T")
    b.ode("x", -a * ca.tanh(x) + u)
    b.output("omega", x)
    return b.model()


def test_reasons_for_all_samples(run_up):
    data, gappy = run_up(), run_up(missing=0.05)
    constrained = ce.one_inertia().parameters()
    constrained.constrain("J_eng + C_eng", max=0.3)
    loose, equal = ce.one_inertia().parameters(), ce.one_inertia().parameters()
    loose.constrain("J_eng + C_eng", max=5.0)
    equal.constrain("C_eng", 0.2, 0.2)
    fixed = ce.one_inertia().parameters()
    for name in ("J_eng", "C_eng"):
        fixed.fix(name)
    cases = [
        (data, {"loss": "huber"}, "the loss is robust"),
        (data, {"parameters": fixed}, "no parameter is free"),
        (data, {"parameters": constrained}, "constraints hold the parameters"),
        (data, {"parameters": equal}, "constraints hold the parameters"),
        (data, {"noise": ce.Noise(omega=0.05, gain=[[0.2]])}, "a predictor corrects the states"),
        (data, {"initial": {"omega_eng": 20.0}}, "initial states are given, or have bounds"),
        (gappy, {}, "run_up lacks samples of an output"),
        (data, {"warm": fitted(data)}, "it starts at an optimum"),
        (data, {"model": nonlinear()}, "one search is as fast on them"),
    ]
    for record, options, why in cases:
        assert fitted(record, **options).options[SEARCHED] == f"all samples: {why}"
    # what no constraint holds at the optimum is found where it is without
    assert "frequency bins" in fitted(data, parameters=loose).options[SEARCHED]


def test_a_start_without_slopes_is_searched_in_full():
    b = ce.Blueprint("square")
    p, x, u = b.parameter("p", 0.0), b.state("x"), b.input("u")
    b.ode("x", -x + p**2 * u)
    b.output("y", x)
    time, rng = np.arange(200) * 0.05, np.random.default_rng(0)
    u = rng.standard_normal(200)
    data = ce.Experiment.from_arrays(
        "r", time=time, units={"u": "1", "y": "1"}, u=u, y=rng.standard_normal(200)
    )
    fit = ce.estimate(b.model(), data, noise=ce.Noise(y=1.0), progress=False, max_iterations=5)
    assert fit.options[SEARCHED] == "all samples: the frequency domain led nowhere"


def test_an_optimum_there_that_leads_nowhere_on_all_samples(run_up, monkeypatch):
    """The best of several starts is finished on all samples; where that fails it is searched anew."""
    data = run_up()
    whole = fitted(data, starts=3)
    monkeypatch.setattr(Search, "_on_all_samples", lambda *_: (None, ""))
    again = fitted(data, starts=3)
    assert again.status == "converged"
    for name, error in whole.stderr.items():
        assert abs(again.values[name] - whole.values[name]) < 1e-3 * error


# ---- what it says, and early ends


def test_it_says_what_was_searched_on_and_that_is_kept(run_up, tmp_path):
    fit = fitted(run_up())
    said = fit.options[SEARCHED]
    kept, bins = (int(word) for word in (said.split()[0], said.split()[2]))
    assert (0 < kept <= bins == 200) or said.startswith("all 200")
    moved = float(said.split("moved the estimates by ")[1].split()[0])
    assert moved < 0.01


@pytest.mark.parametrize("most", [1, 2, 3])
def test_iterations_that_run_out(run_up, most):
    fit = fitted(run_up(), max_iterations=most)
    assert fit.status == "not converged: the iterations ran out; allow more with max_iterations"
    assert fit.iterations <= most


def test_progress_may_end_it_at_any_point(run_up):
    whole = fitted(run_up())
    for last in range(whole.iterations):
        fit = fitted(run_up(), progress=lambda iteration, *_, last=last: iteration == last)
        assert fit.status == "interrupted"
        assert np.isfinite(fit.cost)


# ---- residuals of records simulated in one piece


def promised(shots, x):
    """The fall of the summed squares that one more Gauss-Newton step promises, and the squares."""
    residual, slopes = shots.evaluate(x)
    step = np.linalg.lstsq(slopes, -residual, rcond=None)[0]
    return -residual @ slopes @ step, residual @ residual


def flat(v):
    return 0.0, np.zeros(len(v)), np.zeros((len(v),) * 2), np.zeros((len(v),) * 2)


def test_single_shots_are_led_to_their_optimum(shaft, shaft_model):
    model, data = shaft_model(), [shaft("one").data, shaft("two", n=901, seed=1).data]
    shots = SingleShots(model, data, model.parameters(), ce.Noise(omega=0.05, omega_load=0.1))
    shots.weigh({"omega": 0.04, "omega_load": 0.2})
    z = {name: 1.2 * model.parameters()[name].value for name in shots.free}
    x = shots.start(z, {record.name: np.zeros(len(model.states)) for record in data})
    found = shots.nearer(x, flat)
    assert promised(shots, x)[0] > 100
    assert promised(shots, found)[0] < 1e-3
    assert promised(shots, found)[1] < promised(shots, x)[1]


def test_single_shots_of_other_models_stay_where_they_are():
    b = ce.Blueprint("root")
    k, x, u = b.parameter("k", 1.0, min=0), b.state("x"), b.input("u")
    b.ode("x", u - k * x**3)
    b.output("y", x)
    t = np.arange(100) * 0.01
    data = ce.Experiment.from_arrays("r", time=t, units={"u": "1", "y": "1"}, u=np.sin(t), y=t)
    shots = SingleShots(b.model(), [data], b.model().parameters(), ce.Noise(y=0.1))
    start = shots.start({"k": 1.0}, {"r": np.zeros(1)})
    assert shots.nearer(start, flat) is start

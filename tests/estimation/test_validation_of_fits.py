"""validate on a fit's own data, on fresh data, and of a model with given parameters."""

import numpy as np
import pytest

import casadi_engine as ce

TRUE = {"J_eng": 0.4, "C_eng": 0.5}


@pytest.fixture
def fit(run_up):
    return ce.estimate(ce.one_inertia(), run_up(), progress=False)


def test_its_own_data(fit):
    check = ce.validate(fit)
    assert check.fit is fit
    assert check.passed
    assert check.failed == ()
    found = check.records["run_up"]["omega"]
    residual = fit.traces["run_up"]["omega"].residual
    assert found.rmse == found.S2 == pytest.approx(np.sqrt(np.mean(residual**2)))
    assert pytest.approx(np.abs(residual).max()) == found.S1
    assert found.fit_percent == fit.fit_percent["run_up"]["omega"]
    assert set(found.cross) == {"T"}
    assert found.trace is fit.traces["run_up"]["omega"]


def test_fresh_data(fit, run_up):
    fresh = run_up("fresh", seed=5, start=50.0)
    check = ce.validate(fit, fresh)
    assert check.passed
    assert list(check.records) == ["fresh"]
    held = check.fit
    assert held.free == ()
    assert held.values == pytest.approx(fit.values)
    assert held.initial["fresh"]["omega_eng"].value == pytest.approx(50, abs=0.2)
    assert held.noise == {"omega": (pytest.approx(0.05, rel=0.15), True)}


def test_several_records(fit, run_up):
    check = ce.validate(fit, [run_up("a", seed=5), run_up("b", seed=6)])
    assert list(check.records) == ["a", "b"]
    assert check.passed


def test_a_predictor_stays_one(run_up):
    fit = ce.estimate(
        ce.one_inertia(), run_up(sigma=0.02), noise=ce.Noise(omega=0.03, gain=[[1.0]]), progress=False
    )
    check = ce.validate(fit, run_up("fresh", seed=5, sigma=0.02))
    found = check.records["fresh"]["omega"]
    assert found.fit_percent["prediction"] is not None
    assert found.trace.predicted is not None
    assert check.fit.noise["omega"] == (0.03, False)
    assert found.rmse == pytest.approx(np.sqrt(np.nanmean(found.trace.residual**2)))


def test_a_model_with_its_parameters(run_up):
    model = ce.one_inertia()
    pars = model.parameters()
    for name, value in TRUE.items():
        pars[name].set(value)
    good = ce.validate(model, run_up(), parameters=pars)
    assert good.passed
    bad = ce.validate(model, run_up())  # the defaults are another engine
    assert not bad.passed
    assert "run_up/omega/whiteness" in bad.failed
    assert bad.records["run_up"]["omega"].rmse > 10 * good.records["run_up"]["omega"].rmse


def test_other_parameters_than_the_fits(fit):
    pars = fit.parameters.copy()
    pars["J_eng"].set(0.6)
    check = ce.validate(fit, parameters=pars)
    assert not check.passed
    assert check.fit.values["J_eng"] == 0.6


def test_parameters_at_their_bounds_and_ties(run_up):
    model = ce.one_inertia()
    pars = model.parameters()
    pars.add("tau", 0.8, unit="s")
    pars.tie("J_eng", "tau*C_eng")
    fit = ce.estimate(model, run_up(), parameters=pars, progress=False)
    check = ce.validate(fit, run_up("fresh", seed=5))
    assert check.passed
    assert check.fit.values["J_eng"] == pytest.approx(fit.values["J_eng"])


def test_with_gaps_and_a_lower_rate(fit, run_up):
    data = run_up("fresh", seed=5, n=800, missing=0.1).resample(omega=2)
    check = ce.validate(fit, data)
    assert check.passed
    assert check.fit.n < 400


def test_a_parameter_of_each_experiment_is_found_on_a_record_of_another_name(run_up):
    model = ce.one_inertia()
    pars = model.parameters()
    pars.vary_by_experiment("C_eng")
    records = [run_up("a", C=0.4), run_up("b", C=0.6, seed=1)]
    fit = ce.estimate(model, records, parameters=pars, progress=False)
    own = ce.validate(fit)
    assert own.passed
    fresh = ce.validate(fit, run_up("c", C=0.5, seed=2))
    assert fresh.passed
    assert fresh.fit.values["C_eng@c"] == pytest.approx(0.5, abs=0.005)
    assert fresh.fit.values["J_eng"] == fit.values["J_eng"]


def test_no_data(refused):
    with refused(
        ce.errors.EstimationError,
        "there are no data to validate on",
        seen="data=None with a model",
        allowed="an experiment or several",
        cure="give validate(model, data, parameters=...)",
    ):
        ce.validate(ce.one_inertia())


@pytest.mark.parametrize("alpha", [0, 1, -0.1, 2, float("nan")])
def test_a_false_alarm_rate_that_is_none(fit, alpha):
    with pytest.raises(
        ce.CasadiEngineError, match=r"alpha is not acceptable; .* 0 and 1; do: give alpha=0.01"
    ):
        ce.validate(fit, alpha=alpha)


@pytest.mark.parametrize("given", [None, "result.json", {"parameters": {}}])
def test_what_is_no_fit(run_up, given):
    with pytest.raises(ce.errors.EstimationError, match="there is nothing to validate") as caught:
        ce.validate(given, run_up())
    assert "--from RESULT" in str(caught.value)

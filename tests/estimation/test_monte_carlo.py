"""Monte Carlo: its records are the model's, and the errors of a fit are those that it finds."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import EstimationError, SimulationError, StudyError
from casadi_engine.estimation.monte_carlo import monte_carlo, redrawn


@pytest.mark.parametrize("count", [4, pytest.param(120, marks=pytest.mark.slow)])
def test_errors_are_what_they_claim(run_up, count):
    fit = ce.estimate(
        ce.one_inertia(), run_up(n=200, missing=0.05), noise=ce.Noise(omega=0.05), progress=False
    )
    found = monte_carlo(fit, count=count, seed=1)
    assert found.names == fit.free
    assert found.converged.all()
    for k, name in enumerate(found.names):
        assert found.truth[k] == fit.values[name]
        assert found.claimed[name] == pytest.approx(fit.stderr[name], rel=0.05)
        off = found.values[:, k] - found.truth[k]
        assert found.rmse[name] == pytest.approx(np.sqrt(np.mean(off**2)))
        if count >= 120:  # shares to 2 %, spreads to 6.5 %
            assert 0.89 <= found.coverage[name] <= 0.99
            assert found.rmse[name] / found.claimed[name] == pytest.approx(1.0, abs=0.18)
    text = str(found)
    assert f"{count} of {count} fits converged" in text
    assert all(name in text for name in found.names)


def test_records_are_the_models_and_gaps_stay(run_up):
    data = run_up(missing=0.1)
    fit = ce.estimate(ce.one_inertia(), data, noise=ce.Noise(omega=0.05), progress=False)
    (again,) = redrawn(fit, np.random.default_rng(4))
    assert np.array_equal(again["T"].values, data["T"].values)
    assert np.array_equal(again["omega"].mask, data["omega"].mask)
    noise = (again["omega"].values - fit.traces["run_up"]["omega"].simulated)[again["omega"].mask]
    assert np.allclose(noise, 0.05 * np.random.default_rng(4).standard_normal(400)[data["omega"].mask])


def test_a_measured_speed_carries_its_noise_into_the_torque(misfire):
    """The residual at the truth is the noise, which it is only if the torque is made of the drawn speed."""
    model, data = ce.two_mass(reciprocating_speed="measured"), misfire(1, 2)
    fit = ce.estimate(model, data, noise=ce.Noise(omega=0.1), progress=False)
    (again,) = redrawn(fit, np.random.default_rng(0))
    start = dict(
        zip((state.name for state in model.states), fit.states_at_start[data.name].tolist(), strict=True)
    )
    run = ce.simulate(model, again, parameters=fit.values, initial=start)
    noise = 0.1 * np.random.default_rng(0).standard_normal(len(again["omega"].time))
    assert np.abs(again["omega"].values - run["omega"].values - noise).max() < 1e-8
    # the torque made of the old speed gives another one
    old = ce.simulate(model, data, parameters=fit.values, initial=start)
    assert np.abs(old["omega"].values - run["omega"].values).max() > 1e-4


def test_a_stopped_study_goes_on(run_up, tmp_path):
    fit = ce.estimate(ce.one_inertia(), run_up(n=120), noise=ce.Noise(omega="estimate"), progress=False)
    path, counts = tmp_path / "draws.jsonl", []
    some = monte_carlo(fit, count=3, checkpoint=path)
    more = monte_carlo(fit, count=5, checkpoint=path, watch=lambda *count: counts.append(count))
    assert counts[0] == (3, 5)
    assert np.array_equal(more.values[:3], some.values)
    assert np.array_equal(more.values, monte_carlo(fit, count=5).values)
    assert not np.array_equal(more.values, monte_carlo(fit, count=5, seed=1).values)


def test_a_parameter_on_its_bound_claims_no_error(run_up):
    parameters = ce.one_inertia().parameters()
    parameters["C_eng"].set(0.6, min=0.55)
    fit = ce.estimate(
        ce.one_inertia(), run_up(), parameters=parameters, noise=ce.Noise(omega=0.05), progress=False
    )
    found = monte_carlo(fit, count=3)
    assert np.isnan(found.stderr[:, found.names.index("C_eng")]).any() or (found.values > 0.55).all()


def test_fits_that_say_nothing_about_themselves_are_refused(run_up, refused, monkeypatch):
    model, data = ce.one_inertia(), run_up()
    short = ce.estimate(model, data, noise=ce.Noise(omega=0.05), max_iterations=1, progress=False)
    with refused(EstimationError, "a fit that converged", seen="not converged", cure="more iterations"):
        monte_carlo(short, count=2)
    predictor = ce.estimate(model, data, noise=ce.Noise(omega=0.05, gain=[[0.2]]), progress=False)
    with refused(EstimationError, "measurement noise alone", seen="stated", allowed="simulation error"):
        monte_carlo(predictor, count=2)
    fit = ce.estimate(model, data, noise=ce.Noise(omega=0.05), progress=False)
    with refused(EstimationError, "count is not acceptable", seen="0"):
        monte_carlo(fit, count=0)


def test_a_loop_that_does_not_settle_is_named(refused):
    b = ce.Blueprint("loop")
    k, x, y = b.parameter("k", 0.5, min=0, max=9), b.state("x"), b.input("y")
    b.ode("x", -k * x)
    b.output("y", x + 2.0 * y)
    time = 0.02 * np.arange(100)
    data = ce.Experiment.from_arrays("run", time=time, units={"y": "1"}, hold="zero", y=-np.exp(-time))
    fit = ce.estimate(b.model(), data, noise=ce.Noise(y=0.05), progress=False)
    with refused(SimulationError, "do not settle", seen="rounds", allowed="weakly", cure="another"):
        redrawn(fit, np.random.default_rng(0))


def test_what_monte_carlo_cannot_do_is_refused(run_up, refused):
    with refused(EstimationError, "Monte Carlo needs a fit", seen="3", allowed="a Fit", cure="ce.estimate"):
        monte_carlo(3, count=2)
    fit = ce.estimate(ce.one_inertia(), run_up(), noise=ce.Noise(omega=0.05), progress=False)
    with refused(EstimationError, "estimate has no such option", seen="'nois'", allowed="noise", cure="help"):
        monte_carlo(fit, count=2, nois=3)


def test_rows_made_with_other_priors_are_not_taken_up(run_up, refused, tmp_path):
    fit = ce.estimate(ce.one_inertia(), run_up(), noise=ce.Noise(omega=0.05), progress=False)
    pars = fit.parameters.copy()
    monte_carlo(fit, count=1, parameters=pars, checkpoint=tmp_path / "draws")
    pars["J_eng"].set(prior=(fit.values["J_eng"], 1e-6))
    with refused(StudyError, "belongs to another study", seen="", allowed="", cure="name another file"):
        monte_carlo(fit, count=1, parameters=pars, checkpoint=tmp_path / "draws")

"""Bounds, priors, per-experiment parameters and what the data do not determine, against closed forms."""

import re

import numpy as np
import pytest

import casadi_engine as ce

SIGMA = 0.1
KNOWN = ce.Noise(y=SIGMA)
REST = {"x": 0.0}


def fitted(model, data, parameters=None, **options):
    """With the errors of the curvature: constraints, bounds and priors here speak against the data."""
    options = {"noise": KNOWN, "initial": REST, "progress": False, "errors": "quadratic", **options}
    return ce.estimate(model, data, parameters=parameters, **options)


def regression(phi, y, sigma=SIGMA):
    information = phi.T @ phi / sigma**2
    return np.linalg.solve(information, phi.T @ y / sigma**2), np.linalg.inv(information)


def test_a_model_linear_in_its_parameters_is_a_regression(line, line_data):
    made = line_data()
    fit = fitted(line(), made.data)
    values, covariance = regression(made.phi, made.y)
    np.testing.assert_allclose(fit.z, values, rtol=1e-9)
    np.testing.assert_allclose(fit.covariance, covariance, rtol=1e-6)
    residual = made.y - made.phi @ values
    assert fit.cost == pytest.approx(float(residual @ residual) / SIGMA**2, rel=1e-9)
    assert (fit.n, fit.dof) == (200, 198)
    assert fit.initial["ramp"]["x"].fixed


def test_a_free_initial_state_is_one_more_column(line, line_data):
    made = line_data(start=3.0)
    fit = fitted(line(), made.data, initial=None)
    phi = np.column_stack([made.phi, np.ones(len(made.y))])
    values, covariance = regression(phi, made.y)
    first = fit.initial["ramp"]["x"]
    np.testing.assert_allclose([*fit.z, first.value], values, rtol=1e-9)
    np.testing.assert_allclose(fit.covariance, covariance[:2, :2], rtol=1e-6)
    assert first.stderr == pytest.approx(np.sqrt(covariance[2, 2]), rel=1e-6)
    assert fit.dof == 197


@pytest.mark.parametrize("estimated", [False, True])
def test_priors_give_the_posterior_of_the_linear_gaussian_problem(line, line_data, estimated):
    made = line_data()
    pars = line().parameters()
    pars["p1"].set(prior=(1.2, 0.02))
    pars["p2"].set(prior=(-1.0, 0.05))
    fit = fitted(line(), made.data, pars, noise=ce.Noise() if estimated else KNOWN)
    sigma = fit.noise["y"][0]
    precision = np.diag([1 / 0.02**2, 1 / 0.05**2])
    information = made.phi.T @ made.phi / sigma**2 + precision
    mean = np.linalg.solve(information, made.phi.T @ made.y / sigma**2 + precision @ [1.2, -1.0])
    np.testing.assert_allclose(fit.z, mean, rtol=1e-6)
    np.testing.assert_allclose(fit.covariance, np.linalg.inv(information), rtol=1e-5)
    residual = made.y - made.phi @ fit.z
    pull = float(np.sum(((fit.z - [1.2, -1.0]) / [0.02, 0.05]) ** 2))
    assert fit.cost == pytest.approx(float(residual @ residual) / sigma**2 + pull, rel=1e-6)
    if estimated:  # the level that it has to agree with is that of its own residuals
        assert sigma == pytest.approx(np.sqrt(residual @ residual / 198), rel=1e-5)


def test_a_prior_on_a_tied_parameter_acts_on_what_it_is_tied_to(line, line_data):
    made = line_data()
    pars = line().parameters()
    pars.add("sum", 1.0)
    pars.tie("sum", "p1 + p2")
    pars["sum"].set(prior=(0.5, 0.01))
    fit = fitted(line(), made.data, pars)
    row = np.array([1.0, 1.0])
    information = made.phi.T @ made.phi / SIGMA**2 + np.outer(row, row) / 0.01**2
    right = made.phi.T @ made.y / SIGMA**2 + row * 0.5 / 0.01**2
    np.testing.assert_allclose(fit.z, np.linalg.solve(information, right), rtol=1e-7)
    variance = row @ np.linalg.inv(information) @ row
    assert fit.stderr["sum"] == pytest.approx(np.sqrt(variance), rel=1e-6)


# ---- bounds


@pytest.mark.parametrize(
    ("name", "side", "bound"), [("p1", "max", 1.2), ("p1", "min", 1.9), ("p2", "min", 0.0)]
)
def test_at_a_bound_there_is_no_symmetric_error(line, line_data, name, side, bound):
    made = line_data()
    pars = line().parameters()
    pars["p1"].set(1.9 if side == "min" else 1.0)
    pars[name].set(**{side: bound, "value": bound})
    fit = fitted(line(), made.data, pars)
    other = {"p1": "p2", "p2": "p1"}[name]
    at, free = fit.estimates[name], fit.estimates[other]
    assert fit.status == "converged"
    assert (at.value, at.stderr, at.at_bound) == (bound, None, side)
    word = {"min": "lower", "max": "upper"}[side]
    assert at.why == f"at its {word} bound: there is no symmetric error"
    k = ("p1", "p2").index(other)
    column, held = made.phi[:, k], made.phi[:, 1 - k]
    alone = column @ (made.y - held * bound) / (column @ column)
    assert free.value == pytest.approx(alone, rel=1e-6)
    assert free.stderr == pytest.approx(SIGMA / np.linalg.norm(column), rel=1e-6)
    position = fit.free.index(name)
    assert not fit.covariance[position].any()
    assert fit.dof == 199
    assert f"at its {word} bound: no symmetric error" in str(fit)


def test_a_bound_that_is_met_with_almost_no_force_is_still_met(line, line_data):
    made = line_data()
    best = regression(made.phi, made.y)[0][0]
    pars = line().parameters()
    pars["p1"].set(1.0, max=float(best) - 1e-5)
    fit = fitted(line(), made.data, pars)
    assert fit.estimates["p1"].at_bound == "max"
    assert fit.values["p1"] == pytest.approx(best, abs=2e-5)


def test_a_bound_that_is_near_but_does_not_act_leaves_the_error(line, line_data):
    made = line_data()
    best, covariance = regression(made.phi, made.y)
    pars = line().parameters()
    pars["p1"].set(1.0, max=float(best[0]) + 1e-4)
    fit = fitted(line(), made.data, pars, errors="quadratic")
    assert fit.estimates["p1"].at_bound is False
    assert fit.values["p1"] == pytest.approx(best[0], rel=1e-6)
    assert fit.stderr["p1"] == pytest.approx(np.sqrt(covariance[0, 0]), rel=1e-5)


def test_a_bound_within_two_errors_ends_the_interval(line, line_data):
    """The interval by profile of a linear model is that of the regression, cut at the bound."""
    made = line_data()
    best, covariance = regression(made.phi, made.y)
    size = np.sqrt(covariance[0, 0])
    pars = line().parameters()
    pars["p1"].set(1.0, max=float(best[0]) + 0.5 * size)
    found = fitted(line(), made.data, pars, errors="checked").estimates["p1"]
    assert found.stderr is None
    assert found.quadratic == pytest.approx(size, rel=1e-5)
    assert found.interval == pytest.approx((best[0] - 1.96 * size, best[0] + 0.5 * size), abs=1e-3 * size)


def test_a_damper_that_would_be_negative_rests_on_zero(run_up):
    data = run_up(C=0.0, sigma=0.5, n=100, seed=2)
    pars = ce.one_inertia().parameters()
    free = pars.copy()
    free["C_eng"].set(min=-1)
    unbounded = ce.estimate(ce.one_inertia(), data, parameters=free, progress=False)
    assert unbounded.values["C_eng"] < 0
    fit = ce.estimate(ce.one_inertia(), data, parameters=pars, progress=False)
    assert fit.estimates["C_eng"].at_bound == "min"
    assert fit.values["C_eng"] == 0.0
    # the damper may be as large as the data allow, and a larger one makes the inertia smaller, never larger
    low, high = fit.estimates["J_eng"].interval
    free_error = unbounded.stderr["J_eng"]
    assert fit.values["J_eng"] - low > free_error > high - fit.values["J_eng"]
    assert low < 0.4 < high


# ---- per-experiment parameters


def test_a_parameter_of_each_experiment_and_a_common_one(line, line_data):
    a, b = line_data("a"), line_data("b", n=120, seed=1, p=(1.5, 0.9))
    pars = line().parameters()
    pars.vary_by_experiment("p2")
    fit = fitted(line(), [a.data, b.data], pars, initial={"a": REST, "b": REST})
    assert fit.free == ("p1", "p2@a", "p2@b")
    zero = np.zeros
    phi = np.block([[a.phi, zero((200, 1))], [b.phi[:, :1], zero((120, 1)), b.phi[:, 1:]]])
    values, covariance = regression(phi, np.concatenate([a.y, b.y]))
    np.testing.assert_allclose(fit.z, values, rtol=1e-8)
    np.testing.assert_allclose(fit.covariance, covariance, rtol=1e-6)
    assert set(fit.values) == {"p1", "p2@a", "p2@b"}
    assert fit.stderr["p2@b"] == pytest.approx(np.sqrt(covariance[2, 2]), rel=1e-6)


def test_records_of_one_name_are_told_apart(line, line_data):
    a, b = line_data("same"), line_data("same", seed=1)
    pars = line().parameters()
    pars.vary_by_experiment("p2")
    fit = fitted(line(), [a.data, b.data], pars)
    assert fit.free == ("p1", "p2@same", "p2@same_2")
    assert list(fit.traces) == ["same", "same_2"]


def test_a_prior_holds_for_the_parameter_of_every_experiment(line, line_data):
    a, b = line_data("a"), line_data("b", seed=1)
    pars = line().parameters()
    pars.vary_by_experiment("p2")
    pars["p2"].set(prior=(0.0, 0.01))
    fit = fitted(line(), [a.data, b.data], pars)
    assert -0.7 < fit.values["p2@a"] < 0
    assert fit.values["p2@a"] != fit.values["p2@b"]
    assert fit.stderr["p2@a"] < 0.01


# ---- not determined


def test_a_product_is_determined_but_not_its_factors(line, line_data):
    made = line_data(p=(1.5, 0.0))
    pars = line(product=True).parameters()
    pars.add("product", 1.0)
    pars.tie("product", "p1*p2")
    fit = fitted(line(product=True), made.data, pars)
    column = made.phi[:, 0]
    assert fit.status == "converged"
    assert fit.values["product"] == pytest.approx(column @ made.y / (column @ column), rel=1e-6)
    assert fit.stderr["product"] == pytest.approx(SIGMA / np.linalg.norm(column), rel=1e-6)
    for name in ("p1", "p2"):
        assert fit.stderr[name] is None
        assert fit.estimates[name].why == "the data do not determine it"
    (direction,) = fit.undetermined
    assert set(direction.weights) == {"p1", "p2"}
    assert np.isnan(fit.covariance).all()
    assert np.isnan(fit.correlation[0, 1])
    (message,) = fit.messages
    assert message.startswith("the data do not determine p1")
    assert "fix one of these" in message
    assert "Not determined by these data" in str(fit)
    assert fit.dof == 199


def test_a_parameter_without_effect_on_these_data_is_named(line, line_data):
    made = line_data(p=(1.5, 0.0))
    quiet = made.data.with_channel(
        ce.experiment.Channel("u2", "1", time=made.data["u2"].time, values=np.zeros(200), hold="zero")
    )
    fit = fitted(line(), quiet)
    (direction,) = fit.undetermined
    assert (direction.text, dict(direction.weights)) == ("p2", {"p2": 1.0})
    assert fit.estimates["p2"].why == "the data do not determine it"
    column = made.phi[:, 0]
    assert fit.stderr["p1"] == pytest.approx(SIGMA / np.linalg.norm(column), rel=1e-6)
    assert np.isnan(fit.covariance[1]).all()
    assert fit.covariance[0, 0] == pytest.approx(SIGMA**2 / (column @ column), rel=1e-6)


def test_a_prior_determines_what_the_data_do_not(line, line_data):
    made = line_data(p=(1.5, 0.0))
    pars = line(product=True).parameters()
    pars["p2"].set(2.0, prior=(2.0, 0.1))
    fit = fitted(line(product=True), made.data, pars)
    assert fit.undetermined == ()
    assert fit.values["p2"] == pytest.approx(2.0, rel=1e-5)
    assert fit.stderr["p2"] == pytest.approx(0.1, rel=1e-3)
    assert fit.correlation[0, 1] < -0.9


@pytest.mark.parametrize("off", [0.0, 6.0])
def test_a_prior_that_the_data_contradict_is_named(line, line_data, off):
    """``off`` standard errors, of both, from what the data say alone."""
    made = line_data()
    free = fitted(line(), made.data)
    own, sigma = free.stderr["p1"], 0.5 * free.stderr["p1"]
    pars = line().parameters()
    pars["p1"].set(prior=(free.values["p1"] + off * float(np.hypot(own, sigma)), sigma))
    said = [words for words in fitted(line(), made.data, pars).messages if "the prior of p1" in words]
    assert len(said) == (off > 4)
    assert all("are 6 standard errors apart" in words for words in said)


def test_an_initial_state_that_nothing_shows_is_named(run_up):
    # Two free inertias that are not coupled: the load's speed does not reach the measured one.
    b = ce.Blueprint("apart")
    je = b.parameter("J_eng", 0.5, unit="kg m2", min=1e-3)
    we, wl = b.state("omega_eng", unit="rad/s", scale=100), b.state("omega_load", unit="rad/s", scale=100)
    torque = b.input("T", unit="N m")
    b.ode("omega_eng", (torque - 0.5 * we) / je)
    b.ode("omega_load", -0.1 * wl)
    b.output("omega", we, unit="rad/s", scale=100)
    fit = ce.estimate(b.model(), run_up(), progress=False)
    first = fit.initial["run_up"]["omega_load"]
    assert (first.stderr, first.why) == (None, "the data do not determine it")
    assert fit.initial["run_up"]["omega_eng"].stderr > 0
    assert fit.stderr["J_eng"] > 0
    assert [direction.text for direction in fit.undetermined] == ["omega_load at the start"]


def test_a_parameter_that_runs_away_ends_as_a_number(run_up):
    # Without a torque the speed decays by itself in the data, which this model can only do with no inertia.
    b = ce.Blueprint("slow")
    je = b.parameter("J_eng", 0.5, unit="kg m2", min=1e-3)
    we = b.state("omega_eng", unit="rad/s", scale=20)
    torque = b.input("T", unit="N m")
    b.ode("omega_eng", -1e-6 * torque / je)
    b.output("omega", we, unit="rad/s", scale=20)
    fit = ce.estimate(b.model(), run_up(), progress=False, max_iterations=60)
    assert np.isfinite([e.value for e in fit.estimates.values()]).all()
    assert np.isfinite(fit.cost)


def test_a_residual_that_is_not_white_is_said_to_be(run_up):
    pars = ce.one_inertia().parameters()
    pars.fix("J_eng", 0.8)
    fit = ce.estimate(ce.one_inertia(), run_up(), parameters=pars, progress=False)
    (message,) = fit.messages
    assert message.startswith("the residual of run_up/omega is not white (neighbours correlate by 0.9")
    assert re.search(
        r"and the standard errors count with that: they are up to [\d.]+ times those of white noise; see validate$",
        message,
    )
    plain = ce.estimate(ce.one_inertia(), run_up(), parameters=pars, progress=False, errors="quadratic")
    assert plain.messages[0].endswith("and the standard errors are too small; see validate")
    assert fit.stderr["C_eng"] == pytest.approx(fit.own_noise["C_eng"] * plain.stderr["C_eng"])
    assert fit.own_noise["C_eng"] > 1.1
    assert plain.own_noise["C_eng"] == 1


def test_scales_of_torque_and_inertia_cannot_be_told_apart(run_up):
    b = ce.Blueprint("scaled")
    inertia = b.parameter("J_eng", 0.5, unit="kg m2", min=1e-3)
    damping = b.parameter("C_eng", 0.4, unit="N m s/rad", min=0)
    gain = b.parameter("T_scale", 1.2, min=0.1, max=10)
    speed = b.state("omega_eng", unit="rad/s", scale=20)
    torque = b.input("T", unit="N m", scale=10)
    b.ode("omega_eng", (gain * torque - damping * speed) / inertia)
    b.output("omega", speed, unit="rad/s", scale=20)
    fit = ce.estimate(b.model(), run_up(), progress=False)
    assert fit.status == "converged"
    (direction,) = fit.undetermined
    assert set(direction.weights) == {"J_eng", "C_eng", "T_scale"}
    assert np.sign([direction.weights[name] for name in fit.free]).tolist() in ([1, 1, 1], [-1, -1, -1])
    assert all(fit.stderr[name] is None for name in fit.free)
    assert fit.values["J_eng"] / fit.values["T_scale"] == pytest.approx(0.4, rel=0.05)
    numbers = [e.stderr for e in fit.estimates.values() if e.stderr is not None]
    assert all(0 < number < 1e6 for number in numbers)
    assert fit.initial["run_up"]["omega_eng"].stderr == pytest.approx(0.03, rel=0.8)


def test_nothing_free_but_the_initial_state(run_up):
    pars = ce.one_inertia().parameters()
    pars.fix("J_eng", 0.4)
    pars.fix("C_eng", 0.5)
    fit = ce.estimate(ce.one_inertia(), run_up(), parameters=pars, progress=False)
    assert (fit.status, fit.free, fit.covariance.shape) == ("converged", (), (0, 0))
    assert fit.initial["run_up"]["omega_eng"].value == pytest.approx(20, abs=0.1)
    assert fit.estimates["J_eng"].fixed
    assert (fit.stderr["J_eng"], fit.estimates["J_eng"].why) == (None, "fixed")
    assert fit.dof == 399


def test_nothing_free_at_all(line, line_data):
    made = line_data()
    pars = line().parameters()
    pars.fix("p1", 1.5)
    pars.fix("p2", -0.7)
    fit = fitted(line(), made.data, pars)
    assert fit.status == "converged"
    residual = made.y - made.phi @ [1.5, -0.7]
    assert fit.cost == pytest.approx(float(residual @ residual) / SIGMA**2, rel=1e-9)
    assert fit.dof == 200


def test_the_set_given_is_not_changed_and_that_of_the_fit_is_frozen(line, line_data):
    pars = line().parameters()
    before = pars.as_dict()
    fit = fitted(line(), line_data().data, pars)
    assert pars.as_dict() == before
    assert fit.parameters.as_dict() == pytest.approx(fit.values)
    with pytest.raises(ce.errors.ParameterError):
        fit.parameters["p1"].set(2.0)

"""One inertia against the closed-form least squares of the one-step predictor, (2.37)."""

import numpy as np
import pytest
from scipy import stats

import casadi_engine as ce

SIGMA = 0.05
PREDICTOR = ce.Noise(omega=SIGMA, gain=[[1.0]])


def closed_form(records, method):
    """J, C and their covariance from the linear regression of y(t) on y(t-1), T(t-1), adjacent pairs only."""
    rows, rights = [], []
    for record in records:
        y, torque = record["omega"].values, record["T"].values
        pair = np.isfinite(y[1:]) & np.isfinite(y[:-1])
        rows.append(np.column_stack([y[:-1], torque[:-1]])[pair])
        rights.append(y[1:][pair])
    matrix, right = np.vstack(rows), np.concatenate(rights)
    a, b = np.linalg.lstsq(matrix, right, rcond=None)[0]
    h = np.diff(records[0]["T"].time).mean()
    if method == "euler":  # a = 1 - h C/J, b = h/J
        inertia, damping = h / b, (1 - a) / b
        slope = np.array([[0, -h / b**2], [-1 / b, -(1 - a) / b**2]])
    else:  # a = exp(-h C/J), b = (1 - a)/C
        damping = (1 - a) / b
        inertia = -h * damping / np.log(a)
        by_a, by_b = -1 / b, -(1 - a) / b**2
        log = np.log(a)
        slope = np.array([[-h * by_a / log + h * damping / (a * log**2), -h * by_b / log], [by_a, by_b]])
    covariance = slope @ np.linalg.inv(matrix.T @ matrix) @ slope.T * SIGMA**2
    cost = float(np.sum((right - matrix @ [a, b]) ** 2) / SIGMA**2)
    return np.array([inertia, damping]), covariance, cost, len(right)


def compare(fit, records, method, tolerance):
    values, covariance, cost, pairs = closed_form(records, method)
    assert fit.status == "converged"
    np.testing.assert_allclose([fit.values["J_eng"], fit.values["C_eng"]], values, rtol=tolerance)
    np.testing.assert_allclose(
        [fit.stderr["J_eng"], fit.stderr["C_eng"]], np.sqrt(np.diag(covariance)), rtol=0.01
    )
    wanted = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
    assert fit.correlation[0, 1] == pytest.approx(wanted, abs=0.01)
    assert fit.cost == pytest.approx(cost, rel=1e-9)
    return pairs


@pytest.mark.parametrize(("method", "tolerance"), [("euler", 1e-8), ("exact", 1e-6)])
@pytest.mark.parametrize("interval", ["auto", "single", 1, 7])
def test_one_record_is_the_closed_form(run_up, method, tolerance, interval):
    data = run_up(sigma=SIGMA, euler=method == "euler")
    fit = ce.estimate(
        ce.one_inertia(), data, noise=PREDICTOR, method=method, interval=interval, progress=False,
        errors="quadratic",
    )  # fmt: skip
    compare(fit, [data], method, tolerance)


@pytest.mark.parametrize(("method", "tolerance"), [("euler", 1e-8), ("exact", 1e-6)])
def test_two_records_jointly(run_up, method, tolerance):
    data = [run_up("slow", sigma=SIGMA), run_up("fast", n=250, seed=3, start=60.0, sigma=SIGMA)]
    fit = ce.estimate(
        ce.one_inertia(), data, noise=PREDICTOR, method=method, progress=False, errors="quadratic"
    )
    compare(fit, data, method, tolerance)


@pytest.mark.parametrize(("method", "tolerance"), [("euler", 1e-8), ("exact", 1e-6)])
@pytest.mark.parametrize("interval", ["auto", "single", 1, 7])
def test_a_fifth_of_the_samples_missing(run_up, method, tolerance, interval):
    data = run_up(n=600, sigma=SIGMA, missing=0.2)
    fit = ce.estimate(
        ce.one_inertia(), data, noise=PREDICTOR, method=method, interval=interval, progress=False,
        errors="quadratic",
    )  # fmt: skip
    compare(fit, [data], method, tolerance)


def test_missing_samples_in_two_records(run_up):
    data = [run_up("a", missing=0.2, sigma=SIGMA), run_up("b", n=300, seed=2, missing=0.2, sigma=SIGMA)]
    fit = ce.estimate(ce.one_inertia(), data, noise=PREDICTOR, progress=False, errors="quadratic")
    compare(fit, data, "exact", 1e-6)


def test_the_estimated_noise_level_is_that_of_the_regression(run_up):
    data = run_up(sigma=SIGMA)
    known = ce.estimate(ce.one_inertia(), data, noise=PREDICTOR, progress=False, errors="quadratic")
    fit = ce.estimate(
        ce.one_inertia(), data, noise=ce.Noise(gain=[[1.0]]), progress=False, errors="quadratic"
    )
    _, _, cost, pairs = closed_form([data], "exact")
    assert fit.noise["omega"] == (pytest.approx(SIGMA * np.sqrt(cost / (pairs - 2)), rel=1e-9), True)
    ratio = fit.noise["omega"][0] / SIGMA
    for name in ("J_eng", "C_eng"):
        assert fit.values[name] == pytest.approx(known.values[name], rel=1e-9)
        assert fit.stderr[name] == pytest.approx(known.stderr[name] * ratio, rel=1e-6)


def test_output_error_is_another_estimate_than_the_predictor(run_up):
    # The regressor of the predictor is noisy, so that its estimate is biased; output error is not.
    data = run_up(n=2000, sigma=0.5)
    predictor = ce.estimate(ce.one_inertia(), data, noise=ce.Noise(omega=0.5, gain=[[1.0]]), progress=False)
    output = ce.estimate(ce.one_inertia(), data, noise=ce.Noise(omega=0.5), progress=False)
    assert abs(predictor.values["C_eng"] - 0.5) > 4 * output.stderr["C_eng"]
    for name, truth in (("J_eng", 0.4), ("C_eng", 0.5)):
        assert abs(output.values[name] - truth) < 4 * output.stderr[name]


def test_both_fit_percentages_are_given_and_labelled(run_up):
    data = run_up()
    fit = ce.estimate(ce.one_inertia(), data, noise=PREDICTOR, progress=False)
    found = fit.fit_percent["run_up"]["omega"]
    assert set(found) == {"simulation", "prediction"}
    trace = fit.traces["run_up"]["omega"]
    y = trace.measured
    a = np.exp(-0.02 * fit.values["C_eng"] / fit.values["J_eng"])
    step = a * y[:-1] + (1 - a) / fit.values["C_eng"] * data["T"].values[:-1]
    np.testing.assert_allclose(trace.predicted[1:], step, rtol=1e-9)
    simulated = [fit.initial["run_up"]["omega_eng"].value]
    for torque in data["T"].values[:-1]:
        simulated.append(a * simulated[-1] + (1 - a) / fit.values["C_eng"] * torque)
    np.testing.assert_allclose(trace.simulated, simulated, rtol=1e-9)
    whole = 100 * (1 - np.linalg.norm(y - trace.simulated) / np.linalg.norm(y - y.mean()))
    assert found["simulation"] == pytest.approx(whole)
    plain = ce.estimate(ce.one_inertia(), data, noise=ce.Noise(omega=SIGMA), progress=False)
    assert plain.fit_percent["run_up"]["omega"]["prediction"] is None
    assert plain.traces["run_up"]["omega"].predicted is None


@pytest.mark.parametrize("fits", [12, pytest.param(200, marks=pytest.mark.slow)])
def test_errors_of_many_fits_are_what_the_covariance_says(run_up, fits):
    model, noise = ce.one_inertia(), ce.Noise(omega=0.2)
    chi2, sizes = 0.0, []
    for seed in range(fits):
        # the same input in all fits: the sum is chi-squared with two degrees of freedom for each
        quiet = run_up(n=200, sigma=0.0)
        y = quiet["omega"].values + 0.2 * np.random.default_rng(seed).standard_normal(200)
        units = {"T": "N m", "omega": "rad/s"}
        data = ce.Experiment.from_arrays(
            "mc", time=quiet["T"].time, units=units, hold="zero", T=quiet["T"].values, omega=y
        )
        fit = ce.estimate(model, data, noise=noise, progress=False)
        error = np.array([fit.values["J_eng"] - 0.4, fit.values["C_eng"] - 0.5])
        chi2 += error @ np.linalg.solve(fit.covariance, error)
        first = fit.initial["mc"]["omega_eng"]
        sizes.append(
            [*(error / [fit.stderr["J_eng"], fit.stderr["C_eng"]]), (first.value - 20) / first.stderr]
        )
    assert 0.001 < stats.chi2.sf(chi2, 2 * fits) < 0.999
    assert np.abs(sizes).max() < 4.5
    for column in np.square(sizes).sum(axis=0):
        assert 0.001 < stats.chi2.sf(column, fits) < 0.999

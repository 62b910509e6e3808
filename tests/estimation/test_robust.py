"""Huber's loss: outliers, the sandwich error, and the loss function itself."""

import re

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.estimation.levels import _robust
from casadi_engine.estimation.loss import Loss, read_loss
from casadi_engine.estimation.standard_errors import efficiency

TRUTH = {"J_eng": 0.4, "C_eng": 0.5}


@pytest.fixture
def fixed_input(run_up):
    """Records with the input and outliers of one kind, the noise by seed."""
    quiet = run_up(n=300, sigma=0.0)

    def make(seed, outliers=0.05):
        rng = np.random.default_rng(seed)
        noise = 0.1 * rng.standard_normal(300)
        hit = rng.random(300) < outliers
        noise[hit] = 2.0 * rng.standard_normal(int(hit.sum()))
        units = {"T": "N m", "omega": "rad/s"}
        return ce.Experiment.from_arrays(
            "hit", time=quiet["T"].time, units=units, hold="zero", T=quiet["T"].values,
            omega=quiet["omega"].values + noise,
        )  # fmt: skip

    return make


def test_outliers_hurt_least_squares_and_not_huber(fixed_input):
    errors = {"square": [], "huber": []}
    for seed in range(6):
        for loss, found in errors.items():
            fit = ce.estimate(
                ce.one_inertia(), fixed_input(seed), loss=loss, noise=ce.Noise(omega=0.1), progress=False
            )
            assert fit.status == "converged"
            found.append([fit.values[name] - value for name, value in TRUTH.items()])
    ratio = np.std(errors["square"], axis=0) / np.std(errors["huber"], axis=0)
    assert (ratio > 2).all()


def test_how_many_samples_are_bounded_is_printed(fixed_input):
    """One sample of 500 K among 200 made chi2/N 148, and nothing was said of it."""
    noise = ce.Noise(omega=0.1)
    wild, calm = (
        " ".join(str(ce.estimate(ce.one_inertia(), data, loss="huber", noise=noise, progress=False)).split())
        for data in (fixed_input(1), fixed_input(1, 0.0))
    )
    assert re.search(
        r"\(\d+ of 300 samples are beyond 1.34 sigma .* squares, \d+ of them beyond 5 sigma\)", wild
    )
    assert re.search(r"\(\d+ of 300 samples are beyond 1.34 sigma and count less than their squares\)", calm)


def test_without_outliers_huber_loses_five_percent(fixed_input):
    square, huber = (
        ce.estimate(
            ce.one_inertia(), fixed_input(3, 0.0), loss=loss, noise=ce.Noise(omega=0.1), progress=False
        )
        for loss in ("square", "huber")
    )
    for name in TRUTH:
        assert abs(huber.values[name] - square.values[name]) < square.stderr[name]
        assert huber.stderr[name] == pytest.approx(square.stderr[name] / np.sqrt(0.95), rel=0.08)


def test_a_knee_beyond_all_residuals_is_least_squares(run_up):
    fits = [
        ce.estimate(ce.one_inertia(), run_up(), loss=loss, noise=ce.Noise(omega=0.05), progress=False)
        for loss in ("square", ("huber", 50.0))
    ]
    np.testing.assert_allclose(fits[1].z, fits[0].z, rtol=1e-8)
    assert fits[1].cost == pytest.approx(fits[0].cost, rel=1e-9)
    assert fits[1].stderr["J_eng"] == pytest.approx(
        fits[0].stderr["J_eng"] * np.sqrt(fits[0].cost / fits[0].dof), rel=1e-6
    )


def test_few_samples_have_hubers_corrections():
    """Huber 1981, section 7.6: the squares over the degrees of freedom, and K = 1 + p/n (1 - m)/m."""
    r, loss = np.array([0.5, -0.5, 1.0, -1.0, 2.0, -3.0, 0.2, -0.2, 0.1, 0.4]), Loss(1.5)
    slope, inner = np.clip(r, -1.5, 1.5), 0.8
    size, factor = (slope @ slope) / 7 / inner**2, 1 + 0.3 * 0.2 / inner
    assert efficiency(loss, r, 0.3) == pytest.approx(min(1.0, 1 / size) / factor**2)
    assert efficiency(loss, 2 * r, 0.3) == pytest.approx(
        0.6**2 / (np.sum(np.clip(2 * r, -1.5, 1.5) ** 2) / 7) / (1 + 0.3 * 0.4 / 0.6) ** 2
    )


def test_the_huber_estimate_solves_its_equations(fixed_input):
    fit = ce.estimate(
        ce.one_inertia(), fixed_input(1), loss=("huber", 1.5), noise=ce.Noise(omega=0.1), progress=False
    )
    residual = fit.traces["hit"]["omega"].residual / 0.1
    slope = np.clip(residual, -1.5, 1.5)
    model = ce.one_inertia()
    data = fit.data[0]
    start = {"omega_eng": fit.initial["hit"]["omega_eng"].value}
    for name in TRUTH:
        step = 1e-6 * fit.values[name]
        up, down = (
            ce.simulate(model, data, parameters={**fit.values, name: fit.values[name] + s}, initial=start)[
                "omega"
            ].values
            for s in (step, -step)
        )
        column = (up - down) / (2 * step)
        assert abs(slope @ column) < 1e-5 * np.abs(column) @ np.abs(slope)


def test_the_level_is_estimated_robustly(fixed_input):
    fit = ce.estimate(ce.one_inertia(), fixed_input(2), loss="huber", progress=False)
    sigma, estimated = fit.noise["omega"]
    assert estimated
    assert sigma == pytest.approx(0.1, rel=0.2)
    square = ce.estimate(ce.one_inertia(), fixed_input(2), progress=False)
    assert square.noise["omega"][0] > 0.3


@pytest.mark.parametrize("fits", [8, pytest.param(300, marks=pytest.mark.slow)])
def test_sandwich_errors_by_monte_carlo(fixed_input, fits):
    chi2 = 0.0
    for seed in range(fits):
        fit = ce.estimate(
            ce.one_inertia(), fixed_input(100 + seed), loss="huber", noise=ce.Noise(omega=0.1), progress=False
        )
        error = np.array([fit.values[name] - value for name, value in TRUTH.items()])
        chi2 += error @ np.linalg.solve(fit.covariance, error)
    assert 0.001 < stats.chi2.sf(chi2, 2 * fits) < 0.999


# ---- the function


def test_huber_by_hand():
    loss, r = Loss(2.0), np.array([-3.0, -2.0, 0.5, 4.0])
    assert loss.robust
    assert loss.value(r) == pytest.approx(2 * (3 - 1) + 2.0 + 0.125 + 2 * (4 - 1))
    np.testing.assert_array_equal(loss.slope(r), [-2.0, -2.0, 0.5, 2.0])
    np.testing.assert_array_equal(loss.curvature(r), [0.0, 1.0, 1.0, 0.0])
    square = Loss()
    assert not square.robust
    assert square.value(r) == pytest.approx(0.5 * np.sum(r**2))
    assert square.slope(r) is r
    assert square.curvature(r) is None


@pytest.mark.parametrize(
    ("given", "knee"), [("square", np.inf), ("huber", 1.345), (("huber", 2), 2.0), (Loss(3.0), 3.0)]
)
def test_losses_by_name(given, knee):
    assert read_loss(given).knee == knee


@pytest.mark.parametrize(
    "given", ["cauchy", ("huber",), ("huber", 0), ("huber", -1.0), ("huber", np.inf), ("huber", "2"), 3, None,
              ("huber", True)]
)  # fmt: skip
def test_other_losses_are_refused(given, refused, run_up):
    with refused(
        ce.errors.EstimationError,
        "the loss is not known",
        seen=repr(given),
        allowed='"square", "huber", or ("huber", knee)',
        cure='leave it out for least squares, or give ("huber", 1.345)',
    ):
        ce.estimate(ce.one_inertia(), run_up(), loss=given, progress=False)


def test_a_robust_level_of_residuals_of_which_most_are_one_number():
    """Their median deviation is 0, as of a sensor that reads in steps: that is no level of 0."""
    r = np.zeros(40)
    r[:10] = np.tile([1.0, -1.0], 5)
    assert _robust(r, Loss(1.345), 1.0) == pytest.approx(0.5)


@pytest.mark.parametrize("outliers", [0, 3])
def test_a_robust_level_is_that_of_normal_noise(outliers):
    r = np.random.default_rng(0).standard_normal(4000)
    r[: 10 * outliers] = 100.0
    assert _robust(r, Loss(1.345), 1.0) == pytest.approx(1.0, abs=0.05)


def test_robust_errors_of_a_model_that_is_nearly_linear_within_them_are_symmetric():
    """One outlier in twenty: the initial state was put to its best by squares beside the optimum, and what outliers do
    counted in full, so that chi-squared "rises by 22 and 22, not by 4", or by -0.49, and 0 of 8 fits had a ±."""
    b = ce.Blueprint("body")
    rate, ambient = b.parameter("a", 0.25, unit="1/s", min=0.01), b.parameter("T_a", 18.0, unit="K")
    heat, warm = b.parameter("q", 0.1, unit="K/s"), b.state("T", unit="K")
    b.ode("T", -rate * (warm - ambient) + heat * b.input("u", unit="1"))
    b.output("T", warm, unit="K")
    time = np.linspace(0, 10, 120)
    wave = np.sin(time)
    plain = solve_ivp(
        lambda t, x: -0.2 * (x - 20) + 0.3 * np.interp(t, time, wave),
        (0, 10), [24.0], t_eval=time, rtol=1e-9, max_step=0.1,
    ).y[0]  # fmt: skip
    symmetric = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        noise = 0.2 * rng.standard_normal(120)
        noise[rng.choice(120, 6, replace=False)] += 4 * rng.choice([-1, 1], 6)
        record = ce.Experiment.from_arrays(
            "r", time=time, units={"T": "K", "u": "1"}, T=plain + noise, u=wave
        )
        fit = ce.estimate(b.model(), record, loss="huber", progress=False)
        symmetric += all(fit.stderr[name] is not None for name in ("a", "T_a", "q"))
    assert symmetric >= 7

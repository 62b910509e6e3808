"""White noise plus slow wanders: against dense covariances, and in screens in which nothing is missing."""

import math

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter

import casadi_engine as ce
from casadi_engine.discrepancy.colour_choice import _by_likelihood
from casadi_engine.discrepancy.compression import candidate_columns
from casadi_engine.discrepancy.freedom import freedom_of
from casadi_engine.discrepancy.noise_choice import _CHANCE, _WANDER, wander_gain
from casadi_engine.discrepancy.noise_model import Colour, NoiseModel, deviance, fitted_colour
from casadi_engine.discrepancy.screening import screen
from casadi_engine.discrepancy.wander import Wander, spectrum, wander_of
from casadi_engine.validation.whitening import Whitener

SLOW = Wander(np.array([0.3]), np.array([50.0]))


def dense(wander, size):
    """Covariance with white noise of unit variance."""
    lags = np.arange(size)
    return toeplitz(
        np.eye(1, size)[0] + (wander.variance[:, None] * np.exp(-lags / wander.time[:, None])).sum(0)
    )


def draw(seed, count, variance=0.3, time=50.0):
    rng = np.random.default_rng([4, seed])
    phi = np.exp(-1 / time)
    slow = lfilter([np.sqrt(1 - phi**2)], [1, -phi], rng.standard_normal(count + 1000))[1000:]
    return rng.standard_normal(count) + np.sqrt(variance) * slow


def colour_of(wander, size):
    predictors, variances = wander.predictors(size)
    return Colour(predictors, variances / variances[-1], None, wander), variances[-1]


def test_predictors_whiten_as_the_dense_covariance_does():
    valid = np.random.default_rng(1).random(150) > 0.1
    colour, level = colour_of(SLOW, 150)
    whitener = Whitener(colour.predictors, colour.variances, valid)
    x = np.where(valid, np.random.default_rng(2).standard_normal(150), 0.0)
    covariance = dense(SLOW, 150)[np.ix_(valid, valid)] / level
    wanted = x[valid] @ np.linalg.solve(covariance, x[valid])
    assert np.sum(whitener.apply(x[:, None]) ** 2) == pytest.approx(wanted, rel=2e-3)
    assert whitener.log_determinant == pytest.approx(np.linalg.slogdet(covariance)[1], abs=0.02)


def test_the_spectrum_of_the_predictors_is_that_of_the_wander():
    colour, level = colour_of(SLOW, 2000)
    frequency = np.array([0.0, 0.01, 0.1, 1.0, 3.0])
    assert level * colour.density(frequency) == pytest.approx(SLOW.density(frequency), rel=0.02)


def test_slopes_of_the_spectrum_are_its_differences():
    two = Wander(np.array([0.3, 2.0]), np.array([50.0, 4.0]))
    frequency = np.linspace(0, np.pi, 7)
    found, step = two.slopes(frequency), 1e-5
    for k in range(4):
        shift = np.zeros(4)
        shift[k] = step
        moved = [
            Wander(two.variance * np.exp(s * shift[::2]), two.time * np.exp(s * shift[1::2])) for s in (1, -1)
        ]
        wanted = (np.log(moved[0].density(frequency)) - np.log(moved[1].density(frequency))) / (2 * step)
        assert found[k] == pytest.approx(wanted, rel=1e-5, abs=1e-9)


def test_variance_and_time_constant_are_found_beside_what_was_fitted():
    """Twelve slow columns were fitted, and nothing is lost by it but certainty."""
    found = []
    for seed in range(40):
        e = draw(seed, 2000)
        frame = np.linalg.qr(np.cos(np.pi * np.arange(12) * np.linspace(0, 1, 2000)[:, None]))[0]
        e = e - frame @ (frame.T @ e)
        covariance = dense(SLOW, 2000)
        left = covariance @ frame
        error = frame @ np.linalg.cholesky(frame.T @ left)  # of the coefficients, by ordinary least squares
        power = spectrum(
            np.column_stack([e, error]), np.ones(2000, bool), SLOW.density(np.pi * np.arange(2000) / 2000)
        )
        found.append(np.log([wander_of(power, 1).variance[0], wander_of(power, 1).time[0]]))
    median = np.exp(np.median(found, axis=0))
    assert median == pytest.approx([0.3, 50.0], rel=0.3)


def test_an_autoregression_is_not_taken_for_a_wander():
    made = [
        fitted_colour(
            lfilter([1.0], [1.0, -1.5, 0.85], np.random.default_rng(s).standard_normal(1500)),
            np.arange(1500),
            1500,
        )
        for s in range(5)
    ]
    assert all(one.wander is None and one.order >= 2 for one in made)
    slow = [fitted_colour(draw(s, 1500), np.arange(1500), 1500) for s in range(5)]
    assert sum(one.wander is not None for one in slow) >= 4


def test_a_weak_wander_is_seen_where_white_noise_is_not():
    held = np.ones((1000, 1))
    index = np.arange(1000)
    white = [
        wander_gain(index, 1000, np.random.default_rng(s).standard_normal(1000), held) for s in range(100)
    ]
    assert sum(gain > _WANDER for gain in white) <= 12  # one in twenty
    assert sum(wander_gain(index, 1000, draw(s, 1000, 0.1), held) > _WANDER for s in range(20)) >= 18


def test_how_often_white_noise_looks_like_a_weak_wander():
    """The share that colour is held against where it is said, not only counted with."""
    index, held = np.arange(400), np.ones((400, 1))
    rng = np.random.default_rng(1)
    gains = np.array([wander_gain(index, 400, rng.standard_normal(400), held) for _ in range(600)])
    for least in (2.0, 4.0, 6.0):
        expected = 600 * _CHANCE * math.exp(-least / 2)
        assert abs((gains > least).sum() - expected) <= 3 * math.sqrt(expected) + 1


def test_freedom_is_that_of_the_variance_of_the_estimate(shaft):
    """Score variances move with variance and time constant of a wander as dense matrices say."""
    null = shaft.null(shaft.data(n=300, seed=5))
    record = null.records[0]
    candidates = shaft.candidates(shaft.model)[:4]
    columns = {r.name: candidate_columns(r, candidates) for r in null.records}
    sigma = {"omega": 1.0, "omega_load": 1e6}  # as good as not measured
    covariance = np.array([[0.2, 0.05], [0.05, 0.3]])
    colour, _ = colour_of(SLOW, 300)
    colour = Colour(colour.predictors, colour.variances, covariance, SLOW)
    noise = NoiseModel(sigma, {(record.name, "omega"): colour}, {}, "estimated", {"omega": 1e12})
    found = freedom_of(null, columns, noise)

    def log_variances(values):
        own = Wander(np.exp(values[:1]), np.exp(values[1:]))
        grid = (np.arange(4096) + 0.5) * np.pi / 4096
        white = np.linalg.inv(
            np.linalg.cholesky(dense(own, 300) / np.exp(np.mean(np.log(own.density(grid)))))
        )
        s, c = white @ record.slopes["omega"], white @ columns[record.name]["omega"]
        q = np.linalg.qr(s / np.linalg.norm(s, axis=0))[0]
        return -np.log(((c - q @ (q.T @ c)) ** 2).sum(axis=0))

    at = np.log([0.3, 50.0])
    slopes = [(log_variances(at + d) - log_variances(at - d)) / 2e-4 for d in 1e-4 * np.eye(2)]
    wanted = 2 / np.einsum("ik,ij,jk->k", slopes, covariance, slopes)
    assert found == pytest.approx(wanted, rel=0.02)


def test_the_restricted_likelihood_is_that_of_dense_matrices(shaft):
    null = shaft.null(shaft.data(n=120, seed=5))
    record = null.records[0]
    colour, level = colour_of(SLOW, 120)
    sigma = {o: np.sqrt(level) for o in record.outputs}
    noise = NoiseModel(sigma, {(record.name, o): colour for o in record.outputs})
    rng = np.random.default_rng(0)
    explained = {record.name: {o: rng.standard_normal((120, 3)) for o in record.outputs}}

    def dense_value(held):
        v = np.kron(np.eye(2), dense(SLOW, 120))
        x = np.concatenate([explained[record.name][o] for o in record.outputs])
        e = np.concatenate([record.residual[o] for o in record.outputs])
        inner = x.T @ np.linalg.solve(v, x)
        some = x[:, :held]
        best = np.linalg.solve(some.T @ np.linalg.solve(v, some), some.T @ np.linalg.solve(v, e))
        rest = e - some @ best
        scale = np.linalg.norm(x, axis=0)
        inner = inner / np.outer(scale, scale)
        return np.linalg.slogdet(v)[1] + np.linalg.slogdet(inner)[1] + rest @ np.linalg.solve(v, rest)

    for held in (2, 3):
        assert deviance(null, noise, explained, held) == pytest.approx(dense_value(held), abs=2e-3)


def test_a_gain_of_likelihood_is_students_t():
    """n log(1 + t^2/nu) with n = nu + 1 is what t gains where the level was estimated."""
    from scipy import stats

    assert _by_likelihood(6 * np.log1p(2.5**2 / 5), 5.0) == pytest.approx(stats.t.sf(2.5, 5))
    assert _by_likelihood(4.0, np.inf) == pytest.approx(stats.norm.sf(2.0))
    assert _by_likelihood(-1.0, 5.0) == pytest.approx(0.5)


@pytest.mark.parametrize("draws", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_white_noise_with_a_slow_wander_is_no_effect(draws):
    """A tenth of the variance, 0.5 s: four screens of ten were alarms at 1 % when colours were autoregressions."""
    t = np.arange(1000) * 0.01
    torque = 10 * np.sin(1.5 * t) + 6 * np.sin(4.1 * t)
    model, units = ce.one_inertia(), {"T": "N m", "omega": "rad/s"}
    exp = ce.Experiment.from_arrays("run", time=t, units={"T": "N m"}, T=torque)
    clean = ce.simulate(model, exp, initial={"omega_eng": 0.0})["omega"].values
    alarms = 0
    for seed in range(draws):
        data = ce.Experiment.from_arrays(
            "run", time=t, units=units, T=torque, omega=clean + 0.05 * draw(seed, 1000, 0.1)
        )
        alarms += screen(ce.estimate(model, data, noise=ce.Noise(omega="estimate"), progress=False)).alarm
    assert alarms <= draws // 10

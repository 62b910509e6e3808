"""Whiteness and independence: exact values, false-alarm rates, power, edge cases, messages, speed."""

import json
import time

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter

from casadi_engine.errors import ExperimentError
from casadi_engine.validation.residual_tests import (
    ResidualTest,
    _moments,
    _prepare,
    check_residual,
    independence,
    rejected,
    whiteness,
)
from casadi_engine.validation.whitening import Whitener

NAN = float("nan")
NOISE_300 = np.random.default_rng(28).standard_normal(300)
SIZE = 1000


def engine_torque(size, *, rate=720.0, phase=0.0, noise=0.0, seed=0):
    """Return a torque [N m] of eight orders of a 10 Hz cycle on a mean: periodic and narrow band."""
    angle = 2 * np.pi * 10.0 * np.arange(size) / rate - phase
    orders = sum(np.cos(k * angle + k * k) / (1 + 0.2 * k * k) for k in range(1, 9))
    return 50.0 + 200.0 * orders + noise * np.random.default_rng(seed).standard_normal(size)


def autoregressive(rng, size, coefficient):
    return lfilter([1.0], [1.0, -coefficient], rng.standard_normal(size + 300))[300:]


def assert_calibrated(p_values):
    """Fail unless the shares below 1 % and 5 % lie where 99.9 % of exact tests' shares lie."""
    for level in (0.01, 0.05):
        count = int(np.sum(np.asarray(p_values) < level))
        low, high = stats.binom.interval(0.999, len(p_values), level)
        assert low <= count <= high, f"{count} of {len(p_values)} below {level}: expected {low} to {high}"


def regression_p_value(residual, regressors, nuisance):
    """Return the textbook F test of extra regressors, by two least-squares fits."""

    def energy(columns):
        return np.sum((residual - columns @ np.linalg.lstsq(columns, residual)[0]) ** 2)

    full = np.column_stack([nuisance, regressors])
    extra, rest = regressors.shape[1], residual.size - full.shape[1]
    ratio = (energy(nuisance) - energy(full)) / extra / (energy(full) / rest)
    return stats.f.sf(ratio, extra, rest)


# Exact values


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("fitted", [0, 3])
def test_independence_of_a_white_residual_is_the_f_test(gaps, fitted):
    rng = np.random.default_rng(4)
    e, u = rng.standard_normal((2, 200))
    jacobian = rng.standard_normal((200, fitted)) * 10.0 ** np.arange(fitted)
    mask = rng.random(200) > (0.2 if gaps else -1.0)
    result = independence(e, u, mask=mask, jacobian=jacobian, lags=4)
    rows = np.flatnonzero(mask[4:]) + 4
    past = np.column_stack([u[rows - lag] for lag in range(5)])
    nuisance = np.column_stack([np.ones(rows.size), jacobian[rows]])
    assert result.noise_order == 0
    assert (result.dof, result.samples) == (5, rows.size)
    assert result.p_value == pytest.approx(regression_p_value(e[rows], past, nuisance), rel=1e-9)


def test_the_statistic_is_nearly_chi_square_in_long_records():
    rng = np.random.default_rng(5)
    result = independence(*rng.standard_normal((2, 20000)), lags=10)
    assert stats.chi2.sf(result.statistic, result.dof) == pytest.approx(result.p_value, abs=1e-3)


def test_whiteness_by_hand():
    # e is centred: 1, 1, −1, −1, 1, 1, −1, −1; lag 1: Σ e(t) e(t−1) = 1 with σ² = 8/7, that is 7/8. Of white noise
    # the mean takes tr(QᵀBQ) = 7/8 from it, with B half a step each way, and leaves the variance
    # 2 tr(MBMB) = 7 − 4 |BQ|² + 2 (7/8)²; BQ is 1/√8, half of it at the two ends.
    result = whiteness([1.0, 1.0, -1.0, -1.0, 1.0, 1.0, -1.0, -1.0], lags=1)
    variance = 7 - 4 * (6 + 2 / 4) / 8 + 2 * (7 / 8) ** 2
    assert result.statistic == pytest.approx((7 / 8 + 7 / 8) ** 2 / variance)
    assert 0.3 < result.p_value <= 1  # of few samples the law is drawn, see below


@pytest.mark.parametrize("gaps", [False, True])
def test_moments_of_whiteness_are_those_of_dense_matrices(gaps):
    rng = np.random.default_rng(3)
    mask = rng.random(40) >= 0.3 * gaps
    mask[[0, -1]] = True
    data = _prepare(
        np.where(mask, rng.standard_normal(40), np.nan), None, rng.standard_normal((40, 4)), skip=0
    )
    steps = np.array([1, 2, 7])
    pairs = np.array([np.sum(mask[k:] & mask[:-k]) for k in steps])
    mean, covariance = _moments(data, steps, pairs.astype(float))
    left = np.diag(mask * 1.0) - data.nuisance @ data.nuisance.T
    shifts = [left @ (np.eye(40, k=k) + np.eye(40, k=-k)) / 2 @ left for k in steps]
    assert mean == pytest.approx([np.trace(one) for one in shifts], abs=1e-12)
    dense = [[2 * np.trace(one @ other) for other in shifts] for one in shifts]
    assert covariance == pytest.approx(np.array(dense), abs=1e-11)


@pytest.mark.parametrize("draws", [60, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("size", "fitted", "draw"),
    [
        (60, 5, lambda rng, n: rng.standard_normal(n)),
        (100, 20, lambda rng, n: rng.standard_normal(n)),
        (60, 5, lambda rng, n: rng.standard_t(3, n)),
        (100, 5, lambda rng, n: rng.standard_normal(n) * np.where(rng.random(n) < 0.01, 10.0, 1.0)),
    ],
)
def test_whiteness_of_short_records_keeps_its_rate(size, fitted, draw, draws):
    """At 1 %; a regression on the own past alarmed in 18 to 23 of 100 of the first three."""
    alarms = 0
    for seed in range(draws):
        rng = np.random.default_rng([9, seed])
        jacobian = np.cos(np.pi * np.arange(fitted) * np.linspace(0, 1, size)[:, None])
        e = draw(rng, size)
        e = e - jacobian @ np.linalg.lstsq(jacobian, e, rcond=None)[0]
        alarms += whiteness(e, jacobian=jacobian).p_value <= 0.01
    assert alarms <= stats.binom.ppf(0.999, draws, 0.01)


def test_whiteness_agrees_with_ljung_box_in_long_records():
    e = np.random.default_rng(6).standard_normal(50000)
    centred = e - e.mean()
    r = np.array([centred[k:] @ centred[:-k] for k in range(1, 26)]) / (centred @ centred)
    ljung_box = e.size * (e.size + 2) * np.sum(r**2 / (e.size - np.arange(1, 26)))
    assert whiteness(e).statistic == pytest.approx(ljung_box, rel=0.02)


@pytest.mark.parametrize("gaps", [False, True])
def test_whitening_is_the_inverse_covariance_of_the_present_samples(gaps):
    rng = np.random.default_rng(7)
    e = lfilter([1.0], [1.0, -1.2, 0.5], rng.standard_normal(160))
    valid = rng.random(160) > (0.2 if gaps else -1.0)
    valid[[0, -1]] = True
    e = np.where(valid, e, 0.0)
    noise = Whitener.of(e, valid)
    assert noise.order >= 2
    matrix = noise.matrix.toarray()
    covariance = np.linalg.inv(matrix.T @ matrix)[np.ix_(valid, valid)]
    columns = np.column_stack([e, np.where(valid, rng.standard_normal(160), 0.0)])
    whitened = noise.apply(columns)
    exact = columns[valid].T @ np.linalg.solve(covariance, columns[valid])
    np.testing.assert_allclose(whitened.T @ whitened, exact, rtol=1e-9)


def test_the_autoregression_is_found():
    e = lfilter([1.0], [1.0, -1.2, 0.5], 3.0 * np.random.default_rng(8).standard_normal(20000))
    noise = Whitener.of(e, np.ones(e.size, dtype=bool))
    np.testing.assert_allclose(noise.predictors[-1][:3], [1.0, -1.2, 0.5], atol=0.03)
    assert noise.variances[-1] == pytest.approx(9.0, rel=0.03)


def test_scale_and_offset_do_not_matter():
    rng = np.random.default_rng(9)
    e, u = rng.standard_normal((2, 300))
    one, other = (independence(a * e + b, a * u + 7 * b, jacobian=a * u**2) for a, b in ((1, 0), (1e-6, 3.0)))
    assert other.p_value == pytest.approx(one.p_value, rel=1e-6)
    assert whiteness(1e6 * e + 5.0).p_value == pytest.approx(whiteness(e).p_value, rel=1e-6)


# False alarms


# The quick runs guard the code, the slow ones (2000 draws a case) the claim.
QUICK_AND_SLOW = [pytest.param(100, id="quick"), pytest.param(2000, id="study", marks=pytest.mark.slow)]


@pytest.mark.parametrize("draws", QUICK_AND_SLOW)
@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_whiteness_keeps_its_false_alarm_rate(missing, draws):
    rng = np.random.default_rng(10)
    assert_calibrated(
        [whiteness(rng.standard_normal(SIZE), mask=rng.random(SIZE) >= missing).p_value for _ in range(draws)]
    )


@pytest.mark.parametrize("draws", QUICK_AND_SLOW)
@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_independence_of_a_periodic_drive_keeps_its_false_alarm_rate(missing, draws):
    rng = np.random.default_rng(27)
    torque = engine_torque(SIZE)
    assert_calibrated(
        [
            independence(rng.standard_normal(SIZE), torque, mask=rng.random(SIZE) >= missing, lags=10).p_value
            for _ in range(draws)
        ]
    )


def fitted_one_inertia(rng, torque, missing):
    """Fit gain, decay and start of (2.37) to y = x + v by Gauss-Newton; return residual and Jacobian."""
    true = np.array([0.5, 0.97, 3.0])
    late = np.append(0.0, torque[:-1])
    start = np.append(1.0, np.zeros(torque.size - 1))

    def simulate(p):
        x = lfilter([1.0], [1.0, -p[1]], p[0] * late + p[2] * start)
        by_decay = lfilter([1.0], [1.0, -p[1]], np.append(0.0, x[:-1]))
        by_gain, by_start = (lfilter([1.0], [1.0, -p[1]], column) for column in (late, start))
        return x, np.column_stack([by_gain, by_decay, by_start])

    y = simulate(true)[0] + rng.standard_normal(torque.size)
    y[rng.random(torque.size) < missing] = NAN
    p, present = true * 1.01, ~np.isnan(y)
    for _ in range(3):
        x, jacobian = simulate(p)
        p = p + np.linalg.lstsq(jacobian[present], (y - x)[present])[0]
    x, jacobian = simulate(p)
    return y - x, jacobian


@pytest.mark.parametrize("draws", QUICK_AND_SLOW)
@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_residuals_of_a_fitted_model_keep_both_rates(missing, draws):
    rng = np.random.default_rng(11)
    torque = engine_torque(SIZE, noise=1.0) / 200.0
    whites, crosses = [], []
    for _ in range(draws):
        residual, jacobian = fitted_one_inertia(rng, torque, missing)
        whites.append(whiteness(residual, jacobian=jacobian).p_value)
        crosses.append(independence(residual, torque, jacobian=jacobian).p_value)
    assert_calibrated(whites)
    assert_calibrated(crosses)


def test_many_fitted_parameters_do_not_break_whiteness_if_the_jacobian_is_given():
    rng = np.random.default_rng(12)
    time_axis = np.linspace(-1.0, 1.0, 400)
    jacobian = np.polynomial.legendre.legvander(time_axis, 29)
    basis = np.linalg.qr(jacobian)[0]
    draws = rng.standard_normal((80, 400))
    residuals = draws - (draws @ basis) @ basis.T
    with_jacobian = [whiteness(e, jacobian=jacobian).p_value for e in residuals]
    without = [whiteness(e).p_value for e in residuals]
    assert np.mean(np.less(with_jacobian, 0.05)) < 0.08
    assert np.mean(np.less(without, 0.05)) > 0.3  # thirty parameters in 400 samples: the loss shows


def independence_p_values(*, colour, missing, drive_noise, draws, size=SIZE):
    rng = np.random.default_rng(13)
    torque = engine_torque(size, noise=drive_noise)
    return [
        independence(autoregressive(rng, size, colour), torque, mask=rng.random(size) >= missing).p_value
        for _ in range(draws)
    ]


@pytest.mark.parametrize(
    ("colour", "missing", "drive_noise", "draws"),
    [
        (0.8, 0.2, 1.0, 60),  # more of them in the study below
        *(pytest.param(0.8, *one, 300, marks=pytest.mark.slow) for one in ((0.0, 0.0), (0.2, 1.0))),
    ],
)
def test_a_coloured_residual_keeps_the_rate_of_independence(colour, missing, drive_noise, draws):
    assert_calibrated(
        independence_p_values(colour=colour, missing=missing, drive_noise=drive_noise, draws=draws)
    )


@pytest.mark.slow
@pytest.mark.parametrize("size", [300, 1000, 3000])
@pytest.mark.parametrize("drive_noise", [0.0, 1.0])
@pytest.mark.parametrize("missing", [0.0, 0.2])
@pytest.mark.parametrize("colour", [0.0, 0.3, 0.8])
def test_the_rate_of_independence_study(colour, missing, drive_noise, size):
    p_values = independence_p_values(
        colour=colour, missing=missing, drive_noise=drive_noise, draws=2000, size=size
    )
    # The noise model is estimated: a tenth of slack on top of the sampling error, more in short records.
    slack = 1.1 if size >= 1000 else 1.5
    for level in (0.01, 0.05):
        assert np.sum(np.less(p_values, level)) <= stats.binom.ppf(0.999, 2000, slack * level)


def test_the_naive_sum_over_lags_would_not_keep_it():
    rng = np.random.default_rng(14)
    torque = engine_torque(SIZE)
    u = (torque - torque.mean()) / torque.std()
    draws = rng.standard_normal((500, SIZE))
    sums = sum((draws[:, 25:] @ u[25 - lag : SIZE - lag]) ** 2 for lag in range(26)) / (SIZE - 25)
    assert np.mean(stats.chi2.sf(sums, 26) < 0.01) > 0.05


# Power


@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_weak_colour_is_found(missing):
    rng = np.random.default_rng(15)
    found = [
        whiteness(autoregressive(rng, 14400, 0.1), mask=rng.random(14400) >= missing).p_value < 0.01
        for _ in range(20)
    ]
    assert np.mean(found) == 1.0


@pytest.mark.parametrize("colour", [0.0, 0.5])
@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_a_delayed_drive_left_in_the_residual_is_found(colour, missing):
    rng = np.random.default_rng(16)
    torque = engine_torque(SIZE, noise=1.0)
    leftover = 0.8 * np.append(np.zeros(3), (torque - torque.mean())[:-3]) / torque.std()
    found = [
        independence(
            autoregressive(rng, SIZE, colour) + leftover, torque, mask=rng.random(SIZE) >= missing
        ).p_value
        < 0.01
        for _ in range(20)
    ]
    assert np.mean(found) >= 0.95


@pytest.mark.parametrize("size", [300, 1000, 4000])
@pytest.mark.parametrize("amplitude", [1.0, 3.0, 10.0, 100.0, 1e4])
def test_a_strong_leftover_does_not_pass_for_colour(size, amplitude):
    drive = np.sin(0.1 * np.arange(size))
    noise = np.random.default_rng(17).standard_normal(size)
    assert independence(noise + amplitude * drive, drive).p_value < 1e-3


def test_a_noise_free_leftover_is_found():
    drive = np.sin(0.1 * np.arange(400.0))
    assert independence(np.append(0.0, drive[:-1]), drive).p_value < 1e-6


def test_the_right_drive_is_named_among_unlike_ones():
    rng = np.random.default_rng(18)
    torque, load = engine_torque(SIZE), np.cumsum(rng.standard_normal(SIZE))
    residual = rng.standard_normal(SIZE) + 0.5 * (torque - torque.mean()) / torque.std()
    checks = check_residual(residual, {"T_1": torque, "T_load": load})
    assert rejected(checks.cross) == ("T_1",)


def test_what_the_parameters_absorb_is_not_held_against_the_model():
    rng = np.random.default_rng(19)
    torque = engine_torque(SIZE, noise=1.0)
    sensitivity = lfilter([1.0], [1.0, -0.9], torque)
    fresh = rng.standard_normal(SIZE) + 0.02 * (sensitivity - sensitivity.mean())
    assert independence(fresh, torque).p_value < 1e-6
    assert independence(fresh, torque, jacobian=sensitivity).p_value > 0.01


def test_a_residual_that_vanishes_wherever_it_has_a_past_is_tested():
    pattern = np.arange(300) % 5
    mask = pattern != 1
    result = independence(np.where(pattern == 2, (-1.0) ** (np.arange(300) // 5), 0.0), NOISE_300, mask=mask)
    assert 0.0 < result.p_value <= 1.0


# Gaps and strides


def test_nan_means_missing_without_a_mask():
    rng = np.random.default_rng(20)
    e, u = rng.standard_normal((2, 400))
    mask = rng.random(400) > 0.2
    gappy = np.where(mask, e, NAN)
    assert whiteness(gappy) == whiteness(e, mask=mask)
    assert independence(gappy, u) == independence(e, u, mask=mask)


def test_the_jacobian_may_be_anything_where_the_residual_is_missing():
    rng = np.random.default_rng(21)
    e, jacobian = rng.standard_normal((2, 400))
    mask = rng.random(400) > 0.2
    gappy = np.where(mask, jacobian, NAN)
    assert whiteness(e, mask=mask, jacobian=gappy) == whiteness(e, mask=mask, jacobian=jacobian)


def test_a_regular_stride_is_tested_like_the_record_without_the_gaps():
    e = np.random.default_rng(22).standard_normal(1200)
    mask = np.arange(1200) % 4 == 1
    thin, short = whiteness(e, mask=mask), whiteness(e[mask])
    assert thin.p_value == pytest.approx(short.p_value, rel=1e-9)
    assert thin.dof == short.dof == 25


def test_colour_is_seen_behind_a_regular_stride():
    rng = np.random.default_rng(23)
    mask = np.arange(4 * SIZE) % 4 == 0
    torque = engine_torque(4 * SIZE)
    p_values = [
        independence(np.repeat(autoregressive(rng, SIZE, 0.8), 4), torque, mask=mask).p_value
        for _ in range(60)
    ]
    assert np.mean(np.less(p_values, 0.05)) < 0.12


def test_long_gaps_leave_the_blocks_between_them():
    rng = np.random.default_rng(24)
    mask = np.arange(SIZE) // 100 % 3 != 1
    result = whiteness(rng.standard_normal(SIZE), mask=mask)
    assert (result.samples, result.dof) == (700, 25)
    assert 0.01 < result.p_value <= 1.0


# What cannot be tested


def assert_untested(result, why):
    assert (result.statistic, result.dof, result.p_value, result.why) == (None, None, None, why)
    json.dumps(result.to_dict(), allow_nan=False)


NOISE = np.random.default_rng(25).standard_normal(200)


def test_a_constant_drive_cannot_be_tested():
    why = "the drive is constant: nothing can be told from a correlation with it"
    assert_untested(independence(NOISE, np.full(200, 57.1)), why)
    assert_untested(independence(NOISE, np.zeros(200)), why)


def test_a_drive_that_changes_outside_the_test_only_cannot_be_tested():
    drive = np.where(np.arange(200) < 100, 0.0, 1.0)
    residual = np.where(np.arange(200) < 95, NOISE, NAN)
    why = "the mean and the fitted parameters absorb everything that this drive could explain"
    assert_untested(independence(residual, drive, lags=3), why)


def test_a_drive_that_the_parameters_absorb_cannot_be_tested():
    drive = engine_torque(200)
    lagged = np.column_stack([np.roll(drive, lag) for lag in range(6)])
    why = "the mean and the fitted parameters absorb everything that this drive could explain"
    assert_untested(independence(NOISE, drive, jacobian=lagged, lags=5), why)


@pytest.mark.parametrize("value", [0.0, 0.1])
def test_a_zero_or_constant_residual_cannot_be_tested(value):
    why = "the residual is constant: nothing to test"
    assert_untested(whiteness(np.full(200, value)), why)
    assert_untested(independence(np.full(200, value), NOISE), why)


def test_a_residual_that_the_parameters_explain_cannot_be_tested():
    jacobian = np.column_stack([NOISE, np.arange(200.0)])
    why = "the fitted parameters explain the whole residual: nothing to test"
    assert_untested(whiteness(jacobian @ [2.0, 3.0], jacobian=jacobian), why)


@pytest.mark.parametrize(
    ("size", "why"),
    [
        (20, "only 0 valid samples after the first 25"),
        (26, "only 1 valid samples after the first 25"),
        (60, "only 35 valid samples: testing 26 directions needs more than 53"),
    ],
)
def test_too_few_samples_for_the_lags(size, why):
    assert_untested(independence(NOISE[:size], np.arange(float(size))), why)


def test_too_few_samples_for_whiteness():
    assert_untested(whiteness(NOISE[:51]), "only 51 valid samples: testing 25 directions needs more than 51")
    assert whiteness(NOISE[:52]).why is None


def test_lags_without_any_pair():
    mask = np.isin(np.arange(200) % 5, (0, 2))
    assert_untested(whiteness(NOISE, mask=mask, lags=1), "no lag can be tested: too few pairs of samples")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"mask": np.zeros(200, dtype=bool)},
            "the residual has no valid sample; seen: 0 of 200; allowed: at least 1 in every output; "
            "do: look at the mask, or leave this output out",
        ),
        (
            {"jacobian": np.ones((199, 2))},
            "the Jacobian does not fit the residual; seen: Jacobian (199, 2), residual (200,); "
            "allowed: (N, d), one row per sample",
        ),
        (
            {"jacobian": np.full((200, 2), NAN)},
            "the Jacobian is not finite; seen: 400 of 400 entries; "
            "do: the sensitivities diverged: look at the parameters and the step",
        ),
        (
            {"mask": np.ones(199, dtype=bool)},
            "the mask does not fit the residual; seen: mask (199,), the residual (200,); "
            "allowed: one flag per sample",
        ),
        (
            {"lags": True},
            "the number of lags does not fit; seen: True; allowed: a whole number >= 1; "
            "do: leave it out for as many as the record's length asks for",
        ),
    ],
)
def test_unusable_input_is_named(arguments, message):
    for call in (
        lambda: whiteness(NOISE, **arguments),
        lambda: independence(NOISE, NOISE, **arguments),
        lambda: check_residual(NOISE, {"T": NOISE}, **arguments),
    ):
        with pytest.raises(ExperimentError) as caught:
            call()
        assert str(caught.value) == message


def test_a_drive_of_another_length_is_named():
    with pytest.raises(ExperimentError) as caught:
        check_residual(NOISE, {"T": NOISE[1:]})
    assert str(caught.value) == (
        "the drive does not fit the residual; seen: drive (199,), residual (200,); allowed: equal lengths; "
        "do: give the drive at the residual's times"
    )


# Everything about one output


def test_check_residual_holds_the_single_results():
    drives = {"T_1": engine_torque(200), "T_load": np.full(200, 57.0)}
    checks = check_residual(NOISE, drives, lags=5, cross_lags=4)
    assert checks.whiteness == whiteness(NOISE, lags=5)
    assert checks.cross == {name: independence(NOISE, drive, lags=5) for name, drive in drives.items()}
    assert checks.autocorrelation.lags.tolist() == list(range(6))
    assert checks.cross_correlation["T_1"].lags.tolist() == list(range(-4, 5))
    stored = checks.to_dict()
    assert set(stored) == {"whiteness", "cross", "autocorrelation", "cross_correlation"}
    assert stored["cross"]["T_load"]["p_value"] is None
    json.dumps(stored, allow_nan=False)


def outcome(p_value):
    return ResidualTest(1.0, 1, p_value, 100)


def test_rejected_is_holm():
    tests = {
        "a": outcome(0.004),
        "b": outcome(0.0001),
        "c": outcome(0.5),
        "d": ResidualTest(None, None, None, 0, why="no"),
    }
    assert rejected(tests, alpha=0.01) == ("b", "a")  # 0.0001 ≤ 0.01/3, 0.004 ≤ 0.01/2
    assert rejected({**tests, "e": outcome(0.3)}, alpha=0.01) == ("b",)  # 0.004 > 0.01/3
    assert rejected({}) == ()


@pytest.mark.parametrize("alpha", [0.0, 1.0, -1, 2])
def test_rejected_needs_a_rate(alpha):
    with pytest.raises(ExperimentError) as caught:
        rejected({}, alpha=alpha)
    assert (
        str(caught.value)
        == f"the false-alarm rate does not fit; seen: {alpha!r}; allowed: between 0 and 1; do: give alpha=0.01"
    )


def test_inputs_are_not_changed():
    e, u, jacobian = NOISE.copy(), np.arange(200.0), np.ones((200, 1))
    mask = np.arange(200) > 10
    check_residual(e, {"u": u}, mask=mask, jacobian=jacobian)
    np.testing.assert_array_equal(e, NOISE)
    np.testing.assert_array_equal(u, np.arange(200.0))
    assert mask.sum() == 189


def test_a_full_record_against_five_drives_is_quick():
    size = 14400
    residual = np.random.default_rng(26).standard_normal(size)
    drives = {f"T_{c}": engine_torque(size, rate=14402.0, phase=c, noise=1.0, seed=c) for c in range(5)}
    seconds = []
    for _ in range(5):
        # The time that this thread computed, not that on the clock: a loaded machine lets it wait.
        start = time.thread_time()
        check_residual(residual, drives)
        seconds.append(time.thread_time() - start)
    assert min(seconds) < 0.2  # 0.03 s on an idle core


@pytest.mark.parametrize("count", [16, 40])
def test_few_samples_alarm_as_often_as_they_should(count):
    """600 records of white noise of which two slopes took their share; 1 of 20 alarms within what chance allows."""
    time = np.linspace(0, 1, count)
    slopes = np.stack([np.exp(-3 * time), time], axis=1)
    basis = np.linalg.qr(slopes)[0]
    rng, alarms = np.random.default_rng(0), 0
    for _ in range(600):
        e = rng.standard_normal(count)
        alarms += whiteness(e - basis @ (basis.T @ e), jacobian=slopes, lags=count // 4).p_value < 0.05
    assert 10 < alarms < 48


def test_a_pattern_in_twenty_samples_is_seen_beside_a_large_one():
    """What a second exponential leaves: its first sample is larger than all others."""
    time = np.linspace(0, 5, 20)
    slopes = np.stack([np.exp(-time), time * np.exp(-time)], axis=1)
    basis = np.linalg.qr(slopes)[0]
    left = np.exp(-8 * time) + 0.2 * np.exp(-0.1 * time) + 0.01 * np.random.default_rng(0).standard_normal(20)
    assert whiteness(left - basis @ (basis.T @ left), jacobian=slopes, lags=5).p_value < 0.01

"""Thresholds of a library against exact formulas and plain Monte Carlo."""

import numpy as np
import pytest
from scipy import integrate, stats

from casadi_engine.discrepancy.null_distribution import NullDistribution, Row, split_alpha
from tests.quick import few


def independent(count, *, side=0, start=0, size=None):
    size = count if size is None else size
    return [Row(str(k), np.eye(size)[:, [start + k]], side) for k in range(count)]


@pytest.mark.parametrize("count", [1, 5, 60, 200])
@pytest.mark.parametrize("alpha", [0.01, 0.1])
def test_independent_rows_have_the_closed_form(count, alpha):
    null = NullDistribution(independent(count))
    exact = 1 - (1 - alpha) ** (1 / count)
    assert null.threshold(alpha) == pytest.approx(exact, rel=0.02)
    assert null.critical(alpha) == pytest.approx(stats.norm.isf(exact / 2), abs=0.01)


def test_one_row_with_several_names_counts_once():
    frame = np.ones((1, 1))
    null = NullDistribution([Row(str(k), frame) for k in range(40)])
    assert null.threshold(0.01) == pytest.approx(0.01, rel=1e-3)


@pytest.mark.parametrize("rho", [0.3, 0.9])
def test_equal_correlations_have_a_one_dimensional_integral(rho):
    count, alpha = 20, 0.05
    covariance = np.full((count, count), rho) + (1 - rho) * np.eye(count)
    vectors = np.linalg.cholesky(covariance).T
    c = NullDistribution([Row(str(k), vectors[:, [k]]) for k in range(count)], draws=20000).critical(alpha)

    def inside(x):
        a, s = np.sqrt(rho) * x, np.sqrt(1 - rho)
        return stats.norm.pdf(x) * (stats.norm.cdf((c - a) / s) - stats.norm.cdf((-c - a) / s)) ** count

    assert 1 - integrate.quad(inside, -9, 9)[0] == pytest.approx(alpha, rel=0.03)


def mixed(seed=0, m=12):
    rng = np.random.default_rng(seed)
    tests = []
    for k in range(30):
        frame = np.linalg.qr(rng.standard_normal((m, 1)) + (0 if k % 3 else 2))[0]
        tests.append(Row(str(k), frame, (0, 1, -1)[k % 3]))
    for k, r in enumerate((2, 3, 5)):
        tests.append(Row(f"group {k}", np.linalg.qr(rng.standard_normal((m, r)))[0]))
    return tests


@pytest.mark.parametrize("alpha", few([0.01, 0.1], 0.1))
def test_sides_and_groups_share_one_scale(alpha):
    tests = mixed()
    limit = NullDistribution(tests, draws=20000).threshold(alpha)
    y = np.random.default_rng(5).standard_normal((12, 200_000))
    least = np.min([t.p_value(y) for t in tests], axis=0)
    share = np.mean(least <= limit)
    assert share == pytest.approx(alpha, abs=4 * np.sqrt(alpha / 200_000) + 0.02 * alpha)


def test_pooled_p_values_reach_far_into_the_tail():
    tests = independent(50)
    null = NullDistribution(tests)
    for p in (1e-3, 1e-9, 1e-40):
        assert null.pooled(p) == pytest.approx(-np.expm1(50 * np.log1p(-p)), rel=0.02)
    assert null.pooled(0.0) == 0
    assert null.pooled(1.0) == 1


def test_pooling_inverts_the_threshold_and_repeats():
    null = NullDistribution(mixed(1), draws=8000)
    assert null.pooled(null.threshold(0.01)) == pytest.approx(0.01, rel=0.01)
    assert NullDistribution(mixed(1), draws=8000).threshold(0.01) == null.threshold(0.01)


def test_no_tests_need_no_calibration():
    null = NullDistribution([])
    assert null.threshold(0.01) == 0.01
    assert null.pooled(0.3) == 0


def test_group_limits_are_chi():
    test = Row("three", np.eye(3))
    assert test.limit(0.05) == pytest.approx(np.sqrt(stats.chi2.isf(0.05, 3)))
    assert test.p_value(np.array([[1.0], [2.0], [2.0]])) == pytest.approx(stats.chi2.sf(9, 3))


def test_alpha_is_split():
    library, whiteness = split_alpha(0.01)
    assert library + whiteness == pytest.approx(0.01)
    assert library == pytest.approx(0.008)

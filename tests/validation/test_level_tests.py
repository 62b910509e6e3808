"""The mean and the size of a residual, beside SciPy's tests, and their false alarms."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2, ttest_1samp

from casadi_engine.validation import Correlation, autocorrelation
from casadi_engine.validation.level_tests import LOUDER, mean_test, size_test, worth_of


def none(count):
    """The correlation of a residual without a past."""
    return Correlation(np.arange(2), np.array([1.0, 0.0]), np.zeros(2), count)


def test_student_and_chi_squared_for_white_noise():
    e = 0.1 + np.random.default_rng(1).standard_normal(50)
    assert mean_test(e, none(50)).p_value == pytest.approx(ttest_1samp(e, 0.0).pvalue, rel=1e-6)
    big = 2.0 * e
    expected = chi2.sf(big @ big / LOUDER**2, 50)
    assert size_test(big, 1.0, np.inf, none(50)).p_value == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("memory", [0.0, 0.6])
def test_false_alarms_and_power(memory):
    rng = np.random.default_rng(3)
    low = shifted = 0
    for _ in range(400):
        e = lfilter([1.0], [1.0, -memory], rng.standard_normal(500))[100:]
        low += mean_test(e, autocorrelation(e)).p_value < 0.01
        there = e + 0.5 / (1 - memory)
        shifted += mean_test(there, autocorrelation(there)).p_value < 0.01
    assert low <= 12  # 4 expected of white noise; beyond 12 of 400 lies 1 in 2000
    assert shifted == 400


def test_size_of_coloured_noise_is_no_alarm():
    rng = np.random.default_rng(5)
    alarms = 0
    for _ in range(200):
        e = lfilter([1.0], [1.0, -0.9], rng.standard_normal(700))[300:]
        alarms += size_test(e / np.sqrt(1 / (1 - 0.81)), 1.0, 400, autocorrelation(e)).p_value < 0.01
    assert alarms <= 4


def test_what_cannot_be_tested_says_why():
    few = np.arange(3.0)
    assert mean_test(few, none(3)).why == "3 valid samples: 8 are needed"
    many = np.arange(20.0)
    assert mean_test(many, none(20), reach=0.0).why == "parameters and first states take what is constant"
    assert size_test(many, 0.0, 10, none(20)).why == "the fit leaves no noise"
    assert size_test(np.zeros(0), 1.0, 10, none(0)).why == "0 valid samples: 8 are needed"
    assert size_test(many, 1.0, 10, none(20), fitted=13).why == "20 valid samples: 21 are needed"


@pytest.mark.parametrize("kind", ["white", "coloured", "tails"])
def test_a_level_is_told_by_as_many_samples_as_its_residual_is_worth(kind):
    """The scatter of the logarithm of a mean square over records of one law: 2 over what they are worth."""
    random, found, worth = np.random.default_rng(4), [], []
    for _ in range(400):
        e = random.standard_t(6, 400) if kind == "tails" else random.standard_normal(400)
        for k in range(1, 400 if kind == "coloured" else 0):
            e[k] += 0.8 * e[k - 1]
        found.append(np.log(np.mean(e**2)))
        worth.append(400 * worth_of([e]))
    assert 2 / np.mean(worth) == pytest.approx(np.var(found), rel=0.25)
    if kind == "white":
        assert np.mean(worth) == pytest.approx(400, rel=0.03)

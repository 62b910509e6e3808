"""Correlation functions: hand examples, agreement with direct sums, bands, gaps, and messages."""

import json

import numpy as np
import pytest
from scipy.signal import lfilter

from casadi_engine.errors import ExperimentError
from casadi_engine.validation.correlation import autocorrelation, cross_correlation, lagged_products

NAN = float("nan")


def autoregressive(rng, size, coefficient):
    return lfilter([1.0], [1.0, -coefficient], rng.standard_normal(size + 500))[500:]


def test_autocorrelation_by_hand():
    # centred: −1, 1, −1, 1 with sum of squares 4; lagged products −3, 2, −1
    result = autocorrelation([1.0, 3.0, 1.0, 3.0], lags=3)
    np.testing.assert_allclose(result.values, [1.0, -0.75, 0.5, -0.25], atol=1e-12)
    np.testing.assert_array_equal(result.lags, [0, 1, 2, 3])
    np.testing.assert_allclose(result.band, 2.58 / 2)
    assert result.samples == 4


def test_autocorrelation_with_a_gap_uses_present_pairs():
    # centred over the four present samples: −1, 1, ·, 1, −1; mean square 1
    result = autocorrelation([1.0, 3.0, NAN, 3.0, 1.0], lags=3)
    # lag 1: pairs (1,0) and (4,3), mean −1, times 4/5; lag 2: pair (3,1), mean 1, times 3/5;
    # lag 3: pairs (3,0), (4,1), mean −1, times 2/5
    np.testing.assert_allclose(result.values, [1.0, -0.8, 0.6, -0.4], atol=1e-12)
    np.testing.assert_allclose(
        result.band, 2.58 * np.array([1 / 2, np.sqrt(0.8 / 2), np.sqrt(0.6), np.sqrt(0.4 / 2)])
    )


def test_cross_correlation_by_hand_and_its_direction():
    # the residual is the drive one sample late: the peak is at lag +1
    drive = np.array([1.0, -1.0, 0.0, 0.0, 0.0])
    residual = np.array([0.0, 1.0, -1.0, 0.0, 0.0])
    result = cross_correlation(residual, drive, lags=2)
    np.testing.assert_array_equal(result.lags, [-2, -1, 0, 1, 2])
    np.testing.assert_allclose(result.values, [0.0, 0.0, -0.5, 1.0, -0.5], atol=1e-12)


@pytest.mark.parametrize("gaps", [False, True])
def test_values_equal_direct_sums(gaps):
    rng = np.random.default_rng(1)
    e, u = rng.standard_normal((2, 200)) + 3.0
    mask = rng.random(200) > (0.3 if gaps else -1.0)
    result = cross_correlation(e, u, mask=mask, lags=7)
    centred, drive = np.where(mask, e - e[mask].mean(), 0.0), u - u.mean()
    scale = np.sqrt(np.mean(centred[mask] ** 2) * np.mean(drive**2))
    for lag, value in zip(result.lags, result.values, strict=True):
        pairs = [(t, t - lag) for t in range(200) if 0 <= t - lag < 200 and mask[t]]
        mean = sum(centred[a] * drive[b] for a, b in pairs) / len(pairs)
        assert value == pytest.approx(mean * (200 - abs(lag)) / 200 / scale, abs=1e-12)


def test_white_signals_have_the_textbook_band():
    rng = np.random.default_rng(2)
    result = cross_correlation(rng.standard_normal(4000), rng.standard_normal(4000), lags=5)
    np.testing.assert_allclose(result.band, 2.58 / np.sqrt(4000), rtol=0.1)


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_bands_hold_99_percent_at_each_lag(missing):
    rng = np.random.default_rng(3)
    white, coloured = [], []
    for _ in range(400):
        mask = rng.random(600) >= missing
        auto = autocorrelation(rng.standard_normal(600), mask=mask, lags=10)
        white.append(np.abs(auto.values[1:]) > auto.band[1:])
        cross = cross_correlation(
            autoregressive(rng, 600, 0.8), autoregressive(rng, 600, 0.9), mask=mask, lags=10
        )
        coloured.append(np.abs(cross.values) > cross.band)
    assert 0.004 < np.mean(white) < 0.016
    # A band 2.58/√N would be left at 30 % of the lags here; neighbours are alike, hence the wide margin.
    assert 0.002 < np.mean(coloured) < 0.035


def test_a_lag_without_pairs_is_none_in_the_dictionary():
    every_second = np.arange(60) % 2 == 0
    result = autocorrelation(np.random.default_rng(0).standard_normal(60), mask=every_second, lags=3)
    stored = result.to_dict()
    assert [value is None for value in stored["values"]] == [False, True, False, True]
    assert [value is None for value in stored["band"]] == [False, True, False, True]
    json.dumps(stored, allow_nan=False)


def test_results_cannot_be_changed_and_inputs_are_not():
    residual = np.array([1.0, 3.0, 1.0, 4.0])
    result = autocorrelation(residual, lags=2)
    with pytest.raises(ValueError, match="read-only"):
        result.values[0] = 2.0
    np.testing.assert_array_equal(residual, [1.0, 3.0, 1.0, 4.0])


@pytest.mark.parametrize(
    ("result", "why"),
    [
        (autocorrelation(np.full(40, 0.1)), "the residual is constant: it has no correlation"),
        (autocorrelation(np.zeros(40)), "the residual is constant: it has no correlation"),
        (autocorrelation([1.0, 2.0, 4.0], lags=3), "only 3 valid samples for 3 lags"),
        (
            cross_correlation(np.arange(40.0), np.full(40, 57.3)),
            "the drive is constant: nothing can be told from a correlation with it",
        ),
        (
            cross_correlation(np.full(40, 0.1), np.arange(40.0)),
            "the residual is constant: it has no correlation",
        ),
        (cross_correlation(np.arange(9.0), np.arange(9.0), lags=9), "only 9 valid samples for 9 lags"),
    ],
)
def test_what_has_no_correlation_says_why(result, why):
    assert (result.values, result.band, result.why) == (None, None, why)
    assert result.to_dict()["values"] is None
    json.dumps(result.to_dict(), allow_nan=False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"residual": np.ones(3), "drive": np.ones(4)},
            "the drive does not fit the residual; seen: drive (4,), residual (3,); allowed: equal lengths; "
            "do: give the drive at the residual's times",
        ),
        (
            {"residual": np.ones(3), "drive": [1.0, NAN, 2.0]},
            "the drive is not finite; seen: 1 of 3 samples; allowed: a complete drive; "
            "do: fill the gaps of the inputs before the fit",
        ),
        (
            {"residual": np.full(3, NAN), "drive": np.ones(3)},
            "the residual has no valid sample; seen: 0 of 3; allowed: at least 1 in every output; "
            "do: look at the mask, or leave this output out",
        ),
        (
            {"residual": [1.0, np.inf], "drive": np.ones(2)},
            "the residual has valid samples that are not finite; seen: 1 of 2; "
            "do: mask them, or find out why the model or the data gives them",
        ),
        (
            {"residual": np.ones((3, 2)), "drive": np.ones(3)},
            "the residual must be one signal; seen: shape (3, 2); allowed: shape (N,), N >= 1",
        ),
        (
            {"residual": np.ones(3), "drive": np.ones(3), "lags": 0},
            "the number of lags does not fit; seen: 0; allowed: a whole number >= 1; "
            "do: leave it out for as many as the record's length asks for",
        ),
        (
            {"residual": np.ones(3), "drive": np.ones(3), "lags": 2.5},
            "the number of lags does not fit; seen: 2.5; allowed: a whole number >= 1; "
            "do: leave it out for as many as the record's length asks for",
        ),
    ],
)
def test_unusable_input_is_named(arguments, message):
    with pytest.raises(ExperimentError) as caught:
        cross_correlation(**arguments)
    assert str(caught.value) == message


def test_lagged_products_beyond_the_record_are_zero():
    a = np.array([1.0, 2.0])
    np.testing.assert_allclose(
        lagged_products(a, a, np.array([-5, -1, 0, 1, 2])), [0, 2, 5, 2, 0], atol=1e-12
    )

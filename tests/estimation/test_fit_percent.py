"""Fit percentage, rms and largest error: hand examples, gaps, and the messages of unusable input."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.errors import ExperimentError
from casadi_engine.estimation.fit_percent import fit_measures, fit_percent

NAN = float("nan")


def test_hand_example():
    # errors 0, 0, 2, 0: rms 1; the measurement 0, 2, 4, 2 deviates by 2, 0, 2, 0 from its mean: rms √2
    result = fit_measures([0.0, 2.0, 4.0, 2.0], [0.0, 2.0, 2.0, 2.0])
    assert result.fit_percent == pytest.approx(100 * (1 - 1 / np.sqrt(2)))
    assert (result.rmse, result.S2, result.S1) == (1.0, 1.0, 2.0)
    assert result.samples == 4
    assert result.why is None


def test_a_perfect_prediction_is_100_and_the_mean_is_0():
    measured = np.array([1.0, 5.0, 3.0])
    assert fit_percent(measured, measured) == 100.0
    assert fit_percent(measured, np.full(3, 3.0)) == pytest.approx(0.0)


def test_worse_than_the_mean_is_negative():
    assert fit_percent([0.0, 1.0], [1.0, 0.0]) == pytest.approx(-100.0)


def test_each_output_has_its_own_number():
    measured = np.array([[0.0, 10.0], [2.0, 30.0]])
    predicted = np.array([[0.0, 20.0], [2.0, 20.0]])
    np.testing.assert_allclose(fit_percent(measured, predicted), [100.0, 0.0])


@pytest.mark.parametrize("gap", [NAN, 1e9])
def test_masked_samples_do_not_count(gap):
    mask = np.array([True, False, True, True])
    whole = fit_measures([0.0, 2.0, 1.0], [0.5, 2.0, 1.0])
    assert fit_measures([0.0, gap, 2.0, 1.0], [0.5, NAN, 2.0, 1.0], mask=mask) == whole


def test_nan_means_missing_without_a_mask_per_output():
    measured = np.array([[0.0, 1.0], [NAN, 2.0], [2.0, NAN]])
    predicted = np.array([[0.0, 1.0], [7.0, 2.0], [2.0, 9.0]])
    np.testing.assert_allclose(fit_percent(measured, predicted), [100.0, 100.0])


def test_one_mask_serves_all_outputs():
    measured = np.array([[0.0, 1.0], [5.0, 5.0], [2.0, 3.0]])
    predicted = measured + np.array([[0.0], [100.0], [0.0]])
    mask = np.array([True, False, True])
    np.testing.assert_allclose(fit_percent(measured, predicted, mask=mask), [100.0, 100.0])


def test_a_constant_output_has_no_percentage_but_errors():
    result = fit_measures([4.0, 4.0], [4.0, 5.0])
    assert result.fit_percent is None
    assert result.why == "the measured output is constant: (2.32) divides by its variation"
    assert (result.S1, result.rmse) == (1.0, pytest.approx(np.sqrt(0.5)))
    json.dumps(result.to_dict(), allow_nan=False)


def test_to_dict_is_plain():
    assert fit_measures([0.0, 2.0], [0.0, 2.0]).to_dict() == {
        "fit_percent": 100.0,
        "rmse": 0.0,
        "S1": 0.0,
        "S2": 0.0,
        "samples": 2,
        "why": None,
    }


def test_inputs_are_not_changed():
    measured, predicted = np.array([0.0, NAN, 2.0]), np.array([1.0, 2.0, 3.0])
    copies = measured.copy(), predicted.copy()
    fit_measures(measured, predicted)
    np.testing.assert_array_equal(measured, copies[0])
    np.testing.assert_array_equal(predicted, copies[1])


@settings(max_examples=50, deadline=None)
@given(
    scale=st.floats(1e-3, 1e3),
    shift=st.floats(-1e3, 1e3),
    seed=st.integers(0, 1000),
)
def test_the_percentage_does_not_depend_on_unit_or_origin(scale, shift, seed):
    measured, predicted = np.random.default_rng(seed).standard_normal((2, 50))
    assert fit_percent(scale * measured + shift, scale * predicted + shift) == pytest.approx(
        fit_percent(measured, predicted), abs=1e-6
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"measured": [1.0, 2.0], "predicted": [1.0]},
            "the prediction does not fit the measurement; seen: measured (2,), predicted (1,); "
            "allowed: equal shapes",
        ),
        (
            {"measured": [1.0, 2.0], "predicted": [1.0, NAN]},
            "the predicted output is not finite; seen: 1 of 2 valid samples; "
            "do: the simulation diverged: look at the parameters and the step",
        ),
        (
            {"measured": [NAN, NAN], "predicted": [1.0, 2.0]},
            "the measured output has no valid sample; seen: 0 of 2; allowed: at least 1 in every output; "
            "do: look at the mask, or leave this output out",
        ),
        (
            {"measured": [1.0, NAN], "predicted": [1.0, 2.0], "mask": np.array([True, True])},
            "the measured output has valid samples that are not finite; seen: 1 of 2; "
            "do: mask them, or find out why the model or the data gives them",
        ),
        (
            {"measured": [1.0, 2.0], "predicted": [1.0, 2.0], "mask": [1, 0]},
            "the mask of the measured output must be boolean; seen: int64; allowed: bool",
        ),
        (
            {"measured": [1.0, 2.0], "predicted": [1.0, 2.0], "mask": np.array([True])},
            "the mask does not fit the measured output; seen: mask (1,), the measured output (2,); "
            "allowed: one flag per sample",
        ),
    ],
)
@pytest.mark.parametrize("function", [fit_percent, fit_measures])
def test_unusable_input_is_named(function, arguments, message):
    with pytest.raises(ExperimentError) as caught:
        function(**arguments)
    assert str(caught.value) == message


def test_fit_percent_of_a_constant_output_is_an_error():
    with pytest.raises(ExperimentError) as caught:
        fit_percent([[1.0, 4.0], [2.0, 4.0]], [[1.0, 4.0], [2.0, 4.0]])
    assert str(caught.value) == (
        "the fit percentage of a constant output does not exist; seen: output 1 does not vary; "
        "allowed: a measured output that varies; do: use the rms error (fit_measures) for this output"
    )


def test_shapes_that_are_not_outputs():
    with pytest.raises(ExperimentError) as caught:
        fit_percent(np.zeros((2, 2, 2)), np.zeros((2, 2, 2)))
    assert str(caught.value) == (
        "the measured output must be samples by outputs; seen: shape (2, 2, 2); allowed: (N,) or (N, ny)"
    )
    with pytest.raises(ExperimentError) as caught:
        fit_measures(np.zeros((2, 2)), np.zeros((2, 2)))
    assert str(caught.value) == (
        "the measured output must be one signal; seen: shape (2, 2); allowed: shape (N,), N >= 1"
    )

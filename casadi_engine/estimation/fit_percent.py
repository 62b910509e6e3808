"""How far a prediction lies from the measurement: fit percentage, rms and largest error."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_engine.errors import ExperimentError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# A signal whose span is below this share of its size varies by rounding only.
CONSTANT = 1e-12


@dataclass(frozen=True)
class FitMeasures:
    """Distance between one measured and one predicted output.

    fit_percent : F of (2.32); None when the measurement does not vary (see ``why``)
    rmse, S2 : root of the mean square error, in the output's unit (the same number under two names)
    S1 : largest absolute error, in the output's unit, (2.34)
    samples : number of valid samples used
    """

    fit_percent: float | None
    rmse: float
    S1: float
    S2: float
    samples: int
    why: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for result.json (None where there is no number)."""
        return asdict(self)


def valid_samples(values: FloatArray, mask: ArrayLike | None, what: str) -> BoolArray:
    """Return which samples count, for every array of this package that may have gaps.

    Without a mask a NaN means a missing sample; with one, a NaN that it calls valid is an error, because
    then somebody said that the number exists.

    Raises
    ------
    ExperimentError : wrong mask shape, a valid sample that is not finite, or no valid sample at all
    """
    if mask is None:
        valid = ~np.isnan(values)
    else:
        given = np.asarray(mask)
        if given.dtype != np.bool_:
            raise ExperimentError(
                f"the mask of {what} must be boolean", seen=str(given.dtype), allowed="bool"
            )
        if given.shape not in (values.shape, values.shape[:1]):
            raise ExperimentError(
                f"the mask does not fit {what}",
                seen=f"mask {given.shape}, {what} {values.shape}",
                allowed="one flag per sample",
            )
        valid = np.broadcast_to(given.reshape(given.shape + (1,) * (values.ndim - given.ndim)), values.shape)
    broken = int(np.count_nonzero(~np.isfinite(values) & valid))
    if broken:
        raise ExperimentError(
            f"{what} has valid samples that are not finite",
            seen=f"{broken} of {values.size}",
            cure="mask them, or find out why the model or the data gives them",
        )
    if not valid.any(axis=0).all():
        raise ExperimentError(
            f"{what} has no valid sample",
            seen=f"0 of {values.shape[0]}",
            allowed="at least 1 in every output",
            cure="look at the mask, or leave this output out",
        )
    return np.asarray(valid, dtype=np.bool_)


def as_samples(values: ArrayLike, what: str) -> FloatArray:
    """Return one signal as (N,) floats; raises ExperimentError for any other shape."""
    array = np.asarray(values, dtype=float)
    if array.ndim != 1 or array.size == 0:
        raise ExperimentError(
            f"{what} must be one signal", seen=f"shape {array.shape}", allowed="shape (N,), N >= 1"
        )
    return array


def fit_measures(measured: ArrayLike, predicted: ArrayLike, *, mask: ArrayLike | None = None) -> FitMeasures:
    """Return fit percentage (2.32), rms error and largest error (2.34) of one output.

    Parameters
    ----------
    measured : (N,) measured output; NaN means missing when no mask is given
    predicted : (N,) simulated or predicted output, same unit. Which of the two decides what F means: a
        one-step prediction scores near 100 with a poor model, so a report must name it
    mask : (N,) bool, True marks a valid sample

    Raises
    ------
    ExperimentError : shapes differ, no valid sample, or a value that is not finite at a valid sample

    Source: (2.32), (2.34) of the thesis.

    >>> fit_measures([0.0, 2.0, 4.0], [0.0, 2.0, 3.0]).S1
    1.0
    """
    y, prediction = as_samples(measured, "the measured output"), as_samples(predicted, "the predicted output")
    valid = _common_valid(y, prediction, mask)
    if not valid.all():
        y, prediction = y[valid], prediction[valid]
    percent, rms, largest = _measures(y, prediction)
    why = None if percent is not None else "the measured output is constant: (2.32) divides by its variation"
    return FitMeasures(percent, rms, largest, rms, int(valid.sum()), why)


def fit_percent(
    measured: ArrayLike, predicted: ArrayLike, *, mask: ArrayLike | None = None
) -> float | FloatArray:
    """Return F = 100 (1 − ‖y − ŷ‖ / ‖y − ȳ‖) for each output: 100 perfect, 0 no better than the mean.

    Parameters
    ----------
    measured, predicted : (N,) or (N, ny), same unit; NaN in ``measured`` means missing without a mask
    mask : (N,) or (N, ny) bool, True marks a valid sample

    Returns a float for (N,), an (ny,) array for (N, ny).

    Raises
    ------
    ExperimentError : shapes differ, no valid sample, a value that is not finite, or a constant measurement

    Source: (2.32) of the thesis.

    >>> fit_percent([0.0, 2.0, 4.0], [2.0, 2.0, 2.0])
    0.0
    """
    y, prediction = np.asarray(measured, dtype=float), np.asarray(predicted, dtype=float)
    if y.ndim not in (1, 2) or y.size == 0:
        raise ExperimentError(
            "the measured output must be samples by outputs",
            seen=f"shape {y.shape}",
            allowed="(N,) or (N, ny)",
        )
    valid = _common_valid(y, prediction, mask)
    columns = [
        _measures(a[keep], b[keep])[0]
        for a, b, keep in zip(
            np.atleast_2d(y.T), np.atleast_2d(prediction.T), np.atleast_2d(valid.T), strict=True
        )
    ]
    percents = [value for value in columns if value is not None]
    if len(percents) < len(columns):
        raise ExperimentError(
            "the fit percentage of a constant output does not exist",
            seen=f"output {columns.index(None)} does not vary",
            allowed="a measured output that varies",
            cure="use the rms error (fit_measures) for this output",
        )
    return percents[0] if y.ndim == 1 else np.array(percents)


def _common_valid(measured: FloatArray, predicted: FloatArray, mask: ArrayLike | None) -> BoolArray:
    """Return the valid samples of the measurement; the prediction must be finite at each of them."""
    if measured.shape != predicted.shape:
        raise ExperimentError(
            "the prediction does not fit the measurement",
            seen=f"measured {measured.shape}, predicted {predicted.shape}",
            allowed="equal shapes",
        )
    valid = valid_samples(measured, mask, "the measured output")
    broken = int(np.count_nonzero(~np.isfinite(predicted) & valid))
    if broken:
        raise ExperimentError(
            "the predicted output is not finite",
            seen=f"{broken} of {int(valid.sum())} valid samples",
            cure="the simulation diverged: look at the parameters and the step",
        )
    return valid


def _measures(measured: FloatArray, predicted: FloatArray) -> tuple[float | None, float, float]:
    """Return F (None for a constant measurement), rms and largest error of gap-free samples."""
    error = np.abs(measured - predicted)
    rms = float(np.sqrt(np.mean(error**2)))
    if np.ptp(measured) <= CONSTANT * np.max(np.abs(measured)):
        return None, rms, float(error.max())
    spread = float(np.std(measured))
    return 100.0 * (1.0 - rms / spread), rms, float(error.max())

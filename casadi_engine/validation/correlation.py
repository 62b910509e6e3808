"""Correlation functions of residuals with 99 % bands, for the eye; the verdict is in residual_tests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from casadi_engine.errors import ExperimentError
from casadi_engine.estimation.fit_percent import CONSTANT, BoolArray, FloatArray, as_samples, valid_samples

IntArray = NDArray[np.int_]

# Two-sided 99 % point of the normal distribution, rounded as in the thesis.
NORMAL_99 = 2.58

CONSTANT_DRIVE = "the drive is constant: nothing can be told from a correlation with it"


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlation coefficients over lags, and the band in which 99 % of them lie when there is nothing.

    lags : (K,) int, in samples; a positive lag correlates the residual with the *past* of the other signal
    values : (K,) in [−1, 1] up to sampling error, NaN where no pair of samples exists; None if not computable
    band : (K,) half width of the 99 % band around zero, per lag (it widens where samples are missing)
    samples : number of valid residual samples
    why : why there are no values

    A band per lag fails a perfect model somewhere in most cases: use it to look, not to decide.
    """

    lags: IntArray
    values: FloatArray | None
    band: FloatArray | None
    samples: int
    why: str | None = None

    def __post_init__(self) -> None:
        for array in (self.lags, self.values, self.band):
            if array is not None:
                array.setflags(write=False)

    def to_dict(self) -> dict[str, Any]:
        """Return lists for result.json: None in place of a value that does not exist."""
        return {
            "lags": [int(lag) for lag in self.lags],
            "values": None if self.values is None else _finite(self.values),
            "band": None if self.band is None else _finite(self.band),
            "samples": self.samples,
            "why": self.why,
        }


def autocorrelation(residual: ArrayLike, *, mask: ArrayLike | None = None, lags: int = 25) -> Correlation:
    """Return R_e(k)/R_e(0), k = 0..lags, of one residual with its mean removed, and the band 2.58/√N.

    Parameters
    ----------
    residual : (N,) y − ŷ; NaN means missing when no mask is given
    mask : (N,) bool, True marks a valid sample; only pairs of valid samples are used
    lags : largest lag in samples (25 in the thesis)

    Raises
    ------
    ExperimentError : not (N,), mask misfit, no valid sample, or ``lags`` not a positive whole number

    Source: (2.36) of the thesis.

    >>> autocorrelation([1.0, -1.0, 1.0, -1.0], lags=2).values.round(12)
    array([ 1.  , -0.75,  0.5 ])
    """
    check_lags(lags)
    e, valid = centred(as_samples(residual, "the residual"), mask)
    steps, n = np.arange(lags + 1), int(valid.sum())
    why = _why_not(e, valid, lags)
    if why is not None:
        return Correlation(steps, None, None, n, why)
    pairs = np.rint(lagged_products(valid.astype(float), valid.astype(float), steps))
    weight = _pair_weight(pairs, steps, e.size)
    values = weight * lagged_products(e, e, steps) / (e @ e / n)
    return Correlation(steps, values, NORMAL_99 * weight * np.sqrt(_complete_pairs(pairs, steps, e.size)), n)


def cross_correlation(
    residual: ArrayLike, drive: ArrayLike, *, mask: ArrayLike | None = None, lags: int = 30
) -> Correlation:
    """Return R_eu(τ)/√(R_e(0) R_u(0)), τ = −lags..lags, means removed, with the band for coloured signals.

    The band is 2.58 √(Σ_k R_e(k) R_u(k) / N): a slow drive meets a slow residual with fewer independent
    samples than N. The sum is tapered (Bartlett, 2 lags + 1 terms), which keeps it positive.

    Parameters
    ----------
    residual : (N,) y − ŷ; NaN means missing when no mask is given
    drive : (N,) the drive at the residual's times, complete
    mask : (N,) bool, True marks a valid residual sample
    lags : largest lag in samples, both ways (30 in the thesis: 61 lags for each of two inputs)

    A constant drive, or a constant residual, gives no values and a ``why``.

    Raises
    ------
    ExperimentError : shapes, mask or ``lags`` do not fit, no valid sample, or a drive that is not finite

    Source: (2.35) of the thesis, its band from engine_model section 4.

    >>> cross_correlation([1.0, -1.0, 1.0, -1.0], [5.0, 5.0, 5.0, 5.0], lags=1).why
    'the drive is constant: nothing can be told from a correlation with it'
    """
    check_lags(lags)
    e, valid = centred(as_samples(residual, "the residual"), mask)
    u = drive_samples(drive, e.size)
    steps, n = np.arange(-lags, lags + 1), int(valid.sum())
    why = CONSTANT_DRIVE if is_constant(u) else _why_not(e, valid, lags)
    if why is not None:
        return Correlation(steps, None, None, n, why)
    u = u - u.mean()
    pairs = np.rint(lagged_products(valid.astype(float), np.ones(e.size), steps))
    weight = _pair_weight(pairs, steps, e.size)
    scale = np.sqrt((e @ e / n) * (u @ u / u.size))
    # Missing residuals are zeros in e, so these sums hold just the pairs that the variance is made of.
    window = np.arange(-2 * lags, 2 * lags + 1)
    taper = 1.0 - np.abs(window) / (2 * lags + 1)
    products = lagged_products(e, e, window) * lagged_products(u, u, window) / u.size
    deviation = np.sqrt(max(float(taper @ products), 0.0))
    values = weight * lagged_products(e, u, steps) / scale
    return Correlation(steps, values, NORMAL_99 * weight * deviation / scale, n)


def check_lags(lags: int) -> None:
    """Raise ExperimentError unless ``lags`` is a whole number of at least 1."""
    if isinstance(lags, bool) or not isinstance(lags, int | np.integer) or lags < 1:
        raise ExperimentError(
            "the number of lags does not fit",
            seen=lags,
            allowed="a whole number >= 1",
            cure="leave it out for as many as the record's length asks for",
        )


def centred(residual: FloatArray, mask: ArrayLike | None) -> tuple[FloatArray, BoolArray]:
    """Return the residual with its mean removed and zeros at missing samples, and the valid samples."""
    valid = valid_samples(residual, mask, "the residual")
    present = residual[valid]
    if is_constant(present):
        return np.zeros(residual.size), valid
    return np.where(valid, residual - present.mean(), 0.0), valid


def drive_samples(drive: ArrayLike, size: int) -> FloatArray:
    """Return a drive as (N,) floats; it is an input, so it must be complete.

    Raises
    ------
    ExperimentError : another length than the residual, or a value that is not finite
    """
    u = as_samples(drive, "the drive")
    if u.size != size:
        raise ExperimentError(
            "the drive does not fit the residual",
            seen=f"drive ({u.size},), residual ({size},)",
            allowed="equal lengths",
            cure="give the drive at the residual's times",
        )
    broken = int(np.count_nonzero(~np.isfinite(u)))
    if broken:
        raise ExperimentError(
            "the drive is not finite",
            seen=f"{broken} of {size} samples",
            allowed="a complete drive",
            cure="fill the gaps of the inputs before the fit",
        )
    return u


def is_constant(signal: FloatArray) -> bool:
    """Return whether a signal varies by rounding only."""
    return bool(np.ptp(signal) <= CONSTANT * np.max(np.abs(signal)))


def lagged_products(a: FloatArray, b: FloatArray, steps: IntArray) -> FloatArray:
    """Return Σ_t a(t) b(t − k) for each k of ``steps`` (either sign; signals are zero outside) by FFT."""
    reach = int(np.max(np.abs(steps)))
    length = fft.next_fast_len(a.size + min(reach, a.size), real=True)
    spectrum = fft.rfft(a, length) * np.conj(fft.rfft(b, length))
    inside = np.abs(steps) < a.size
    return np.where(inside, fft.irfft(spectrum, length)[np.where(inside, steps, 0)], 0.0)


def _pair_weight(pairs: FloatArray, steps: IntArray, size: int) -> FloatArray:
    """Return the factor from a sum over pairs to R(k): 1/N when complete, as in (2.35) and (2.36).

    With gaps the mean over the pairs stands for the missing ones; NaN where there is no pair.
    """
    share = np.maximum(size - np.abs(steps), 0) / size
    return np.divide(share, pairs, out=np.full(pairs.shape, np.nan), where=pairs > 0)


def _complete_pairs(pairs: FloatArray, steps: IntArray, size: int) -> FloatArray:
    """Return the pairs there would be without the loss at the ends (then the band is flat, 2.58/√N)."""
    return pairs * size / np.maximum(size - np.abs(steps), 1)


def _why_not(e: FloatArray, valid: BoolArray, lags: int) -> str | None:
    """Return why a correlation function cannot be made of this centred residual, None if it can."""
    n = int(valid.sum())
    if n <= lags:
        return f"only {n} valid samples for {lags} lags"
    if not e.any():
        return "the residual is constant: it has no correlation"
    return None


def _finite(values: FloatArray) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]

"""Coloured noise that several outputs of a record have in common, as what pushes a machine moves all its sensors.

The covariance of estimates counts with that of all residuals together: J'VJ = sum over pairs of outputs J_i' V_ij J_j.
V is that of a vector autoregression of the residuals (Lütkepohl, New Introduction to Multiple Time Series Analysis,
2005), taken in the frequency domain. As in an autoregression of one output, what estimates took out of the residuals is
put back by the columns that stand for it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from casadi_engine.estimation.autoregression import LARGEST_ORDER

Array = NDArray[np.float64]

# Rows to a coefficient of the largest order that is tried, and the share of the samples that it leaves.
_ROWS, _LEFT = 10, 0.25


def common_scatter(
    noises: Sequence[Array], valid: NDArray[np.bool_], slopes: Sequence[Array]
) -> Array | None:
    """J'VJ (k, k) of outputs whose noise is one vector autoregression; None where there are too few rows for one.

    noises : (n, 1 + q) of each output, its residual and columns that stand for what the estimates took, the same for
        all; 0 where not valid
    valid : (n,) where all of them count; slopes : (n, k) of each output
    """
    made = vector_autoregression(np.stack(noises), valid)
    if made is None:
        return None
    coefficients, innovations = made
    length = 1 << int(2 * len(valid) - 1).bit_length()
    spectrum = _spectrum(coefficients, innovations, length)
    weight = np.full(len(spectrum), 2.0)
    weight[[0, -1]] = 1.0
    power = np.einsum("f,fii->i", weight, spectrum.real) / length
    wanted = np.array([float((one**2).sum()) for one in noises]) / np.count_nonzero(valid)
    size = np.sqrt(wanted / np.maximum(power, 1e-300))
    spectrum = spectrum * np.outer(size, size)
    waves = [np.fft.rfft(one, length, axis=0) for one in slopes]
    found = np.zeros((slopes[0].shape[1],) * 2)
    for i, first in enumerate(waves):
        for j, second in enumerate(waves):
            heard = (weight * spectrum[:, i, j])[:, None] * second
            found += (first.conj().T @ heard).real
    return found / length


def vector_autoregression(noise: Array, valid: NDArray[np.bool_]) -> tuple[Array, Array] | None:
    """Coefficients (p, m, m) and covariance (m, m) of the innovations of noise (m, n, 1 + q), e(t) = sum A_l e(t - l),
    the order by Akaike's criterion; None without rows enough for an order of 1."""
    outputs = len(noise)
    index = np.arange(len(valid))
    run = index - np.maximum.accumulate(np.where(valid, -1, index))
    orders = np.arange(LARGEST_ORDER + 1)
    rows = np.array([np.count_nonzero(run > order) for order in orders])
    able = rows >= np.maximum(_ROWS * outputs * (orders + 1), _LEFT * np.count_nonzero(valid))
    largest = int(np.flatnonzero(able).max(initial=0))
    if not largest:
        return None
    now = np.flatnonzero(run > largest)
    # (rows, outputs (largest + 1)) of e(t), e(t - 1) ... for every column
    products = np.zeros((outputs * (largest + 1),) * 2)
    for column in range(noise.shape[2]):
        windows = sliding_window_view(noise[:, :, column], largest + 1, axis=1)[:, now - largest, ::-1]
        own = windows.transpose(1, 2, 0).reshape(len(now), -1)
        products += own.T @ own
    products[np.diag_indices(len(products))] += (
        1e-12 * np.trace(products) / len(products) + np.finfo(float).tiny
    )
    found = []
    for order in range(1, largest + 1):
        past = slice(outputs, outputs * (order + 1))
        told = np.linalg.solve(products[past, past], products[past, :outputs])
        left = products[:outputs, :outputs] - products[:outputs, past] @ told
        sign, log = np.linalg.slogdet(left / len(now))
        found.append(
            (len(now) * log + 2.0 * outputs**2 * order if sign > 0 else np.inf, told, left / len(now))
        )
    _, told, left = min(found, key=lambda one: one[0])
    coefficients = np.asarray(told.reshape(-1, outputs, outputs).transpose(0, 2, 1), dtype=float)
    return _lasting(coefficients, len(valid)), left


def _lasting(coefficients: Array, samples: int) -> Array:
    """The same with a memory of no more than the record: least squares may find one that grows."""
    order, outputs, _ = coefficients.shape
    companion = np.zeros((order * outputs,) * 2)
    companion[:outputs] = coefficients.transpose(1, 0, 2).reshape(outputs, -1)
    companion[outputs:, :-outputs] = np.eye(outputs * (order - 1))
    largest, limit = float(np.abs(np.linalg.eigvals(companion)).max(initial=0.0)), 1 - 1 / samples
    if largest <= limit:
        return coefficients
    return np.asarray(coefficients * ((limit / largest) ** np.arange(1, order + 1))[:, None, None])


def _spectrum(coefficients: Array, innovations: Array, length: int) -> NDArray[np.complex128]:
    """(f, m, m) of noise at the frequencies of a real transform of so many samples."""
    padded = np.concatenate([np.eye(len(innovations))[None], -coefficients])
    inverse = np.linalg.inv(np.fft.rfft(padded, length, axis=0))
    return np.asarray(inverse @ innovations @ inverse.conj().transpose(0, 2, 1))
